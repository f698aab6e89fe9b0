"""The command line that the sweeps over gap, speed and feed share."""

import functools
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple

import tyro
from pydantic import ValidationError

from hpgr import budget, presets, units
from hpgr.keys import refuse_key
from hpgr.scene import Scene, faults_of, field_info

if TYPE_CHECKING:
    import xarray as xr

AXES = {
    "gap": "rolls.gap",
    "press_force": "rolls.specific_pressing_force",
    "roll_speed": "rolls.speed",
    "feed_top_size": "feed.top_size",
}


class Study(NamedTuple):
    """One ready sweep: its name, the option of its main axis, default values as multiples, and its message."""

    name: str
    main: str
    factors: tuple[float, ...]
    about: str
    caption: str
    exchange_caption: str = ""


def shown_as(metavar: str):
    """Return the word by which `--help` shows an option's value."""
    return tyro.conf.arg(metavar=metavar)


@dataclass(frozen=True)
class Options:
    """Options of a sweep; quantities are text with a unit, such as "60 mm" or "19 rpm"."""

    gap: Annotated[tuple[str, ...] | None, shown_as("LENGTH ...")] = None
    """Gaps to sweep, such as --gap "40 mm" "60 mm"."""
    press_force: Annotated[tuple[str, ...] | None, shown_as("PRESSURE ...")] = None
    """Specific pressing forces F/(D L) to sweep, such as --press-force "2.5 N/mm^2" "4 N/mm^2"; the gap then floats."""
    roll_speed: Annotated[tuple[str, ...] | None, shown_as("SPEED ...")] = None
    """Roll speeds to sweep, such as --roll-speed "15 rpm" "19 rpm"."""
    feed_top_size: Annotated[tuple[str, ...] | None, shown_as("LENGTH ...")] = None
    """Top sizes of the feed to sweep, such as --feed-top-size "40 mm" "60 mm"."""
    scene: Annotated[str, shown_as("PRESET|FILE")] = "paper"
    """Base scene: a preset (paper, khd_pilot), or the path of a .toml or .json scene file."""
    replicates: Annotated[int, shown_as("N")] = 3
    """Independent repetitions of every operating point; they make the spread."""
    level: Annotated[Literal["draft", "standard", "fine"] | None, shown_as("draft|standard|fine")] = None
    """Named resolution instead of the scene's, with measured error and cost (docs/accuracy.md)."""
    cells: Annotated[int | None, shown_as("N")] = None
    """Cells per material point (default: the scene's); 0 computes stress only."""
    points: Annotated[int | None, shown_as("N")] = None
    """Material points per streamline (default: the scene's)."""
    streamlines: Annotated[int | None, shown_as("N")] = None
    """Streamlines from the mid-plane to the roll (default: the scene's)."""
    tolerance: Annotated[float | None, shown_as("X")] = None
    """Relative error wanted, such as 0.01: every operating point is refined until its estimate is below it."""
    max_cost: Annotated[float, shown_as("SECONDS")] = 60.0
    """Predicted time that meeting the tolerance may take at an operating point."""
    sieve: Annotated[str, shown_as("LENGTH")] = "1 mm"
    """Sieve whose percent passing is shown."""
    workers: Annotated[int, shown_as("N")] = 2
    """Threads of this process to run cases on; without effect beside --scheduler."""
    scheduler: Annotated[str | None, shown_as("ADDRESS")] = None
    """Running dask scheduler to use instead, such as tcp://127.0.0.1:8786."""
    exchange: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Switch on segregation and mixing between streamlines, as the scene says, or else with default strength."""
    record: Literal["product", "distributions", "cells"] = "product"
    """What is kept of every case beside its summary: a file of distributions or cells, for studies.open_cases."""
    timeout: Annotated[float | None, shown_as("SECONDS")] = None
    """Time that a case may take; cases then run in processes of their own, and one that hangs or dies is named."""
    force: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Compute every case, also those that are finished already in <out>.cases."""
    seed: Annotated[int, shown_as("N")] = 0
    """Seed of all randomness; the same seed gives the same bits."""
    out: Annotated[Path | None, shown_as("FILE")] = None
    """NetCDF file to write (default: outputs/<study>.nc); beside it the figure, .png, and finished cases, .cases."""
    plot: bool = True
    """Draw the figure, or not."""
    dry_run: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """List the cases with their predicted memory and time, say which are finished already, and run none."""


def refusing(command: Callable[..., int]) -> Callable[..., int]:
    """Make a command print what it refuses as one clear error, and return exit code 2."""

    @functools.wraps(command)
    def wrapped(*args, **kwargs) -> int:
        try:
            return command(*args, **kwargs)
        except ValidationError as error:
            message = "the scene is refused:\n  " + faults_of(error, separator="\n  ")
        except (OSError, ValueError, MemoryError) as error:
            message = str(error)
        except KeyboardInterrupt:
            print("interrupted; finished cases are kept, and the same command goes on from there", file=sys.stderr)
            return 130
        print(f"error: {message}", file=sys.stderr)
        return 2

    return wrapped


