"""The paper's figures 3a-d, 4a-c and 5, and how the bed fills: `python -m studies.paper`.

Everything drawn is in one NetCDF file, mirrored: both halves of the gap, from the left roll to the right one. Where the
scene has a pressing force, all is drawn at the gap that carries it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from hpgr.fields import values_of
from hpgr.scene import Scene
from studies.command import (
    Cells,
    Exchange,
    Level,
    Overwrite,
    Points,
    Report,
    SceneName,
    Seed,
    Streamlines,
    base_scene,
    command,
    figure,
    shown_as,
)

if TYPE_CHECKING:
    import xarray as xr

FIGURES = ("paper_figure3.png", "paper_figure4.png", "paper_figure5.png")
ANIMATION = "paper_startup.gif"

_FRAMES = 80  # snapshots of the start-up at most, about
_STARTUP_CELLS = 400  # of a material point in the animation, whose P80 then scatters by some per cent
_EXCHANGE_GRID = {"points": 200, "cells": 2000}  # at most, of the one assumption that needs the whole lattice
_SIEVES = tuple(float(f"{10 ** (k / 20 - 6):.6g}") for k in range(121))  # 1 um to 1 m, twice as fine as the default


@dataclass(frozen=True)
class Options:
    """Options of the figures; without level, cells, points and streamlines level fine, with exchange standard."""

    scene: SceneName = "paper"
    level: Level = None
    cells: Cells = None
    points: Points = None
    streamlines: Streamlines = None
    shown_points: Annotated[int, shown_as("N")] = 80
    """Material points per streamline in figures 3c and 3d and in the animation: few enough to be seen."""
    exchange: Exchange = False
    assumptions: bool = True
    """Run the scene with other assumptions too, and say what they change, or not."""
    animation: bool = True
    """Draw the animation of the start-up, or not."""
    seed: Seed = 0
    out: Annotated[Path, shown_as("FOLDER")] = Path("outputs")
    """Folder for paper.nc, paper_figure3.png, paper_figure4.png, paper_figure5.png and paper_startup.gif."""
    overwrite: Overwrite = False


def _files(options: Options) -> list[Path]:
    return [options.out / name for name in ("paper.nc", *FIGURES, *([ANIMATION] if options.animation else []))]


@command("paper", __doc__, files=_files)
def main(options: Options) -> Report:
    """Draw the figures of the command line."""
    scene = base_scene(options)
    if all(value is None for value in (options.level, options.cells, options.points, options.streamlines)):
        scene = scene.with_values({"resolution": "fine" if scene.exchange is None else "standard"})
    result = study(scene, options.shown_points, options.seed, options.animation, options.assumptions)
    from studies.show.plots import paper as plots

    figures = [
        figure(lambda draw=draw: draw(result), dpi=110) for draw in (plots.figure3, plots.figure4, plots.figure5)
    ]
    animation = lambda path, history: plots.startup_animation(result, path, history)  # noqa: E731
    return Report(findings(result), [result, *figures, animation])


def study(
    scene: Scene, shown_points: int = 80, seed: int = 0, animation: bool = True, assumptions: bool = True
) -> "xr.Dataset":
    """Return everything the figures and the animation show, labelled, in SI units.

    Parameters
    ----------
    scene : Scene
        What is simulated, at its own resolution and, if it has a pressing force, at the gap that carries it.
    shown_points : int
        Material points per streamline where single ones are drawn: figures 3c, 3d and the start-up.
    seed : int
        Seed of all randomness.
    animation, assumptions : bool
        Whether the start-up is simulated, and the scene with other assumptions.

    Returns
    -------
    xarray.Dataset
        Fields over (streamline, point), the left roll to the right one, mid-plane and outermost streamlines
        included; shown points and their volumes; products over (product_streamline, sieve), the mid-plane to the
        roll; `startup_p80` over snapshots; pressures and P80 by assumption.

    Raises
    ------
    ValueError
        If there is no bed to draw, or nothing to crush.

    Examples
    --------
    >>> import hpgr
    >>> from studies.paper import study
    >>> small = {"resolution.streamlines": 3, "resolution.points": 50, "resolution.cells": 100}
    >>> result = study(hpgr.presets.paper().with_values(small), shown_points=20, assumptions=False)
    >>> dict(result["pressure"].sizes)
    {'streamline': 9, 'point': 50}
    """
    from hpgr import run
    from hpgr.results import schema

    _refuse(scene, shown_points)
    floated = run.load(scene)[0]
    # everything is drawn at this gap, also what has another number of points, or another law
    scene = floated.with_values({"rolls.specific_pressing_force": None})
    shown = scene.with_values({"resolution.points": shown_points})
    values, told = _product(scene, seed)
    values |= _rolls(scene) | _fields(scene) | _shown(shown)
    values |= _startup(shown, seed) if animation else {}
    values |= _assumptions(scene, seed) if assumptions else {}
    attrs = schema.dataset_attributes(
        "Figures 3, 4 and 5 of 'Heterarchical model of comminution in high pressure grinding rolls'",
        history=f"studies.paper.study(scene, {shown_points}, seed={seed})",
        scene=floated.model_dump_json(),
        shown_points=shown_points,
        seed=seed,
        streamline_deviation_m=run.load(scene)[1].geometry.deviation(),
    )
    return schema.to_dataset(values, attrs | told, _own())


def _own() -> dict[str, Any]:
    """Return the table of the study's own variables."""
    from functools import partial

    from hpgr.results.schema import Variable

    field, place, corner = ("streamline", "point"), ("shown_streamline", "shown_point"), ("corner",)
    product, frame, variant = ("product_streamline",), ("snapshot",), ("variant",)
    whole = partial(Variable, dtype=None)
    across = "across the gap, negative on the left"
    table = {
        "roll_radius": whole((), "m", "radius of the rolls"),
        "roll_axis_x": whole((), "m", "distance of the roll axes from the mid-plane", "at height 0"),
        "xi": whole(("streamline",), "1", "position of the streamline", "over half the gap, negative on the left"),
        "x": whole(field, "m", "distance from the mid-plane", across),
        "mid_gap_depth": whole(("point",), "m", "depth on the mid-plane", "below the top of the bed, where v = 0"),
        "mid_gap_pressure": whole(("point",), "Pa", "mean stress on the mid-plane"),
        "shown_x": whole(place, "m", "distance of the shown point from the mid-plane", across),
        "shown_height": whole(place, "m", "height of the shown point", "above the minimum gap"),
        "volume": whole(place, "m2", "volume per roll width", "area of the shown point's Voronoi cell"),
        "shown_time_step": whole((), "s", "time between neighbouring shown points"),
        "outline_cell": whole(("outline",), "1", "number of the right half's shown point", "that the outline is of"),
        "corner_outline": whole(corner, "1", "number of the outline", "that the corner is of"),
        "corner_x": whole(corner, "m", "distance of the corner from the mid-plane", "of a Voronoi cell, right half"),
        "corner_height": whole(corner, "m", "height of the corner", "of a Voronoi cell above the minimum gap"),
        "product_xi": whole(product, "1", "position of the stream tube", "distance from the mid-plane over half gap"),
        "passing": Variable((*product, "sieve"), "1", "mass fraction passing", "product of the stream tube"),
        "p50": Variable(product, "m", "product P50", "size that 50 % of the stream tube's product passes"),
        "p80": Variable(product, "m", "product P80", "size that 80 % of the stream tube's product passes"),
        "feed_passing": whole(("sieve",), "1", "mass fraction of the feed passing"),
        "snapshot": whole(frame, "1", "snapshot number", "of the start-up"),
        "elapsed_time": whole(frame, "s", "time since the machine was filled"),
        "steady": whole(frame, "1", "whether the snapshot is steady", "taken after one residence time"),
        "startup_p80": whole((*frame, *place), "m", "P80 at the shown point", "while the machine fills"),
        "assumption": whole(variant, "", "what is changed in the scene"),
    }
    for where, tube in {"mid_gap": "innermost", "roll": "outermost"}.items():
        table[f"assumed_peak_pressure_{where}"] = whole(variant, "Pa", f"peak pressure of the {tube} stream tube")
        table[f"assumed_p80_{where}"] = whole(variant, "m", f"product P80 of the {tube} stream tube")
    return table


