"""The best operating point under constraints, and what it trades: `python -m studies.optimum`.

Every evaluation draws the same random numbers, so that what is minimised is smooth but for whole cells. A design over
the ranges tells what matters, what can be reached and what is traded; from its best point a trust-region method goes on
(COBYQA, Ragonneau & Zhang 2024), which takes no derivatives and so no harm from what noise is left.
"""

import itertools
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np

from hpgr.fields import check_number, show, values_of
from hpgr.scene import Scene, check_scene, field_info
from studies import Late
from studies import command as line
from studies.command import Report, shown_as
from studies.convergence import unbeaten
from studies.quantities import Quantity, quantity_of, refuse_lost, with_sieves
from studies.sweep.space import between, ends_of, sobol_points

if TYPE_CHECKING:
    import xarray as xr

loaded, run, solve = Late("hpgr.bed.loaded"), Late("hpgr.run"), Late("hpgr.grains.solve")

_POINTS = 64  # of the design, for one field or two; twice as many for each field more
_REPLICATES = 4  # of a scene that breaks at random: their mean is optimised
_JUDGES = 8  # replicates with other random numbers, by which the best point is told
_RADIUS = 2e-3  # final trust region, of a range
_MOST_RUNS = 150
_SAME = 1e-6  # relative change that is rounding: figures are float32


class Limit(NamedTuple):
    """A figure and its bound, SI."""

    quantity: Quantity
    at_least: bool
    bound: float

    def slack(self, value: Any) -> Any:
        """Return by how much a value is on the right side of the bound."""
        return value - self.bound if self.at_least else self.bound - value

    def __str__(self) -> str:
        return f"{self.quantity.words} {'>=' if self.at_least else '<='} {self.quantity.told(self.bound)}"


class Optimum(NamedTuple):
    """The best operating point.

    Attributes
    ----------
    scene : Scene
        The scene there.
    values : dict
        Its value of each field that was varied, SI.
    figures : dict
        By words, (value, error), SI, judged by other random numbers than it was found with. The error is two standard
        errors, and what the figure changes within the final trust region.
    binding : list of str
        Bounds and ends of ranges that it lies at.
    without_effect : list of str
        Which field does not matter to what.
    tradeoff : xarray.Dataset
        The sweep over the design, with `best_energy` and `best_throughput`: whether no other point is finer and better
        in these.
    """

    scene: Scene
    values: dict[str, float]
    figures: dict[str, tuple[float, float]]
    binding: list[str]
    without_effect: list[str]
    tradeoff: "xr.Dataset"

    def __str__(self) -> str:
        lines = [f"{field} = {show(value, field_info(field).unit)}" for field, value in self.values.items()]
        for name, (value, error) in self.figures.items():
            one = quantity_of(name)
            lines.append(f"{one.words}: {one.told(value)} ± {one.told(error, 2)}")
        return "\n".join([*lines, f"binding: {'; '.join(self.binding) or 'nothing'}", *self.without_effect])


def optimise(
    scene: Scene,
    over: Mapping[str, tuple[Any, Any]],
    minimise: str | None = None,
    maximise: str | None = None,
    subject_to: Mapping[str, str | Sequence[str]] | None = None,
    seed: int = 0,
    **options: Any,
) -> Optimum:
    """Return the operating point within ranges of fields that is best under constraints.

    Parameters
    ----------
    scene : Scene
        The machine with its ore; what is not varied stays.
    over : mapping
        Lowest and highest value of each field.
    minimise, maximise : str
        The figure, as `studies.quantities.quantity_of` takes it; one of the two.
    subject_to : mapping
        By figure, a bound such as ``">= 60 %"`` or ``"<= 1.5 kWh/t"``, or several.
    seed : int
        Of the design and of all cases.
    **options
        Of `studies.sweep.sweep`: client, threads, progress, folder.

    Raises
    ------
    TypeError
        If `scene` is none.
    ValueError
        If a figure or range is none, or nothing within the ranges meets the bounds; the message has what is reached.

    Examples
    --------
    >>> import hpgr, studies
    >>> coarse = {"resolution.points": 50, "resolution.streamlines": 3, "strength.cushioning": float("inf")}
    >>> scene = hpgr.presets.industrial().with_values(coarse)
    >>> over = {"press_force": ("2 N/mm^2", "5 N/mm^2")}
    >>> best = studies.optimise(scene, over, minimise="specific_energy", subject_to={"passing 6 mm": ">= 60 %"})
    >>> best.binding
    ['passing 6 mm >= 60 %']
    """
    check_scene(scene)
    check_number("seed", seed)
    if (minimise is None) == (maximise is None):
        raise ValueError("minimise: give a figure to minimise or one to maximise; such as minimise='specific_energy'")
    if over == {}:
        raise ValueError(
            "over: got no fields; give ranges; such as {'gap': ('40 mm', '60 mm')}, or --vary 'gap=40 mm..60 mm'"
        )
    if not isinstance(subject_to, Mapping | None):
        raise ValueError(f"subject_to: got {subject_to!r:.80}; must be bounds; such as {{'passing 6 mm': '>= 60 %'}}")
    limits = [_limit(name, text) for name, texts in (subject_to or {}).items() for text in np.atleast_1d(texts)]
    ends, sign = ends_of(over), -1 if minimise is None else 1
    search = _Search(scene, ends, quantity_of(minimise if maximise is None else maximise), limits, sign, seed)
    tradeoff = search.design(options)
    without_effect = search.without_effect()
    best = search.descend()
    if best is None:
        raise ValueError(f"subject_to: {search.reached()} within these ranges; widen them, or relax a bound")
    values = search.values(best)
    figures = search.judged(best)
    return Optimum(scene.with_values(values), values, figures, search.binding(best, figures), without_effect, tradeoff)


