"""What every result must satisfy, whatever the scene: `violations(dataset)` lists all that it does not.

Everything is judged from the Dataset alone, which holds its scene and seed. Sizes and fractions are stored as
float32; where rounding to it can make equal values differ, the slack is `_ROUNDING`, and where it cannot, none.
"""

import math
from collections.abc import Callable, Iterator

import numpy as np
import xarray as xr
from pydantic import ValidationError

from hpgr.bed import machine
from hpgr.fields import faults_of
from hpgr.grains import kernels, march
from hpgr.grains.lattice import MOST_SUBSTEPS
from hpgr.results import flags
from hpgr.scene import Scene

_ROUNDING = 2.0**-22  # relative; a float32 is good to 2**-24, a quotient or mean of some to a few of that
_TINY = 1e-36  # below it float32 has fewer digits, and at last none
_CARRIED = 2e-6  # relative, of a pressing force under which the gap floats; half of it is the rounding to float32
_CLASS = math.exp(1 / 30)  # ratio of the ends of a size class of the closed form by classes
_NIPPING = 1.5  # gaps, top size of the feed from which single grains are nipped


class Result(dict):
    """The arrays of a Dataset by name, and its attributes: reading them off it each time costs more than a run."""

    attrs: dict

    def doubles(self, *names: str) -> list[np.ndarray]:
        """Return these arrays in double precision."""
        return [self[name].astype(float) for name in names]

    def flagged(self) -> list[str]:
        """Return the limits that the result says it hit."""
        return flags.names(int(self["flags"]))


Check = Callable[[Scene, Result], Iterator[tuple[bool, str]]]  # whether all is well, and else what is wrong
INVARIANTS: dict[str, Check] = {}


def _invariant(name: str) -> Callable[[Check], Check]:
    return lambda check: INVARIANTS.setdefault(name, check)


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
    found: list[str] = []
    for name, check in INVARIANTS.items():  # the first judges what the others need
        found += [f"{name}: {what}" for well, what in check(scene, result) if not well]
        if name == "complete" and found:
            break
    return found


@_invariant("complete")
def _complete(scene: Scene, result: Result):
    wanted = {"pressure", "shear_stress", "volumetric_strain", "shear_strain", "solid_fraction", "throughput", "flags"}
    if scene.resolution.cells:
        wanted |= {"passing", "passing_total", "p50", "p80", "p50_total", "p80_total", "breaks_per_cell", "below_floor"}
        wanted |= {"cells": {"size"}, "distributions": {"mass_fraction"}, "product": set()}[scene.resolution.record]
    if result.attrs["solver"].endswith("lattice"):
        wanted |= {"volume", "swaps_per_cell", "exchange_substeps"}
    missing = sorted(wanted - set(result))
    yield not missing, f"missing {', '.join(missing)}"


@_invariant("finite")
def _finite(scene: Scene, result: Result):
    for name, values in result.items():
        if values.dtype.kind == "f":
            yield np.isfinite(values).all(), f"{name} holds {'nan' if np.isnan(values).any() else 'inf'}"


@_invariant("points in order")
def _points(scene: Scene, result: Result):
    if scene.rolls.gap < scene.rolls.entry_gap:  # else every point is the exit
        yield (np.diff(result["height"], axis=1) < 0).all(), "height does not fall along a streamline"
        yield (np.diff(result["residence_time"], axis=1) > 0).all(), "residence_time does not rise along a streamline"
        yield (result["x"] > 0).all(), "x is not positive"
        yield (result["height"][:, -1] == 0).all(), "the last point is not at the exit"


@_invariant("stresses not negative")
def _stresses(scene: Scene, result: Result):
    for name in ("pressure", "shear_stress", "volumetric_strain", "shear_strain"):
        yield result[name].min() >= 0, f"{name} falls to {result[name].min():g}"
    peaks = result["pressure"].max(axis=1)
    largest = result["peak_pressure"] == peaks.max() and np.array_equal(result["streamline_peak_pressure"], peaks)
    yield largest, f"peak_pressure {float(result['peak_pressure']):g} is not the largest pressure"