@refusing
def run(study: Study, arguments: Sequence[str] | None = None) -> int:
    """Run a study from the command line; return its exit code.

    0: every case is well. 1: some cases hold no result, named on standard error. 2: nothing was run or written.
    """
    options = tyro.cli(Options, prog=f"python -m studies.{study.name}", description=study.about, args=arguments)
    chosen = {name: getattr(options, name) for name in ("level", "cells", "points", "streamlines")}
    scene = base_scene(options.scene, **{name: value for name, value in chosen.items() if value is not None})
    if options.exchange and scene.exchange is None:
        scene = scene.with_values({"exchange": {}})
    study = _floating(study, options)
    axes = _axes(study, options, scene)
    sieve = _sieve(options, scene)
    if min(options.workers, options.replicates) < 1:
        raise ValueError(f"got --workers {options.workers} --replicates {options.replicates}; both must be at least 1")
    refuse_key("--seed", options.seed)
    _check_tolerance(options)
    if options.timeout is not None and not 0.1 <= options.timeout <= 1e6:
        raise ValueError(f"--timeout: got {options.timeout:g}; must be 0.1 to 1,000,000 s; such as 60")
    if options.dry_run:
        _print_cases(scene, axes, options, _folder(study, options))
        return 0
    from studies import store

    out = _out(study, options)
    store.probe(out)
    result = _sweep(scene, axes, options, _folder(study, options))
    result.attrs["history"] = _command_line(study, arguments)
    return _report(study, options, result, sieve, out)


def _check_tolerance(options: Options) -> None:
    if options.tolerance is None:
        return
    if not 1e-4 <= options.tolerance <= 0.5:
        raise ValueError(f"--tolerance: got {options.tolerance:g}; must be within 0.0001 to 0.5; such as 0.01")
    given = [name for name in ("level", "cells", "points") if getattr(options, name) is not None]
    if given:
        raise ValueError(
            f"--{given[0]}: got it beside --tolerance, which chooses points and cells itself; give one of them"
        )


def base_scene(name: str, **resolution: int | str) -> Scene:
    """Return the scene of a preset or file, with another resolution.

    Raises
    ------
    ValueError
        If there is no such scene, or it is impossible.
    """
    if name in presets.PRESETS:
        scene = presets.PRESETS[name]()
    elif Path(name).suffix in {".toml", ".json"}:
        try:
            scene = Scene.from_file(name)
        except OSError as error:
            raise ValueError(f"--scene: cannot read {name!r}: {error.strerror}") from None
    else:
        raise ValueError(
            f"--scene: got {name!r}; must be a preset ({', '.join(presets.PRESETS)}) or a .toml or .json file"
        )
    return scene.with_values({f"resolution.{key}": value for key, value in resolution.items()})


def _floating(study: Study, options: Options) -> Study:
    """Return a study of the gap as one of the pressing force, if forces are given: the gap then floats."""
    if study.main != "gap" or options.press_force is None:
        return study
    if options.gap is not None:
        raise ValueError("--gap: got it beside --press-force, under which the gap floats; give one of them")
    return study._replace(main="press_force", caption="The gap floats under the pressing force; the nip angle is held.")


def _axes(study: Study, options: Options, scene: Scene) -> dict[str, list]:
    """Return the swept fields with their values, the study's own first."""
    if scene.feed.kind == "single" and (study.main == "feed_top_size" or options.feed_top_size):
        raise ValueError("--feed-top-size: the scene's feed is of a single size and has no top; sweep another feed")
    order = [study.main, *(name for name in AXES if name != study.main)]
    axes = {AXES[name]: list(getattr(options, name)) for name in order if getattr(options, name) is not None}
    if getattr(options, study.main) is None:
        axes = {AXES[study.main]: _default_values(study, scene), **axes}
    from studies.sweep import axis_values  # late, like all that --help does without

    return axis_values(axes)


def _default_values(study: Study, scene: Scene) -> list[float]:
    """Return the scene's own value times the study's factors."""
    section, key = AXES[study.main].split(".")
    own = getattr(getattr(scene, section), key)
    if own is None and key == "top_size":
        own = scene.feed.coarsest
    shown = units.SHOWN[field_info(AXES[study.main]).unit][1]
    return [own if factor == 1 else float(f"{own * factor * shown:.3g}") / shown for factor in study.factors]


def _sieve(options: Options, scene: Scene) -> float:
    known = scene.resolution.sieves
    try:
        sieve = units.parse(options.sieve, "m")
    except ValueError as error:
        raise ValueError(f"--sieve: got {options.sieve!r}; {error}") from None
    if not known[0] <= sieve <= known[-1]:
        raise ValueError(
            f"--sieve: got {options.sieve!r}; must lie within the scene's sieves, "
            f"{units.show(known[0], 'm')} to {units.show(known[-1], 'm')}"
        )
    return sieve


