"""`ds.hpgr` of any Dataset of this package, once this is imported: units of a plant, table and figure of a sweep."""

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from hpgr.fields import parse, unit_shown

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
        from studies.show import report

        return report.table(self._dataset, parse(sieve, "m"))

    def plot(self, sieve: str = "1 mm") -> "Figure":
        """Return the figure of a sweep, as its command draws it."""
        from studies.show import report

        field = self._dataset.attrs["axes"].partition(",")[0]
        return picture(self._dataset, field, parse(sieve, "m"), "\n".join(report.change(self._dataset, field)))


def picture(result: xr.Dataset, field: str, sieve: float, words: str) -> "Figure":
    """Return the figure of a sweep along a field: maps over two axes, else curves."""
    from studies.show.plots import maps, sweeps

    if maps.is_map(result):
        return maps.maps_figure(result, sieve, words)
    return sweeps.sweep_figure(result, field, sieve, words)
