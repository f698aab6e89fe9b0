"""The one door from a scene to its results: floats the gap, loads the bed, crushes the feed, labels what comes out.

Not simulate.py: importing a module of that name would replace the function `hpgr.simulate` by the module.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hpgr import __version__, cost
from hpgr.bed import machine, stress
from hpgr.bed.loaded import Beds, LoadedBed, inputs_of
from hpgr.fields import check_number
from hpgr.grains import solve
from hpgr.results import flags, schema
from hpgr.scene import Scene, check_scene
from hpgr.tolerance import refine

if TYPE_CHECKING:
    import xarray as xr

_LAST = Beds(1)  # a bed costs 0.5 ms, and calls that differ in seed, feed or ore alone have the same
_KEPT = 100_000  # points of a bed at most for it to be kept, which takes some 20 MB


class Result(NamedTuple):
    """What a run gives."""

    scene: Scene  # that was run, its gap the one that carries the pressing force
    bed: LoadedBed
    values: dict[str, Any]  # every variable of the Dataset by name, unrounded; None where the scene has none
    diagnostics: str  # a line for each limit that was hit
    solver: str


def load(scene: Scene, beds: Beds | None = None) -> tuple[Scene, LoadedBed]:
    """Return `scene` with the gap that carries its pressing force, or its own if it has none, and the bed loaded there.

    `beds` are shared by scenes that differ in the ore's strength, fragments or cells alone; default: the bed of the
    last call, if it is small. ValueError if no gap carries the pressing force, or material points coincide.
    """
    scene = machine.float_gap(scene)
    inputs = inputs_of(scene, tessellated=solve.choose(scene).endswith("lattice"))
    if beds is None:
        beds = _LAST if inputs.streamlines * inputs.stress_points <= _KEPT else Beds(1)
    return scene, beds.load(inputs)


def run_scene(scene: Scene, seed: int = 0, replicate: int = 0, beds: Beds | None = None) -> Result:
    """Run `scene`, its gap floated.

    Studies take their figures from here: making a Dataset of every case would cost them as much as crushing.

    Examples
    --------
    >>> import hpgr
    >>> from hpgr.run import run_scene
    >>> result = run_scene(hpgr.presets.industrial().with_values({"rolls.specific_pressing_force": "4 N/mm^2"}))
    >>> round(result.scene.rolls.gap, 4), round(float(result.values["specific_pressing_force"]))
    (0.059, 4000000)
    """
    [[result]] = run_together([(scene, [replicate])], seed, beds)
    return result


def run_together(points: list[tuple[Scene, Sequence[int]]], seed: int, beds: Beds | None = None) -> list[list[Result]]:
    """Run each scene once for every one of its replicates.

    Replicates share their bed and what is known of it; scenes that differ by feed and load alone share calls of the
    kernels. All beds are held at once.
    """
    loaded = [solve.Loaded(*load(scene, beds), replicates) for scene, replicates in points]
    return [_results(*one[:2], products) for one, products in zip(loaded, solve.crush(loaded, seed), strict=True)]


def _results(scene: Scene, bed: LoadedBed, products: list[solve.Crushed | None]) -> list[Result]:
    throughput = machine.gap_throughput(scene, float(bed.stress.solid_fraction[:, -1].mean()))
    performance = machine.performance(scene, bed.pressed, throughput)
    of_bed = _fields(bed) | _summaries(scene, bed) | performance._asdict() | {"throughput": throughput}
    limits = flags.diagnose(scene, bed, performance, products)
    solver = solve.choose(scene) + ", control variate" * solve.is_controlled(scene)
    return [
        Result(
            scene,
            bed,
            of_bed | _product(scene, crushed) | {"flags": sum(flags.BITS[name] for name in found)},
            "\n".join(f"{name}: {words}" for name, words in found.items()),
            solver,
        )
        for crushed, found in zip(products, limits, strict=True)
    ]


def simulate(
    scene: Scene, seed: int = 0, replicate: int = 0, tolerance: float | None = None, max_cost: float = 60.0
) -> "xr.Dataset":
    """Simulate the steady machine of `scene`.

    Parameters
    ----------
    scene : Scene
        What is simulated; `scene.resolution.record` decides what is kept.
    seed : int
        Seed of all randomness, at least 0. The same scene and seed give the same bits.
    replicate : int
        Number of an independent repetition with the same seed, at least 0.
    tolerance : float, optional
        Wanted relative error, 1e-4 to 0.5, of P80, the fraction below 1 mm and peak pressure: points, streamlines
        and cells are then chosen so that the estimated error, bias + 2 standard errors, is below it. The Dataset
        then has `p80_total_error`, `fineness_error` and `peak_pressure_error`.
    max_cost : float
        Predicted seconds that meeting the tolerance may take.

    Returns
    -------
    xarray.Dataset
        Dims time (snapshots of the steady machine), streamline (mid-plane to roll), point (entry to
        exit), cell and sieve; SI units. `attrs["scene"]` rebuilds the scene with
        `Scene.model_validate_json`; `flags` and `attrs["diagnostics"]` tell which limits were hit.

    Raises
    ------
    TypeError
        If `scene` is none, such as the path of one.
    ValueError
        If the tolerance or `max_cost` is not a number in its range, or the seed or replicate not a whole number from 0
        to 2**63 - 1; if material points coincide, if exchange would need absurdly many substeps, if no gap carries the
        scene's pressing force, or if the tolerance cannot be met under `max_cost`.
    MemoryError
        If the scene does not fit this machine's memory; the message has the predicted bytes.

    Examples
    --------
    >>> import hpgr
    >>> scene = hpgr.presets.paper().with_values({"resolution.cells": 200, "resolution.points": 50})
    >>> dataset = hpgr.simulate(scene)
    >>> dict(dataset["size"].sizes)
    {'time': 1, 'streamline': 10, 'point': 50, 'cell': 200}
    """
    check_scene(scene)
    for name, value in {"seed": seed, "replicate": replicate, "max_cost": max_cost}.items():
        check_number(name, value)
    chosen = {}
    if tolerance is not None:
        estimate = refine(scene, tolerance, run_scene, max_cost, seed)
        scene, chosen = estimate.scene, estimate.variables()
    cost.refuse_too_large(scene)
    result = run_scene(scene, seed, replicate)
    history = f"hpgr {__version__}: simulate(scene, seed={seed}, replicate={replicate})"
    title = "Comminution in high pressure grinding rolls, heterarchical model"
    return schema.to_dataset(result.values | chosen, attributes(result, title, seed, replicate) | {"history": history})


def attributes(result: Result, title: str, seed: int, replicate: int) -> dict[str, Any]:
    """Return the attributes of a Dataset of one run."""
    return schema.dataset_attributes(
        title,
        scene=result.scene.model_dump_json(),
        level=result.scene.resolution.level(),
        seed=int(seed),
        replicate=int(replicate),
        solver=result.solver,
        time_step_s=result.bed.kinematics.time_step,
        streamline_deviation_m=result.bed.geometry.deviation(),
        diagnostics=result.diagnostics,
    )


def _fields(bed: LoadedBed) -> dict[str, Any]:
    motion, state = bed.kinematics, bed.stress._asdict()
    return {name: field for name, field in state.items() if name in schema.VARIABLES} | {
        # copies of what is stored as it is, for a bed may be kept and a Dataset's arrays are its user's
        "xi": bed.geometry.xi.copy(),
        "x": bed.geometry.x(motion.y),
        "height": motion.y.copy(),
        "residence_time": np.tile(motion.time_step * np.arange(motion.y.shape[1]), (motion.y.shape[0], 1)),
        "speed": motion.speed,
        "volumetric_strain_rate": motion.volumetric_rate,
        "shear_strain_rate": motion.shear_rate,
        "volume": None if bed.tessellation is None else bed.tessellation.volume,
    }


def _summaries(scene: Scene, bed: LoadedBed) -> dict[str, Any]:
    pressure = bed.stress.pressure
    peak = pressure.argmax(axis=1)
    lines = np.arange(peak.size)
    peaks, heights = pressure[lines, peak], bed.kinematics.y[lines, peak]
    highest = int(peaks.argmax())
    return {
        "operating_gap": None if scene.rolls.specific_pressing_force is None else scene.rolls.gap,
        "peak_pressure": peaks[highest],
        "peak_pressure_height": heights[highest],
        "streamline_peak_pressure": peaks,
        "streamline_peak_pressure_height": heights,
        "continuity_solid_fraction": stress.continuity_solid_fraction(bed.stress, scene.bed.feed_solid_fraction),
        "shear_limit_fraction": bed.stress.on_shear_limit.mean(),
    }


def _product(scene: Scene, crushed: solve.Crushed | None) -> dict[str, Any]:
    if crushed is None:
        return {}
    frames = next((part.shape[0] for part in (crushed.size, crushed.mass_fraction) if part is not None), None)
    values = {
        "time": None if frames is None else np.arange(frames),
        "sieve": scene.resolution.sieves,
        "size": crushed.size,
        "mass_fraction": crushed.mass_fraction,
        "passing": crushed.passing,
        "passing_total": crushed.total_passing,
        "p50": crushed.percentiles[0],
        "p80": crushed.percentiles[1],
        "p50_total": crushed.total_percentiles[0],
        "p80_total": crushed.total_percentiles[1],
        "breaks_per_cell": crushed.breaks,
        "below_floor": crushed.below_floor,
    }
    if crushed.along_width is not None:
        values |= _along_width(scene, crushed.along_width)
    exchanged = crushed.exchanged
    if exchanged is not None:
        values |= {"swaps_per_cell": exchanged.swaps_per_cell, "exchange_substeps": exchanged.substeps}
        if frames is not None:
            values |= {"elapsed_time": exchanged.elapsed_time, "steady": exchanged.steady}
    return values


def _along_width(scene: Scene, found: solve.AlongWidth) -> dict[str, Any]:
    return {
        "width_position": scene.roll_width.cut(scene.rolls.gap, scene.rolls.width).position,
        "passing_slice": found.passing,
        "passing_width_centre": found.centre_passing,
        "passing_width_edge": found.edge_passing,
        "p50_width_centre": found.centre_percentiles[0],
        "p80_width_centre": found.centre_percentiles[1],
        "p50_width_edge": found.edge_percentiles[0],
        "p80_width_edge": found.edge_percentiles[1],
    }