@_invariant("tension told")
def _tension(scene: Scene, result: Result):
    """A stress of 0 in a bed that is still compacted was held there, and a state law below 0 asks for tension."""
    *stresses, volumetric, shear = result.doubles("pressure", "shear_stress", "volumetric_strain", "shear_strain")
    law, pressed = scene.elasticity, volumetric[:, 1:] > 0
    if law.recovery_modulus is not None:  # what was pressed need not be pressed when it has recovered
        pressed &= volumetric[:, 1:] >= volumetric[:, :-1]
    held = [((each[:, 1:] == 0) & (each[:, :-1] > _TINY) & pressed).any() for each in stresses]
    c, eta = law.exponent, np.divide(shear, volumetric, out=np.zeros_like(shear), where=volumetric > _TINY)
    pulled = law.bulk_modulus / (c + 1) + 1.5 * law.shear_modulus * c * eta**2 < -1e-3 * law.bulk_modulus
    told = "tension_clamped" in result.flagged()
    yield told or not any(held), "tension_clamped is missing: a stress falls to 0"
    yield told or not pulled.any(), "tension_clamped is missing: the state law is negative"


@_invariant("shear within its limit")
def _shear_ratio(scene: Scene, result: Result):
    limit = scene.elasticity.largest_shear_ratio()
    volumetric, shear = result.doubles("volumetric_strain", "shear_strain")
    if math.isfinite(limit):
        slack = 2.0**-149 * (1 + limit)  # spacing of the smallest float32
        within = shear <= limit * volumetric * (1 + _ROUNDING) + slack
        yield within.all(), f"eta is above {limit:g} at {(~within).sum()} points"


@_invariant("solid fraction within its limits")
def _solid_fraction(scene: Scene, result: Result):
    bed, found = scene.bed, result["solid_fraction"]
    most, least = np.float32(bed.max_solid_fraction), np.float32(bed.feed_solid_fraction)
    yield (found <= most).all(), f"solid_fraction reaches {found.max():g}, its limit is {most:g}"
    yield (found >= least).all(), f"solid_fraction falls to {found.min():g}, below the feed's {least:g}"


@_invariant("throughput")
def _throughput(scene: Scene, result: Result):
    found = float(result["throughput"])
    wanted = machine.gap_throughput(scene, float(result["solid_fraction"][:, -1].mean(dtype=float)))
    yield found > 0, f"throughput is {found:g}"
    yield abs(found - wanted) <= _ROUNDING * wanted, f"throughput is {found:g}, but rho phi s L U is {wanted:g}"


@_invariant("energy")
def _energy(scene: Scene, result: Result):
    """Power is what the pressing force does at its angle, and what idling takes; energy is power over throughput."""
    rolls, names = scene.rolls, ("pressing_force", "force_angle", "power", "torque", "specific_energy", "throughput")
    force, angle, power, torque, energy, throughput = (float(result[name]) for name in names)
    taken = 2 * force * rolls.surface_speed * math.sin(angle) + rolls.idle_torque * rolls.speed
    held = angle >= math.pi / 2 * (1 - _ROUNDING)  # flagged: no angle of the force takes so much
    yield held or _close(power, taken), f"power is {power:g}, force and idling take {taken:g}"
    yield _close(torque * rolls.speed, power), f"power is {power:g}, torque {torque:g}"
    yield _close(energy * throughput, power), f"power is {power:g}, specific energy {energy:g}"
    wanted, carried = rolls.specific_pressing_force, force / (rolls.diameter * rolls.width)
    if wanted is not None:
        yield abs(carried / wanted - 1) <= _CARRIED, f"the gap carries {carried:g} Pa of the {wanted:g} wanted"


def _close(one: float, other: float) -> bool:
    return abs(one - other) <= 16 * _ROUNDING * max(abs(one), abs(other)) + _TINY


@_invariant("sizes positive and never growing")
def _sizes(scene: Scene, result: Result):
    if "size" in result:
        size = result["size"]
        yield size.min() >= np.float32(kernels.SMALLEST), f"a size is {size.min():g} m, below what is kept"
        grows = _marched(result) and (np.diff(size, axis=2) > 0).any()
        yield not grows, "a grain grows along a streamline"


@_invariant("never coarser than the feed")
def _never_coarser(scene: Scene, result: Result):
    """Nothing is coarser than the feed's largest grain as float32; without exchange the product passes every sieve as
    the very grains that entered do, or more.
    """
    if scene.resolution.cells:
        top, (least, _) = np.float32(scene.feed.largest_grain), _feed_passing(scene, result)
        for name in {"size", "p50", "p80", "p50_total", "p80_total"} & set(result):
            largest = result[name].max()
            yield largest <= top, f"{name} reaches {largest:g} m, the feed's largest grain is {top:g} m"
        yield (result["passing"] >= least - _ROUNDING).all(), "the product passes a sieve with less than the feed does"


