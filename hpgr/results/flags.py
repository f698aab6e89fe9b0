"""Limits that a run may hit: one table of their names, bits, conditions and words."""

import math
from collections.abc import Callable, Iterable
from functools import cache
from typing import NamedTuple

import numpy as np

from hpgr.bed.loaded import LoadedBed
from hpgr.bed.machine import Performance
from hpgr.bed.stress import continuity_solid_fraction
from hpgr.fields import show, unit_shown
from hpgr.grains.solve import Crushed, crushing_stress
from hpgr.laws.fragments import HELD
from hpgr.scene import Scene

_NIPPING = 1.5  # top size over gap above which rolls nip single grains, which is not modelled
_FAR = 3.0  # times beyond its range from which a number is suspected of having been given in another unit
_UNBROKEN = 0.05  # mass fraction of the feed below the critical size from which it is told


class Run(NamedTuple):
    """What a run is judged by."""

    scene: Scene
    bed: LoadedBed
    performance: Performance
    broken: bool | None  # whether any grain broke; None where there are none
    below_floor: float  # mass fraction of the product below the size floor


class Flag(NamedTuple):
    """A limit."""

    name: str
    bit: int  # of the variable `flags`
    meaning: str  # what it says of any run
    hit: Callable[[Run], bool | str]  # whether a run hit it, or a sentence with its figures
    own: bool = False  # whether replicates differ in it


class Usual(NamedTuple):
    """Range of usual machines and ores, SI, and what else a number far outside of it may have been meant as."""

    low: float
    high: float
    unit: str
    field: str = ""  # that it is in proportion to
    plant_unit: str = ""  # that the field may have been meant in
    factor: float = 1.0  # SI units of the field in one of these


# design figures of makers, as collected in the mission of this package; densities, moduli and solid fraction ours
USUAL = {
    "roll diameter": Usual(0.5, 2.8, "m", "rolls.diameter", "mm", 1e-3),
    "surface speed": Usual(0.2, 3.0, "m s-1", "rolls.speed", "rpm", math.pi / 30),
    "solid density": Usual(1500.0, 6000.0, "kg m-3", "bed.solid_density", "g/cm^3", 1e3),
    "bulk modulus": Usual(1e6, 1e10, "Pa", "elasticity.bulk_modulus", "MPa", 1e6),
    "shear modulus": Usual(1e6, 1e10, "Pa", "elasticity.shear_modulus", "MPa", 1e6),
    "specific pressing force": Usual(1e6, 9e6, "Pa"),
    "specific energy": Usual(3600.0, 10800.0, "J kg-1"),
    "gap over diameter": Usual(0.02, 0.03, "1"),
    "exit solid fraction": Usual(0.75, 0.92, "1"),
}


def diagnose(
    scene: Scene, bed: LoadedBed, performance: Performance, products: Iterable[Crushed | None]
) -> list[dict[str, str]]:
    """Return for each product of a bed, by flag, a sentence for each limit that its run hit."""

    @cache
    def shared(broken: bool | None) -> dict[str, bool | str]:
        run = Run(scene, bed, performance, broken, 0.0)
        return {flag.name: flag.hit(run) for flag in FLAGS if not flag.own}

    @cache
    def found(broken: bool | None, below_floor: float) -> dict[str, str]:
        run, known = Run(scene, bed, performance, broken, below_floor), shared(broken)
        hits = ((flag, flag.hit(run) if flag.own else known[flag.name]) for flag in FLAGS)
        return {flag.name: words if isinstance(words, str) else flag.meaning for flag, words in hits if words}

    return [
        found(None, 0.0) if one is None else found(bool(one.breaks.any()), float(one.below_floor.mean()))
        for one in products
    ]


def names(bits: int) -> list[str]:
    """Return the names of the flags that are set in `bits`.

    Examples
    --------
    >>> from hpgr.results import flags
    >>> flags.names(5)
    ['no_breakage', 'solid_fraction_capped']
    """
    return [name for name, bit in BITS.items() if bits & bit]


def _unusual_machine(run: Run) -> str:
    given = {name: _given(run.scene, usual.field) for name, usual in USUAL.items() if usual.field}
    rolls = run.scene.rolls
    values = given | {
        "surface speed": rolls.surface_speed,
        "specific pressing force": run.performance.specific_pressing_force,
        "specific energy": run.performance.specific_energy,
        "gap over diameter": rolls.gap / rolls.diameter,
        "exit solid fraction": float(run.bed.stress.solid_fraction[:, -1].mean()),
    }
    told = ((name, values[name], usual, given.get(name)) for name, usual in USUAL.items())
    return "; ".join(
        f"{name} {show(value, usual.unit, 4)} (usual {show(usual.low, usual.unit)} to {show(usual.high, usual.unit)}"
        f"{_meant_otherwise(usual, value, field)})"
        for name, value, usual, field in told
        if value is not None and not usual.low <= value <= usual.high
    )


def _given(scene: Scene, field: str) -> float | None:
    """Return the value of a scene field; None for a law that has no such field."""
    section, _, key = field.partition(".")
    return getattr(getattr(scene, section, None), key, None)


