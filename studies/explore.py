"""A sweep as one page to play with, in a single file: `python -m studies.explore outputs/gap_sweep.nc`.

The page holds the data and the library that draws it, and asks the network for nothing.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from studies import command as cli

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True)
class Options:
    """Options of the explorer; the page has a slider for the sieve."""

    result: Annotated[Path, tyro.conf.Positional, cli.shown_as("FILE")]
    """NetCDF file of a sweep, such as outputs/gap_sweep.nc."""
    sieve: cli.Sieve = "1 mm"
    out: Annotated[Path | None, cli.shown_as("FILE")] = None
    """Page to write (default: beside the NetCDF file, as .html)."""
    overwrite: cli.Overwrite = False


def _files(options: Options) -> list[Path]:
    out = options.out or options.result.with_suffix(".html")
    if out.suffix not in (".html", ".htm"):
        raise ValueError(f"--out: got {str(out)!r}; must end with .html, so that a browser opens it")
    return [out]


@cli.command("explore", __doc__, files=_files)
def main(options: Options) -> cli.Report:
    """Write the page of the command line."""
    sieve = cli.si_value("--sieve", options.sieve, "m")
    library = chart_library()
    from studies.show.page import page_data, page_of

    data = page_data(opened(options.result), sieve, options.result.name)

    def write(path: Path, history: str) -> None:
        path.write_text(page_of(data, library, history), encoding="utf-8")

    return cli.Report(parts=[write])


def chart_library() -> str:
    """Return the source of plotly.js; ValueError if the Python package that carries it is not installed."""
    try:
        from plotly.offline import get_plotlyjs
    except ImportError:
        raise ValueError(
            "the explorer draws with plotly, which is not installed; install it: pip install 'plotly>=6', or "
            "pip install -e '.[explore]' in a clone of this project"
        ) from None
    return get_plotlyjs()


def opened(path: Path) -> "xr.Dataset":
    """Return the Dataset of a NetCDF file that may be anybody's, read whole.

    ValueError if there is no such file, or it is no NetCDF file, or one that is not safe to open.
    """
    from studies.sweep.netcdf import open_result

    if not path.is_file():
        raise ValueError(f"{path}: there is no such file; make one first, such as by python -m studies.gap_sweep")
    try:
        with open_result(path) as dataset:
            return dataset.load()
    except (OSError, RuntimeError) as error:
        raise ValueError(f"{path}: cannot be read as NetCDF ({error}); give a file that a study has written") from None


if __name__ == "__main__":
    raise SystemExit(main())
