"""Scene -> loaded bed -> crushed feed -> every variable of the Dataset, by name: the one pipeline."""

from typing import Any, NamedTuple

import numpy as np

from hpgr import exchange, flow, geometry, machine, metrics, schema, solve, stress, tessellation, width
from hpgr.scene import Scene

_NIPPING = 1.5  # top size over gap above which rolls nip single grains, which is not modelled


class Prepared(NamedTuple):
    """The loaded bed of a scene, which scenes of the same `bed_key` share.

    Attributes
    ----------
    bed : hpgr.geometry.Geometry
        The bed.
    motion : hpgr.flow.Motion
        Material points and strain rates.
    state : hpgr.stress.Load
        Strains and stresses there.
    crushing : ndarray
        (streamline, point) stress that crushes, Pa.
    volume : ndarray or None
        (streamline, point) Voronoi volumes per roll width, m2, of a scene with exchange.
    rates : hpgr.exchange.SwapRates or None
        Swap rates of a scene with exchange.
    pressed : hpgr.machine.Press
        Force and power per roll width.
    """

    bed: geometry.Geometry
    motion: flow.Motion
    state: stress.Load
    crushing: np.ndarray
    volume: np.ndarray | None
    rates: exchange.SwapRates | None
    pressed: machine.Press


def bed_key(scene: Scene) -> tuple:
    """Return all that `prepare` makes of a scene: scenes of equal keys share their bed."""
    ore, grid = scene.material, scene.resolution
    elastic = (
        ore.bulk_modulus,
        ore.shear_modulus,
        ore.elastic_exponent,
        ore.feed_solid_fraction,
        ore.max_solid_fraction,
    )
    exchanging = scene.exchange if solve.choose(scene) == "lattice" else None
    return scene.rolls, scene.flow, scene.stress, elastic, grid.streamlines, grid.points, exchanging


def prepare(scene: Scene) -> Prepared:
    """Return the loaded bed of `scene`: geometry, motion, stress, and swap rates if it has exchange.

    Raises
    ------
    ValueError
        If material points coincide.
    """
    points, substeps = scene.resolution.points, scene.stress.substeps
    bed = geometry.bed(scene.rolls, scene.resolution.streamlines)
    walled = bed._replace(xi=np.append(bed.xi, 1.0))  # the roll itself, whose force and power are wanted
    fine = flow.move(scene, walled, (points - 1) * substeps + 1)
    state = stress.load(scene, fine)
    pressed = machine.press(scene, walled, fine, state)
    crushing = stress.crushing_stress(scene, fine, state)
    motion, state, crushing = (_kept(substeps, part) for part in (fine, state, crushing))
    motion = motion._replace(time_step=substeps * fine.time_step, onset=None)
    if solve.choose(scene) != "lattice":
        return Prepared(bed, motion, state, crushing, None, None, pressed)
    cells = tessellation.tessellate(scene, bed, motion)
    rates = exchange.swap_rates(scene, motion, state, cells)
    return Prepared(bed, motion, state, crushing, cells.volume, rates, pressed)


def crush(scene: Scene, prepared: Prepared, seed: int, replicate: int) -> dict[str, Any]:
    """Crush the feed of `scene` in its prepared bed; return every variable of the Dataset by name, and `notes`.

    Studies take their summaries from here: making a Dataset of every case would cost them as much as crushing.
    """
    bed, motion, state = prepared.bed, prepared.motion, prepared.state
    crushed = solve.crush(scene, prepared.crushing, motion.time_step, prepared.rates, seed, replicate)
    throughput = metrics.gap_throughput(scene, float(state.solid_fraction[:, -1].mean()))
    felt = machine.figures(scene, prepared.pressed, throughput)
    summaries = _summaries(scene, prepared) | felt._asdict() | {"throughput": throughput}
    values = _fields(bed, motion, state) | summaries | _product(scene, crushed)
    notes = _notes(scene, prepared, felt, crushed)
    return values | {
        "volume": prepared.volume,
        "flags": sum(schema.FLAGS[name] for name in notes),
        "notes": "\n".join(f"{name}: {text}" for name, text in notes.items()),
    }


def _kept(step: int, part: Any) -> Any:
    """Return `part` at every step-th point and without the streamline along the roll."""
    if isinstance(part, np.ndarray):
        return part[:-1, ::step] if part.ndim == 2 else part
    kept = {name: _kept(step, value) for name, value in part._asdict().items() if isinstance(value, np.ndarray)}
    if "residence_time" in kept:
        kept["residence_time"] = kept["residence_time"][::step]
    if "continuity_solid_fraction" in kept:
        kept["continuity_solid_fraction"] = kept["continuity_solid_fraction"][:-1]
    return part._replace(**kept)


