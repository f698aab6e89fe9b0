"""The paper's figures 3a-d, 4a-c and 5, and how the bed fills: `python -m studies.paper`.

Everything drawn is in one NetCDF file, mirrored: both halves of the gap, from the left roll to the right one.
"""

import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro

from hpgr.keys import refuse_key
from hpgr.scene import Scene
from studies.command import base_scene, refusing, shown_as

if TYPE_CHECKING:
    import xarray as xr

FIGURES = ("paper_figure3.png", "paper_figure4.png", "paper_figure5.png")
ANIMATION = "paper_startup.gif"

_FRAMES = 80  # photographs of the start-up at most, about
_STARTUP_CELLS = 400  # of a material point in the animation, whose P80 then scatters by some per cent
_EXCHANGE_GRID = {"points": 200, "cells": 2000}  # at most, of the one assumption that needs the whole lattice
_SIEVES = tuple(float(f"{10 ** (k / 20 - 6):.6g}") for k in range(121))  # 1 um to 1 m, twice as fine as the default


@dataclass(frozen=True)
class Options:
    """Options of the figures."""

    scene: Annotated[str, shown_as("PRESET|FILE")] = "paper"
    """Scene: a preset (paper, khd_pilot), or the path of a .toml or .json scene file."""
    level: Annotated[Literal["draft", "standard", "fine"] | None, shown_as("draft|standard|fine")] = None
    """Named resolution of figures 3a, 3b, 4 and 5 (default: fine; with exchange standard)."""
    cells: Annotated[int | None, shown_as("N")] = None
    """Cells per material point, instead of a level; what is not given is then the scene's."""
    points: Annotated[int | None, shown_as("N")] = None
    """Material points per streamline, instead of a level."""
    streamlines: Annotated[int | None, shown_as("N")] = None
    """Streamlines from the mid-plane to the roll, instead of a level."""
    shown_points: Annotated[int, shown_as("N")] = 80
    """Material points per streamline in figures 3c and 3d and in the animation: few enough to be seen."""
    exchange: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Switch on segregation and mixing between streamlines, as the scene says, or else with default strength."""
    assumptions: bool = True
    """Run the scene with other assumptions too, and say what they change, or not."""
    animation: bool = True
    """Draw the animation of the start-up, or not."""
    seed: Annotated[int, shown_as("N")] = 0
    """Seed of all randomness; the same seed gives the same bits."""
    out: Annotated[Path, shown_as("FOLDER")] = Path("outputs")
    """Folder for paper.nc, paper_figure3.png, paper_figure4.png, paper_figure5.png and paper_startup.gif."""


@refusing
def main(arguments: Sequence[str] | None = None) -> int:
    """Draw the figures and return the exit code, 0 or 2; `arguments` default to the command line's."""
    options = tyro.cli(Options, prog="python -m studies.paper", description=__doc__, args=arguments)
    scene = _scene(options)
    refuse_key("--seed", options.seed)
    from studies import store

    store.probe(options.out / "paper.nc")
    result = study(scene, options.shown_points, options.seed, options.animation, options.assumptions)
    given = sys.argv[1:] if arguments is None else arguments
    result.attrs["history"] = f"python -m studies.paper {shlex.join(given)}".strip()
    written = _write(result, options)
    print("\n".join(findings(result)))
    print("wrote " + ", ".join(map(str, written)))
    return 0


