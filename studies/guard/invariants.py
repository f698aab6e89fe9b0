"""What every result must satisfy, whatever the scene: `violations(dataset)` lists all that it does not.

Everything is judged from the Dataset alone, which holds its scene and seed. Sizes and fractions are stored as
float32; where rounding to it can make equal values differ, the slack is `_ROUNDING`, and where it cannot, none.
"""

import math
from collections.abc import Callable, Iterator

import numpy as np
import xarray as xr
from pydantic import ValidationError

from hpgr.fields import faults_of
from hpgr.grains import kernels, march
from hpgr.grains.lattice import MOST_SUBSTEPS
from hpgr.results import flags, metrics
from hpgr.scene import Scene

_ROUNDING = 2.0**-22  # relative; a float32 is good to 2**-24, a quotient or mean of some to a few of that
_TINY = 1e-36  # below it float32 has fewer digits, and at last none
_CARRIED = 2e-6  # relative, of a pressing force under which the gap floats; half of it is the rounding to float32
_NIPPING = 1.5  # gaps, top size of the feed from which single grains are nipped


def violations(dataset: xr.Dataset) -> list[str]:
    """Return every invariant that `dataset`, from `hpgr.simulate`, violates: its name and the figure.

    Examples
    --------
    >>> import hpgr
    >>> from studies.guard.invariants import violations
    >>> violations(hpgr.simulate(hpgr.presets.paper().with_values({"resolution.cells": 50})))
    []
    """
    try:
        scene = Scene.model_validate_json(dataset.attrs["scene"])
    except ValidationError as error:
        return [f"a scene that can be read back: {faults_of(error)}"]
    result = Result({name: variable.values for name, variable in dataset.variables.items()})
    result.attrs = dataset.attrs
    found = []
    for name, check in INVARIANTS.items():  # the first judges what the others need
        found += [f"{name}: {what}" for what in check(scene, result)]
        if name == "complete" and found:
            break
    return found


class Result(dict):
    """The arrays of a Dataset by name, and its attributes: reading them off it each time costs more than a run."""

    attrs: dict


def _finite(scene: Scene, result: Result) -> Iterator[str]:
    for name, values in result.items():
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            yield f"{name} holds {values[~np.isfinite(values)][0]}"


def _complete(scene: Scene, result: Result) -> Iterator[str]:
    wanted = {"pressure", "shear_stress", "volumetric_strain", "shear_strain", "solid_fraction", "throughput", "flags"}
    if scene.resolution.cells:
        wanted |= {"passing", "passing_total", "p50", "p80", "p50_total", "p80_total", "breaks_per_cell", "below_floor"}
        wanted |= {"cells": {"size"}, "distributions": {"mass_fraction"}, "product": set()}[scene.resolution.record]
    if result.attrs["solver"] == "lattice":
        wanted |= {"volume", "swaps_per_cell", "exchange_substeps"}
    missing = sorted(wanted - set(result))
    if missing:
        yield f"missing {', '.join(missing)}"


def _points(scene: Scene, result: Result) -> Iterator[str]:
    if scene.rolls.gap == scene.rolls.entry_gap:
        return  # every point is the exit
    if not (np.diff(result["height"], axis=1) < 0).all():
        yield "height does not fall along a streamline"
    if not (np.diff(result["residence_time"], axis=1) > 0).all():
        yield "residence_time does not rise along a streamline"
    if not (result["x"] > 0).all():
        yield "x is not positive"
    if not (result["height"][:, -1] == 0).all():
        yield "the last point is not at the exit"


def _stresses(scene: Scene, result: Result) -> Iterator[str]:
    for name in ("pressure", "shear_stress", "volumetric_strain", "shear_strain"):
        lowest = result[name].min()
        if not lowest >= 0:
            yield f"{name} falls to {lowest:g}"
    peak, pressure = float(result["peak_pressure"]), result["pressure"]
    if peak != pressure.max() or not np.array_equal(result["streamline_peak_pressure"], pressure.max(axis=1)):
        yield f"peak_pressure {peak:g} is not the largest pressure"


