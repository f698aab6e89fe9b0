"""The paper's figures 3a-d, 4a-c and 5, and how the bed fills: `python -m studies.paper`.

Everything drawn is in one NetCDF file, mirrored: both halves of the gap, from the left roll to the right one. Where the
scene has a pressing force, all is drawn at the gap that carries it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from hpgr.fields import values_of
from hpgr.scene import Scene
from studies import Late
from studies import command as cli

if TYPE_CHECKING:
    import xarray as xr

loaded, run, schema = Late("hpgr.bed.loaded"), Late("hpgr.run"), Late("hpgr.results.schema")

FIGURES = ("paper_figure3.png", "paper_figure4.png", "paper_figure5.png")
ANIMATION = "paper_startup.gif"

_FRAMES = 80  # snapshots of the start-up at most, about
_STARTUP_CELLS = 400  # of a material point in the animation, whose P80 then scatters by some per cent
_EXCHANGE_GRID = {"points": 200, "cells": 2000}  # at most, of the one assumption that needs the whole lattice
_SIEVES = tuple(float(f"{10 ** (k / 20 - 6):.6g}") for k in range(121))  # 1 um to 1 m, twice as fine as the default


@dataclass(frozen=True)
class Options:
    """Options of the figures; without level, cells, points and streamlines level fine, with exchange standard."""

    scene: cli.SceneName = "paper"
    level: cli.Level = None
    cells: cli.Cells = None
    points: cli.Points = None
    streamlines: cli.Streamlines = None
    shown_points: Annotated[int, cli.shown_as("N")] = 80
    """Material points per streamline in figures 3c and 3d and in the animation: few enough to be seen."""
    exchange: cli.Exchange = False
    assumptions: bool = True
    """Run the scene with other assumptions too, and say what they change, or not."""
    animation: bool = True
    """Draw the animation of the start-up, or not."""
    seed: cli.Seed = 0
    out: Annotated[Path, cli.shown_as("FOLDER")] = Path("outputs")
    """Folder for paper.nc, paper_figure3.png, paper_figure4.png, paper_figure5.png and paper_startup.gif."""
    overwrite: cli.Overwrite = False


def _files(options: Options) -> list[Path]:
    return [options.out / name for name in ("paper.nc", *FIGURES, *([ANIMATION] if options.animation else []))]


@cli.command("paper", __doc__, files=_files)
def main(options: Options) -> cli.Report:
    """Draw the figures of the command line."""
    scene = cli.base_scene(options)
    if all(value is None for value in (options.level, options.cells, options.points, options.streamlines)):
        scene = scene.with_values({"resolution": "fine" if scene.exchange is None else "standard"})
    result = study(scene, options.shown_points, options.seed, options.animation, options.assumptions)
    from studies.show.plots import paper as plots

    every = (plots.figure3, plots.figure4, plots.figure5)
    figures = [cli.figure(lambda draw=draw: draw(result), dpi=110) for draw in every]
    animation = lambda path, history: plots.startup_animation(result, path, history)  # noqa: E731
    return cli.Report(findings(result), [result, *figures, animation])


def study(
    scene: Scene, shown_points: int = 80, seed: int = 0, animation: bool = True, assumptions: bool = True
) -> "xr.Dataset":
    """Return everything the figures and the animation show, labelled, in SI units.

    Fields are over (streamline, point), the left roll to the right one, mid-plane and outermost streamlines included;
    products over (product_streamline, sieve), the mid-plane to the roll. Where single points are drawn, figures 3c,
    3d and the start-up, there are `shown_points` on a streamline. ValueError if there is no bed to draw, or nothing to
    crush.

    Examples
    --------
    >>> import hpgr
    >>> from studies.paper import study
    >>> small = {"resolution.streamlines": 3, "resolution.points": 50, "resolution.cells": 100}
    >>> result = study(hpgr.presets.paper().with_values(small), shown_points=20, assumptions=False)
    >>> dict(result["pressure"].sizes)
    {'streamline': 9, 'point': 50}
    """
    _refuse(scene, shown_points)
    floated = run.load(scene)[0]
    # everything is drawn at this gap, also what has another number of points, or another law
    scene = floated.with_values({"rolls.specific_pressing_force": None})
    shown = scene.with_values({"resolution.points": shown_points})
    values, told = _product(scene, seed)
    values |= _fields(scene) | _shown(shown)
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
    place, product = ("shown_streamline", "shown_point"), ("product_streamline",)
    whole = partial(schema.Variable, dtype=None)
    point, corner, variant = partial(whole, place), partial(whole, ("corner",)), partial(whole, ("variant",))
    frame, left = partial(whole, ("snapshot",)), "negative on the left"
    return {
        "roll_radius": whole((), "m", "radius of the rolls"),
        "roll_axis_x": whole((), "m", "distance of the roll axes from the mid-plane"),
        "xi": whole(("streamline",), "1", "position of the streamline", f"over half the gap, {left}"),
        "x": whole(("streamline", "point"), "m", "distance from the mid-plane", left),
        "mid_gap_depth": whole(("point",), "m", "depth on the mid-plane", "below the top of the bed, where v = 0"),
        "shown_x": point("m", "distance of the shown point from the mid-plane", left),
        "shown_height": point("m", "height of the shown point"),
        "volume": point("m2", "volume per roll width", "area of the shown point's Voronoi cell"),
        "shown_time_step": whole((), "s", "time between neighbouring shown points"),
        "outline_cell": whole(("outline",), "1", "number of the right half's shown point"),
        "corner_outline": corner("1", "number of the outline"),
        "corner_x": corner("m", "distance of the corner from the mid-plane", "of a Voronoi cell, right half"),
        "corner_height": corner("m", "height of the corner", "of a Voronoi cell"),
        "product_xi": whole(product, "1", "position of the stream tube", "over half the gap"),
        "passing": schema.Variable((*product, "sieve"), "1", "mass fraction passing", "product of the stream tube"),
        "p50": schema.Variable(product, "m", "product P50"),
        "p80": schema.Variable(product, "m", "product P80"),
        "feed_passing": whole(("sieve",), "1", "mass fraction of the feed passing"),
        "snapshot": frame("1", "snapshot number", "of the start-up"),
        "elapsed_time": frame("s", "time since the machine was filled"),
        "steady": frame("1", "whether the snapshot is steady"),
        "startup_p80": whole(("snapshot", *place), "m", "P80 at the shown point"),
        "assumption": variant("", "what is changed in the scene"),
        "assumed_peak_pressure_mid_gap": variant("Pa", "peak pressure of the innermost stream tube"),
        "assumed_peak_pressure_roll": variant("Pa", "peak pressure of the outermost stream tube"),
        "assumed_p80_mid_gap": variant("m", "product P80 of the innermost stream tube"),
        "assumed_p80_roll": variant("m", "product P80 of the outermost stream tube"),
    }


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

    Odd ones, such as x, change sign on the left.
    """
    values = np.asarray(values)
    return np.concatenate([-values[::-1] if odd else values[::-1], values])


