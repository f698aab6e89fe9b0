"""What all command lines share: options, base scene, history, writing, refusing, exit codes, progress."""

import contextlib
import dataclasses
import functools
import itertools
import re
import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import tyro
from pydantic import ValidationError

from hpgr import presets
from hpgr.fields import check_number, faults_of, parse
from hpgr.scene import Scene, field_info, levels
from studies import Late
from studies.sweep.space import ends_of, field_of

if TYPE_CHECKING:
    import matplotlib.figure

metrics, netcdf = Late("hpgr.results.metrics"), Late("studies.sweep.netcdf")

# A study's files name the command that made them: in the history, a PNG's "Source", a GIF's comment, a page's
# generator, the first line of a scene file
_PREFIX = re.compile(r"python -m studies\.\w+")
_MARK = re.compile(rb"(?:\A# |Source\0+|!\xfe.|\"generator\" content=\")(python -m studies\.\w+)", re.DOTALL)
_MARK_WITHIN = 1 << 16  # bytes from the beginning

Part = "xr.Dataset | Callable[[Path, str], object]"


# ---- options


def shown_as(metavar: str, words: str | None = None) -> Any:
    """Return what has `--help` show an option's value as `metavar`, and describe it in these words."""
    return tyro.conf.arg(metavar=metavar, help=words, help_behavior_hint=_default)


def _default(value: str) -> str:
    """Return what `--help` says of a default; nothing where there is none, of which the words tell what it means."""
    return "" if value in ("None", "") else f"(default: {value.replace(str(presets.DATA), 'hpgr/data')})"


# which is off unless it is given
Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(help_behavior_hint="")]
_LEVELS = tuple(levels())

_SCENES = f"preset ({', '.join(presets.NAMES)}), .toml or .json scene file, or .nc file of a study, whose scene it is"
SceneName = Annotated[str, shown_as("PRESET|FILE", f"Base scene: {_SCENES}.")]
_OF_FILE = "(default: paper, or the scene of the calibration's file)"
CalibratedScene = Annotated[str | None, shown_as("PRESET|FILE", f"Base scene: {_SCENES} {_OF_FILE}.")]
SceneNames = Annotated[
    tuple[str, ...] | None, shown_as("PRESET|FILE ...", f"Scene, or scenes to compare: {_SCENES} {_OF_FILE}.")
]
Vary = Annotated[
    tyro.conf.UseAppendAction[tuple[str, ...]],
    shown_as("FIELD=V1,V2,...", "Values of any scene field, or lo..hi:N, such as 'gap=40 mm..60 mm:5'; repeatable."),
]
Range = Annotated[
    tyro.conf.UseAppendAction[tuple[str, ...]],
    shown_as("FIELD=LO..HI", "Range of any scene field, such as 'gap=40 mm..60 mm'; repeatable."),
]
Level = Annotated[
    Literal[_LEVELS] | None,
    shown_as(
        "|".join(_LEVELS), "Named resolution instead of the scene's, with measured error and cost (docs/accuracy.md)."
    ),
]
Cells = Annotated[
    int | None, shown_as("N", "Cells per material point, instead of the scene's; 0 computes stress only.")
]
Points = Annotated[int | None, shown_as("N", "Material points per streamline, instead of the scene's.")]
Streamlines = Annotated[
    int | None, shown_as("N", "Streamlines from the mid-plane to the roll, instead of the scene's.")
]
Exchange = Annotated[
    Flag, tyro.conf.arg(help="Switch on segregation and mixing, as the scene says, or else with default strength.")
]
Replicates = Annotated[int, shown_as("N", "Independent repetitions of every operating point; they make the spread.")]
Seed = Annotated[int, shown_as("N", "Seed of all randomness; the same seed gives the same bits.")]
Workers = Annotated[int, shown_as("N", "Threads of this process to run cases on.")]
Sieve = Annotated[str, shown_as("LENGTH", "Sieve whose percent passing is shown.")]
Quick = Annotated[
    Flag, tyro.conf.arg(help="Fewer and coarser runs: seconds instead of minutes, to see what comes out.")
]
Out = Annotated[Path, shown_as("FILE", "NetCDF file to write; the figure goes beside it, as .png.")]
Plot = Annotated[bool, tyro.conf.arg(help="Draw the figure, or not.")]
Overwrite = Annotated[Flag, tyro.conf.arg(help="Replace files that are not this command's own earlier result.")]