def _limit(name: str, text: str) -> Limit:
    found = re.fullmatch(r"\s*(>=|<=)\s*(.+)", str(text))
    if not found:
        raise ValueError(f"subject_to: got {text!r} of {name}; must be a bound; such as '>= 60 %'")
    quantity = quantity_of(name)
    return Limit(quantity, found[1] == ">=", quantity.value(found[2]))


class _Search:
    """A search in the unit cube of the ranges; figures, the objective first, are means and are kept."""

    def __init__(self, scene: Scene, ends: dict, objective: Quantity, limits: list[Limit], sign: int, seed: int):
        self.ends, self.limits, self.sign, self.seed = ends, limits, sign, seed
        self.asked = list(dict.fromkeys([objective, *(limit.quantity for limit in limits)]))
        fineness = next((one for one in self.asked if one.of_product), quantity_of("p80"))
        self.traded = [fineness, quantity_of("specific energy"), quantity_of("throughput")]
        self.every = list(dict.fromkeys([*self.asked, *self.traded]))
        self.own, self.scene, self.beds = scene, with_sieves(scene, self.every), loaded.Beds(4)
        drawn = solve.choose(self.scene) not in ("stress only", "closed form")
        random = drawn and any(one.of_product for one in self.asked)
        self.replicates, self.judges = (_REPLICATES, _JUDGES) if random else (1, 1)
        self.bounded = [self.every.index(limit.quantity) for limit in limits]
        self.free, self.known, self.scales = list(ends), {}, np.ones(len(self.every))

    def values(self, unit: np.ndarray) -> dict[str, Any]:
        """Return the fields' values at a point; a field that does not matter keeps the scene's, within its range."""
        found = dict(zip(self.ends, between(self.ends, np.atleast_2d(unit))[0], strict=True))
        for field in set(self.ends) - set(self.free):
            own, (low, high) = values_of(self.own).get(field), self.ends[field]
            found[field] = low if own is None else min(max(own, low), high)
        return found

    def run(self, unit: np.ndarray, replicates: range) -> np.ndarray:
        """Return the figures (figure, replicate) at a point; NaN if its scene is refused."""
        try:
            scene = self.scene.with_values(self.values(unit))
            runs = [run.run_scene(scene, self.seed, replicate, self.beds).values for replicate in replicates]
        except ValueError:
            return np.full((len(self.every), len(replicates)), np.nan)
        return np.array([[one.of(values) for values in runs] for one in self.every], float)

    def figures(self, unit: np.ndarray) -> np.ndarray:
        """Return the mean figures at a point."""
        key = tuple(np.round(unit, 12).tolist())
        if key not in self.known:
            self.known[key] = self.run(unit, range(self.replicates)).mean(axis=1)
        return self.known[key]

    def slacks(self, unit: np.ndarray) -> np.ndarray:
        """Return how far figures are from their bounds, in parts of their ranges; below 0 the bound is not met."""
        found = self.figures(unit)
        each = [limit.slack(found[k]) / self.scales[k] for limit, k in zip(self.limits, self.bounded, strict=True)]
        return np.nan_to_num(each, nan=-1.0)

    def merit(self, unit: np.ndarray) -> float:
        """Return what is to be least: the objective in parts of its range."""
        return float(np.nan_to_num(self.sign * self.figures(unit)[0] / self.scales[0], nan=1e3))

    def design(self, options: Mapping[str, Any]) -> "xr.Dataset":
        """Run the corners of the cube and a Sobol sequence in it; return their figures and what is traded."""
        from studies.sweep import sweep

        count = _POINTS * 2 ** max(len(self.ends) - 2, 0)
        corners = np.stack(np.meshgrid(*[[0.0, 1.0]] * len(self.ends)), axis=-1).reshape(-1, len(self.ends))
        unit = np.vstack([corners, sobol_points(len(self.ends), count, self.seed)])
        result = sweep(self.scene, {tuple(self.ends): between(self.ends, unit)}, self.replicates, self.seed, **options)
        if not (result["status"] == 0).any():
            refuse_lost(result)
        means = np.array([one.of(result).mean("replicate", dtype=float) for one in self.every])
        self.known |= {tuple(np.round(point, 12).tolist()): means[:, k] for k, point in enumerate(unit)}
        spans = np.nanmax(means, axis=1) - np.nanmin(means, axis=1)
        self.scales = np.where(spans > 0, spans, 1.0)
        fine, energy, throughput = (means[self.every.index(one)] for one in self.traded)
        fine = fine if self.traded[0].sieve else -fine
        better = {"best_energy": unbeaten(fine, -energy), "best_throughput": unbeaten(fine, throughput)}
        words = {"long_name": "no other point is finer and better", "units": "1"}
        return result.assign({name: ("sample", flags.astype(np.int8), words) for name, flags in better.items()})

    def without_effect(self) -> list[str]:
        """Say which field does not matter to which figure that was asked about; free those that matter to any."""
        said = []
        for k, field in enumerate(self.ends):
            here, places = np.arange(len(self.ends)) == k, np.array([[0.25], [0.5], [0.75]])
            low, high = (np.array([self.figures(place) for place in np.where(here, end, places)]) for end in (0, 1))
            flags = np.isclose(low, high, rtol=_SAME, atol=0).all(axis=0)  # NaN is close to nothing
            same = [one for one, flag in zip(self.asked, flags, strict=False) if flag]
            if len(same) == len(self.asked):
                self.free.remove(field)
            if same:
                rest = "; it is not varied" if field not in self.free else ""
                said.append(f"{field} does not matter to {', '.join(one.words for one in same)}{rest}")
        return said

    def best(self) -> np.ndarray | None:
        """Return the best point so far that meets every bound."""
        fine = [np.array(key) for key in self.known if (self.slacks(np.array(key)) >= 0).all()]
        return min(fine, key=self.merit, default=None)

    def descend(self) -> np.ndarray | None:
        """Return the best point, found from the best of the design; None if none meets the bounds."""
        start = self.best()
        if start is None:
            start = max(map(np.array, self.known), key=lambda unit: self.slacks(unit).min())
        if self.free:
            self._trust_region(start)
            self._poll()
        return self.best()

    def _trust_region(self, start: np.ndarray) -> None:
        from scipy.optimize import NonlinearConstraint, minimize

        free = [field in self.free for field in self.ends]

        def whole(part: np.ndarray) -> np.ndarray:
            unit = start.copy()
            unit[free] = np.clip(part, 0, 1)
            return unit

        minimize(
            lambda part: self.merit(whole(part)),
            start[free],
            method="COBYQA",
            bounds=[(0, 1)] * sum(free),
            constraints=[NonlinearConstraint(lambda part: self.slacks(whole(part)), 0, np.inf)] if self.limits else [],
            options={"initial_tr_radius": 0.1, "final_tr_radius": _RADIUS, "maxfev": _MOST_RUNS},
        )

    def _poll(self) -> None:
        """Look around the best point in ever smaller steps, which whole cells cannot mislead as they can a model."""
        axes = [(-1, 0, 1) if field in self.free else (0,) for field in self.ends]
        steps = np.array([step for step in itertools.product(*axes) if 0 < np.abs(step).sum() <= 2])
        size = 16 * _RADIUS
        while size >= _RADIUS and (centre := self.best()) is not None:
            for step in steps:
                self.figures(np.clip(centre + size * step, 0, 1))
            if (self.best() == centre).all():
                size /= 2

    def reached(self) -> str:
        """Return in words what is reached of each figure that has a bound."""
        every = np.array(list(self.known.values()))[:, self.bounded]
        ends = zip(self.limits, np.nanmin(every, axis=0).tolist(), np.nanmax(every, axis=0).tolist(), strict=True)
        told = [f"got {one}; {one.quantity.told(lo)} to {one.quantity.told(hi)} is reached" for one, lo, hi in ends]
        return "; ".join(told) + (", but not together," if len(told) > 1 else "")

    def judged(self, best: np.ndarray) -> dict[str, tuple[float, float]]:
        """Return figures with errors, from replicates that the point was not found with."""
        first = self.replicates if self.judges > 1 else 0
        runs = self.run(best, range(first, first + self.judges))
        noise = 2 * runs.std(axis=1, ddof=1) / math.sqrt(self.judges) if self.judges > 1 else np.zeros(len(runs))
        every = np.eye(best.size)[[field in self.free for field in self.ends]]
        near = [best, *np.clip(best + _RADIUS * np.vstack([every, -every]), 0, 1)]  # what is held varied in the design
        here, *others = (self.run(unit, range(self.replicates)).mean(axis=1) for unit in near)
        errors = noise + np.nanmax(np.abs(np.array([here, *others]) - here), axis=0)
        return {one.words: (float(runs[k].mean()), float(errors[k])) for k, one in enumerate(self.every)}

    def binding(self, best: np.ndarray, figures: Mapping[str, tuple[float, float]]) -> list[str]:
        """Return the bounds and ends of ranges that a point lies at."""
        near = [
            figures[one.quantity.words][1] / self.scales[k] for one, k in zip(self.limits, self.bounded, strict=True)
        ]
        met = self.slacks(best) - near <= _RADIUS
        found = [str(one) for one, flag in zip(self.limits, met, strict=True) if flag]
        for field, x in zip(self.ends, best.tolist(), strict=True):
            if field in self.free and not _RADIUS < x < 1 - _RADIUS:
                found.append(f"{field} at the {'lowest' if x < 0.5 else 'highest'} of its range")
        return found