def _across(values, odd: bool = False) -> np.ndarray:
    """Return both halves of values whose first streamline is the mid-plane, which is there once."""
    return np.delete(mirrored(values, odd), len(values) - 1, axis=0)


def _fields(scene: Scene) -> dict[str, Any]:
    """Return figures 3a, 3b and 4: everything that needs no grains, on the stream tubes' centres, mid-plane and rim."""
    from hpgr.bed import geometry, kinematics, stress

    inputs, substeps = loaded.inputs_of(scene), scene.elasticity.substeps
    xi = np.array([0.0, *geometry.centres(inputs.streamlines), 1.0])
    bed = inputs.between_rolls(xi)
    flow, *solid = inputs.laws()
    motion, strains = kinematics.move(bed, flow, inputs.surface_speed, inputs.stress_points)
    state = stress.load(*solid, motion, strains)
    found = {
        "x": bed.x(motion.y),
        "height": motion.y,
        "speed": motion.speed,
        "volumetric_strain_rate": motion.volumetric_rate,
        "pressure": state.pressure,
        "shear_stress": state.shear_stress,
    }
    values = {name: _across(each[:, ::substeps], odd=name == "x") for name, each in found.items()}
    depth = bed.height - values["height"][len(xi) - 1]
    rolls = {"roll_radius": scene.rolls.diameter / 2, "roll_axis_x": (scene.rolls.gap + scene.rolls.diameter) / 2}
    return values | rolls | {"xi": _across(xi, odd=True), "mid_gap_depth": depth}