def _meant_otherwise(usual: Usual, value: float, field: float | None) -> str:
    """Return in words the unit that was probably meant, or nothing: a value far off that another unit makes usual."""
    low, high = usual.low / _FAR, usual.high * _FAR
    if field is None or low <= value <= high or not low <= value * usual.factor <= high:
        return ""
    unit = "rad s-1" if usual.unit == "m s-1" else usual.unit
    read = unit if unit_shown(unit)[1] == 1 else f"{unit}, {show(field, unit, 4)}"
    meant = f"{field:g} {usual.plant_unit}"
    return f"; {usual.field} {field:g} is read in {read}; for {meant} write '{meant}'"


def _no_compaction(run: Run) -> str:
    if run.bed.stress.pressure.astype(np.float32).any():  # as it is stored: of less nothing would be seen
        return ""
    flat = run.bed.geometry.height == 0
    why = "the gap equals the entry gap" if flat else "the bed only dilates on its way to the gap"
    return f"{why}: nothing is compacted nor pressed, the product is the feed"


def _solid_fraction_capped(run: Run) -> str:
    bed = run.scene.bed
    phi, most = continuity_solid_fraction(run.bed.stress, bed.feed_solid_fraction).max(), bed.max_solid_fraction
    words = f"mass continuity would need a solid fraction of {phi:.3g} at the exit; held at max_solid_fraction {most:g}"
    return words if phi > most else ""


def _single_particle_nipping(run: Run) -> str:
    gaps = run.scene.feed.largest_grain / run.scene.rolls.gap
    words = (
        f"the feed's top size is {gaps:.3g} gaps; above {_NIPPING:g} the rolls nip single grains, which is not modelled"
    )
    return words if gaps > _NIPPING else ""


def _no_limit_of_steps(run: Run) -> str:
    exponent = getattr(run.scene.elasticity, "exponent", 0.0)
    words = f"with elasticity.exponent {exponent:g}, below 0, stresses need not converge as time steps shrink"
    return words if exponent < 0 and run.bed.stress.pressure.any() else ""


def _no_force_angle(run: Run) -> bool:
    return run.performance.force_angle >= np.pi / 2


def _recovery_held(run: Run) -> bool:
    recovers = run.scene.elasticity.recovery_modulus is not None
    return recovers and run.performance.force_angle == 0 < run.performance.pressing_force


def _few_cells(run: Run) -> bool:
    return run.scene.resolution.cells in (2, 3)


def _feed_below_critical(run: Run) -> str:
    scattered = math.isfinite(getattr(run.scene.strength, "scatter", math.inf))
    if not run.broken or scattered:
        return ""
    critical = _critical_size(run)
    share = float(run.scene.feed.passing(np.nextafter(critical, 0.0)))
    words = f"{share:.3g} of the feed is finer than {show(critical, 'm', 3)}, which no stress of this bed breaks"
    return words if share > _UNBROKEN else ""


def _critical_size(run: Run) -> float:
    """Return the size in m that the largest stress of the bed just breaks without cushioning."""
    strength = run.scene.strength
    return float(strength.critical_size(strength.log_stress(crushing_stress(run.scene, run.bed).max())))


def _fragment_exponent_held(run: Run) -> str:
    law, largest = run.scene.fragments, run.scene.feed.largest_grain
    if run.broken is None or not getattr(law, "size_exponent", 0.0):
        return ""
    parents = sorted({min(max(_critical_size(run), law.size_floor), largest), largest})
    held = [size for size in parents if float(law.exponent_of(size)) in HELD]
    told = " and ".join(f"{float(law.exponent_of(size)):g} for parents of {show(size, 'm', 3)}" for size in held)
    return f"the exponent of fragments is held at {told}, beyond which no measurement reaches" if held else ""


def _size_floor_reached(run: Run) -> str:
    words = f"{run.below_floor:.3g} of the product is below the size floor, where nothing breaks"
    return words if run.below_floor else ""


FLAGS = (  # in the order in which they are told
    Flag("unusual_machine", 128, "machine, ore or operation outside usual ranges", _unusual_machine),
    Flag("no_compaction", 2, "nothing is compacted: the product is the feed", _no_compaction),
    Flag("solid_fraction_capped", 4, "mass continuity would need a denser cake", _solid_fraction_capped),
    Flag("single_particle_nipping", 8, f"the feed's top size is above {_NIPPING:g} gaps", _single_particle_nipping),
    Flag("tension_clamped", 64, "tension or reverse shear was held at 0", lambda run: run.bed.stress.tension_clamped),
    Flag("no_limit_of_steps", 512, "stresses need not converge as time steps shrink", _no_limit_of_steps),
    Flag("no_force_angle", 256, "more power than the force can give at any angle", _no_force_angle),
    Flag("recovery_held", 4096, "the cake gives back no more than was put in: no net power", _recovery_held),
    Flag("no_breakage", 1, "no grain broke: the product is the feed", lambda run: run.broken is False),
    Flag("feed_below_critical", 1024, "part of the feed is finer than any stress breaks", _feed_below_critical),
    Flag("fragment_exponent_held", 2048, "the exponent of fragments left its range", _fragment_exponent_held),
    Flag("size_floor_reached", 16, "part of the product is below the size floor", _size_floor_reached, True),
    Flag("few_cells", 32, "of 2 or 3 cells each neighbours every other; use more", _few_cells),
)
BITS = {flag.name: flag.bit for flag in sorted(FLAGS, key=lambda flag: flag.bit)}
ATTRIBUTES = {"flag_masks": np.array(list(BITS.values()), np.int32), "flag_meanings": " ".join(BITS)}
