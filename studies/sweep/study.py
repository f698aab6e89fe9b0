"""The command line that the sweeps over gap, speed and feed share."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

from pydantic import ValidationError

from hpgr import presets
from hpgr.fields import check_number, faults_of, show, unit_shown
from hpgr.scene import Scene, field_info
from studies import Late
from studies import command as line
from studies.command import Report, shown_as
from studies.sweep.space import AXES, SCENE, Space, SweepSpec, axes_of, sobol_design

if TYPE_CHECKING:
    import xarray as xr

cost, machine, report = Late("hpgr.cost"), Late("hpgr.bed.machine"), Late("studies.show.report")
assemble, cases = Late("studies.sweep.assemble"), Late("studies.sweep.cases")

_DRAWS = 32  # samples of a calibration
_MOST_FORCE = 2.0  # on the narrowest gap of a default range, over that of the scene's own gap
_ALIKE_CAPTION = (
    "Tests of one feed tell k, the scatter of strength, no better than this: with the k of each further scene the "
    "product of the seven tests is missed by 9 % more than with the preset's own, and what the feed does lies between "
    "them as far as these tests tell. Another ore, fitted to a coarse feed, was missed by 2.5 to 2.7 percent passing "
    "on a finer one (docs/validation.md)."
)


class Study(NamedTuple):
    """One ready sweep: its name, the option of its main axis, default values as multiples, and its message."""

    name: str
    main: str
    factors: tuple[float, ...]
    about: str
    caption: str
    exchange_caption: str = ""


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
    vary: line.Vary = ()
    sample: Annotated[int | None, shown_as("N")] = None
    """Points of a Sobol design, drawn over the fields that --vary gives as a range, such as 'gap=40 mm..60 mm'."""
    calibration: Annotated[Path | None, shown_as("FILE")] = None
    """File of studies.pilot: 32 of its samples are run at every operating point; bands tell what it leaves open."""
    scene: line.SceneNames = None
    replicates: line.Replicates = 3
    level: line.Level = None
    cells: line.Cells = None
    points: line.Points = None
    streamlines: line.Streamlines = None
    tolerance: Annotated[float | None, shown_as("X")] = None
    """Relative error wanted, such as 0.01: every operating point is refined until its estimate is below it."""
    max_cost: Annotated[float, shown_as("SECONDS")] = 60.0
    """Predicted time that meeting the tolerance may take at an operating point."""
    sieve: line.Sieve = "1 mm"
    workers: line.Workers = 2
    scheduler: Annotated[str | None, shown_as("ADDRESS")] = None
    """Running dask scheduler to use instead of threads, such as tcp://127.0.0.1:8786."""
    exchange: line.Exchange = False
    record: Literal["product", "distributions", "cells"] = "product"
    """What is kept of every case beside its summary: a file of distributions or cells, for studies.open_cases."""
    timeout: Annotated[float | None, shown_as("SECONDS")] = None
    """Time that a case may take; cases then run in processes of their own, and one that hangs or dies is named."""
    recompute: line.Flag = False
    """Compute every case, also those that are finished already in <out>.cases."""
    seed: line.Seed = 0
    out: Annotated[Path | None, shown_as("FILE")] = None
    """NetCDF file to write (default: outputs/<study>.nc); beside it the figure, .png, and finished cases, .cases."""
    plot: line.Plot = True
    csv: Annotated[Path | None, shown_as("FILE")] = None
    """Write one row per operating point in plant units, too, for a spreadsheet."""
    flags: line.Flag = False
    """Describe every limit that operating points have hit, not only name it."""
    overwrite: line.Overwrite = False
    dry_run: line.Flag = False
    """List the cases with their predicted memory and time, say which are finished already, and run none."""


def sweep_command(study: Study) -> Callable[..., int]:
    """Return the main function of a ready sweep, as `studies.command.command` makes it."""

    def files(options: Options) -> list[Path]:
        out = _out(study, options)
        extra = [] if options.csv is None else [line.file_of(options.csv, ".csv", "--csv")]
        return [] if options.dry_run else [out, *[out.with_suffix(".png")] * options.plot, *extra]

    @line.command(study.name, study.about, files)
    def main(options: Options) -> Report:
        """Run the study and return its exit code; `arguments` default to the command line's."""
        return _run(study, options)

    return main


def _out(study: Study, options: Options) -> Path:
    return line.file_of(options.out or Path("outputs") / f"{study.name}.nc")