def study(
    scene: Scene, shown_points: int = 80, seed: int = 0, animation: bool = True, assumptions: bool = True
) -> "xr.Dataset":
    """Return everything the figures and the animation show, labelled, in SI units.

    Parameters
    ----------
    scene : Scene
        What is simulated, at its own resolution.
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
        roll; `startup_p80` over photographs; pressures and P80 by assumption.

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
    import xarray as xr

    _refuse(scene, shown_points)
    shown = scene.with_values({"resolution.points": shown_points})
    result = xr.Dataset()
    _add_rolls(result, scene)
    _add_fields(result, scene)
    _add_shown(result, shown)
    _add_product(result, scene, seed)
    if animation:
        _add_startup(result, shown, seed)
    if assumptions:
        _add_assumptions(result, scene, seed)
    return result.assign_attrs(_attributes(scene, shown_points, seed) | result.attrs)


def _scene(options: Options) -> Scene:
    names = ("level", "cells", "points", "streamlines")
    given = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    scene = base_scene(options.scene)
    if options.exchange and scene.exchange is None:
        scene = scene.with_values({"exchange": {}})
    given = given or {"level": "fine" if scene.exchange is None else "standard"}
    return scene.with_values({f"resolution.{name}": value for name, value in given.items()})


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
    values = np.asarray(values)
    return np.concatenate([mirrored(values, odd)[: len(values) - 1], values])


def _add_rolls(result, scene: Scene) -> None:
    result["roll_radius"] = ((), scene.rolls.diameter / 2, {"units": "m", "long_name": "radius of the rolls"})
    attrs = {"units": "m", "long_name": "distance of the roll axes from the mid-plane, at height 0"}
    result["roll_axis_x"] = ((), (scene.rolls.gap + scene.rolls.diameter) / 2, attrs)


def _add_fields(result, scene: Scene) -> None:
    """Add figures 3a, 3b and 4: everything that needs no grains, on the stream tubes' centres, mid-plane and rim."""
    from hpgr import flow, geometry, schema, stress

    bed = geometry.bed(scene.rolls, scene.resolution.streamlines)
    bed = bed._replace(xi=np.array([0.0, *bed.xi, 1.0]))
    grid, substeps = scene.resolution, scene.stress.substeps
    motion = flow.move(scene, bed, (grid.points - 1) * substeps + 1)
    state = stress.load(scene, motion)
    place = {"xi": bed.xi, "x": motion.x, "height": motion.y}
    for name, values in place.items():
        values = _across(values, odd=name != "height")
        dims = schema.COORDINATES[name].dims
        values = values if name == "xi" else values[:, ::substeps]
        result.coords[name] = (dims, values, schema.attributes(name))
    result["x"].attrs["long_name"] = "distance from the mid-plane, across the gap, negative on the left"
    result["xi"].attrs["long_name"] += ", negative on the left"
    fields = {
        "speed": motion.speed,
        "volumetric_strain_rate": motion.volumetric_rate,
        "pressure": state.pressure,
        "shear_stress": state.shear_stress,
    }
    for name, values in fields.items():
        result[name] = (("streamline", "point"), _across(values)[:, ::substeps], schema.attributes(name))
    middle = len(bed.xi) - 1
    attrs = {"units": "m", "long_name": "depth on the mid-plane below the top of the bed, where the speed is zero"}
    result["mid_gap_depth"] = ("point", bed.height - result["height"].values[middle], attrs)
    attrs = {"units": "Pa", "long_name": "mean stress on the mid-plane"}
    result["mid_gap_pressure"] = ("point", result["pressure"].values[middle], attrs)
    result.attrs["streamline_deviation_m"] = bed.deviation()


def _add_shown(result, shown: Scene) -> None:
    """Add figures 3c and 3d: few material points, their volumes, and the outlines of the right half's."""
    from hpgr import flow, geometry, tessellation

    bed = geometry.bed(shown.rolls, shown.resolution.streamlines)
    motion = flow.move(shown, bed, shown.resolution.points)
    cells = tessellation.tessellate(shown, bed, motion)
    dims = ("shown_streamline", "shown_point")
    attrs = {"units": "m", "long_name": "distance of the shown point from the mid-plane, negative on the left"}
    result.coords["shown_x"] = (dims, mirrored(motion.x, odd=True), attrs)
    attrs = {"units": "m", "long_name": "height of the shown point above the minimum gap"}
    result.coords["shown_height"] = (dims, mirrored(motion.y), attrs)
    attrs = {"units": "m2", "long_name": "area of the Voronoi cell of the shown point, volume per roll width"}
    result["volume"] = (dims, mirrored(cells.volume), attrs)
    attrs = {"units": "s", "long_name": "time between neighbouring shown points of a streamline"}
    result["shown_time_step"] = ((), motion.time_step, attrs)
    # the concave rim may cut a cell in two: outlines are of pieces
    pieces = [
        (number, np.asarray(piece.exterior.coords))
        for number, cell in enumerate(cells.cells)
        for piece in getattr(cell, "geoms", [cell])
    ]
    corners = np.concatenate([outline for _, outline in pieces])
    sizes = [len(outline) for _, outline in pieces]
    attrs = {"units": "1", "long_name": "number of the right half's shown point that the outline is of"}
    result["outline_cell"] = ("outline", np.array([number for number, _ in pieces], np.int32), attrs)
    attrs = {"units": "1", "long_name": "number of the outline that the corner is of"}
    result["corner_outline"] = ("corner", np.repeat(np.arange(len(pieces), dtype=np.int32), sizes), attrs)
    attrs = {"units": "m", "long_name": "distance of the corner of a Voronoi cell from the mid-plane, right half"}
    result["corner_x"] = ("corner", corners[:, 0], attrs)
    attrs = {"units": "m", "long_name": "height of the corner of a Voronoi cell above the minimum gap"}
    result["corner_height"] = ("corner", corners[:, 1], attrs)


