"""Parametric studies: scenes fanned out over dask, summaries in NetCDF, figures.

`studies.open_cases(folder)` opens the cases that a sweep has recorded whole. It loads on first use: a study's `--help`
needs no xarray.
"""

from typing import Any

__all__ = ["open_cases"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'studies' has no attribute {name!r}")
    from studies.sweep.assemble import open_cases

    return open_cases