def _run(study: Study, options: Options) -> Report:
    names = options.scene or (str(options.calibration or "paper"),)
    scenes = line.scenes_of(replace(options, scene=names))
    scene = next(iter(scenes.values()))
    given, ranges = _given(options)
    study = _floating(study, [*given, *ranges], scene)
    space = _space(study, options, scenes, given, ranges)
    if AXES["feed_top_size"] in space and options.calibration is None:
        scenes = {label: one for name in scenes for label, one in _fitting_alike(name, scenes[name]).items()}
    space = ({SCENE: scenes} if len(scenes) > 1 else {}) | space
    axes = axes_of(space)
    sieve = _sieve(options, scene)
    _check(options)
    folder = _out(study, options).with_suffix(".cases")
    if options.dry_run:
        return Report(_cases(scene, Space(axes, options.replicates), options, folder))
    exchanging = scene.exchange is not None and study.exchange_caption
    caption = study.exchange_caption if exchanging else study.caption
    fields = Space(axes).fields
    main = AXES[study.main] if AXES[study.main] in fields else fields[0]
    caption = caption if main == AXES[study.main] else ""
    caption = f"{caption} {_ALIKE_CAPTION}".strip() if len(scenes) > len(names) else caption
    return _report(main, caption, _swept(scene, space, options, folder), sieve, options)


def _check(options: Options) -> None:
    for name in ("workers", "replicates", "max_cost", "timeout", "tolerance"):
        value = getattr(options, name)
        if value is not None:
            check_number(f"--{name.replace('_', '-')}", value)
    if options.tolerance is None:
        return
    given = [name for name in ("level", "cells", "points") if getattr(options, name) is not None]
    if given:
        raise ValueError(
            f"--{given[0]}: got it beside --tolerance, which chooses points and cells itself; give one of them"
        )


def _given(options: Options) -> tuple[dict[str, list], dict[str, tuple]]:
    """Return the fields that the options give values of, and those of which they give a range."""
    given = {field: list(getattr(options, dim)) for dim, field in AXES.items() if getattr(options, dim) is not None}
    ranges: dict[str, tuple] = {}
    for text in options.vary:
        field, values = line.varied(text)
        if field in given or field in ranges:
            raise ValueError(f"--vary: got {field} twice; give it once")
        (ranges if isinstance(values, tuple) else given)[field] = values
    if bool(ranges) != (options.sample is not None):
        told = f"--sample {options.sample}" if options.sample is not None else f"a range of {next(iter(ranges))}"
        raise ValueError(f"{told}: ranges, lo..hi, and --sample go together; give both, or lo..hi:N for a grid")
    return given, ranges


def _floating(study: Study, fields: list[str], scene: Scene) -> Study:
    """Return a study of the gap as one of the pressing force, if the scene or an option has one: the gap floats."""
    if AXES["press_force"] not in fields and scene.rolls.specific_pressing_force is None:
        return study
    if AXES["gap"] in fields:
        raise ValueError(
            "--gap: got it beside a pressing force, of the scene or of --press-force, under which the gap floats; give "
            "one of them"
        )
    if study.main != "gap":
        return study
    return study._replace(main="press_force", caption="The gap floats under the pressing force; the nip angle is held.")


def _fitting_alike(name: str, scene: Scene) -> dict[str, Scene]:
    return {name: scene} | {f"{name}, {label}": one for label, one in presets.fitting_alike(scene).items()}


def _space(
    study: Study, options: Options, scenes: dict[str, Scene], given: dict[str, list], ranges: dict[str, tuple]
) -> dict:
    """Return the space of the options, the study's own field first; with default values if nothing else says what."""
    main, scene = AXES[study.main], next(iter(scenes.values()))
    if scene.feed.kind == "single" and "feed.top_size" in {main, *given, *ranges}:
        raise ValueError("--feed-top-size: the scene's feed is of a single size and has no top; sweep another feed")
    if main not in given and not ranges:
        given = {main: _default_values(study, list(scenes.values()))} | given
    space = {main: given[main]} | given if main in given else given
    if options.calibration is not None:
        if ranges:
            raise ValueError("--calibration: got it beside --sample; give one of them")
        drawn = line.posterior(options.calibration)
        return space | {tuple(drawn): list(zip(*drawn.values(), strict=True))[:_DRAWS]}
    return (sobol_design(ranges, options.sample, options.seed) if ranges else {}) | space


def _default_values(study: Study, scenes: list[Scene]) -> list[float]:
    """Return the first scene's own value times the study's factors; of the gap as far as the beds can be pressed."""
    scene, (section, key) = scenes[0], AXES[study.main].split(".")
    own = getattr(getattr(scene, section), key)
    if own is None and key == "top_size":
        own = scene.feed.largest_grain
    shown = unit_shown(field_info(AXES[study.main]).unit)[1]
    factors = _carried(study.factors, scenes) if study.main == "gap" else study.factors
    found = {text: float(text) / shown for text in (f"{own * factor * shown:.3g}" for factor in factors)}
    return list((found | {f"{own * shown:.3g}": own}).values())  # those that three digits do not tell apart are one


