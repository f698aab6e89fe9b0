"""What a screen holds back, or the edge of the rolls, goes back to the feed: `python -m studies.circuit`.

In the steady state the rolls take fresh feed f and recycle r, by size class and per unit of fresh feed; of their
product the part o(f + r) goes back, and r = o(f + r). The machine sets how much it takes; the fresh feed follows.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
from pydantic import ValidationError

from hpgr.fields import Frozen, Metres, Number, check_number, faults_of, quantity, show
from hpgr.laws.feed import TableFeed
from hpgr.scene import Scene, check_scene
from studies import Late
from studies import command as line
from studies.command import Report, shown_as
from studies.sweep.space import Case, CaseResult, Space, SweepSpec, axes_of

if TYPE_CHECKING:
    import xarray as xr

loaded, run, schema = Late("hpgr.bed.loaded"), Late("hpgr.run"), Late("hpgr.results.schema")
report, assemble = Late("studies.show.report"), Late("studies.sweep.assemble")

_SIEVES = np.round(10 ** (np.arange(241) / 40 - 6), 12)  # m, 40 a decade: between them distributions are log-linear
_SIZES = np.sqrt(_SIEVES * np.append(_SIEVES[0] / 10, _SIEVES[:-1]))  # of the classes below them
_MOST_LOAD = 20.0  # recycle over fresh feed beyond which the circuit is taken to fill up
_MOST_ITERATIONS = 200
_CONVERGED = 1e-9  # of the fresh feed, by which the recycle changes no more
_CELLS = 10.0  # the same where grains break at random: the change that is of a few cells may go on for ever
_KEPT = 12  # rounds that Anderson's acceleration (1965) combines; none where grains break at random: it feeds on noise


class Screen(Frozen):
    """Efficiency of a screen by Whiten's curve (Napier-Munn et al. 1996, section 12.4).

    Examples
    --------
    >>> from studies.circuit import Screen
    >>> Screen(cut_size="6 mm", sharpness=6, bypass=0.1).oversize([1e-6, 6e-3, 30e-3]).round(2)
    array([0.1 , 0.55, 1.  ])
    """

    cut_size: Metres = quantity(symbol="d_50c", unit="m", source="screen", example="6 mm", ge=1e-6, le=1)
    """Size of which half goes each way, but for the bypass"""
    sharpness: Number = quantity(8.0, symbol="alpha", source="screen", example=8, ge=0.1, le=1000)
    """Sharpness of the cut"""
    bypass: Number = quantity(0.0, symbol="1 - C", source="screen", example=0.05, ge=0, le=0.9)
    """Fraction of the fines that goes with the oversize"""

    def __str__(self) -> str:
        cut = f"oversize of a screen that cuts at {show(self.cut_size, 'm')}"
        return f"{cut}, sharpness {self.sharpness:g}, bypass {self.bypass:g}"

    def oversize(self, size) -> np.ndarray:
        """Return the fraction of grains of a size (m) that goes back."""
        alpha, over = self.sharpness, np.asarray(size, float) / self.cut_size
        grown = np.exp(np.minimum(alpha * (over - 1), 700.0))
        return 1 - (1 - self.bypass) * (1 - math.exp(-alpha)) / (grown + 1 - 2 * math.exp(-alpha))

    def split(self, scene: Scene, values: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        """Return what goes back and what leaves the circuit, by size class, of one unit of the rolls' product."""
        product = _classes(values["passing_total"])
        back = self.oversize(_SIZES) * product
        return back, product - back