def _refuse(scene: Scene, shown_points: int) -> None:
    if scene.rolls.gap == scene.rolls.entry_gap:
        raise ValueError("rolls.gap: got the entry gap; must be below it: there is no bed to draw; give a smaller gap")
    if scene.resolution.cells == 0:
        raise ValueError("--cells: got 0 (stress only); must be at least 1: figure 5 is of grains; give 2000")
    if shown_points < 3:
        raise ValueError(
            f"--shown-points: got {shown_points}; must be at least 3, to have something to see; such as 80"
        )


def mirrored(values, odd: bool = False) -> np.ndarray:
    """Return values over (streamline from the mid-plane outwards, ...) for both halves, the left roll first.

    The first streamline is doubled unless it is the mid-plane itself, which the caller then drops; odd ones, such as
    x, change sign on the left.
    """
    values = np.asarray(values)
    return np.concatenate([-values[::-1] if odd else values[::-1], values])


def _across(values, odd: bool = False) -> np.ndarray:
    """Return both halves of values whose first streamline is the mid-plane."""
    return np.delete(mirrored(values, odd), len(values) - 1, axis=0)


def _rolls(scene: Scene) -> dict[str, Any]:
    rolls = scene.rolls
    return {"roll_radius": rolls.diameter / 2, "roll_axis_x": (rolls.gap + rolls.diameter) / 2}


