"""Sweep -> the page of the explorer: what it holds, plain lists and text ready for JSON, and the page itself.

Numbers are means and sample standard deviations over the replicates that hold a result, in the units people read.
Arrays are flat, operating points slowest, in the order of the swept axes; None stands for NaN.
"""

import base64
import gzip
import html
import itertools
import json
import math
import re
from collections import Counter
from importlib.resources import files
from typing import Any

import numpy as np
import xarray as xr
from pydantic import ValidationError

from hpgr.fields import show, unit_shown
from hpgr.fields import values_of as values_in
from hpgr.laws.feed import Feed
from hpgr.results import metrics
from hpgr.results.metrics import scene_of
from hpgr.results.schema import STATUS
from hpgr.scene import Scene
from studies.show import report

MOST_NUMBERS = 4_000_000  # in a page: about 30 MB, which a browser still opens in seconds
DIGITS, SPREAD_DIGITS = 6, 4  # significant digits of means (float32 has about 7) and of standard deviations

_CASE = ("operating_point", "replicate")
_MADE = ("history", "source", "seed", "versions")  # attributes that tell how the sweep was made
_MOST_LOST = 10  # lost operating points that the page lists; the others tell when they are selected


def page_data(result: xr.Dataset, sieve: float, name: str) -> dict[str, Any]:
    """Return everything the page of a sweep holds; `sieve`, in m, is that whose percent passing is shown first.

    ValueError if the Dataset is no sweep, holds no result, is too large for a page, or the sieve is not within its
    sieves.

    Examples
    --------
    >>> import hpgr
    >>> from studies.show.page import page_data
    >>> from studies.sweep import sweep
    >>> base = hpgr.presets.paper().with_values({"resolution.cells": 100, "resolution.points": 50})
    >>> data = page_data(sweep(base, {"rolls.gap": ["40 mm", "60 mm"]}), 0.001, "two gaps")
    >>> data["axes"][0]["texts"]
    ['40 mm', '60 mm']
    """
    require_sweep(result, name)
    axes = report.axes_of(result)
    scene = scene_of(result)
    points = report.operating_points(result)
    feeds, feed_of = feeds_of(result, scene)
    sieved = with_sieve(result, sieve, max((one.largest_grain for one in feeds if one), default=0.0))
    sizes = {key: entry(values_of(report.operating_points(sieved), key)) for key in sieved.data_vars}
    shown_sieves = sieved["sieve"].values if sizes else np.array([])
    held = (points["status"] == STATUS["ok"]).sum("replicate").values
    lost = report.lost_cases(result)
    figures, across = kpis(points, sieve), profiles(points)
    refuse_too_many([*figures, *across, *sizes.values()], result, name)
    return {
        "name": name,
        "told": [line[0].upper() + line[1:] for line in (*report.remarks(result), *lost[:_MOST_LOST])],
        "made": {key: str(result.attrs[key]) for key in _MADE if key in result.attrs},
        "replicates": result.sizes["replicate"],
        "axes": [axis_data(result, axis, scene) for axis in axes],
        "start": start(result, scene, held),
        "held": held.tolist(),
        "said": [said(points.isel(operating_point=k)) for k in range(points.sizes["operating_point"])],
        "kpis": figures,
        "streamlines": numbers(result["xi"].values) if "xi" in result else [],
        "profiles": across,
        "sieves": numbers(shown_sieves * 1e3),
        "sieve": int(np.argmin(np.abs(shown_sieves - sieve))) if sizes else 0,
        "passing": sizes,
        "feeds": [numbers(one.passing(shown_sieves)) if one and sizes else None for one in feeds],
        "feed_of": feed_of,
        "scene": json.loads(result.attrs["scene"]),
    }


def require_sweep(result: xr.Dataset, name: str) -> None:
    """Raise ValueError if a Dataset is not of a sweep, or holds no result at all."""
    lacking = [each for each in ("replicate", "status", "message", "diagnostics") if each not in result.variables]
    lacking += [] if "scene" in result.attrs else ["the attribute scene"]
    if lacking:
        raise ValueError(
            f"{name}: is not the result of a sweep: it lacks {', '.join(lacking)}; give a file that "
            "python -m studies.gap_sweep, speed_sweep or feed_sweep has written, or a Dataset of studies.sweep.sweep"
        )
    if not report.any_result(result):
        lines = report.lost_cases(result)
        raise ValueError(f"{name}: no case holds a result, so there is nothing to show; the first: {lines[0]}")


def refuse_too_many(entries: list[dict[str, Any]], result: xr.Dataset, name: str) -> None:
    """Raise ValueError if means and spreads are more than `MOST_NUMBERS` numbers."""
    total = sum(len(one["mean"]) + len(one["sd"]) for one in entries)
    if total > MOST_NUMBERS:
        axis = max(report.axes_of(result), key=lambda one: result.sizes[one])
        raise ValueError(
            f"{name}: its means and spreads are {total:.2g} numbers; a page holds at most {MOST_NUMBERS:.2g}; "
            f'show a part: xarray.open_dataset("{name}").isel({axis}=slice(None, None, 2)).to_netcdf("part.nc")'
        )


