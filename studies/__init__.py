"""Parametric studies: scenes fanned out over dask, summaries in NetCDF, figures.

`studies.open_cases(folder)` opens the cases that a sweep has recorded whole, `studies.optimise(scene, ...)` looks for
the best operating point, `studies.close_circuit(scene, ...)` returns what is too coarse to the feed. They load on first
use: a study's `--help` needs no xarray.
"""

from importlib import import_module
from typing import Any

_HOMES = {"open_cases": "sweep.assemble", "optimise": "optimum", "close_circuit": "circuit"}
__all__ = sorted(_HOMES)


class Late:
    """A module that is loaded when something of it is first asked for, after the command line is read."""

    def __init__(self, name: str):
        self._module = name

    def __getattr__(self, name: str) -> Any:
        return getattr(import_module(self._module), name)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'studies' has no attribute {name!r}")
    return getattr(import_module(f"studies.{_HOMES[name]}"), name)