def _fields(scene: Scene) -> dict[str, Any]:
    """Return figures 3a, 3b and 4: everything that needs no grains, on the stream tubes' centres, mid-plane and rim."""
    from hpgr.bed import geometry, kinematics, stress
    from hpgr.bed.loaded import inputs_of

    inputs, substeps = inputs_of(scene), scene.elasticity.substeps
    xi = np.array([0.0, *geometry.centres(inputs.streamlines), 1.0])
    bed = inputs.between_rolls(xi)
    flow, *solid = inputs.laws()
    motion, strains = kinematics.move(bed, flow, inputs.surface_speed, inputs.stress_points)
    state = stress.load(*solid, motion, strains)
    found = {
        "x": motion.x,
        "height": motion.y,
        "speed": motion.speed,
        "volumetric_strain_rate": motion.volumetric_rate,
        "pressure": state.pressure,
        "shear_stress": state.shear_stress,
    }
    values = {name: _across(each[:, ::substeps], odd=name == "x") for name, each in found.items()}
    middle = len(xi) - 1
    values |= {"mid_gap_depth": bed.height - values["height"][middle], "mid_gap_pressure": values["pressure"][middle]}
    return values | {"xi": _across(xi, odd=True)}


def _shown(shown: Scene) -> dict[str, Any]:
    """Return figures 3c and 3d: few material points, their volumes, and the outlines of the right half's."""
    from hpgr.bed.loaded import inputs_of, load_bed

    bed = load_bed(inputs_of(shown, tessellated=True))
    motion, cells = bed.kinematics, bed.tessellation
    # the concave rim may cut a cell in two: outlines are of pieces
    pieces = [
        (number, np.asarray(piece.exterior.coords))
        for number, cell in enumerate(cells.cells)
        for piece in getattr(cell, "geoms", [cell])
    ]
    corners = np.concatenate([outline for _, outline in pieces])
    numbers = np.arange(len(pieces), dtype=np.int32)
    return {
        "shown_x": mirrored(motion.x, odd=True),
        "shown_height": mirrored(motion.y),
        "volume": mirrored(cells.volume),
        "shown_time_step": motion.time_step,
        "outline_cell": np.array([number for number, _ in pieces], np.int32),
        "corner_outline": np.repeat(numbers, [len(outline) for _, outline in pieces]),
        "corner_x": corners[:, 0],
        "corner_height": corners[:, 1],
    }