def _fields(bed: geometry.Geometry, motion: flow.Motion, state: stress.Load) -> dict[str, Any]:
    return {
        "xi": bed.xi,
        "x": motion.x,
        "height": motion.y,
        "residence_time": np.broadcast_to(motion.residence_time, motion.x.shape),
        "speed": motion.speed,
        "volumetric_strain_rate": motion.volumetric_rate,
        "shear_strain_rate": motion.shear_rate,
        "volumetric_strain": state.volumetric_strain,
        "shear_strain": state.shear_strain,
        "solid_fraction": state.solid_fraction,
        "pressure": state.pressure,
        "shear_stress": state.shear_stress,
        "on_shear_limit": state.on_shear_limit,
    }


def _summaries(scene: Scene, prepared: Prepared) -> dict[str, Any]:
    motion, state = prepared.motion, prepared.state
    pressure = state.pressure
    peak = pressure.argmax(axis=1)
    lines = np.arange(peak.size)
    peaks, heights = pressure[lines, peak], motion.y[lines, peak]
    highest = int(peaks.argmax())
    return {
        "operating_gap": None if scene.rolls.specific_pressing_force is None else scene.rolls.gap,
        "peak_pressure": peaks[highest],
        "peak_pressure_height": heights[highest],
        "streamline_peak_pressure": peaks,
        "streamline_peak_pressure_height": heights,
        "continuity_solid_fraction": state.continuity_solid_fraction,
        "shear_limit_fraction": state.on_shear_limit.mean(),
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
        "passing_total": crushed.passing.mean(axis=0),
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
        values |= {"swaps_per_cell": exchanged.swaps_per_cell, "exchange_passes": exchanged.passes}
        if frames is not None:
            values |= {"elapsed_time": exchanged.elapsed_time, "steady": exchanged.steady}
    return values


def _along_width(scene: Scene, found: solve.AlongWidth) -> dict[str, Any]:
    return {
        "width_position": width.slices_of(scene).position,
        "passing_slice": found.passing,
        "passing_width_centre": found.centre_passing,
        "passing_width_edge": found.edge_passing,
        "p50_width_centre": found.centre_percentiles[0],
        "p80_width_centre": found.centre_percentiles[1],
        "p50_width_edge": found.edge_percentiles[0],
        "p80_width_edge": found.edge_percentiles[1],
    }


def _notes(scene: Scene, prepared: Prepared, felt: machine.Figures, crushed: solve.Crushed | None) -> dict[str, str]:
    """Return, by flag, a sentence for each limit that was hit."""
    notes = {}
    bed, state = prepared.bed, prepared.state
    ore, rolls = scene.material, scene.rolls
    needed = float(state.continuity_solid_fraction.max())
    if not state.pressure.astype(np.float32).any():  # as it is stored: of less nothing would be seen
        why = "the gap equals the entry gap" if bed.height == 0 else "the bed only dilates on its way to the gap"
        notes["no_compaction"] = f"{why}: nothing is compacted nor pressed, the product is the feed"
    if needed > ore.max_solid_fraction:
        notes["solid_fraction_capped"] = (
            f"mass continuity would need a solid fraction of {needed:.3g} at the exit; "
            f"held at max_solid_fraction {ore.max_solid_fraction:g}"
        )
    if scene.feed.coarsest > _NIPPING * rolls.gap:
        notes["single_particle_nipping"] = (
            f"the feed's top size is {scene.feed.coarsest / rolls.gap:.3g} gaps; above {_NIPPING:g} the rolls nip "
            "single grains, which is not modelled"
        )
    if state.tension_clamped:
        notes["tension_clamped"] = "the elastic law asked for tension or reverse shear; stresses were held at 0 there"
    if ore.elastic_exponent < 0 and state.pressure.any():
        notes["no_limit_of_steps"] = (
            f"with elastic_exponent {ore.elastic_exponent:g}, below 0, stresses need not converge as time steps shrink"
        )
    unusual = machine.unusual(scene, felt, float(state.solid_fraction[:, -1].mean()))
    if unusual:
        notes["unusual_machine"] = unusual
    if felt.force_angle >= np.pi / 2:
        notes["no_force_angle"] = "the bed takes more power than the force can give at any angle; force_angle is 90 deg"
    if crushed is None:
        return notes
    if not crushed.breaks.any():
        notes["no_breakage"] = "no grain broke: the product is the feed"
    if crushed.below_floor.any():
        notes["size_floor_reached"] = (
            f"{crushed.below_floor.mean():.3g} of the product is below the size floor, where nothing breaks"
        )
    if scene.resolution.cells in (2, 3):
        notes["few_cells"] = "with 2 or 3 cells every cell neighbours every other; use more"
    return notes