class EdgeRecycle(Frozen):
    """The product of the roll's edges goes back; the scene needs a roll width."""

    def __str__(self) -> str:
        return "product of the edges of the rolls"

    def split(self, scene: Scene, values: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        """Return what goes back and what leaves the circuit, by size class, of one unit of the rolls' product."""
        if scene.roll_width is None:
            raise ValueError("roll_width: got none; edge recycle needs the product of the edges; give a roll_width")
        slices = scene.roll_width.cut(scene.rolls.gap, scene.rolls.width)
        share = float(slices.share[slices.at_edge].sum())
        edge, centre = (_classes(values[f"passing_width_{part}"]) for part in ("edge", "centre"))
        return share * edge, (1 - share) * centre


class Closed(NamedTuple):
    """The steady state of a circuit, by size class (mass between a sieve and the next finer) per unit of fresh feed."""

    fresh: np.ndarray
    back: np.ndarray
    product: np.ndarray
    values: Mapping[str, Any]
    diagnostics: str
    iterations: int
    residual: float

    @property
    def load(self) -> float:
        """Recycle over fresh feed."""
        return float(self.back.sum())


def _classes(passing) -> np.ndarray:
    return np.diff(np.asarray(passing, float), prepend=0.0)


def steady(scene: Scene, returned: Screen | EdgeRecycle, seed: int = 0, replicate: int = 0) -> Closed:
    """Return the steady state of the circuit, `scene.feed` being its fresh feed.

    ValueError if the recycle grows without end, or does not settle.
    """
    scene = scene.with_values({"resolution.sieves": _SIEVES.tolist(), "resolution.record": "product"})
    if scene.resolution.cells == 0:
        raise ValueError("resolution.cells: got 0; a circuit needs the product; give cells")
    fresh, beds = _classes(scene.feed.passing(_SIEVES)), loaded.Beds(1)
    inputs, outputs = [np.zeros(_SIEVES.size)], []
    for iteration in range(1, _MOST_ITERATIONS + 1):
        feed = fresh + inputs[-1]
        result = run.run_scene(scene.with_values({"feed": _table(feed)}), seed, replicate, beds)
        back, product = returned.split(scene, result.values)
        outputs.append(back * feed.sum())
        residual = float(np.abs(outputs[-1] - inputs[-1]).sum())
        load = back.sum() / product.sum()
        if load > _MOST_LOAD or inputs[-1].sum() > 2 * _MOST_LOAD:
            coarse = show(float(_SIEVES[np.argmax(np.cumsum(back) >= 0.5 * back.sum())]), "m", 3)
            raise ValueError(
                f"recycle: got more than {100 * _MOST_LOAD:.0f} % of the fresh feed, and it grows: half of it is "
                f"coarser than {coarse}, and the rolls break too little of that; cut coarser, or press harder"
            )
        smooth, cells = result.solver == "closed form", scene.resolution.cells * scene.resolution.streamlines
        if residual <= (_CONVERGED if smooth else _CELLS * feed.sum() / cells):
            shared = (part * (1 + load) for part in (back, product))  # the last product: what goes in is what goes out
            return Closed(fresh, *shared, result.values, result.diagnostics, iteration, residual)
        kept = _KEPT if smooth else 1
        inputs.append(np.maximum(_accelerated(inputs[-kept:], outputs[-kept:]), 0.0))
    raise ValueError(
        f"recycle: got a change of {residual:.2g} of the fresh feed after {iteration} rounds; must settle; give more "
        "cells or streamlines"
    )


def _table(mass: np.ndarray) -> TableFeed:
    """Return masses by class as a feed."""
    last = int(np.flatnonzero(mass)[-1])
    percent = 100 * np.minimum(np.cumsum(mass[: last + 1]) / mass.sum(), 1.0)
    percent[-1] = 100.0
    first = max(int(np.argmax(percent > 0)) - 1, 0)
    rows = list(zip(_SIEVES[first : last + 1].tolist(), percent[first:].tolist(), strict=True))
    return TableFeed(table=rows if percent[first] == 0 else [(rows[0][0] / 1000, 0.0), *rows])


def _accelerated(inputs: list[np.ndarray], outputs: list[np.ndarray]) -> np.ndarray:
    """Return the next guess at the fixed point: the combination of what came out whose changes cancel best."""
    changes = np.array(outputs) - inputs
    if len(changes) == 1:
        return outputs[-1]
    steps = np.diff(changes, axis=0).T
    weights = np.linalg.lstsq(steps, changes[-1], rcond=1e-10)[0]
    return outputs[-1] - np.diff(np.array(outputs), axis=0).T @ weights


# ---- what is told


def close_circuit(
    scene: Scene, returned: Screen | EdgeRecycle, space: Any = None, replicates: int = 1, seed: int = 0
) -> "xr.Dataset":
    """Return the steady state of a closed circuit, at each operating point of a space.

    Parameters
    ----------
    scene : Scene
        The machine; its feed is the circuit's fresh feed.
    returned : Screen or EdgeRecycle
        What goes back to the feed.
    space : mapping or xarray.Dataset, optional
        As `studies.sweep.sweep` takes it.
    replicates, seed : int
        As in `studies.sweep.sweep`.

    Returns
    -------
    xarray.Dataset
        Dims: of the space, replicate, sieve. Circulating load, fresh feed, energy per tonne of the circuit's product,
        its P80; mass fractions passing of the rolls' feed and product, of the recycle and of the circuit's product; how
        well the mass balance closes. A point whose load grows without end, or whose scene is refused, holds NaN.

    Raises
    ------
    TypeError
        If `scene` is none.
    ValueError
        If what goes back is no separation, or no point has a steady state.

    Examples
    --------
    >>> import hpgr, studies
    >>> from studies.circuit import Screen
    >>> scene = hpgr.presets.industrial().with_values({"strength.cushioning": float("inf"), "resolution.points": 50})
    >>> found = studies.close_circuit(scene, Screen(cut_size="10 mm"), {"press_force": ["3 N/mm^2", "5 N/mm^2"]})
    >>> low, high = found["circulating_load"].values[:, 0]
    >>> bool(low > high > 0)
    True
    """
    check_scene(scene)
    check_number("replicates", replicates)
    check_number("seed", seed)
    if not isinstance(returned, Screen | EdgeRecycle):
        raise ValueError(f"returned: got {returned!r:.80}; must be what separates; such as Screen(cut_size='6 mm')")
    spec = SweepSpec(scene.with_values({"resolution.record": "product"}), seed)
    space = Space(axes_of({} if space is None else space), replicates)
    results = [_case(spec, returned, case) for case in space.cases()]
    if not any(one.summary for one in results):
        raise ValueError(results[0].message)
    return assemble.assemble(spec, space, results, _variables()).assign_attrs(returned=str(returned))


def _case(spec: SweepSpec, returned: Screen | EdgeRecycle, case: Case) -> CaseResult:
    """Return the steady state of one point, or why it has none."""
    try:
        found = steady(spec.base.with_values(case.values), returned, spec.seed, case.replicate)
    except ValueError as error:
        words = faults_of(error) if isinstance(error, ValidationError) else str(error)
        return CaseResult(case.index, "refused", words, {})
    entries, values = _variables(), _figures(found)
    summary = {name: np.asarray(value, entries[name].dtype) for name, value in values.items() if name in entries}
    return CaseResult(case.index, "ok", "", summary, found.diagnostics)


def _figures(found: Closed) -> dict[str, Any]:
    """Return the variables of a steady state, those of the rolls' last run among them."""
    load = found.load
    masses = {"feed_passing": found.fresh + found.back, "recycle_passing": found.back, "product_passing": found.product}
    passing = {name: np.cumsum(mass) / max(mass.sum(), 1e-300) for name, mass in masses.items()}
    own = {
        "circulating_load": load,
        "fresh_feed": found.values["throughput"] / (1 + load),
        "product_energy": found.values["specific_energy"] * (1 + load),
        "product_p80": math.exp(np.interp(0.8, passing["product_passing"], np.log(_SIEVES))),
        "mass_balance": found.fresh.sum() - found.product.sum(),
        "residual": found.residual,
        "iterations": found.iterations,
    }
    return {name: value for name, value in found.values.items() if value is not None} | own | passing


def _variables() -> dict[str, Any]:
    """Return what a circuit's Dataset has: the rolls' variables, and its own."""
    Variable, per, sieve = schema.Variable, "per unit of fresh feed", ("sieve",)
    rolls = {name: entry for name, entry in schema.VARIABLES.items() if not {"point", "cell", "time"} & set(entry.dims)}
    own = {
        "circulating_load": Variable((), "1", "circulating load", "recycle over fresh feed"),
        "fresh_feed": Variable((), "kg s-1", "fresh feed", "and product of the circuit"),
        "product_energy": Variable((), "J kg-1", "specific energy of the product", "power over product of the circuit"),
        "product_p80": Variable((), "m", "P80 of the circuit's product"),
        "mass_balance": Variable((), "1", "fresh feed less product", per, np.float64),
        "residual": Variable((), "1", "change of the recycle in the last round", per, np.float64),
        "iterations": Variable((), "1", "rounds of the recycle"),
        "feed_passing": Variable(sieve, "1", "mass fraction passing", "feed of the rolls"),
        "recycle_passing": Variable(sieve, "1", "mass fraction passing", "what goes back"),
        "product_passing": Variable(sieve, "1", "mass fraction passing", "product of the circuit"),
    }
    return {name: schema.COORDINATES[name] for name in ("xi", "sieve")} | rolls | own


_SHOWN = {
    "circulating_load": ("load [%]", 100.0),
    "fresh_feed": ("fresh feed [t/h]", 3.6),
    "throughput": ("rolls [t/h]", 3.6),
    "product_p80": ("product P80 [mm]", 1e3),
    "specific_energy": ("rolls [kWh/t]", 1 / 3600),
    "product_energy": ("product [kWh/t]", 1 / 3600),
    "iterations": ("rounds", 1.0),
}


def table(result: "xr.Dataset") -> str:
    """Return a line for each operating point."""
    points = report.operating_points(result)
    found = {heading: points[name].astype(float) * factor for name, (heading, factor) in _SHOWN.items()}
    return report.points_table(result, points, found)


# ---- the command line


@dataclass(frozen=True)
class Options(line.Common):
    """Options of the closed circuit; sizes are text with a unit."""

    cut: Annotated[str | None, shown_as("LENGTH")] = None
    """Cut size of the screen, such as "6 mm"; needed but for --edge-recycle."""
    sharpness: Annotated[float, shown_as("ALPHA")] = 8.0
    """Sharpness of the cut, by Whiten's curve, 0.1 to 1000."""
    bypass: Annotated[float, shown_as("PART")] = 0.0
    """Part of the fines, 0 to 0.9, that goes with the oversize."""
    edge_recycle: line.Flag = False
    """Return the product of the roll's edges, in place of a screen's oversize."""
    vary: line.Vary = ()
    scene: line.SceneName = "industrial"
    replicates: line.Replicates = 1
    out: line.Out = Path("outputs/circuit.nc")


@line.command("circuit", __doc__)
def main(options: Options) -> Report:
    """Write the steady state of the command line's circuit."""
    if (options.cut is None) != options.edge_recycle:
        raise ValueError("--cut: give a screen's cut size, or --edge-recycle; such as --cut '6 mm'")
    screen = {"cut_size": options.cut, "sharpness": options.sharpness, "bypass": options.bypass}
    returned = EdgeRecycle() if options.edge_recycle else Screen(**screen)
    space = line.all_varied(list, options.vary)
    result = close_circuit(line.base_scene(options), returned, space, options.replicates, options.seed)
    from studies.show.plots.circuit import circuit_figure

    lines = [table(result), *report.flagged(result)]
    return Report(lines, [result, line.figure(lambda: circuit_figure(result))], report.lost_cases(result))


if __name__ == "__main__":
    raise SystemExit(main())