@_invariant("distributions rise from 0 to 1")
def _distributions(scene: Scene, result: Result):
    if not scene.resolution.cells:
        return
    whole = np.float32(scene.resolution.sieves[-1]) >= np.float32(scene.feed.largest_grain)
    found = {name: result[name] for name in ("passing", "passing_total")}
    if "mass_fraction" in result:
        found["mass_fraction"] = np.cumsum(result["mass_fraction"], axis=-1, dtype=float)
    for name, passing in found.items():
        low, high, last = passing.min(), passing.max(), passing[..., -1].min()
        yield (np.diff(passing, axis=-1) >= 0).all(), f"{name} falls with sieve size"
        yield low >= 0 and high <= 1 + _ROUNDING, f"{name} leaves 0 to 1: {low:g} to {high:g}"
        yield not whole or last >= 1 - _ROUNDING, f"{name} ends at {last:g}, though the last sieve passes every grain"
    for end in ("", "_total"):
        p50, p80 = result[f"p50{end}"], result[f"p80{end}"]
        yield (p50 > 0).all() and (p50 <= p80).all(), f"p50{end} is not between 0 and p80{end}"
    if "size" in result:
        steady = result["steady"].astype(bool) if "steady" in result else slice(None)
        exits = np.moveaxis(result["size"][steady, :, -1], 0, -1)
        counted = _counted(exits.reshape(len(exits), -1), scene)
        same = _controlled(result) or np.array_equal(result["passing"], counted)
        yield same, "passing is not what the recorded cells at the exit give"


@_invariant("counts")
def _counts(scene: Scene, result: Result):
    if not scene.resolution.cells:
        return
    floor, breaks = result["below_floor"], result["breaks_per_cell"]
    yield floor.min() >= 0 and floor.max() <= 1, f"below_floor leaves 0 to 1: {floor.min():g} to {floor.max():g}"
    yield breaks.min() >= 0, f"breaks_per_cell is {breaks.min():g}"
    if _marched(result):
        steps = (result["volumetric_strain_rate"] > 0).sum(axis=1)
        yield (breaks <= steps).all(), f"breaks_per_cell is {breaks.max():g}: more than one in a time step"
    if "exchange_substeps" in result:
        substeps, swaps = int(result["exchange_substeps"]), float(result["swaps_per_cell"])
        counted = 1 <= substeps <= MOST_SUBSTEPS and swaps >= 0
        yield counted, f"exchange_substeps is {substeps}, swaps_per_cell {swaps:g}"
        yield result["volume"].min() > 0, f"a volume is {result['volume'].min():g}"


@_invariant("no stress leaves the feed")
def _unbroken(scene: Scene, result: Result):
    """Where no stress reaches the strength of any grain, the product is the feed bit for bit."""
    if not scene.resolution.cells or not _nothing_can_break(scene, result):
        return
    least, most = _feed_passing(scene, result)
    yield not result["breaks_per_cell"].any(), "grains broke under a stress below every strength"
    same = (result["passing"] >= least) & (result["passing"] <= most)
    yield same.all(), "the product's distribution is not the feed's, though nothing broke"
    if "size" in result and _marched(result):
        same = (result["size"] == _feed_cells(scene, result)[:, :, None]).all()
        yield same, "sizes are not those of the feed bit for bit, though nothing broke"


@_invariant("swaps conserve every size")
def _swaps_conserve(scene: Scene, result: Result):
    """From one time step to the next all cells but those that left are still there, bit for bit.

    Judged where every step is a snapshot and nothing can break.
    """
    if "size" not in result or "elapsed_time" not in result or scene.exchange.interval > 1:
        return
    size = result["size"] if _nothing_can_break(scene, result) else []
    for step in range(len(size) - 1):
        stayed, count = np.unique(size[step, :, :-1], return_counts=True)
        known, found = np.unique(size[step + 1], return_counts=True)
        place = np.minimum(np.searchsorted(known, stayed), known.size - 1)
        lost = np.where(known[place] == stayed, np.maximum(count - found[place], 0), count).sum()
        yield not lost, f"{lost} cells of snapshot {step} are gone from the next"