def _add_product(result, scene: Scene, seed: int) -> None:
    """Add figure 5: the product of every stream tube from the mid-plane to the roll, and the feed."""
    import hpgr
    from hpgr import feed

    product = hpgr.simulate(scene.with_values({"resolution.record": "product", "resolution.sieves": _SIEVES}), seed)
    attrs = dict(
        product["xi"].attrs, long_name="position of the stream tube: distance from the mid-plane over half gap"
    )
    result.coords["product_xi"] = ("product_streamline", product["xi"].values, attrs)
    result.coords["sieve"] = product["sieve"]
    for name in ("passing", "p50", "p80"):
        result[name] = product[name].drop_vars("xi").rename(streamline="product_streamline")
    attrs = {"units": "1", "long_name": "mass fraction of the feed passing"}
    result["feed_passing"] = ("sieve", feed.passing(scene.feed, np.array(_SIEVES)), attrs)
    result.attrs |= {name: product.attrs[name] for name in ("notes", "solver")}


def _add_startup(result, shown: Scene, seed: int) -> None:
    """Add P80 of the shown points while the machine, filled with feed, turns until it is steady."""
    import hpgr

    points = shown.resolution.points
    values = {
        "resolution.cells": min(shown.resolution.cells, _STARTUP_CELLS),
        "resolution.record": "cells",
        "resolution.photographs": 1,
        "exchange.record_startup": True,
        "exchange.fill": "feed",
        "exchange.interval": max(1, round((points - 1) / _FRAMES)),
    }
    if shown.exchange is None:  # the lattice without swaps gives the product that a scene without exchange has
        values |= {"exchange.segregation": 0.0, "exchange.mixing": 0.0}
    machine = hpgr.simulate(shown.with_values(values), seed)
    p80 = np.quantile(machine["size"].values, 0.8, axis=-1)
    attrs = {"units": "1", "long_name": "number of the photograph"}
    result.coords["photograph"] = ("photograph", machine["time"].values, attrs)
    result.coords["elapsed_time"] = ("photograph", machine["elapsed_time"].values, machine["elapsed_time"].attrs)
    result.coords["steady"] = ("photograph", machine["steady"].values, machine["steady"].attrs)
    attrs = {"units": "m", "long_name": "size that 80 % of the mass at the shown point passes"}
    both = np.stack([mirrored(frame) for frame in p80])
    result["startup_p80"] = (("photograph", "shown_streamline", "shown_point"), both, attrs)


def variants(scene: Scene) -> dict[str, Scene]:
    """Return the scene without exchange, and with one assumption changed at a time, by what is changed."""
    ore, base = scene.material, scene.with_values({"exchange": None, "resolution.record": "product"})
    changed = {
        "as it is, without exchange": {},
        "c = 1": {"material.elastic_exponent": 1.0},
        "phi held at the feed's": {"material.max_solid_fraction": ore.feed_solid_fraction},
        "phi up to 1": {"material.max_solid_fraction": 1.0},
        "n = 0.5": {"material.cushioning": 0.5},
        "n = inf": {"material.cushioning": "inf"},
        "gamma = 0.35": {"material.fragment_exponent": 0.35},
        "crushed by p + 2q/3": {"stress.crushing": "major"},
        "Euler integration": {"stress.integrator": "euler"},
        "speed exponent m = 0.5": {"flow.exponent": 0.5},
        "speed exponent m = 2": {"flow.exponent": 2.0},
        "first point at 0.1 H": {"flow.entry_fraction": 0.1},
    }
    scenes = {name: base.with_values(values) for name, values in changed.items()}
    strength = scene.exchange or scene.with_values({"exchange": {}}).exchange
    grid = {f"resolution.{name}": min(getattr(base.resolution, name), most) for name, most in _EXCHANGE_GRID.items()}
    name = f"exchange A = {strength.segregation:g}, B = {strength.mixing:g}"
    scenes[name] = base.with_values({"exchange": strength} | grid)
    first = next(iter(scenes))
    return {name: other for name, other in scenes.items() if name == first or other != base}


