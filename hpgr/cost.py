"""What a scene will cost, before it is run: memory against this machine's limit, and time."""

import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import psutil

from hpgr.bed.loaded import inputs_of, load_bed
from hpgr.grains import lattice
from hpgr.grains.march import AT_ONCE
from hpgr.grains.solve import choose, crushing_stress, is_controlled
from hpgr.scene import Scene

_SHARE = 0.8  # of the available memory that one scene may take; the rest is for the reader of the result
_SLIGHT = 10_000_000  # bytes, a tenth of what the libraries have taken; asking for more takes 0.6 ms
_NO_LIMIT = 2**60  # bytes; version 1 writes "no limit" as a number near 2**63
_PROCESS = Path("/proc/self/cgroup")  # where the system tells the control groups of this process
_CGROUPS = (  # of version 1 (its memory controller), version 2, and version 2 beside version 1
    (Path("/sys/fs/cgroup/memory"), "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
    (Path("/sys/fs/cgroup"), "memory.max", "memory.current", "inactive_file"),
    (Path("/sys/fs/cgroup/unified"), "memory.max", "memory.current", "inactive_file"),
)


class Cost(NamedTuple):
    """Predicted peak memory in bytes and time in seconds of one run of a scene."""

    bytes: int
    seconds: float


def predict(scene: Scene) -> Cost:
    """Return the predicted cost of `scene`: peak memory beyond the interpreter's, and processor time.

    Coefficients are measured (docs/performance.md): a run takes at most 1.3 times these bytes, and times are good to a
    factor of 5.
    """
    grid, exchange, solver = scene.resolution, scene.exchange, choose(scene)
    lines, points, cells = grid.streamlines, grid.points, grid.cells
    slices = 1 if scene.roll_width is None else 2 * scene.roll_width.slices
    columns, frames = lines * slices, grid.snapshots
    simple = math.isinf(scene.strength.scatter) and scene.fragments.size_exponent == 0
    fields = lines * ((points - 1) * scene.elasticity.substeps + 1)
    size, seconds = 150 * fields, 1.5e-3 + 0.25e-6 * fields  # motion and stress, with temporaries
    closed, controlled = solver == "closed form", is_controlled(scene)
    if closed or controlled:
        each, time = (5_000, 40e-6) if simple else (26_000, 150e-6)  # nodes of quadratures, or classes of a cascade
        everywhere = lines * points if closed and grid.record == "distributions" else 0
        size += each * max(columns, min(everywhere, 4000))  # at once, see hpgr.grains.solve
        seconds += time * (columns + 0.5 * everywhere)
    if cells and not closed:
        product = grid.snapshots * columns * cells
        at_once = max(AT_ONCE // cells, os.cpu_count() or 1)  # parcels
        size += (12 if slices == 1 else 62) * product  # kept, pooled, sorted; with slices ordered by their shares
        size += 8 * product * controlled  # what cells come to without cushioning, kept and pooled
        size += 40 * cells * min(columns * grid.snapshots, at_once)  # work space
        seconds += product * (0.2e-6 + 0.15e-9 * points + 0.01e-6 * controlled)
    if solver.endswith("lattice"):
        ahead = foresee(scene)
        last = points + ahead.settling
        frames += -(-last // exchange.interval) if exchange.startup else 0
        size += 24 * lines * points * cells + 10_000 * lines * points  # parcels; edges of the tessellation
        whole = 2e-7 + (1e-9 + 2e-9 * ahead.broken) * cells + (1e-7 + 6e-10 * cells) * ahead.turns  # a step of a point
        filling = last - (0 if exchange.startup else points / 2)
        steps = filling + (grid.snapshots - 1) * exchange.interval
        if solver == "lattice":
            seconds += 5e-5 * lines * points + steps * lines * points * whole
        else:  # the mean field, and a lattice of the points past the first break
            seconds += (2e-5 + filling * (1e-7 + 1.2e-7 * ahead.turns)) * lines * points
            seconds += steps * ahead.broken**2 * lines * points * whole
    if cells and grid.record == "cells":
        size += 4 * frames * lines * points * cells
        seconds += 1e-9 * frames * lines * points * cells
    elif cells and grid.record == "distributions":
        size += (28 if solver == "closed form" else 16) * frames * lines * points * (len(grid.sieves) + 1)
    return Cost(size, seconds)


class Foreseen(NamedTuple):
    """What a lattice will need, from a bed of few points, in which the feed is still unbroken above the first break."""

    substeps: float  # most of a time step
    turns: float  # mean over points
    settling: int  # points, see `hpgr.grains.lattice.settling`
    broken: float  # share of the points that are past the first break


def foresee(scene: Scene) -> Foreseen:
    """Return what the lattice of a scene that exchanges will need, in 0.5 ms.

    A Voronoi cell is taken for as wide as its tube and as high as its neighbours are apart; two of its edges lead along
    the tube.
    """
    exchange, grid, largest = scene.exchange, scene.resolution, scene.feed.largest_grain
    few = min(grid.points, 41)
    once = scene.elasticity.model_copy(update={"substeps": 1})
    try:
        bed = load_bed(inputs_of(scene)._replace(streamlines=3, points=few, elasticity=once))
    except ValueError:  # points that coincide: the run will refuse them at once
        return Foreseen(1.0, 1.0, 0, 0.0)
    first = lattice.first_break(scene, scene.strength.log_stress(crushing_stress(scene, bed)))
    motion, solid, stretch = bed.kinematics, bed.stress.solid_fraction, (grid.points - 1) / (few - 1)
    time_step = motion.time_step / stretch
    width, height = motion.flux / motion.speed / grid.streamlines, np.abs(np.gradient(motion.y, axis=1)) / stretch
    sheared = math.sqrt(3) * motion.shear_rate * time_step * solid
    parcel = lattice.parcel_of(scene, time_step, solid)
    mean = np.where(np.arange(few) < first, lattice.class_sizes(scene).mean(), 0.0)
    along, across = (
        exchange.diffusion(sheared * edge, distance, parcel) * mean**2
        for edge, distance in ((width, height), (height, width))
    )
    rise = exchange.rising(sheared * width, 1.0, parcel)
    substeps = 2 * (along + across + rise * largest) / lattice.LARGEST_SUM
    moved = (rise * (largest - mean)).sum(axis=1) * stretch + 2 * np.sqrt(2 * along.sum(axis=1) * stretch)
    return Foreseen(
        float(max(substeps.max(), 1.0)), float(np.ceil(substeps).mean()), math.ceil(moved.max()), 1 - first / few
    )


def available_memory() -> tuple[int, str]:
    """Return the memory left for this process in bytes, and the name of the limit that sets it.

    A process is bound by its own control group and by every one above it. What files have left in the cache counts as
    free: the system drops it when memory is asked for.
    """
    limits, groups = [(psutil.virtual_memory().available, "physical memory")], _own_groups()
    for root, *files in _CGROUPS:
        for group in groups:
            left = _left_in(root / group, *files)
            if left is not None:
                limits.append((left, f"the memory limit of cgroup /{'/'.join(group.parts)}"))
    return min(limits)


def _own_groups() -> list[Path]:
    """Return the control groups of this process, each with those above it, relative to where they are mounted."""
    groups = {Path()}
    try:
        lines = _PROCESS.read_text().splitlines()
    except OSError:  # no Linux
        return [Path()]
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers in ("", "memory") or "memory" in controllers.split(","):
            own = Path(path.lstrip("/"))
            groups |= {own, *own.parents}
    return sorted(group for group in groups if ".." not in group.parts)


def _left_in(group: Path, limit_file: str, used_file: str, cache: str) -> int | None:
    """Return the bytes left in a control group, or None if it has no limit."""
    try:
        with open(f"{group}/{limit_file}") as file:  # a path of pathlib costs as much again
            limit = int(file.read())
        if limit >= _NO_LIMIT:
            return None
        used = int((group / used_file).read_text())
    except (OSError, ValueError):  # no such group, or "max"
        return None
    return max(0, limit - max(0, used - _cached(group, cache)))


def _cached(group: Path, name: str) -> int:
    try:
        counts = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
        return int(counts.get(name, 0))
    except (OSError, ValueError):
        return 0


def refuse_too_large(scene: Scene, room: Callable[[], tuple[int, str]] | None = None) -> None:
    """Raise MemoryError with the predicted bytes if `scene` does not fit this machine.

    Of a scene that takes much, `room` tells what memory there is, as `available_memory`, its default, does.
    """
    needed = predict(scene).bytes
    if needed < _SLIGHT:
        return
    available, limit = (room or available_memory)()
    if needed > _SHARE * available:
        spare = "" if scene.resolution.record == "product" else "record 'product', or "
        raise MemoryError(
            f"resolution.cells: got {scene.resolution.cells} cells x {scene.resolution.points} points x "
            f"{scene.resolution.streamlines} streamlines, recording {scene.resolution.record}: predicted "
            f"{needed:,} bytes, must be at most {_SHARE:.0%} of the {available:,} bytes that {limit} leaves; "
            f"{spare}use fewer cells, points or snapshots"
        )
