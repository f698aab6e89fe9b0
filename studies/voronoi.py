"""The paper's figure 3d, the volume of each material point: `python -m studies.voronoi`."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from studies.command import base_scene, refusing, shown_as


@dataclass(frozen=True)
class Options:
    """Options of the picture."""

    scene: Annotated[str, shown_as("PRESET|FILE")] = "paper"
    """Scene: a preset (paper, khd_pilot), or the path of a .toml or .json scene file."""
    points: Annotated[int, shown_as("N")] = 60
    """Material points per streamline."""
    streamlines: Annotated[int, shown_as("N")] = 10
    """Streamlines from the mid-plane to the roll."""
    out: Annotated[Path, shown_as("FILE")] = Path("outputs/voronoi.png")
    """Picture to write."""


@refusing
def main(arguments: Sequence[str] | None = None) -> int:
    """Draw the picture and return the exit code; `arguments` default to the command line's."""
    options = tyro.cli(Options, prog="python -m studies.voronoi", description=__doc__, args=arguments)
    scene = base_scene(options.scene, points=options.points, streamlines=options.streamlines)
    from hpgr import flow, geometry, tessellation
    from studies import store
    from studies.plots import bed as pictures

    bed = geometry.bed(scene.rolls, scene.resolution.streamlines)
    motion = flow.move(scene, bed, scene.resolution.points)
    cells = tessellation.tessellate(scene, bed, motion)
    figure = pictures.tessellation_figure(bed, motion, cells)
    store.replace(options.out, lambda part: figure.savefig(part, dpi=150))
    print(f"{cells.volume.size} material points, {len(cells.pairs)} edges; volumes sum to {cells.volume.sum():.6g} m2")
    print(f"wrote {options.out}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