def _sweep(scene: Scene, axes: dict[str, list], options: Options, folder: Path) -> "xr.Dataset":
    from studies.sweep import sweep

    common = {
        "tolerance": options.tolerance,
        "max_cost": options.max_cost,
        "replicates": options.replicates,
        "seed": options.seed,
        "progress": True,
        "folder": folder,
        "force": options.force,
        "timeout": options.timeout,
        "record": options.record,
    }
    if options.scheduler is None:
        return sweep(scene, axes, threads=options.workers, **common)
    from distributed import Client

    with Client(options.scheduler, timeout="10s") as client:
        return sweep(scene, axes, client=client, **common)


def _print_cases(scene: Scene, axes: dict[str, list], options: Options, folder: Path) -> None:
    from studies.sweep import enumerate_cases, finished_cases

    scene = scene.with_values({"resolution.record": options.record})
    kept = finished_cases(scene, axes, options.replicates, folder, options.seed, options.tolerance, options.max_cost)
    if options.force:
        kept = dict.fromkeys(kept, 0)
    shows_kept = any(kept.values())
    print(f"{scene}\n")
    names = list(axes)
    heading = "".join(f"{_heading(name):>24}" for name in names) + f"{'memory':>12}{'time':>12}"
    print(heading + (f"{'finished':>14}" if shows_kept else ""))
    total = 0.0
    for case in enumerate_cases(axes, 1):
        shown = "".join(f"{units.show(case.values[name], field_info(name).unit):>24}" for name in names)
        try:
            cost = budget.predict(scene.with_values(case.values))
        except ValidationError as error:
            print(f"{shown}  refused: {faults_of(error)}")
            continue
        done = kept[case.index[:-1]]
        total += cost.seconds * (options.replicates - done)
        told = f"{f'{done} of {options.replicates}':>14}" if shows_kept else ""
        print(f"{shown}{cost.bytes / 1e6:>9.1f} MB{cost.seconds * 1e3:>9.1f} ms{told}")
    if options.tolerance is not None:
        print(f"\nbefore refinement: --tolerance {options.tolerance:g} chooses points and cells when a case is run")
    count, done = options.replicates * len(kept), sum(kept.values())
    finished = f"{done} of them finished already in {folder}; the others " if done else ""
    print(f"\n{count} cases ({options.replicates} replicates each), {finished}about {total / options.workers:.2g} s on "
          f"{options.workers} threads, plus start-up")  # fmt: skip


def _report(study: Study, options: Options, result: "xr.Dataset", sieve: float, out: Path) -> int:
    """Write the files, print the table, and return the exit code."""
    from studies import report, store

    lost = report.lost_cases(result)
    for line in lost:
        print(line, file=sys.stderr)
    if not report.any_result(result):
        print("no case holds a result; nothing was written", file=sys.stderr)
        return 1
    sayings = [*report.change(result, AXES[study.main]), _caption(study, result)]
    try:
        store.write_dataset(result, out)
        written = [out]
        if options.plot:
            from studies.plots import sweeps as plots

            figure = plots.sweep_figure(result, AXES[study.main], sieve, "\n".join(sayings))
            store.replace(out.with_suffix(".png"), lambda part: figure.savefig(part, dpi=150))
            written.append(out.with_suffix(".png"))
    except OSError as error:
        raise OSError(f"could not write the result: {error}") from error
    print(report.table(result, sieve))
    for line in (*report.notes(result), *sayings):
        print(line)
    print("wrote " + " and ".join(map(str, written)))
    return 1 if lost else 0


def _out(study: Study, options: Options) -> Path:
    out = options.out or Path("outputs") / f"{study.name}.nc"
    return out if out.suffix == ".nc" else out.with_name(out.name + ".nc")


def _folder(study: Study, options: Options) -> Path:
    """Return where finished cases are kept."""
    return _out(study, options).with_suffix(".cases")


def _caption(study: Study, result: "xr.Dataset") -> str:
    exchange = Scene.model_validate_json(result.attrs["scene"]).exchange
    return study.caption if exchange is None or not study.exchange_caption else study.exchange_caption


def _heading(name: str) -> str:
    info = field_info(name)
    shown = units.SHOWN.get(info.unit, (info.unit,))[0]
    return f"{AXES_BY_FIELD.get(name, name)} [{shown}]"


AXES_BY_FIELD = {field: name.replace("_", " ") for name, field in AXES.items()}


def _command_line(study: Study, arguments: Sequence[str] | None) -> str:
    import shlex

    given = sys.argv[1:] if arguments is None else arguments
    return f"python -m studies.{study.name} {shlex.join(given)}".strip()
