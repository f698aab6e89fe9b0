"""Comminution in high pressure grinding rolls: the heterarchical model, as labelled Datasets.

Names load on first use: a study's `--help` needs neither the compiler nor xarray.
"""

from importlib import import_module
from importlib.metadata import version
from typing import Any

__version__ = version("hpgr")

_HOMES = {
    "Scene": "scene",
    "Rolls": "scene",
    "Material": "scene",
    "Feed": "scene",
    "Flow": "scene",
    "Stress": "scene",
    "Exchange": "scene",
    "Resolution": "scene",
    "simulate": "run",
    "passing": "metrics",
    "percentile_size": "metrics",
    "throughput": "metrics",
    "peak_pressure": "metrics",
    "reduction_ratio": "metrics",
    "operating_gap": "machine",
    "calibrate": "calibration",
}

__all__ = [*_HOMES, "presets"]


def __getattr__(name: str) -> Any:
    if name == "presets":
        return import_module("hpgr.presets")
    if name not in _HOMES:
        raise AttributeError(f"module 'hpgr' has no attribute {name!r}")
    value = getattr(import_module(f"hpgr.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
