"""What matters: Sobol indices of what a machine does, over ranges of scene fields: `python -m studies.sensitivity`.

The first-order index of a field is the part of a figure's variance that goes with that field alone; the total index
adds what it does together with others (Saltelli et al. 2010). Fields vary independently of each other.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from hpgr.scene import Scene
from studies import command as line
from studies.command import Report, shown_as
from studies.quantities import quantity_of, refuse_lost, with_sieves
from studies.sweep.space import ends_of, field_of, sobol_points

if TYPE_CHECKING:
    import xarray as xr

FIGURES = ("p80", "throughput", "specific_energy", "peak_pressure")  # beside the percent below a sieve
_RESAMPLES, _CONFIDENCE = 500, 0.95
_ORDERS = ("first_order", "total_order")


@dataclass(frozen=True)
class Options(line.Common):
    """Options of the sensitivity study; ranges are text with units, such as --vary "gap=40 mm..60 mm"."""

    vary: line.Range = ()
    posterior: Annotated[Path | None, shown_as("FILE")] = None
    """NetCDF file of samples of scene fields, by dotted name along `sample`, such as a calibration's posterior."""
    figures: Annotated[tuple[str, ...] | None, shown_as("NAME ...")] = None
    """What is asked about (default: P80, percent below the sieve, throughput, specific energy, peak pressure)."""
    sample: Annotated[int, shown_as("N")] = 512
    """Points of the design, a power of two; N (fields + 2) cases are run."""
    scene: line.CalibratedScene = None
    sieve: line.Sieve = "1 mm"
    workers: line.Workers = 2
    out: line.Out = Path("outputs/sensitivity.nc")


def indices(function: Callable[[np.ndarray], np.ndarray], fields: int, count: int, seed: int = 0) -> np.ndarray:
    """Return Sobol indices of the figures of a function on the unit cube, with bootstrapped 95 % intervals.

    The function takes points (point, field) within 0 to 1 and returns figures (figure, point); two designs of `count`
    points each, a power of two, are crossed. Indices are (order, estimate, figure, field): first order and total;
    value, low and high. NaN where a figure is the same everywhere.
    """
    both = sobol_points(2 * fields, count, seed)
    one, other = both[:, :fields], both[:, fields:]
    crossed = np.repeat(one[None], fields, axis=0)
    for k in range(fields):
        crossed[k, :, k] = other[:, k]
    values = np.asarray(function(np.concatenate([one, other, *crossed])), float)
    values = values.reshape(values.shape[0], fields + 2, count)
    best = _sobol(values)
    generator = np.random.default_rng(seed)
    again = [_sobol(values[..., generator.integers(count, size=count)]) for _ in range(_RESAMPLES)]
    tail = 100 * (1 - _CONFIDENCE) / 2
    found = np.stack([best, *np.nanpercentile(again, [tail, 100 - tail], axis=0)], axis=1)
    same = np.ptp(values.reshape(values.shape[0], -1), axis=1) <= 1e-6 * np.abs(values).max(axis=(1, 2))  # of float32
    found[:, :, same] = np.nan
    return found


def _sobol(values: np.ndarray) -> np.ndarray:
    """Return (order, figure, field) indices of values (figure, design, point)."""
    from scipy.stats import sobol_indices

    constant = np.ptp(values, axis=(1, 2), keepdims=True) == 0
    values = np.where(constant, np.arange(values.shape[2]), values)  # which SciPy would divide by; NaN in the end
    figures, values = len(values), np.concatenate([values, values])  # it takes no single figure
    design = {"f_A": values[:, 0], "f_B": values[:, 1], "f_AB": values[:, 2:].transpose(1, 0, 2)}
    found = sobol_indices(func=design, n=values.shape[2])
    orders = np.array([found.first_order, found.total_order])
    return orders.reshape(2, len(values), -1)[:, :figures]