def values_of(points: xr.Dataset, name: str) -> xr.DataArray:
    """Return a variable in double precision, operating points and replicates first, NaN where a case is lost."""
    values = points[name].astype(float)
    if "status" in points:
        values = values.where(points["status"] == STATUS["ok"])
    return values.transpose(*_CASE, ...)


def entry(values: xr.DataArray) -> dict[str, list]:
    """Return the flat mean and standard deviation over the replicates."""
    return {
        "mean": numbers(values.mean("replicate").values),
        "sd": numbers(report.spread(values).transpose("operating_point", ...).values, SPREAD_DIGITS),
    }


def numbers(values: np.ndarray, digits: int = DIGITS) -> list:
    """Return an array flat, rounded to significant digits, whole numbers short, None for NaN."""
    return [_short(value, digits) for value in np.asarray(values, float).ravel().tolist()]


def _short(value: float, digits: int) -> float | int | None:
    if not math.isfinite(value):
        return None
    rounded = float(f"{value:.{digits}g}")
    return int(rounded) if rounded.is_integer() and abs(rounded) < 1e15 else rounded


def kpis(points: xr.Dataset, sieve: float) -> list[dict[str, Any]]:
    """Return every figure of an operating point but the percent below a sieve, which the page takes from `passing`."""
    ok = points["status"] == STATUS["ok"]
    first = report.figures(points, sieve)
    known = {heading: (values.where(ok), "") for heading, values in first.items() if not heading.startswith("below ")}
    for name in of_dims(points, set(_CASE)):
        if name not in ("status", "flags", *report.FIGURES):
            known[heading_of(points[name])] = (shown(points, name), points[name].attrs.get("long_name", ""))
    return [
        {"heading": heading, "about": about} | entry(values.transpose(*_CASE))
        for heading, (values, about) in known.items()
    ]


def profiles(points: xr.Dataset) -> list[dict[str, Any]]:
    """Return every variable that differs from streamline to streamline."""
    return [
        {"name": name, "heading": heading_of(points[name]), "about": points[name].attrs.get("long_name", "")}
        | entry(shown(points, name))
        for name in of_dims(points, {*_CASE, "streamline"})
    ]


def of_dims(points: xr.Dataset, dims: set[str]) -> list[str]:
    """Return the names of the numeric variables that have just these dims."""
    return [name for name, value in points.data_vars.items() if set(value.dims) == dims and value.dtype.kind in "fiu"]


def shown(points: xr.Dataset, name: str) -> xr.DataArray:
    """Return a variable in the unit it is shown in."""
    return values_of(points, name) * unit_shown(points[name].attrs.get("units", "1"))[1]


def heading_of(variable: xr.DataArray) -> str:
    """Return a variable's name as words, with the unit it is shown in."""
    words = variable.name.replace("_", " ").removesuffix(" total")
    words = words[0].upper() + words[1:] if words in ("p50", "p80") else words
    unit = variable.attrs.get("units", "1")
    return words if unit == "1" else f"{words} [{unit_shown(unit)[0]}]"


def with_sieve(result: xr.Dataset, sieve: float, largest: float) -> xr.Dataset:
    """Return the mass fractions passing, at the sieves that tell something and at `sieve`; none if stress only.

    Left out are sieves that nothing passes, and that everything passes of products and of feeds, whose largest grain
    is `largest` (m), but for the last and the first of them.
    """
    kept = result[[name for name in ("passing_total", "passing") if name in result]]
    if not kept.data_vars:
        return kept
    known = kept["sieve"].values
    if not known[0] <= sieve <= known[-1]:
        raise ValueError(
            f"--sieve: got {show(sieve, 'm')}; must lie within the recorded sieves, "
            f"{show(known[0], 'm')} to {show(known[-1], 'm')}; choose one within"
        )
    across = [name for name in kept["passing_total"].dims if name != "sieve"]
    first = max(int(np.argmax(kept["passing_total"].max(across).values > 0)) - 1, 0)
    beyond = kept["passing_total"].min(across).values >= 1
    beyond &= known >= largest
    last = int(np.argmax(beyond)) if beyond.any() else known.size - 1
    if np.isclose(known, sieve, rtol=1e-9).any():
        sieve = known[np.argmin(np.abs(known - sieve))]
    wanted = np.union1d(known[first : last + 1], [sieve])
    return xr.Dataset({key: metrics.between_sieves(kept[key], wanted) for key in kept}).assign(status=result["status"])


def axis_data(result: xr.Dataset, dim: str, scene: Scene) -> dict[str, Any]:
    """Return a swept axis: labels, values, the order of its slider, and what each place changes in the scene."""
    axis, places = result[dim], report.places(result, dim)
    numeric = axis.dtype.kind in "fiu"
    values = report.shown_values(axis)
    return {
        "name": axis.name,
        "words": axis.name.replace("_", " "),
        "label": report.axis_label(axis),
        "about": axis.attrs.get("long_name", ""),
        "values": numbers(values) if numeric and np.isfinite(values).all() else None,
        "texts": [report.place_text(result, dim, k) for k in range(axis.size)],
        "order": np.argsort(values, kind="stable").tolist() if numeric else list(range(axis.size)),
        "raw": [{name: _plain(value) for name, value in place.items() if "." in name} for place in places],
        "changes": [changes(scene, place) for place in places],
    }


