"""Parametric studies: scenes fanned out over dask, summaries in NetCDF, figures."""