def _tension(scene: Scene, result: Result) -> Iterator[str]:
    """A stress of 0 in a bed that is still compacted was held there, and a state law below 0 asks for tension."""
    names = ("pressure", "shear_stress", "volumetric_strain", "shear_strain")
    pressure, shear_stress, volumetric, shear = (result[name].astype(float) for name in names)
    dropped = any(
        ((found[:, 1:] == 0) & (found[:, :-1] > _TINY) & (volumetric[:, 1:] > 0)).any()
        for found in (pressure, shear_stress)
    )
    law = scene.elasticity
    c, eta = law.exponent, np.divide(shear, volumetric, out=np.zeros_like(shear), where=volumetric > _TINY)
    pulled = law.bulk_modulus / (c + 1) + 1.5 * law.shear_modulus * c * eta**2 < -1e-3 * law.bulk_modulus
    if (dropped or pulled.any()) and "tension_clamped" not in flags.names(int(result["flags"])):
        yield f"tension_clamped is missing: {'a stress falls to 0' if dropped else 'the state law is negative'}"


def _shear_ratio(scene: Scene, result: Result) -> Iterator[str]:
    limit = scene.elasticity.largest_shear_ratio()
    volumetric, shear = (result[name].astype(float) for name in ("volumetric_strain", "shear_strain"))
    slack = 2.0**-149 * (1 + limit)  # spacing of the smallest float32
    if math.isfinite(limit) and not (shear <= limit * volumetric * (1 + _ROUNDING) + slack).all():
        worst = np.max(shear[volumetric > 0] / volumetric[volumetric > 0], initial=0.0)
        yield f"eta reaches {worst:g}, its limit is {limit:g}"


def _solid_fraction(scene: Scene, result: Result) -> Iterator[str]:
    bed, found = scene.bed, result["solid_fraction"]
    if not (found <= np.float32(bed.max_solid_fraction)).all():
        yield f"solid_fraction reaches {found.max():g}, its limit is {bed.max_solid_fraction:g}"
    if not (found >= np.float32(bed.feed_solid_fraction)).all():
        yield f"solid_fraction falls to {found.min():g}, below the feed's {bed.feed_solid_fraction:g}"


def _throughput(scene: Scene, result: Result) -> Iterator[str]:
    found = float(result["throughput"])
    wanted = metrics.gap_throughput(scene, float(result["solid_fraction"][:, -1].mean(dtype=float)))
    if not found > 0:
        yield f"throughput is {found:g}"
    if not abs(found - wanted) <= _ROUNDING * wanted:
        yield f"throughput is {found:g}, but rho phi s L U is {wanted:g}"


def _energy(scene: Scene, result: Result) -> Iterator[str]:
    """Power is what the pressing force does at its angle, and what idling takes; energy is power over throughput."""
    rolls, names = scene.rolls, ("pressing_force", "force_angle", "power", "torque", "specific_energy", "throughput")
    force, angle, power, torque, energy, throughput = (float(result[name]) for name in names)
    idle = rolls.idle_torque * rolls.speed
    by_force = 2 * force * rolls.surface_speed * math.sin(angle)
    if angle < math.pi / 2 * (1 - _ROUNDING) and not _close(power, by_force + idle):
        yield f"power is {power:g}, force and idling take {by_force + idle:g}"
    if not _close(torque * rolls.speed, power) or not _close(energy * throughput, power):
        yield f"power is {power:g}, but torque {torque:g}, specific energy {energy:g}"
    wanted, area = rolls.specific_pressing_force, rolls.diameter * rolls.width
    if wanted is not None and abs(force / area / wanted - 1) > _CARRIED:
        yield f"the gap carries {force / area:g} Pa of the {wanted:g} wanted"


def _close(one: float, other: float) -> bool:
    """Return whether two figures that float32 holds are the same to a few roundings; what is too small for it is."""
    return abs(one - other) <= 16 * _ROUNDING * max(abs(one), abs(other)) + _TINY


def _sizes(scene: Scene, result: Result) -> Iterator[str]:
    if "size" not in result:
        return
    size = result["size"]
    if not size.min() >= np.float32(kernels.SMALLEST):
        yield f"a size is {size.min():g} m, below the smallest that is kept, {kernels.SMALLEST:g} m"
    if result.attrs["solver"] == "march" and not (np.diff(size, axis=2) <= 0).all():
        yield "a grain grows along a streamline"


def _never_coarser(scene: Scene, result: Result) -> Iterator[str]:
    """Nothing is coarser than the feed's top size as float32; without exchange the product passes every sieve as
    the very grains that entered do, or more.
    """
    if not scene.resolution.cells:
        return
    top = np.float32(scene.feed.largest_grain)
    for name in ("size", "p50", "p80", "p50_total", "p80_total"):
        if name in result and not result[name].max() <= top:
            yield f"{name} reaches {result[name].max():g} m, the feed's top size is {top:g} m"
    entered = _feed_passing(scene, result)
    if entered is not None and not (result["passing"] >= entered - _ROUNDING).all():
        yield "the product passes a sieve with less than the feed does"


