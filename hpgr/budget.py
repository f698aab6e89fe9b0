"""What a scene will cost, before it is run: memory against this machine's limit, and time."""

import os
from pathlib import Path
from typing import NamedTuple

import psutil

from hpgr.scene import Scene

_SHARE = 0.8  # of the available memory that one scene may take; the rest is for the reader of the result
_CGROUP_FILES = (  # (limit, in use), version 2 and 1
    ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
    ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
)


class Cost(NamedTuple):
    """Predicted peak memory in bytes and time in seconds of one run of a scene."""

    bytes: int
    seconds: float


def predict(scene: Scene) -> Cost:
    """Return the predicted cost of `scene`: memory beyond the interpreter's, and time on one core.

    The coefficients are measured on the paper's scene (docs/performance.md); treat times as good to a
    factor of 2.
    """
    grid = scene.resolution
    lines, points, cells = grid.streamlines, grid.points, grid.cells
    fields = lines * ((points - 1) * scene.stress.substeps + 1)
    size = 240 * fields  # the arrays of motion and load, 8 bytes each, with their temporaries
    seconds = 2.5e-3 + 1.5e-6 * fields
    if cells:
        columns = lines * (1 if scene.roll_width is None else 2 * scene.roll_width.slices)
        product = 4 * grid.photographs * columns * cells
        at_once = max(os.cpu_count() or 1, 200_000 // cells)  # parcels, see hpgr.solve
        size += 3 * product + 40 * cells * min(columns * grid.photographs, at_once)  # kept, pooled, sorted; work space
        seconds += grid.photographs * columns * cells * (0.28e-6 + 0.15e-9 * points)
        frames = grid.photographs
        if scene.exchange is not None:
            frames += -(-(points - 1) // scene.exchange.interval) if scene.exchange.record_startup else 0
            size += 17 * lines * points * cells + 30_000 * lines * points  # parcels; edges of the tessellation
            steps = points + grid.photographs * scene.exchange.interval
            seconds += 5e-5 * lines * points + steps * lines * points * (2e-6 + 1.5e-9 * cells)
        if grid.record == "cells":
            size += 4 * frames * lines * points * cells
            seconds += 1e-9 * frames * lines * points * cells
        elif grid.record == "distributions":
            size += 16 * frames * lines * points * (len(grid.sieves) + 1)
    return Cost(size, seconds)


def available_memory() -> tuple[int, str]:
    """Return the memory left for this process in bytes, and the name of the limit that sets it."""
    limits = [(psutil.virtual_memory().available, "physical memory")]
    for limit_file, used_file in _CGROUP_FILES:
        try:
            limit, used = int(Path(limit_file).read_text()), int(Path(used_file).read_text())
        except (OSError, ValueError):  # no such cgroup, or "max"
            continue
        limits.append((limit - used, "the cgroup's memory limit"))
    return min(limits)


def refuse_too_large(scene: Scene, room: tuple[int, str] | None = None) -> None:
    """Raise MemoryError with the predicted bytes if `scene` does not fit this machine.

    `room` is what `available_memory` returned before; asking the system costs 0.1 ms.
    """
    needed = predict(scene).bytes
    available, limit = room or available_memory()
    if needed > _SHARE * available:
        raise MemoryError(
            f"resolution.cells: got {scene.resolution.cells} cells x {scene.resolution.points} points x "
            f"{scene.resolution.streamlines} streamlines, recording {scene.resolution.record}: predicted "
            f"{needed:,} bytes, must be at most {_SHARE:.0%} of the {available:,} bytes that {limit} leaves; "
            "record 'product', or use fewer cells, points or photographs"
        )