@dataclass(frozen=True)
class Common:
    """Options that studies of one scene have in common."""

    level: Level = None
    cells: Cells = None
    points: Points = None
    streamlines: Streamlines = None
    seed: Seed = 0
    plot: Plot = True
    overwrite: Overwrite = False


def base_scene(options: Any) -> Scene:
    """Return the scene of a preset or file, with the resolution and exchange that are asked for.

    `options` have its name as `scene`, and may have level, cells, points, streamlines and exchange. ValueError if
    there is no such scene.
    """
    asked = {"resolution": "level"} | {f"resolution.{name}": name for name in ("cells", "points", "streamlines")}
    values = {field: getattr(options, name, None) for field, name in asked.items()}
    values = {field: value for field, value in values.items() if value is not None}
    scene = _named_scene(options.scene)
    if getattr(options, "exchange", False) and scene.exchange is None:
        values["exchange"] = {}
    return scene.with_values(values)


def _named_scene(name: str) -> Scene:
    if name in presets.NAMES:
        return Scene.preset(name)
    if Path(name).suffix not in {".toml", ".json", ".nc"}:
        raise ValueError(
            f"--scene: got {name!r}; must be a preset ({', '.join(presets.NAMES)}) or a .toml, .json or .nc file"
        )
    try:
        if Path(name).suffix != ".nc":
            return Scene.from_file(name)
        with netcdf.open_result(name) as dataset:
            return metrics.scene_of(dataset)
    except OSError as error:
        raise ValueError(f"--scene: cannot read {name!r}: {error.strerror}") from None


def si_value(option: str, text: str, unit: str) -> float:
    """Return the SI value of an option's text, such as "1 mm"; a ValueError names the option."""
    try:
        return parse(text, unit)
    except ValueError as error:
        raise ValueError(f"{option}: got {text!r}; {error}") from None


def scenes_of(options: Any) -> dict[str, Scene]:
    """Return the scenes of options that have several names as `scene`, each as `base_scene` makes it."""
    found = {Path(name).stem: base_scene(dataclasses.replace(options, scene=name)) for name in options.scene}
    if not options.scene or len(found) < len(options.scene):
        raise ValueError(f"--scene: got {' '.join(options.scene) or 'none'}; must be scenes of different names")
    return found


def varied(text: str) -> tuple[str, list | tuple]:
    """Return the field that a `--vary` names and its values, or the ends (low, high) of a range to draw from.

    Examples
    --------
    >>> from studies.command import varied
    >>> varied("gap=40 mm..60 mm:3")
    ('rolls.gap', [0.04, 0.05, 0.06])
    """
    name, equals, values = text.partition("=")
    if not equals:
        raise ValueError(f"--vary: got {text!r}; must be a field and its values; such as 'gap=40 mm,60 mm'")
    field = field_of(name.strip())
    low, dots, rest = values.partition("..")
    if not dots:
        return field, [_number(field, value) for value in values.split(",")]
    high, colon, count = rest.partition(":")
    [(low, high)] = ends_of({field: (_number(field, low), _number(field, high))}).values()
    if not colon:
        return field, (low, high)
    if not count.strip().isdecimal() or not 2 <= int(count) <= 10_000:
        raise ValueError(f"--vary: got {text!r}; must end with the number of values, 2 to 10,000; such as 'lo..hi:5'")
    last = int(count) - 1
    values = [float(f"{low + k * (high - low) / last:.12g}") for k in range(last + 1)]
    return field, [round(value) for value in values] if isinstance(low, int) and isinstance(high, int) else values