def _shown(shown: Scene) -> dict[str, Any]:
    """Return figures 3c and 3d: few material points, their volumes, and the outlines of the right half's."""
    bed = loaded.load_bed(loaded.inputs_of(shown, tessellated=True))
    motion, cells = bed.kinematics, bed.tessellation
    # the concave rim may cut a cell in two: outlines are of pieces
    parts = enumerate(getattr(cell, "geoms", [cell]) for cell in cells.cells)
    pieces = [(number, np.asarray(piece.exterior.coords)) for number, part in parts for piece in part]
    corners = np.concatenate([outline for _, outline in pieces])
    numbers = np.arange(len(pieces), dtype=np.int32)
    return {
        "shown_x": mirrored(bed.geometry.x(motion.y), odd=True),
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
    found = run.run_scene(scene.with_values({"resolution.record": "product", "resolution.sieves": _SIEVES}), seed)
    values = {name: found.values[name] for name in ("passing", "p50", "p80", "sieve")}
    values |= {"product_xi": found.values["xi"], "feed_passing": scene.feed.passing(_SIEVES)}
    return values, {"diagnostics": found.diagnostics, "solver": found.solver}


def _startup(shown: Scene, seed: int) -> dict[str, Any]:
    """Return P80 of the shown points while the machine, filled with feed, turns until it is steady."""
    changed = {
        "resolution.cells": min(shown.resolution.cells, _STARTUP_CELLS),
        "resolution.record": "cells",
        "resolution.snapshots": 1,
        "exchange.startup": "feed",
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
    scenes = variants(scene)
    runs = [run.run_scene(other, seed).values for other in scenes.values()]
    found: dict[str, Any] = {"assumption": list(scenes)}
    for short, name in {"peak_pressure": "streamline_peak_pressure", "p80": "p80"}.items():
        for where, number in {"mid_gap": 0, "roll": -1}.items():
            found[f"assumed_{short}_{where}"] = [float(np.float32(each[name][number])) for each in runs]
    return found


def findings(result: "xr.Dataset") -> list[str]:
    """Return lines that put numbers beside what the paper says of its figures in words."""
    middle = result.sizes["streamline"] // 2
    lines = [_pressure_words(result.isel(streamline=middle)), *_across_words(result, middle)]
    if "assumption" in result:
        lines += ["", *_assumption_table(result).splitlines(), ""]
    return lines


def crossing_heights(mid_gap: "xr.Dataset", fractions: Sequence[float]) -> list[float]:
    """Return the heights in m at which the pressure on a streamline first exceeds these fractions of its peak."""
    pressure, height = mid_gap["pressure"].values, mid_gap["height"].values
    return [float(height[np.argmax(pressure > fraction * pressure.max())]) for fraction in fractions]


def _pressure_words(mid_gap) -> str:
    pressure, height = 1e-6 * mid_gap["pressure"].values.astype(float), 1e3 * mid_gap["height"].values
    if not pressure.any():
        return "figure 4: the bed is not compacted, there is no pressure"
    begin, tenth, most = (1e3 * one for one in crossing_heights(mid_gap, (0.0, 0.1, 0.9)))
    peak = int(pressure.argmax())
    top = height[0] + 1e3 * float(mid_gap["mid_gap_depth"][0])
    return (
        f"figure 4c: mid-gap pressure is zero down to {begin:.0f} mm above the gap (bed {top:.0f} mm high), rises from "
        f"10 % to 90 % of its peak between {tenth:.0f} and {most:.0f} mm, peaks with {pressure[peak]:.4g} MPa at "
        f"{height[peak]:.0f} mm, and is {pressure[-1]:.4g} MPa at the gap"
    )


def _across_words(result, middle: int) -> list[str]:
    row = result["pressure"].values[middle:, -1].astype(float)
    falls = "falls" if (np.diff(row) < 0).all() else "does not fall"
    ratio = f"{100 * (row[-1] / row[0] - 1):+.1f} %" if row[0] > 0 else "no pressure"
    p80 = 1e3 * result["p80"].values.astype(float)
    apart = 100 * (result["passing"].values[0] - result["passing"].values[-1]).astype(float)
    return [
        f"figure 4a: at the gap, mean stress {falls} all the way from mid-gap to the roll ({ratio})",
        f"figure 5: P80 is {p80[0]:.4g} mm in the innermost stream tube and {p80[-1]:.4g} mm in the outermost "
        f"({100 * (p80[-1] / p80[0] - 1):+.1f} %); at the sieves the innermost passes up to {apart.max():.2f} percent "
        f"points more, and at most {max(-apart.min(), 0.0):.2f} less",
    ]


def _assumption_table(result) -> str:
    from studies.show.report import aligned

    columns = []
    for name, factor, form in (("peak_pressure", 1e-6, ".2f"), ("p80", 1e3, ".4g")):
        inner, outer = (factor * result[f"assumed_{name}_{side}"].values.astype(float) for side in ("mid_gap", "roll"))
        ratios = [f"{roll / middle:.3f}" if middle > 0 else "-" for middle, roll in zip(inner, outer, strict=True)]
        columns += [[format(one, form) for one in each] for each in (inner, outer)] + [ratios]
    headings = ["assumption", "peak pressure [MPa]: mid-gap", "roll", "ratio", "P80 [mm]: mid-gap", "roll", "ratio"]
    return aligned(headings, zip(result["assumption"].values, *columns, strict=True), words=1)


if __name__ == "__main__":
    raise SystemExit(main())