def _add_assumptions(result, scene: Scene, seed: int) -> None:
    """Add peak pressure and P80 at mid-gap and at the roll, with one assumption changed at a time."""
    import hpgr

    scenes = variants(scene)
    runs = [hpgr.simulate(other, seed) for other in scenes.values()]
    result.coords["assumption"] = ("variant", list(scenes), {"long_name": "what is changed in the scene"})
    words = {"streamline_peak_pressure": "largest mean stress on", "p80": "product P80 of"}
    for name, what in words.items():
        for place, number in {"mid_gap": 0, "roll": -1}.items():
            short = {"streamline_peak_pressure": "peak_pressure"}.get(name, name)
            tube = "innermost" if number == 0 else "outermost"
            attrs = {"units": runs[0][name].attrs["units"], "long_name": f"{what} the {tube} stream tube"}
            result[f"assumed_{short}_{place}"] = ("variant", [float(run[name][number]) for run in runs], attrs)


def _attributes(scene: Scene, shown_points: int, seed: int) -> dict[str, Any]:
    import hpgr

    return {
        "Conventions": "CF-1.11",
        "title": "Figures 3, 4 and 5 of 'Heterarchical model of comminution in high pressure grinding rolls'",
        "source": f"hpgr {hpgr.__version__}",
        "history": f"hpgr {hpgr.__version__}: studies.paper.study(scene, {shown_points}, seed={seed})",
        "scene": scene.model_dump_json(),
        "shown_points": shown_points,
        "seed": seed,
    }


def findings(result: "xr.Dataset") -> list[str]:
    """Return lines that put numbers beside what the paper says of its figures in words."""
    lines = [_pressure_words(result), _across_words(result), _product_words(result)]
    if "assumption" in result:
        lines += ["", *_assumption_lines(result), ""]
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


def _assumption_lines(result) -> list[str]:
    names = ("assumed_peak_pressure_mid_gap", "assumed_peak_pressure_roll", "assumed_p80_mid_gap", "assumed_p80_roll")
    columns = [result[name].values.astype(float) for name in names]
    width = max(map(len, result["assumption"].values))
    lines = [f"{'assumption':<{width}}  peak pressure [MPa]: mid-gap, roll, ratio      P80 [mm]: mid-gap, roll, ratio"]
    for name, p_mid, p_roll, s_mid, s_roll in zip(result["assumption"].values, *columns, strict=True):
        p_ratio = f"{p_roll / p_mid:.3f}" if p_mid > 0 else "-"
        lines.append(
            f"{name:<{width}}  {1e-6 * p_mid:18.2f} {1e-6 * p_roll:10.2f} {p_ratio:>8}  "
            f"{1e3 * s_mid:24.4g} {1e3 * s_roll:8.4g} {s_roll / s_mid:8.3f}"
        )
    return lines


def _write(result: "xr.Dataset", options: Options) -> list[Path]:
    """Write the NetCDF file, the figures and the animation; return their paths."""
    from studies import store
    from studies.plots import paper as plots

    folder = options.out
    drawn = dict(zip(FIGURES, (plots.figure3, plots.figure4, plots.figure5), strict=True))
    try:
        store.write_dataset(result, folder / "paper.nc")
        for name, draw in drawn.items():
            figure = draw(result)
            store.replace(folder / name, lambda part, figure=figure: figure.savefig(part, dpi=110))
        if options.animation:
            store.replace(folder / ANIMATION, lambda part: plots.startup_animation(result, part))
    except OSError as error:
        raise OSError(f"could not write the result: {error}") from error
    names = ["paper.nc", *FIGURES, *([ANIMATION] if options.animation else [])]
    return [folder / name for name in names]


if __name__ == "__main__":
    raise SystemExit(main())