def _distributions(scene: Scene, result: Result) -> Iterator[str]:
    if not scene.resolution.cells:
        return
    largest_passes = np.float32(scene.resolution.sieves[-1]) >= np.float32(scene.feed.largest_grain)
    found = {name: result[name] for name in ("passing", "passing_total")}
    if "mass_fraction" in result:
        if not result["mass_fraction"].min() >= 0:
            yield f"mass_fraction falls to {result['mass_fraction'].min():g}"
        found["mass_fraction"] = np.cumsum(result["mass_fraction"], axis=-1, dtype=float)
    for name, passing in found.items():
        if not (np.diff(passing, axis=-1) >= 0).all():
            yield f"{name} falls with sieve size"
        if not (passing.min() >= 0 and passing.max() <= 1 + _ROUNDING):
            yield f"{name} leaves 0 to 1: {passing.min():g} to {passing.max():g}"
        if largest_passes and not (passing[..., -1] >= 1 - _ROUNDING).all():
            yield f"{name} ends at {passing[..., -1].min():g}, though the coarsest sieve passes every grain"
    for end in ("", "_total"):
        p50, p80 = result[f"p50{end}"], result[f"p80{end}"]
        if not (p50 > 0).all() or not (p50 <= p80).all():
            yield f"p50{end} is not between 0 and p80{end}"
    if "size" in result:
        steady = result["steady"].astype(bool) if "steady" in result else slice(None)
        exit_sizes = np.moveaxis(result["size"][steady, :, -1], 0, -1)
        counted = _counted(exit_sizes.reshape(len(exit_sizes), -1), scene)
        if not np.array_equal(result["passing"], counted):
            yield "passing is not what the recorded cells at the exit give"


def _counts(scene: Scene, result: Result) -> Iterator[str]:
    if not scene.resolution.cells:
        return
    floor, breaks = result["below_floor"], result["breaks_per_cell"]
    if not (floor.min() >= 0 and floor.max() <= 1):
        yield f"below_floor leaves 0 to 1: {floor.min():g} to {floor.max():g}"
    if not breaks.min() >= 0:
        yield f"breaks_per_cell is {breaks.min():g}"
    if result.attrs["solver"] == "march":
        steps = (result["volumetric_strain_rate"] > 0).sum(axis=1)
        if not (breaks <= steps).all():
            yield f"breaks_per_cell is {breaks.max():g}: more than one in a time step"
    if "exchange_substeps" in result:
        substeps, swaps = int(result["exchange_substeps"]), float(result["swaps_per_cell"])
        if not (1 <= substeps <= MOST_SUBSTEPS and swaps >= 0):
            yield f"exchange_substeps is {substeps}, swaps_per_cell {swaps:g}"
        if not result["volume"].min() > 0:
            yield f"a volume is {result['volume'].min():g}"


def _unbroken(scene: Scene, result: Result) -> Iterator[str]:
    """Where no stress reaches the strength of any grain, the product is the feed bit for bit."""
    if not scene.resolution.cells or not nothing_can_break(scene, result):
        return
    if result["breaks_per_cell"].any():
        yield "grains broke under a stress below every strength"
    entered = _feed_passing(scene, result)
    if entered is not None and not np.array_equal(result["passing"], entered):
        yield "the product's distribution is not the feed's, though nothing broke"
    if "size" in result and result.attrs["solver"] == "march":
        cells = feed_cells(scene, result)
        if not np.array_equal(result["size"], np.broadcast_to(cells[:, :, None], result["size"].shape)):
            yield "sizes are not those of the feed bit for bit, though nothing broke"


def _swaps_conserve(scene: Scene, result: Result) -> Iterator[str]:
    """From one time step to the next all cells but those that left are still there, bit for bit.

    Judged where every step is recorded and nothing can break.
    """
    if "size" not in result or "elapsed_time" not in result or not nothing_can_break(scene, result):
        return
    if scene.exchange.interval > 1:
        return
    size = result["size"]
    for step in range(len(size) - 1):
        stayed, count = np.unique(size[step, :, :-1], return_counts=True)
        known, found = np.unique(size[step + 1], return_counts=True)
        place = np.minimum(np.searchsorted(known, stayed), known.size - 1)
        lost = np.where(known[place] == stayed, np.maximum(count - found[place], 0), count).sum()
        if lost:
            yield f"{lost} cells of snapshot {step} are gone from the next"


