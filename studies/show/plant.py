"""`ds.hpgr` of any Dataset of this package, once this is imported: units of a plant, table and figure of a sweep."""

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from hpgr.fields import unit_shown
from studies.command import si_value
from studies.show import report

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_UNITS = {"Pa": ("N/mm^2", 1e-6), "specific_throughput": ("t s h-1 m-3", 3.6)}


@xr.register_dataset_accessor("hpgr")
class Plant:
    """What an engineer reads of a Dataset of this package."""

    def __init__(self, dataset: xr.Dataset):
        self._dataset = dataset

    def plant_units(self) -> xr.Dataset:
        """Return the Dataset in mm, t/h, kW, kWh/t, N/mm^2, rpm and degrees; every variable says its unit.

        Examples
        --------
        >>> import hpgr
        >>> import studies.show.plant
        >>> result = hpgr.simulate(hpgr.presets.paper().with_values({"resolution": "draft"}))
        >>> result.hpgr.plant_units()["p80_total"].attrs["units"]
        'mm'
        """
        found = self._dataset.copy()
        for name, variable in self._dataset.variables.items():
            unit = variable.attrs.get("units", "1")
            shown, factor = _UNITS.get(name) or _UNITS.get(unit) or unit_shown(unit)
            if shown != unit:
                values = variable.data * factor
                if name in found.coords:  # `sel(roll_speed=16)` finds 16 rpm
                    values = np.round(values, 9)
                found[name] = xr.Variable(variable.dims, values, variable.attrs | {"units": shown})
        return found

    def table(self, sieve: str = "1 mm") -> str:
        """Return the table of a sweep, a line for each operating point, as its command prints it."""
        return report.table(self._sweep(), si_value("sieve", sieve, "m"))

    def plot(self, sieve: str = "1 mm") -> "Figure":
        """Return the figure of a sweep, as its command draws it."""
        result, size = self._sweep(), si_value("sieve", sieve, "m")
        field = result.attrs["axes"].partition(",")[0]
        if not field:
            raise ValueError("dataset: got a sweep of no axis; must have one to be drawn; such as {'gap': ['40 mm']}")
        return picture(result, field, size, "\n".join(report.change(result, field)))

    def _sweep(self) -> xr.Dataset:
        found = self._dataset
        if "axes" not in found.attrs or found["throughput"].attrs["units"] != "kg s-1":
            raise ValueError("dataset: got no sweep in SI units; must be one; such as sweep(scene, {'gap': ['40 mm']})")
        return found


def picture(result: xr.Dataset, field: str, sieve: float, words: str) -> "Figure":
    """Return the figure of a sweep along a field: maps over two axes, else curves."""
    from studies.show.plots import maps, sweeps

    if maps.is_map(result):
        return maps.maps_figure(result, sieve, words)
    return sweeps.sweep_figure(result, field, sieve, words)
