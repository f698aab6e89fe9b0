"""A sweep as one page to play with, in a single file: `python -m studies.explore outputs/gap_sweep.nc`.

The page holds the data and the library that draws it, and asks the network for nothing.
"""

import base64
import gzip
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from hpgr import units
from studies.command import refusing, shown_as

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True)
class Options:
    """Options of the explorer."""

    result: Annotated[Path, tyro.conf.Positional, shown_as("FILE")]
    """NetCDF file of a sweep, such as outputs/gap_sweep.nc."""
    sieve: Annotated[str, shown_as("LENGTH")] = "1 mm"
    """Sieve whose percent passing is shown first; the page has a slider for it."""
    out: Annotated[Path | None, shown_as("FILE")] = None
    """Page to write (default: beside the NetCDF file, as .html)."""


@refusing
def main(arguments: Sequence[str] | None = None) -> int:
    """Write the page and return the exit code; `arguments` default to the command line's."""
    options = tyro.cli(Options, prog="python -m studies.explore", description=__doc__, args=arguments)
    try:
        sieve = units.parse(options.sieve, "m")
    except ValueError as error:
        raise ValueError(f"--sieve: got {options.sieve!r}; {error}") from None
    library = chart_library()
    from studies import store
    from studies.explore_data import page_data

    out = options.out or options.result.with_suffix(".html")
    if out.suffix not in (".html", ".htm"):
        raise ValueError(f"--out: got {str(out)!r}; must end with .html, so that a browser opens it")
    page = page_of(page_data(opened(options.result), sieve, options.result.name), library)
    store.replace(out, lambda part: part.write_text(page, encoding="utf-8"))
    print(f"wrote {out} ({len(page.encode()) / 1e6:.1f} MB); open it in a browser")
    return 0


def chart_library() -> str:
    """Return the source of plotly.js.

    Raises
    ------
    ValueError
        If the Python package that carries it is not installed.
    """
    try:
        from plotly.offline import get_plotlyjs
    except ImportError:
        raise ValueError(
            "the explorer draws with plotly, which is not installed; install it: pip install 'plotly>=6', or "
            "pip install -e '.[explore]' in a clone of this project"
        ) from None
    return get_plotlyjs()


def opened(path: Path) -> "xr.Dataset":
    """Return the Dataset of a NetCDF file, read whole.

    Raises
    ------
    ValueError
        If there is no such file, or it is no NetCDF file.
    """
    if not path.is_file():
        raise ValueError(f"{path}: there is no such file; make one first, such as by python -m studies.gap_sweep")
    import xarray as xr

    try:
        with xr.open_dataset(path, engine="netcdf4") as dataset:
            return dataset.load()
    except (OSError, ValueError, RuntimeError) as error:
        raise ValueError(f"{path}: cannot be read as NetCDF ({error}); give a file that a study has written") from None


def page_of(data: dict[str, Any], library: str) -> str:
    """Return the page as text.

    Parameters
    ----------
    data : dict
        From `studies.explore_data.page_data`.
    library : str
        Source of plotly.js, which is packed to two fifths of its size; browsers since 2023 unpack it.

    Examples
    --------
    >>> from studies.explore import page_of
    >>> "<title>a &lt; b" in page_of({"name": "a < b"}, "")
    True
    """
    packed = base64.b64encode(gzip.compress(library.encode(), 9, mtime=0)).decode()
    parts = {"TITLE": escaped(data["name"]), "DATA": embedded(data), "LIBRARY": packed}
    template = (files("studies") / "explore_page.html").read_text(encoding="utf-8")
    return re.sub("@@([A-Z]+)@@", lambda found: parts[found[1]], template)


def escaped(text: str) -> str:
    """Return text as it is written in HTML."""
    import html

    return html.escape(text)


def embedded(data: dict[str, Any]) -> str:
    r"""Return data as JSON that no text in it can end the script element of.

    Examples
    --------
    >>> from studies.explore import embedded
    >>> embedded({"note": "</script>"})
    '{"note":"\\u003c/script\\u003e"}'
    """
    text = json.dumps(data, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    for mark in "<>&\u2028\u2029":
        text = text.replace(mark, f"\\u{ord(mark):04x}")
    return text


if __name__ == "__main__":
    raise SystemExit(main())