def _plain(value: Any) -> Any:
    """Return a value as JSON can hold it, and a scene file reads it: infinity is text there."""
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def changes(scene: Scene, values: dict[str, Any]) -> dict[str, Any]:
    """Return the fields, by dotted name, that a scene changes when given values; None for one, or part, it drops."""
    try:
        other = scene.with_values(values)
    except ValidationError:  # a case that was refused
        return {field: _plain(value) for field, value in values.items()}
    found: dict[str, Any] = {}
    every, now = (json.loads(one.model_dump_json()) for one in (scene, other))
    for section in dict.fromkeys(name.partition(".")[0] for name in values):
        before, after = every[section] or {}, now[section]
        if after is None:
            found |= {section: None} if before else {}
            continue
        after = after | {key: None for key in before if key not in after}
        found |= {f"{section}.{key}": new for key, new in after.items() if key not in before or before[key] != new}
    return found


def start(result: xr.Dataset, scene: Scene, held: np.ndarray) -> list[int]:
    """Return the places on the axes of the operating point shown first: the scene's own, or the next with a result."""
    axes = [result[name] for name in report.axes_of(result)]
    own = [_nearest(axis, scene) if report.is_field(axis) else 0 for axis in axes]
    full = np.argwhere(held.reshape([axis.size for axis in axes]) > 0)
    return full[np.argmin(np.abs(full - own).sum(axis=1))].tolist()


def _nearest(axis: xr.DataArray, scene: Scene) -> int:
    own = values_in(scene).get(axis.attrs["scene_field"])
    if axis.dtype.kind not in "fiu":
        return int(np.argmax(axis.values == own))  # the first, if it is none of them
    if own is None or not math.isfinite(own):
        return axis.size // 2
    return int(np.argmin(np.abs(np.nan_to_num(axis.values.astype(float)) - own)))


def feeds_of(result: xr.Dataset, scene: Scene) -> tuple[list[Feed | None], list[int]]:
    """Return every feed of the sweep, None where a scene is refused, and the number of each operating point's feed."""
    axes = report.axes_of(result)
    fed = {name: [_of_feed(place) for place in report.places(result, name)] for name in axes}
    swept = [name for name in axes if fed[name][0]]
    every = list(itertools.product(*(range(result.sizes[name]) for name in swept)))
    values = [dict(item for name, k in zip(swept, at, strict=True) for item in fed[name][k].items()) for at in every]
    places = itertools.product(*(range(result.sizes[name]) for name in axes))
    chosen = [tuple(k for name, k in zip(axes, place, strict=True) if name in swept) for place in places]
    return [_feed(scene, each) for each in values], [every.index(place) for place in chosen]


def _of_feed(values: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if name.partition(".")[0] == "feed"}


def _feed(scene: Scene, values: dict[str, Any]) -> Feed | None:
    try:
        return scene.with_values(values).feed
    except ValidationError:
        return None


def said(point: xr.Dataset) -> list[list]:
    """Return what became of an operating point, as [what, replicates it holds for, words], lost cases first."""
    words = {number: word for word, number in STATUS.items()}
    status, messages, told = (np.atleast_1d(point[name].values) for name in ("status", "message", "diagnostics"))
    lost = Counter((words[int(state)], str(text)) for state, text in zip(status, messages, strict=True) if state)
    lines = [line.partition(": ") for each in told for line in str(each).splitlines()]
    first = {name: text for name, _, text in reversed(lines)}
    limits = Counter(name for name, *_ in lines)
    return [
        *([what, count, text] for (what, text), count in lost.items()),
        *([name.replace("_", " "), count, first[name]] for name, count in limits.items()),
    ]


def page_of(data: dict[str, Any], library: str, history: str = "") -> str:
    """Return the page as text, from `page_data`, the source of plotly.js and the command that made it.

    The library is packed to two fifths of its size; browsers since 2023 unpack it.

    Examples
    --------
    >>> from studies.show.page import page_of
    >>> "<title>a &lt; b" in page_of({"name": "a < b"}, "")
    True
    """
    packed = base64.b64encode(gzip.compress(library.encode(), 9, mtime=0)).decode()
    parts = {"TITLE": html.escape(data["name"]), "HISTORY": html.escape(history)}
    parts |= {"DATA": embedded(data), "LIBRARY": packed}
    template = (files("studies.show") / "page.html").read_text(encoding="utf-8")
    return re.sub("@@([A-Z]+)@@", lambda found: parts[found[1]], template)


def embedded(data: dict[str, Any]) -> str:
    r"""Return data as JSON that no text in it can end the script element of.

    Examples
    --------
    >>> from studies.show.page import embedded
    >>> embedded({"remark": "</script>"})
    '{"remark":"\\u003c/script\\u003e"}'
    """
    text = json.dumps(data, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    for mark in "<>&\u2028\u2029":
        text = text.replace(mark, f"\\u{ord(mark):04x}")
    return text