def _carried(factors: tuple[float, ...], scenes: list[Scene]) -> tuple[float, ...]:
    """Return factors of the first gap, drawn together so that none carries more than twice the force of a scene's own.

    Where the nip takes in what it grips, the bed would else be denser than rock: of `industrial` at 0.83 of its gap.
    """
    own, narrowest = scenes[0].rolls.gap, factors[0] * scenes[0].rolls.gap
    for scene in scenes:
        with suppress(ValueError):  # no gap carries as much
            force = _MOST_FORCE * machine.specific_pressing_force(scene)
            narrowest = max(narrowest, machine.operating_gap(scene, force))
    if narrowest >= own:
        raise ValueError(
            f"--gap: got none; has no default for scenes of which one needs at least {show(narrowest, 'm', 3)} and the "
            f"first has {show(own, 'm')}; such as --gap '{show(1.2 * narrowest, 'm', 2)}'"
        )
    reach = (1 - narrowest / own) / (1 - factors[0])
    return tuple(1 + (factor - 1) * reach for factor in factors)


def _sieve(options: Options, scene: Scene) -> float:
    known = scene.resolution.sieves
    sieve = line.si_value("--sieve", options.sieve, "m")
    if not known[0] <= sieve <= known[-1]:
        raise ValueError(
            f"--sieve: got {options.sieve!r}; must lie within the scene's sieves, "
            f"{show(known[0], 'm')} to {show(known[-1], 'm')}; such as --sieve '{show(known[-1], 'm')}'"
        )
    return sieve


def _swept(scene: Scene, space: dict[Any, Any], options: Options, folder: Path) -> "xr.Dataset":
    from studies.sweep import sweep

    names = ("tolerance", "max_cost", "replicates", "seed", "recompute", "timeout", "record")
    common = {name: getattr(options, name) for name in names} | {"progress": True, "folder": folder}
    if options.scheduler is None:
        return sweep(scene, space, threads=options.workers, **common)
    from distributed import Client

    with Client(options.scheduler, timeout="10s") as client:
        return sweep(scene, space, client=client, **common)


def _report(field: str, caption: str, result: "xr.Dataset", sieve: float, options: Options) -> Report:
    from studies.show import plant

    lost = report.lost_cases(result)
    if not report.any_result(result):
        return Report(faults=[*lost, "no case holds a result; nothing was written"])
    sayings = [*report.change(result, field), caption]
    lines = [report.table(result, sieve), *report.remarks(result, options.flags), *sayings]
    drawn = line.figure(lambda: plant.picture(result, field, sieve, "\n".join(sayings)))
    if options.calibration is not None:
        from studies.show.plots.bands import bands_figure, bands_table

        lines[0] = bands_table(result, sieve)
        drawn = line.figure(lambda: bands_figure(result, sieve, "\n".join(sayings)))

    def write_csv(path: Path, _: str) -> None:
        table = report.plant_table(result, sieve)
        table.to_csv(path, index=False, encoding="utf-8-sig")  # with the mark by which spreadsheets know UTF-8

    return Report(lines, [result, *[drawn] * options.plot, write_csv], lost)


def _cases(scene: Scene, space: Space, options: Options, folder: Path) -> list[str]:
    """Return in words what a sweep would run: its operating points, with predicted memory and time."""
    scene = scene.with_values({"resolution.record": options.record})
    spec = SweepSpec(scene, options.seed, options.tolerance, options.max_cost, code=cases.code_version())
    kept = {} if options.recompute else cases.finished(spec, space, folder)
    known = assemble.coordinates(space)
    axes = [axis for dim in space.axes for axis in report.swept(known, dim)]
    rows, refused, seconds = [], [], 0.0
    for case in Space(space.axes).cases():
        at = dict(zip(space.axes, case.index, strict=False))
        place = [report.value_text(axis, axis.values[at[axis.dims[0]]]) for axis in axes]
        try:
            predicted = cost.predict(scene.with_values(case.values))
        except ValidationError as error:
            refused.append(f"refused: {', '.join(place)}: {faults_of(error)}")
            continue
        done = kept.get(case.index[:-1], 0)
        seconds += predicted.seconds * (space.replicates - done)
        figures = [f"{predicted.bytes / 1e6:.1f} MB", f"{predicted.seconds * 1e3:.1f} ms"]
        figures += [f"{done} of {space.replicates}"] if kept else []
        rows.append([*place, *figures])
    table = report.aligned([*map(report.axis_label, axes), "memory", "time", *(["finished"] if kept else [])], rows)
    lines = [f"{scene}\n", table, *refused, ""]
    if options.tolerance is not None:
        lines.append(
            f"before refinement: --tolerance {options.tolerance:g} chooses points and cells when a case is run"
        )
    done = f"{sum(kept.values())} of them finished already in {folder}; the others " if kept else ""
    lines.append(
        f"{space.total} cases ({space.replicates} replicates each), {done}about {seconds / options.workers:.2g} s on "
        f"{options.workers} threads, plus start-up"
    )
    return lines