# ---- the command line


@dataclass(frozen=True)
class Options(line.Common):
    """Options of the optimum; ranges and bounds are text with units."""

    vary: line.Range = ()
    minimise: Annotated[str | None, shown_as("FIGURE")] = None
    """What is to be least, such as specific_energy; this or --maximise."""
    maximise: Annotated[str | None, shown_as("FIGURE")] = None
    """What is to be most, such as throughput; this or --minimise."""
    subject_to: Annotated[tuple[str, ...], shown_as("BOUND ...")] = ()
    """Bounds, such as "passing 6 mm >= 60 %" "throughput >= 200 t/h"."""
    scene: line.SceneName = "industrial"
    workers: line.Workers = 2
    out: line.Out = Path("outputs/optimum.nc")


def _files(options: Options) -> list[Path]:
    out, *figure = line.beside(options)
    return [out, out.with_suffix(".toml"), *figure]


@line.command("optimum", __doc__, _files)
def main(options: Options) -> Report:
    """Write the best operating point of the command line's ranges as a scene file, and what it trades."""
    bounds: dict[str, list[str]] = {}
    for text in options.subject_to:
        name = re.split("[<>]=", text)[0]
        bounds.setdefault(name.strip(), []).append(text[len(name) :])
    scene, over, run = line.base_scene(options), line.all_varied(tuple, options.vary), {"threads": options.workers}
    best = optimise(scene, over, options.minimise, options.maximise, bounds, options.seed, progress=True, **run)
    from studies.show.plots.optimum import optimum_figure

    def write(path: Path, history: str) -> None:
        path.write_text(f"# {' '.join(history.split())}\n{as_toml(best.scene)}", encoding="utf-8")

    return Report(str(best).splitlines(), [best.tradeoff, write, line.figure(lambda: optimum_figure(best))])


def as_toml(scene: Scene) -> str:
    """Return a scene as the text of a TOML file."""
    parts = json.loads(scene.model_dump_json(exclude_none=True))
    text = f"remark = {json.dumps(parts.pop('remark'))}\n"
    for name, part in parts.items():
        text += f"\n[{name}]\n" + "".join(f"{key} = {json.dumps(value)}\n" for key, value in part.items())
    return text


if __name__ == "__main__":
    raise SystemExit(main())