@_invariant("flags")
def _flags(scene: Scene, result: Result):
    """Every flag is there that must be, and none that must not; None where rounding decides."""
    cells, found = scene.resolution.cells, result.flagged()
    needed = float(result["continuity_solid_fraction"].max()) / scene.bed.max_solid_fraction
    # as little as float32 cannot hold may be below the floor of a closed form
    floor = cells > 0 and (result["below_floor"].any() or (None if result.attrs["solver"] == "closed form" else False))
    wanted = {
        "solid_fraction_capped": None if abs(needed - 1) <= _ROUNDING else needed > 1,
        "single_particle_nipping": scene.feed.largest_grain > _NIPPING * scene.rolls.gap,
        "no_compaction": not result["pressure"].any(),
        "no_breakage": bool(cells) and not result["breaks_per_cell"].any(),
        "size_floor_reached": floor,
        "few_cells": cells in (2, 3),
    }
    for name, must in wanted.items():
        right = must is None or bool(must) == (name in found)
        yield right, f"{name} is {'missing' if must else 'set without its reason'}"
    told = [line.partition(":")[0] for line in result.attrs["diagnostics"].splitlines()]
    told_words, found_words = (", ".join(sorted(each)) or "none" for each in (told, found))
    yield told_words == found_words, f"flags say {found_words}, diagnostics say {told_words}"


def _nothing_can_break(scene: Scene, result: Result) -> bool:
    """Return whether the largest crushing stress anywhere stays below the strength of the feed's largest grain.

    Cushioning only strengthens, and fragments are stronger, so then no grain can break. The answer is no within
    1e-4 of the limit, where rounding could decide, and where strength scatters.
    """
    ore, (pressure, shear) = scene.strength, result.doubles("pressure", "shear_stress")
    stresses = ore.crushing_stress(pressure, shear)[result["volumetric_strain_rate"] > 0]
    largest = stresses.max(initial=0.0)
    if math.isfinite(ore.scatter) or largest == 0:
        return largest == 0 and not pressure.any()
    weakest = -(3 / ore.weibull_modulus) * math.log(scene.feed.largest_grain / ore.reference_size)
    return math.log(largest / ore.reference_strength) < weakest - 1e-4


def _feed_cells(scene: Scene, result: Result) -> np.ndarray:
    """Return the cells (snapshot, streamline, cell) that entered and are now the product, without exchange."""
    grid, attrs = scene.resolution, result.attrs
    shape = (grid.snapshots, grid.streamlines)
    keys = [(int(attrs["replicate"]), line, snapshot) for snapshot, line in np.ndindex(shape)]
    return march.first_cells(scene, int(attrs["seed"]), keys)[0][:, 1:-1].reshape(*shape, grid.cells)


def _feed_passing(scene: Scene, result: Result) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the most (streamline, sieve) that passes of the feed of each streamline.

    They differ where size classes blur the feed, and are 0 and 1 with exchange or a control variate.
    """
    shape, sieves = result["passing"].shape, np.array(scene.resolution.sieves)
    if result.attrs["solver"] == "closed form":
        classes = math.isfinite(scene.strength.scatter) or scene.fragments.size_exponent != 0
        ratio, slack = (_CLASS, 2e-4) if classes else (1.0, 0.0)
        bounds = scene.feed.passing(sieves / ratio) - slack, scene.feed.passing(sieves * ratio) + slack
        return tuple(np.broadcast_to(each.astype(np.float32), shape) for each in bounds)
    if _controlled(result) and _nothing_can_break(scene, result):  # what is known exactly is then the feed itself
        return (np.broadcast_to(scene.feed.passing(sieves).astype(np.float32), shape),) * 2
    if _controlled(result) or not _marched(result):
        return np.zeros(shape), np.ones(shape)
    cells = _feed_cells(scene, result).transpose(1, 0, 2)
    counted = _counted(cells.reshape(len(cells), -1), scene)
    return counted, counted


def _marched(result: Result) -> bool:
    return result.attrs["solver"].startswith("march")


def _controlled(result: Result) -> bool:
    return result.attrs["solver"].endswith("control variate")


def _counted(cells: np.ndarray, scene: Scene) -> np.ndarray:
    """Return the fraction (streamline, sieve) of cells no larger than each sieve, as a Dataset holds it."""
    sieves = np.array(scene.resolution.sieves, np.float32)  # a grain of just a sieve's size passes it
    counts = np.stack([np.searchsorted(np.sort(row), sieves, side="right") for row in cells])
    return (counts / cells.shape[1]).astype(np.float32)