def _product(scene: Scene, seed: int) -> tuple[dict[str, Any], dict[str, str]]:
    """Return figure 5, the product of every stream tube from mid-plane to roll and the feed, and what is told of it."""
    from hpgr import run

    found = run.run_scene(scene.with_values({"resolution.record": "product", "resolution.sieves": _SIEVES}), seed)
    values = {name: found.values[name] for name in ("passing", "p50", "p80", "sieve")}
    values |= {"product_xi": found.values["xi"], "feed_passing": scene.feed.passing(_SIEVES)}
    return values, {"diagnostics": found.diagnostics, "solver": found.solver}


def _startup(shown: Scene, seed: int) -> dict[str, Any]:
    """Return P80 of the shown points while the machine, filled with feed, turns until it is steady."""
    from hpgr import run

    changed = {
        "resolution.cells": min(shown.resolution.cells, _STARTUP_CELLS),
        "resolution.record": "cells",
        "resolution.snapshots": 1,
        "exchange.record_startup": True,
        "exchange.start": "feed",
        "exchange.interval": max(1, round((shown.resolution.points - 1) / _FRAMES)),
    }
    if shown.exchange is None:  # the lattice without swaps gives the product that a scene without exchange has
        changed |= {"exchange.segregation": 0.0, "exchange.mixing": 0.0}
    machine = run.run_scene(shown.with_values(changed), seed).values
    p80 = np.quantile(machine["size"], 0.8, axis=-1)
    values = {name: machine[name] for name in ("elapsed_time", "steady")}
    return values | {"snapshot": machine["time"], "startup_p80": np.stack([mirrored(frame) for frame in p80])}


def variants(scene: Scene) -> dict[str, Scene]:
    """Return the scene without exchange, and with one assumption changed at a time, by what is changed.

    What the scene's laws have no field of is left out.
    """
    changed = {
        "c = 1": {"elasticity.exponent": 1.0},
        "phi held at the feed's": {"bed.max_solid_fraction": scene.bed.feed_solid_fraction},
        "phi up to 1": {"bed.max_solid_fraction": 1.0},
        "n = 0.5": {"strength.cushioning": 0.5},
        "n = inf": {"strength.cushioning": "inf"},
        "gamma = 0.35": {"fragments.exponent": 0.35},
        "crushed by p + 2q/3": {"strength.stress": "major"},
        "Euler integration": {"elasticity.integrator": "euler"},
        "speed exponent m = 0.5": {"flow.exponent": 0.5},
        "speed exponent m = 2": {"flow.exponent": 2.0},
        "first point at 0.1 H": {"flow.entry_fraction": 0.1},
    }
    base = scene.with_values({"exchange": None, "resolution.record": "product"})
    known = values_of(base)
    scenes = {name: base.with_values(values) for name, values in changed.items() if values.keys() <= known.keys()}
    strength = scene.exchange or scene.with_values({"exchange": {}}).exchange
    grid = {f"resolution.{name}": min(getattr(base.resolution, name), most) for name, most in _EXCHANGE_GRID.items()}
    name = f"exchange A = {strength.segregation:g}, B = {strength.mixing:g}"
    scenes[name] = base.with_values({"exchange": strength, "roll_width": None} | grid)
    return {"as it is, without exchange": base} | {name: other for name, other in scenes.items() if other != base}


def _assumptions(scene: Scene, seed: int) -> dict[str, Any]:
    """Return peak pressure and P80 at mid-gap and at the roll, with one assumption changed at a time."""
    from hpgr import run

    scenes = variants(scene)
    runs = [run.run_scene(other, seed).values for other in scenes.values()]
    found: dict[str, Any] = {"assumption": list(scenes)}
    for short, name in {"peak_pressure": "streamline_peak_pressure", "p80": "p80"}.items():
        for where, number in {"mid_gap": 0, "roll": -1}.items():
            found[f"assumed_{short}_{where}"] = [float(np.float32(each[name][number])) for each in runs]
    return found


