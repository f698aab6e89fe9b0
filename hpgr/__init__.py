"""Comminution in high pressure grinding rolls: the heterarchical model, as labelled Datasets.

Names load on first use: a study's `--help` needs neither the compiler nor xarray.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hpgr import presets
    from hpgr.bed.machine import operating_gap
    from hpgr.calibration import calibrate
    from hpgr.laws.exchange import Exchange
    from hpgr.results.metrics import passing, peak_pressure, percentile_size, reduction_ratio, throughput
    from hpgr.run import simulate
    from hpgr.scene import Bed, Resolution, Rolls, Scene

    __version__: str

_HOMES = {
    "scene": ("Bed", "Resolution", "Rolls", "Scene"),
    "laws.exchange": ("Exchange",),
    "run": ("simulate",),
    "results.metrics": ("passing", "peak_pressure", "percentile_size", "reduction_ratio", "throughput"),
    "bed.machine": ("operating_gap",),
    "calibration": ("calibrate",),
}

__all__ = [
    "Bed",
    "Exchange",
    "Resolution",
    "Rolls",
    "Scene",
    "calibrate",
    "operating_gap",
    "passing",
    "peak_pressure",
    "percentile_size",
    "presets",
    "reduction_ratio",
    "simulate",
    "throughput",
]


if not TYPE_CHECKING:  # or a type checker would take every name for an existing one

    def __getattr__(name: str) -> Any:
        if name == "presets":
            return import_module("hpgr.presets")
        if name == "__version__":  # asking takes 15 ms
            value = import_module("importlib.metadata").version("hpgr")
        else:
            home = next((module for module, names in _HOMES.items() if name in names), None)
            if home is None:
                raise AttributeError(f"module 'hpgr' has no attribute {name!r}")
            value = getattr(import_module(f"hpgr.{home}"), name)
        globals()[name] = value
        return value

    def __dir__() -> list[str]:
        return sorted(__all__)
