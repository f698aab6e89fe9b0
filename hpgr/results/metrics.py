"""Size distributions, percentiles, throughput, pressure and reduction of a Dataset, as free functions.

Each returns a DataArray with a `streamline` dimension, or, with `total=True`, the figure of the whole gap.
All stream tubes carry equal mass, so the whole gap is their plain mean (model page, section 4).
"""

import json
import numbers

import numpy as np
import xarray as xr

from hpgr.fields import check_number, parse
from hpgr.results.schema import Variable
from hpgr.scene import Scene

_MOST_SCENE = 1_000_000  # characters of a scene as JSON


def passing(dataset: xr.Dataset, sieves=None, point: int = -1, total: bool = False) -> xr.DataArray:
    """Return the mass fraction passing `sieves` at a material point, snapshots of the steady machine pooled.

    Parameters
    ----------
    dataset : xarray.Dataset
        From `hpgr.simulate` or a study.
    sieves : array_like, optional
        Sizes in m, or texts with a unit; default the recorded sieves. Of recorded cells those are counted that pass;
        otherwise sizes between sieves are interpolated linearly in log size. The product at the default sieves is
        corrected by a control variate (`resolution.control_variate`), cells that are counted are not.
    point : int
        Material point; the default is the exit. Others need recorded cells or distributions.
    total : bool
        Whether to combine the streamlines.

    Returns
    -------
    xarray.DataArray
        Dims (..., streamline, sieve), or (..., sieve) if `total`; 1.

    Raises
    ------
    ValueError
        If the Dataset holds no sizes, or none at that point, or a sieve is outside the recorded ones.

    Examples
    --------
    >>> import hpgr
    >>> dataset = hpgr.simulate(hpgr.presets.paper())
    >>> float(hpgr.passing(dataset, ["60 mm"], total=True)[0])
    1.0
    """
    _require_sizes(dataset, point)
    wanted = dataset["sieve"].values if sieves is None else _sizes(sieves)
    if "size" in dataset and not (sieves is None and _is_exit(dataset, point)):
        as_cells = wanted.astype(np.float32)  # a grain of just a sieve's size passes it
        found = _over_cells(
            lambda row: np.searchsorted(row, as_cells, side="right") / row.size + 0 * row[-1],  # NaN of a lost case
            dataset,
            point,
            ("sieve",),
        ).assign_coords(sieve=wanted)
    else:
        found = _recorded_passing(dataset, point)
        found = found if sieves is None else between_sieves(found, wanted)
    found.attrs = Variable((), "1", "mass fraction passing").attributes()
    found = found.rename("passing")
    return found.mean("streamline", keep_attrs=True) if total else found


def percentile_size(dataset: xr.Dataset, percent: float, point: int = -1, total: bool = False) -> xr.DataArray:
    """Return the size in m that `percent` % of the mass passes at a material point, such as P80.

    Exact from recorded cells, and for P50 and P80 of any product; other percentiles without cells are
    interpolated between the recorded sieves, linearly in log size.

    Raises
    ------
    ValueError
        If `percent` is not within 0 to 100, or cannot be had from what was recorded.

    Examples
    --------
    >>> import hpgr
    >>> dataset = hpgr.simulate(hpgr.presets.paper())
    >>> bool(hpgr.percentile_size(dataset, 80, total=True) == dataset["p80_total"])
    True
    """
    _require_sizes(dataset, point)
    check_number("percent", percent)
    name = f"p{percent:g}" + ("_total" if total else "")
    if _is_exit(dataset, point) and name in dataset:
        return dataset[name]
    if "size" in dataset:
        result = _over_cells(lambda row: np.quantile(row, percent / 100), dataset, point, total=total)
    else:
        result = _percentile_between_sieves(_recorded_passing(dataset, point), percent / 100, total)
    result.attrs = Variable((), "m", f"product P{percent:g}").attributes()
    return result.rename(name)


def throughput(dataset: xr.Dataset, total: bool = False) -> xr.DataArray:
    """Return the solids through each stream tube of both half gaps, or through the whole gap, kg/s.

    Q = rho_s phi_exit s_b L U (model page, section 7), in equal parts.

    Examples
    --------
    >>> import hpgr
    >>> dataset = hpgr.simulate(hpgr.presets.paper().with_values({"resolution.cells": 0}))
    >>> round(float(hpgr.throughput(dataset, total=True)) * 3.6)  # t/h
    3075
    >>> hpgr.throughput(dataset).dims
    ('streamline',)
    """
    _require(dataset, "throughput")
    if total:
        return dataset["throughput"]
    share = dataset["throughput"] / dataset.sizes["streamline"]
    found = share * xr.ones_like(dataset["xi"])
    found.attrs = dict(dataset["throughput"].attrs, comment="solids through the stream tube and its mirror image")
    return found