def sensitivity(
    scene: Scene,
    over: "Mapping[str, Any] | xr.Dataset",
    figures: Sequence[str] = (*FIGURES, "passing 1 mm"),
    count: int = 512,
    seed: int = 0,
    **options: Any,
) -> "xr.Dataset":
    """Return Sobol indices of figures of `scene` over ranges of its fields.

    Parameters
    ----------
    scene : Scene
        What is varied. Every case draws the same random numbers. Without figures of the product it runs stress only.
    over : mapping or xarray.Dataset
        By field, lowest and highest value, or samples such as those of a posterior, of which each field's own
        distribution is taken: what fields have in common is left out.
    figures : sequence of str
        As `studies.quantities.quantity_of` takes them.
    count : int
        Points of the design, a power of two; count x (fields + 2) cases are run.
    seed : int
        Of the design and of the cases.
    **options
        Of `studies.sweep.sweep`: client, threads, progress, folder.

    Returns
    -------
    xarray.Dataset
        `first_order` and `total_order`, each with `_low` and `_high` of its 95 % interval; dims figure, field.

    Raises
    ------
    ValueError
        If a range is none, or a case of it was refused or failed.

    Examples
    --------
    >>> import hpgr
    >>> from studies.sensitivity import sensitivity
    >>> over = {"gap": ("50 mm", "60 mm"), "roll_speed": ("15 rpm", "19 rpm")}
    >>> found = sensitivity(hpgr.presets.industrial(), over, ["specific energy"], count=16)
    >>> float(found["total_order"].sel(field="rolls.speed")[0])
    0.0
    """
    from hpgr.results import schema
    from studies.sweep import sweep

    if count < 4 or count & (count - 1):
        raise ValueError(f"sample: got {count}; must be a power of two, at least 4; such as 512")
    wanted = [quantity_of(name) for name in figures]
    fields, rows = _rows(over)

    def run(unit: np.ndarray) -> np.ndarray:
        result = sweep(with_sieves(scene, wanted), {fields: rows(unit)}, seed=seed, **options)
        refuse_lost(result)
        return np.array([one.of(result.isel(replicate=0)) for one in wanted])

    found = indices(run, len(fields), count, seed)
    dims, values, own = ("figure", "field"), {}, {}
    for (k, order), (j, end) in itertools.product(enumerate(_ORDERS), enumerate(("", "_low", "_high"))):
        words, part = order.replace("_", " "), f"{end[1:]} end of its 95 % interval" * bool(end)
        values[order + end], own[order + end] = found[k, j], schema.Variable(dims, "1", f"{words} Sobol index", part)
    own |= {"figure": schema.Variable(("figure",), "", "figure of a run", dtype=None)}
    own |= {"field": schema.Variable(("field",), "", "field of the scene", dtype=None)}
    values |= {"figure": [one.words for one in wanted], "field": list(fields)}
    attrs = schema.dataset_attributes(
        "Sobol indices of high pressure grinding rolls", scene=scene.model_dump_json(), seed=seed, samples=count
    )
    return schema.to_dataset(values, attrs, own)


def _rows(over: Any) -> tuple[tuple[str, ...], Callable[[np.ndarray], list[tuple]]]:
    """Return the fields, and what makes rows of their values of points (point, field) of the unit cube."""
    given = {field_of(name): values for name, values in over.items()}
    if not given:
        raise ValueError(
            "over: got no fields; give ranges; such as {'gap': ('40 mm', '60 mm')}, or --vary 'gap=40 mm..60 mm'"
        )
    ranges = ends_of({field: ends for field, ends in given.items() if isinstance(ends, tuple)})
    drawn = {field: np.asarray(ranges.get(field, values), float).ravel() for field, values in given.items()}
    if not all(np.isfinite(values).all() for values in drawn.values()):
        raise ValueError("over: got samples that are not finite; leave them out")

    def rows(unit: np.ndarray) -> list[tuple]:
        columns = (np.quantile(values, unit[:, k]).tolist() for k, values in enumerate(drawn.values()))
        return list(zip(*columns, strict=True))

    return tuple(drawn), rows


def table(result: "xr.Dataset") -> str:
    """Return the indices as text, the fields of each figure in order of what they matter."""
    from studies.show.report import aligned

    rows = []
    for name in result["figure"].values:
        one = result.sel(figure=name)
        if one["total_order"].isnull().all():
            rows.append([name, "none", "it is the same everywhere", ""])
            continue
        for k in np.argsort(-one["total_order"].values, kind="stable"):
            texts = (
                "{:.3f} ({:.3f} to {:.3f})".format(*(float(one[f"{order}{end}"][k]) for end in ("", "_low", "_high")))
                for order in _ORDERS
            )
            rows.append([name, f"{one['field'].values[k]}", *texts])
    return aligned(["figure", "field", "alone (95 %)", "with others (95 %)"], rows, words=2)


@line.command("sensitivity", __doc__)
def main(options: Options) -> Report:
    """Write the indices of the command line's ranges."""
    ranges: dict[str, Any] = line.all_varied(tuple, options.vary)
    if options.posterior is not None:
        ranges |= line.posterior(options.posterior)
    figures = options.figures or (*FIGURES, f"passing {options.sieve}")
    scene = line.base_scene(replace(options, scene=options.scene or str(options.posterior or "paper")))
    result = sensitivity(scene, ranges, figures, options.sample, options.seed, threads=options.workers, progress=True)
    from studies.show.plots.sensitivity import sensitivity_figure

    return Report([table(result)], [result, line.figure(lambda: sensitivity_figure(result))])


if __name__ == "__main__":
    raise SystemExit(main())