def all_varied(kind: type, texts: Sequence[str]) -> dict[str, Any]:
    """Return what `--vary` gives of each field: a list of values, or a tuple, which is a range; not the other kind."""
    words = "values; such as 'gap=40 mm..60 mm:5'" if kind is list else "ranges; such as 'gap=40 mm..60 mm'"
    found: dict[str, Any] = {}
    for text in texts:
        field, values = varied(text)
        if field in found or not isinstance(values, kind):
            told = f"{field} twice" if field in found else repr(text)
            raise ValueError(f"--vary: got {told}; must be {words}, each field once")
        found[field] = values
    return found


def posterior(path: Path) -> dict[str, list[float]]:
    """Return samples of scene fields of a calibration's file, such as outputs/pilot.nc: variables along `sample`."""
    with netcdf.open_result(path) as dataset:
        found = {name: value.values.tolist() for name, value in dataset.data_vars.items() if value.dims == ("sample",)}
    if not found:
        raise ValueError(f"{path}: has no samples of scene fields along 'sample'; give the file of a studies.pilot")
    return found


def _number(field: str, text: str) -> Any:
    """Return the text of a value as the number it is, where the field has no unit."""
    if field_info(field).unit == "1":
        for kind in (int, float):
            with contextlib.suppress(ValueError):
                return kind(text)
    return text.strip()


# ---- one main


class Report(NamedTuple):
    """What a study hands to its command line.

    Attributes
    ----------
    lines : sequence of str
        What is printed when the files stand.
    parts : sequence
        What goes into the command's files, in their order: a Dataset, or a function that writes a file, given its
        path and the command line that made it. Fewer paths than parts leave the last ones out.
    faults : sequence of str
        What is printed on standard error; any makes the exit code 1.
    """

    lines: Sequence[str] = ()
    parts: Sequence[Part] = ()
    faults: Sequence[str] = ()


def file_of(out: Path, suffix: str = ".nc", option: str = "--out") -> Path:
    """Return the path that an option asks for, with its suffix."""
    if out.name in ("", ".."):
        raise ValueError(f"{option}: got {str(out)!r}; must be the name of a file; such as outputs/mine{suffix}")
    return out if out.suffix == suffix else out.with_name(out.name + suffix)


def beside(options: Any) -> list[Path]:
    """Return the files of most studies: a NetCDF file, and a figure beside it unless there is to be none."""
    out = file_of(options.out)
    return [out, out.with_suffix(".png")] if options.plot else [out]


Study = Callable[[Any], Report]
Files = Callable[[Any], list[Path]]


def command(name: str, about: str, files: Files = beside) -> Callable[[Study], Callable[..., int]]:
    """Make a study, a function of its options, into the main function of `python -m studies.<name>`.

    Parameters
    ----------
    name, about : str
        Name of the study, and what it does, for `--help`.
    files : function
        Paths that these options have written. They are looked at before the study runs, and written after it.

    Returns
    -------
    A decorator; what it makes takes arguments (default: the command line's) and returns an exit code. 0: all is well.
    1: the report tells of faults. 2: the input is refused, or the result cannot be written. 130: interrupted.
    """

    def decorate(study: Study) -> Callable[..., int]:
        [kind] = (kind for argument, kind in study.__annotations__.items() if argument != "return")

        @functools.wraps(study)
        def main(arguments: Sequence[str] | None = None) -> int:
            options = tyro.cli(kind, prog=f"python -m studies.{name}", description=about, args=arguments)
            given = sys.argv[1:] if arguments is None else arguments
            return _exit_code(study, options, files, f"python -m studies.{name} {shlex.join(given)}".strip())

        del main.__wrapped__  # whose signature is the study's
        return main

    return decorate


def _exit_code(study: Study, options: Any, files: Files, line: str) -> int:
    """Run a study; print what is refused as one clear error."""
    try:
        return _run(study, options, files, line)
    except ValidationError as error:
        message = "the scene is refused:\n  " + faults_of(error, separator="\n  ")
    except (OSError, ValueError, MemoryError) as error:
        message = str(error)
    except KeyboardInterrupt:
        print(
            "interrupted; a sweep's finished cases are kept, and the same command goes on from there", file=sys.stderr
        )
        return 130
    print_plainly(f"error: {message}", file=sys.stderr)
    return 2