def peak_pressure(dataset: xr.Dataset, total: bool = False) -> xr.Dataset:
    """Return the largest mean stress (Pa) and its height above the minimum gap (m), as a Dataset.

    Variables `peak_pressure` and `peak_pressure_height`, per streamline or of the whole bed.

    Examples
    --------
    >>> import hpgr
    >>> dataset = hpgr.simulate(hpgr.presets.paper().with_values({"resolution.cells": 0}))
    >>> round(float(hpgr.peak_pressure(dataset, total=True)["peak_pressure"]) / 1e6, 1)  # MPa
    26.5
    """
    names = ("peak_pressure", "peak_pressure_height")
    _require(dataset, *names)
    return xr.Dataset({name: dataset[name if total else f"streamline_{name}"] for name in names})


def reduction_ratio(dataset: xr.Dataset, percent: float = 80, total: bool = False) -> xr.DataArray:
    """Return feed size over product size at `percent` % passing, such as F80/P80, 1.

    The feed is that of `dataset.attrs["scene"]`.

    Raises
    ------
    ValueError
        If the Dataset is of a sweep over feeds or scenes, and holds the feed of its base scene only.

    Examples
    --------
    >>> import hpgr
    >>> dataset = hpgr.simulate(hpgr.presets.paper().with_values({"strength.cushioning": float("inf")}))
    >>> 25 < float(hpgr.reduction_ratio(dataset, 80, total=True)) < 40
    True
    """
    check_number("percent", percent)
    _require(dataset)
    fields = {name: axis.attrs.get("scene_field", "") for name, axis in dataset.coords.items() if axis.dims}
    swept = [name for name, field in fields.items() if field.startswith("feed.") or name == "scene"]
    if swept:
        raise ValueError(
            f"the Dataset sweeps {swept[0]}, but holds the feed of its base scene only; take feed.quantile of "
            "each scene over hpgr.percentile_size instead"
        )
    ratio = scene_of(dataset).feed.quantile(percent / 100) / percentile_size(dataset, percent, total=total)
    ratio.attrs = Variable((), "1", f"reduction ratio F{percent:g}/P{percent:g}").attributes()
    return ratio


def scene_of(dataset: xr.Dataset) -> Scene:
    """Return the scene in the attributes of a result that may be anybody's; no file that it names is opened.

    ValueError if there is none, or it is none.
    """
    text = dataset.attrs.get("scene")
    if not isinstance(text, str) or len(text) > _MOST_SCENE:
        raise ValueError(f"attribute scene: got none, or more than {_MOST_SCENE:,} characters; give a study's own file")
    try:
        told = json.loads(text)
        if isinstance(told["feed"].get("table"), str):
            raise ValueError("feed.table: got the name of a file; a result holds the table itself; correct the scene")
        return Scene.model_validate(told)
    except (RecursionError, TypeError, KeyError, AttributeError, json.JSONDecodeError):
        raise ValueError("attribute scene: is no scene as JSON; give a file that a study has written") from None


def _sizes(sieves) -> np.ndarray:
    given = [sieves] if isinstance(sieves, str) else np.atleast_1d(np.asarray(sieves, dtype=object)).tolist()
    try:
        found = np.array([parse(size, "m") if isinstance(size, str) else size for size in given], dtype=float)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"sieves: got {sieves!r:.80}; {error}; such as ['1 mm'], or [0.001] in m") from None
    if not (found > 0).all():
        raise ValueError(f"sieves: got {sieves!r}; must be sizes above 0 in m; such as ['1 mm'], or [0.001]")
    return found


def _require(dataset: xr.Dataset, *names: str) -> None:
    if not isinstance(dataset, xr.Dataset):
        raise TypeError(f"dataset: got {dataset!r:.80}; must be a Dataset; such as hpgr.simulate(scene)")
    missing = [name for name in names if name not in dataset]
    if missing:
        raise ValueError(
            f"dataset: has no {missing[0]!r}; must be of hpgr.simulate or a study; such as hpgr.simulate(scene)"
        )


