"""Limits that a run may hit: one table of their names, bits, conditions and words."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from hpgr.bed.loaded import LoadedBed
from hpgr.bed.machine import Performance
from hpgr.fields import show
from hpgr.grains.solve import Crushed
from hpgr.scene import Scene

# Usual machines, ores and operation (design figures of makers, as collected in the mission of this package; ore ours)
USUAL = {
    "roll diameter": (0.5, 2.8, "m"),
    "surface speed": (0.2, 3.0, "m s-1"),
    "solid density": (1500.0, 6000.0, "kg m-3"),
    "bulk modulus": (1e6, 1e10, "Pa"),
    "shear modulus": (1e6, 1e10, "Pa"),
    "specific pressing force": (1e6, 9e6, "Pa"),
    "specific energy": (3600.0, 10800.0, "J kg-1"),
    "gap over diameter": (0.02, 0.03, "1"),
    "exit solid fraction": (0.75, 0.92, "1"),
}
_INPUTS = {  # by field: its unit, the one a plant may have meant, and how many of that make the SI unit
    "roll diameter": ("rolls.diameter", "m", "mm", 1e3),
    "surface speed": ("rolls.speed", "rad s-1", "rpm", 60 / (2 * math.pi)),
    "solid density": ("bed.solid_density", "kg m-3", "g/cm^3", 1e-3),
    "bulk modulus": ("elasticity.bulk_modulus", "Pa", "MPa", 1e-6),
    "shear modulus": ("elasticity.shear_modulus", "Pa", "MPa", 1e-6),
}
_FAR = 3.0  # times beyond its range from which a number is suspected of having been given in another unit
_NIPPING = 1.5  # top size over gap above which rolls nip single grains, which is not modelled


class Run(NamedTuple):
    """What a run is judged by."""

    scene: Scene
    bed: LoadedBed
    performance: Performance
    crushed: Crushed | None


class Flag(NamedTuple):
    """A limit.

    Attributes
    ----------
    name : str
        Its name.
    bit : int
        Its bit of the variable `flags`.
    meaning : str
        What it says of a run.
    words : callable
        Returns a sentence with the figures of a run that hit the limit, and nothing for one that did not.
    """

    name: str
    bit: int
    meaning: str
    words: Callable[[Run], str]


def diagnose(scene: Scene, bed: LoadedBed, performance: Performance, crushed: Crushed | None) -> dict[str, str]:
    """Return, by flag, a sentence for each limit that a run hit."""
    run = Run(scene, bed, performance, crushed)
    told = ((flag.name, flag.words(run)) for flag in FLAGS)
    return {name: words for name, words in told if words}


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
    rolls = run.scene.rolls
    values = {
        "roll diameter": rolls.diameter,
        "surface speed": rolls.surface_speed,
        "solid density": run.scene.bed.solid_density,
        "bulk modulus": run.scene.elasticity.bulk_modulus,
        "shear modulus": run.scene.elasticity.shear_modulus,
        "specific pressing force": run.performance.specific_pressing_force,
        "specific energy": run.performance.specific_energy,
        "gap over diameter": rolls.gap / rolls.diameter,
        "exit solid fraction": float(run.bed.stress.solid_fraction[:, -1].mean()),
    }
    return "; ".join(
        f"{name} {show(values[name], unit, 4)} (usual {show(low, unit)} to {show(high, unit)}"
        f"{_meant_otherwise(run.scene, name, values[name])})"
        for name, (low, high, unit) in USUAL.items()
        if not low <= values[name] <= high
    )


def _meant_otherwise(scene: Scene, name: str, value: float) -> str:
    """Return in words the unit that was probably meant, or nothing: a value far off that another unit makes usual."""
    low, high, _ = USUAL[name]
    if name not in _INPUTS or low / _FAR <= value <= high * _FAR:
        return ""
    field, unit, plant, factor = _INPUTS[name]
    section, _, key = field.partition(".")
    given = getattr(getattr(scene, section), key)
    if not low / _FAR <= value / factor <= high * _FAR:
        return ""
    shown = show(given, unit, 4)
    return f"; {field} {given:g} is read in {unit}, {shown}; for {given:g} {plant} write '{given:g} {plant}'"


def _no_compaction(run: Run) -> str:
    if run.bed.stress.pressure.astype(np.float32).any():  # as it is stored: of less nothing would be seen
        return ""
    why = (
        "the gap equals the entry gap" if run.bed.geometry.height == 0 else "the bed only dilates on its way to the gap"
    )
    return f"{why}: nothing is compacted nor pressed, the product is the feed"


def _solid_fraction_capped(run: Run) -> str:
    needed, most = float(run.bed.stress.continuity_solid_fraction.max()), run.scene.bed.max_solid_fraction
    if needed <= most:
        return ""
    return (
        f"mass continuity would need a solid fraction of {needed:.3g} at the exit; held at max_solid_fraction {most:g}"
    )


def _single_particle_nipping(run: Run) -> str:
    gaps = run.scene.feed.largest_grain / run.scene.rolls.gap
    if gaps <= _NIPPING:
        return ""
    return (
        f"the feed's top size is {gaps:.3g} gaps; above {_NIPPING:g} the rolls nip single grains, which is not modelled"
    )


def _tension_clamped(run: Run) -> str:
    words = "the elastic law asked for tension or reverse shear; stresses were held at 0 there"
    return words if run.bed.stress.tension_clamped else ""


def _no_limit_of_steps(run: Run) -> str:
    exponent = run.scene.elasticity.exponent
    if exponent >= 0 or not run.bed.stress.pressure.any():
        return ""
    return f"with elasticity.exponent {exponent:g}, below 0, stresses need not converge as time steps shrink"


def _no_force_angle(run: Run) -> str:
    words = "the bed takes more power than the force can give at any angle; force_angle is 90 deg"
    return words if run.performance.force_angle >= np.pi / 2 else ""


def _no_breakage(run: Run) -> str:
    unbroken = run.crushed is not None and not run.crushed.breaks.any()
    return "no grain broke: the product is the feed" if unbroken else ""


def _size_floor_reached(run: Run) -> str:
    if run.crushed is None or not run.crushed.below_floor.any():
        return ""
    return f"{run.crushed.below_floor.mean():.3g} of the product is below the size floor, where nothing breaks"


def _few_cells(run: Run) -> str:
    few = run.scene.resolution.cells in (2, 3)
    return "with 2 or 3 cells every cell neighbours every other; use more" if few else ""


FLAGS = (  # in the order in which they are told
    Flag("unusual_machine", 128, "machine, ore or operation outside usual ranges", _unusual_machine),
    Flag("no_compaction", 2, "nothing is compacted: the product is the feed", _no_compaction),
    Flag("solid_fraction_capped", 4, "mass continuity would need a denser cake", _solid_fraction_capped),
    Flag("single_particle_nipping", 8, f"the feed's top size is above {_NIPPING:g} gaps", _single_particle_nipping),
    Flag("tension_clamped", 64, "the elastic law asked for tension or reverse shear", _tension_clamped),
    Flag("no_limit_of_steps", 512, "stresses need not converge as time steps shrink", _no_limit_of_steps),
    Flag("no_force_angle", 256, "more power than the force can give at any angle", _no_force_angle),
    Flag("no_breakage", 1, "no grain broke: the product is the feed", _no_breakage),
    Flag("size_floor_reached", 16, "part of the product is below the size floor", _size_floor_reached),
    Flag("few_cells", 32, "with 2 or 3 cells every cell neighbours every other", _few_cells),
)
BITS = {flag.name: flag.bit for flag in sorted(FLAGS, key=lambda flag: flag.bit)}
ATTRIBUTES = {"flag_masks": np.array(list(BITS.values()), np.int32), "flag_meanings": " ".join(BITS)}