def _run(study: Study, options: Any, files: Files, line: str) -> int:
    check_number("--seed", getattr(options, "seed", 0))
    paths = files(options)
    for path in paths:
        _refuse_foreign(path, line, options.overwrite)
    report = study(options)
    try:
        written = [_write(part, path, line) for path, part in zip(paths, report.parts, strict=False)]
    except OSError as error:
        raise OSError(f"could not write the result: {error}") from error
    print_plainly(*report.lines)
    print_plainly(*report.faults, file=sys.stderr)
    if written:
        print("wrote " + " and ".join(filter(None, (", ".join(written[:-1]), written[-1]))))
    return 1 if report.faults else 0


def print_plainly(*lines: str, file: Any = None) -> None:
    """Print lines in which what would steer the terminal is written out: files and scenes may be anybody's."""
    for line in lines:
        print(re.sub(r"[^\n -~\u00a0-\U0010ffff]", lambda found: ascii(found[0])[1:-1], line), file=file)


# ---- files


def _write(part: Part, path: Path, line: str) -> str:
    if callable(part):
        netcdf.replace(path, lambda temporary: part(temporary, line))
    else:
        netcdf.write_dataset(part.assign_attrs(history=line), path)
    return str(path)


def figure(draw: "Callable[[], matplotlib.figure.Figure]", dpi: int = 150) -> Part:
    """Return what writes the figure that `draw` makes, and in it the command line that made it."""
    return lambda path, line: draw().savefig(path, dpi=dpi, metadata={"Source": line})


def _refuse_foreign(path: Path, line: str, overwrite: bool) -> None:
    """Raise if a file cannot be written, or one is there that is not this command's own earlier result.

    Raises
    ------
    OSError, ValueError
        Naming the file, what it holds, and the remedy.
    """
    netcdf.probe(path)
    if overwrite or not path.exists():
        return
    option = "--csv" if path.suffix == ".csv" else "--out"
    remedy = f"give {option} another name, or --overwrite to replace it"
    if not path.stat().st_mode & 0o222:
        raise ValueError(f"{option}: got {path}, which is read-only; {remedy}")
    maker = _maker(path)
    if maker is None:
        raise ValueError(f"{option}: got {path}, which is no whole result of a study; {remedy}")
    same = _named(maker)[:1] == _named(line)[:1] and (path.suffix != ".nc" or _named(maker) == _named(line))
    if not same:
        raise ValueError(f"{option}: got {path}, which is the result of another command, `{maker}`; {remedy}")


def _maker(path: Path) -> str | None:
    """Return the command line that made a file, of a picture or page its beginning; None if it is no study's."""
    if path.suffix != ".nc":
        with path.open("rb") as file:
            found = _MARK.search(file.read(_MARK_WITHIN))
        return found[1].decode() if found else None
    try:
        with netcdf.open_result(path) as dataset:
            found = str(dataset.attrs.get("history"))
    except (OSError, ValueError):
        return None
    return found if _PREFIX.match(found) else None


def _named(line: str) -> tuple[str, str]:
    """Return the study and the scenes that a command line names."""
    try:
        words = shlex.split(line.replace(" --scene=", " --scene "))
    except ValueError:  # quotes that nobody closed: it is no command line, but somebody's
        return line, ""
    scenes = words[words.index("--scene") + 1 :] if "--scene" in words else []
    return words[2], " ".join(itertools.takewhile(lambda word: not word.startswith("-"), scenes))


# ---- progress


def progress_bar(total: int, progress: bool, unit: str, line: str = "{elapsed}", done: int = 0) -> Any:
    """Return a progress bar over `total` units, `done` of them already; none without `progress`.

    Where no terminal is watching it is a plain line every few seconds, with `line` in tqdm's terms behind the count.
    """
    from tqdm.auto import tqdm  # late: `--help` does without

    common = {"total": total, "initial": done, "unit": f" {unit}", "disable": not progress}
    if sys.stderr.isatty():
        return tqdm(**common)
    return tqdm(**common, bar_format=f"{{n_fmt}} of {{total_fmt}} {unit}, {line}\n", mininterval=5)