def _flags(scene: Scene, result: Result) -> Iterator[str]:
    """Every flag is there that must be, and none that must not."""
    found, cells = flags.names(int(result["flags"])), scene.resolution.cells
    needed = float(result["continuity_solid_fraction"].max()) / scene.bed.max_solid_fraction
    nipped = scene.feed.largest_grain / (_NIPPING * scene.rolls.gap)
    wanted = {
        "solid_fraction_capped": None if abs(needed - 1) <= _ROUNDING else needed > 1,
        "single_particle_nipping": nipped > 1,
        "no_compaction": not result["pressure"].any(),
        "no_breakage": bool(cells) and not result["breaks_per_cell"].any(),
        "size_floor_reached": _reaches_floor(scene, result),
        "few_cells": cells in (2, 3),
    }
    for name, must in wanted.items():
        if must is not None and must != (name in found):
            yield f"{name} is {'missing' if must else 'set without its reason'}"
    noted = [line.partition(":")[0] for line in result.attrs["diagnostics"].splitlines()]
    if sorted(noted) != sorted(found):
        yield f"flags say {', '.join(found) or 'none'}, diagnostics say {', '.join(noted) or 'none'}"


INVARIANTS: dict[str, Callable[[Scene, Result], Iterator[str]]] = {
    "complete": _complete,
    "finite": _finite,
    "points in order": _points,
    "stresses not negative": _stresses,
    "tension told": _tension,
    "shear within its limit": _shear_ratio,
    "solid fraction within its limits": _solid_fraction,
    "throughput": _throughput,
    "energy": _energy,
    "sizes positive and never growing": _sizes,
    "never coarser than the feed": _never_coarser,
    "distributions rise from 0 to 1": _distributions,
    "counts": _counts,
    "no stress leaves the feed": _unbroken,
    "swaps conserve every size": _swaps_conserve,
    "flags": _flags,
}


def _reaches_floor(scene: Scene, result: Result) -> bool | None:
    """Return whether some of the product is below the floor; None where as little as a float32 cannot hold may be."""
    if scene.resolution.cells and result["below_floor"].any():
        return True
    return None if result.attrs["solver"] == "closed form" else False


def nothing_can_break(scene: Scene, result: Result) -> bool:
    """Return whether the largest crushing stress anywhere stays below the strength of the feed's coarsest grain.

    Cushioning only strengthens, and fragments are stronger, so then no grain can break. The answer is no within
    1e-4 of the limit, where rounding could decide.
    """
    stresses = result["pressure"].astype(float)
    if scene.strength.stress == "major":
        stresses = stresses + 2 / 3 * result["shear_stress"]
    if math.isfinite(scene.strength.scatter):
        return False  # any grain may be weak
    largest = stresses[result["volumetric_strain_rate"] > 0].max(initial=0.0)
    if largest == 0:
        return not result["pressure"].any()
    ore = scene.strength
    weakest = -(3 / ore.weibull_modulus) * math.log(scene.feed.largest_grain / ore.reference_size)
    return math.log(largest / ore.reference_strength) < weakest - 1e-4


def feed_cells(scene: Scene, result: Result) -> np.ndarray:
    """Return the cells (snapshot, streamline, cell) that entered and are now the product, without exchange."""
    grid = scene.resolution
    shape = (grid.snapshots, grid.streamlines)
    keys = [(int(result.attrs["replicate"]), line, snapshot) for snapshot, line in np.ndindex(shape)]
    cells = march.first_cells(scene, int(result.attrs["seed"]), keys)[0][:, 1:-1]
    return cells.reshape(*shape, grid.cells)


def _feed_passing(scene: Scene, result: Result) -> np.ndarray | None:
    """Return the fraction (streamline, sieve) that the feed of each streamline passes; None with exchange."""
    solver = result.attrs["solver"]
    if solver == "closed form":
        law = scene.feed.passing(scene.resolution.sieves).astype(np.float32)
        return np.broadcast_to(law, result["passing"].shape)
    if solver != "march":
        return None
    cells = feed_cells(scene, result).transpose(1, 0, 2)
    return _counted(cells.reshape(len(cells), -1), scene)


def _counted(cells: np.ndarray, scene: Scene) -> np.ndarray:
    """Return the fraction (streamline, sieve) of cells no larger than each sieve, as a Dataset holds it."""
    sieves = np.array(scene.resolution.sieves, np.float32)  # a grain of just a sieve's size passes it
    counts = np.stack([np.searchsorted(np.sort(row), sieves, side="right") for row in cells])
    return (counts / cells.shape[1]).astype(np.float32)
