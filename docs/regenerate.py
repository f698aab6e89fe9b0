"""Make the pictures of README.md and docs/ anew: `python docs/regenerate.py [PICTURE ...]`, by hand, in some minutes.

Each picture is what a study draws by default; docs/files.md names the studies. What is larger than 250 kB is reduced
to 256 colours. `python docs/regenerate.py pages` renews what the Python of the pages prints, which the tests compare.
"""

import ast
import io
import os
import re
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from pathlib import Path

from PIL import Image

from studies import accuracy, extremes, gap_sweep, paper, pilot
from studies.sweep import netcdf

DOCS = Path(__file__).parent
BY_HAND = ("explore.png",)  # a screenshot of a browser
LARGEST = 250_000  # bytes of a PNG that stays in all its colours
PAGES = [
    DOCS / "tutorial.md",
    DOCS / "gallery.md",
    *sorted(DOCS.glob("howto_*.md")),
]  # whose Python runs, from top to bottom
ARROW = "# ->"  # before each line that a statement prints

# picture: (the study that draws it, the option --out of the study, relative to a folder)
PICTURES: dict[str, tuple[Callable[[Sequence[str]], int], str]] = {
    "gap_sweep.png": (gap_sweep.main, "gap_sweep.nc"),
    "accuracy.png": (accuracy.main, "accuracy.nc"),
    "pilot.png": (pilot.main, "pilot.nc"),
    "extremes.png": (extremes.main, "extremes.nc"),
    "extremes_euler.png": (extremes.main, "extremes.nc"),
    **{name: (paper.main, "") for name in (*paper.FIGURES, paper.ANIMATION)},
}


def main(names: Sequence[str]) -> int:
    """Make these pictures, or all, and return the exit code: 1 if a study could not draw its own."""
    if list(names) == ["pages"]:
        return renew_pages()
    unknown = sorted(set(names) - set(PICTURES))
    if unknown:
        print(f"error: got {', '.join(unknown)}; must be among {', '.join(PICTURES)}", file=sys.stderr)
        return 2
    wanted = names or list(PICTURES)
    for study, out in dict.fromkeys(PICTURES[name] for name in wanted):
        with tempfile.TemporaryDirectory() as folder:
            if study(["--out", str(Path(folder) / out)]):
                return 1
            for name in wanted:
                if PICTURES[name] == (study, out):
                    put(Path(folder) / name, DOCS / name)
    return 0


def put(drawn: Path, place: Path) -> None:
    """Put a drawn picture in its place, in fewer colours if it is large."""
    if drawn.suffix == ".png" and drawn.stat().st_size > LARGEST:
        with Image.open(drawn) as picture:
            few = picture.convert("RGB").quantize(256, dither=Image.Dither.NONE)
        few.save(drawn, optimize=True)
    content = drawn.read_bytes()
    netcdf.replace(place, lambda part: part.write_bytes(content))
    print(f"{place}: {len(content):,} bytes")


def renew_pages() -> int:
    """Write what the Python of the pages prints now."""
    for page in PAGES:
        with tempfile.TemporaryDirectory() as folder:
            os.chdir(folder)
            text = renewed(page)
            os.chdir(DOCS)
        page.write_text(text, encoding="utf-8")
    return 0


def renewed(page: Path) -> str:
    """Return a page with what its Python prints, run in this folder, after each statement of blocks that show it."""
    namespace = {"__name__": "page"}

    def run(found: re.Match) -> str:
        lines = [line for line in found[0].splitlines() if not line.startswith(ARROW)]
        shown, done = [], 0
        for statement in ast.parse("\n".join(lines)).body:
            printed = io.StringIO()
            with redirect_stdout(printed):
                exec(compile(ast.Module([statement], []), str(page), "exec"), namespace)
            shown += lines[done : statement.end_lineno]
            done = statement.end_lineno
            shown += [f"{ARROW} {line}" for line in printed.getvalue().splitlines()] if ARROW in found[0] else []
        return "".join(f"{line}\n" for line in shown + lines[done:])

    return re.sub(r"(?<=^```python\n).*?(?=^```)", run, page.read_text(encoding="utf-8"), flags=re.M | re.S)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