def _require_sizes(dataset: xr.Dataset, point: int) -> None:
    _require(dataset)
    if "passing" not in dataset:
        raise ValueError("the Dataset holds no sizes: it is stress only (resolution.cells = 0); simulate it with cells")
    if dataset["sieve"].attrs.get("units", "m") != "m":  # plant units, of which a size of 1 mm would be taken for 1 m
        raise ValueError("dataset: got sieves in another unit; must be in m; such as hpgr.simulate(scene) returns them")
    if not isinstance(point, numbers.Integral) or isinstance(point, bool):
        raise ValueError(f"point: got {point!r}; must be a whole number; take -1 for the exit")
    points = dataset.sizes.get("point")
    if points is not None and not -points <= point < points:
        raise ValueError(
            f"point: got {point}; must be within {-points} to {points - 1}, entry to exit; take -1 for the exit"
        )


def _steady(recorded: xr.DataArray) -> xr.DataArray:
    """Return the snapshots that are not of the start-up, over `time`, which a file calls `snapshot`."""
    if "snapshot" in recorded.dims:
        recorded = recorded.rename(snapshot="time")
    if "steady" not in recorded.coords:
        return recorded
    return recorded.isel(time=np.flatnonzero(recorded["steady"].values))


def _is_exit(dataset: xr.Dataset, point: int) -> bool:
    return point in (-1, dataset.sizes.get("point", 0) - 1)


def _over_cells(function, dataset: xr.Dataset, point: int, new_dims=(), total: bool = False) -> xr.DataArray:
    """Apply `function` to the sorted cells of a point, snapshots pooled, for each streamline or for all."""
    pooled = ("streamline", "time", "cell") if total else ("time", "cell")
    return xr.apply_ufunc(
        lambda cells: function(np.sort(cells, axis=None)),
        _steady(dataset["size"]).isel(point=point, drop=True).compute(),  # cases may be lazy
        input_core_dims=[pooled],
        output_core_dims=[new_dims],
        vectorize=True,
    )


def _recorded_passing(dataset: xr.Dataset, point: int) -> xr.DataArray:
    if _is_exit(dataset, point):
        return dataset["passing"]
    if "mass_fraction" not in dataset:
        raise ValueError(
            f"point: got {point}; only the exit (-1) is recorded; "
            "simulate with resolution.record 'distributions' or 'cells'"
        )
    mean = _steady(dataset["mass_fraction"]).isel(point=point).mean("time")
    return mean.cumsum("sieve", skipna=False).assign_coords(sieve=dataset["sieve"])


def between_sieves(found: xr.DataArray, wanted: np.ndarray) -> xr.DataArray:
    """Return mass fractions (..., sieve) at other sizes (m), linear in log size between the recorded sieves.

    ValueError if a size lies outside the recorded sieves.
    """
    known = found["sieve"].values
    outside = wanted[(wanted < known[0]) | (wanted > known[-1])]
    if outside.size:
        raise ValueError(
            f"sieves: got {outside[0]:g} m; must lie within the recorded {known[0]:g} to {known[-1]:g} m; "
            "extend resolution.sieves, or record 'cells'"
        )
    place = np.interp(np.log(wanted), np.log(known), np.arange(known.size))
    before = place.astype(int)
    after = np.minimum(before + 1, known.size - 1)
    weight = xr.DataArray(place - before, dims="sieve")
    finer, coarser = (found.drop_vars("sieve").isel(sieve=k) for k in (before, after))
    return ((1 - weight) * finer + weight * coarser).transpose(*found.dims).assign_coords(sieve=wanted)


def _percentile_between_sieves(found: xr.DataArray, fraction: float, total: bool) -> xr.DataArray:
    if total:
        found = found.mean("streamline")
    log_sieves = np.log(found["sieve"].values)

    def invert(fractions):
        if np.isnan(fractions).any():  # a case of a sweep that holds no result
            return np.nan
        if not fractions[0] <= fraction <= fractions[-1]:
            raise ValueError(
                f"percent: got {100 * fraction:g}; must lie within what the recorded sieves pass, "
                f"{100 * fractions[0]:.3g} to {100 * fractions[-1]:.3g} %; extend resolution.sieves, or record 'cells'"
            )
        first = int(np.searchsorted(fractions, fraction))  # the finest sieve that passes it
        around = slice(max(first - 1, 0), first + 1)
        return np.exp(np.interp(fraction, fractions[around], log_sieves[around]))

    return xr.apply_ufunc(invert, found.compute(), input_core_dims=[["sieve"]], vectorize=True)