def findings(result: "xr.Dataset") -> list[str]:
    """Return lines that put numbers beside what the paper says of its figures in words."""
    lines = [_pressure_words(result), _across_words(result), _product_words(result)]
    if "assumption" in result:
        lines += ["", *_assumption_table(result).splitlines(), ""]
    return lines


def crossing_heights(result: "xr.Dataset", fractions: Sequence[float]) -> list[float]:
    """Return the heights in m at which the mid-gap pressure first exceeds these fractions of its peak."""
    pressure, height = result["mid_gap_pressure"].values, result["height"].sel(streamline=_middle(result)).values
    return [float(height[np.argmax(pressure > fraction * pressure.max())]) for fraction in fractions]


def _middle(result) -> int:
    return result.sizes["streamline"] // 2


def _pressure_words(result) -> str:
    middle = _middle(result)
    pressure, height = result["mid_gap_pressure"].values, result["height"].values[middle]
    if not pressure.any():
        return "figure 4: the bed is not compacted, there is no pressure"
    top = height + result["mid_gap_depth"].values
    begin, tenth, most = (1e3 * one for one in crossing_heights(result, (0.0, 0.1, 0.9)))
    peak = int(pressure.argmax())
    highest, last = 1e-6 * pressure[peak], 1e-6 * pressure[-1]
    return (
        f"figure 4c: mid-gap pressure is zero down to {begin:.0f} mm above the gap (bed {1e3 * top[0]:.0f} mm high), "
        f"rises from 10 % to 90 % of its peak between {tenth:.0f} and {most:.0f} mm, peaks with {highest:.4g} MPa at "
        f"{1e3 * height[peak]:.0f} mm, and is {last:.4g} MPa at the gap"
    )


def _across_words(result) -> str:
    middle = _middle(result)
    row = result["pressure"].values[middle:, -1].astype(float)
    falls = bool((np.diff(row) < 0).all())
    shown = "falls all the way" if falls else "does not fall all the way"
    ratio = f"{100 * (row[-1] / row[0] - 1):+.1f} %" if row[0] > 0 else "no pressure"
    return f"figure 4a: at the gap, mean stress {shown} from mid-gap to the roll ({ratio})"


def _product_words(result) -> str:
    p80 = 1e3 * result["p80"].values.astype(float)
    apart = 100 * (result["passing"].values[0] - result["passing"].values[-1]).astype(float)
    return (
        f"figure 5: P80 is {p80[0]:.4g} mm in the innermost stream tube and {p80[-1]:.4g} mm in the outermost "
        f"({100 * (p80[-1] / p80[0] - 1):+.1f} %); at the sieves the innermost passes up to {apart.max():.2f} percent "
        f"points more, and at most {max(-apart.min(), 0.0):.2f} less"
    )


def _assumption_table(result) -> str:
    from studies.show.report import aligned

    columns = []
    for name, factor, form in (("peak_pressure", 1e-6, ".2f"), ("p80", 1e3, ".4g")):
        inner, outer = (
            factor * result[f"assumed_{name}_{where}"].values.astype(float) for where in ("mid_gap", "roll")
        )
        ratios = [f"{roll / middle:.3f}" if middle > 0 else "-" for middle, roll in zip(inner, outer, strict=True)]
        columns += [[format(one, form) for one in each] for each in (inner, outer)] + [ratios]
    headings = ["assumption", "peak pressure [MPa]: mid-gap", "roll", "ratio", "P80 [mm]: mid-gap", "roll", "ratio"]
    return aligned(headings, zip(result["assumption"].values, *columns, strict=True), words=1)


if __name__ == "__main__":
    raise SystemExit(main())
