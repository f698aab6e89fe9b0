"""Numerical extremes: every scene ends well, flagged, in substeps or refused, and never silently wrong.

Walks the catalogue of docs/model.md, every scene field to its ends and just beyond, pairs of fields at their corners
and random scenes, checks each result against `studies.invariants`, and maps where the model is stable.
"""

import json
import math
import re
import shlex
import sys
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import tyro
from pydantic import ValidationError

from hpgr import budget, presets
from hpgr.keys import refuse_key
from hpgr.scene import Scene
from studies import ranges
from studies.command import refusing, shown_as
from studies.progress import progress_bar

if TYPE_CHECKING:
    import xarray as xr

KINDS = ("ok", "flagged", "substepped", "refused", "fault")
PARTS = ("catalogue", "ends", "outside", "pairs", "random")
ROOM = 256_000_000  # bytes that a scene of this study may take: what is refused must not depend on the machine
_PAIR_SECONDS = 0.05  # predicted cost from which the upper end of a field takes no part in pairs
_RANDOM_SECONDS = 0.15  # and most that a random scene may cost
_STILL = {  # no stress reaches any strength, and every time step is photographed: what swaps conserve shows
    "material.strength": 1e15,
    "material.weibull_modulus": math.inf,
    "material.bulk_modulus": 1.0,
    "material.shear_modulus": 1.0,
    "material.elastic_exponent": 1.0,
    "exchange.interval": 1,
    "resolution.photographs": 3,
    "resolution.record": "cells",
}
FEEDS: dict[str, dict[str, Any]] = {
    "uniform": {"bottom_size": 0.008, "top_size": 0.06},
    "single": {"size": 0.06},
    "power_law": {"top_size": 0.06, "exponent": 0.7},
    "rosin_rammler": {"size": 0.03, "exponent": 1.3, "top_size": 0.06},
    "table": {"table": ((0.004, 0.0), (0.016, 40.0), (0.06, 100.0))},
}


class Outcome(NamedTuple):
    """How a scene ended: one of `KINDS`, its flags and exchange passes, and what there is to say."""

    kind: str
    flags: int = 0
    passes: int = 0
    message: str = ""


class Walked(NamedTuple):
    """One scene of the walk: where it belongs, what was set in it, and how it ended."""

    part: str
    name: str
    values: dict[str, Any]
    outcome: Outcome


class Row(NamedTuple):
    """One extreme of docs/model.md: its words, the values, the kind of outcome wanted, and words it must hold."""

    name: str
    values: dict[str, Any]
    wanted: str
    says: tuple[str, ...] = ()


@dataclass(frozen=True)
class Options:
    """Options of the study."""

    scenes: Annotated[int, shown_as("N")] = 2000
    """Random scenes; every fourth has exchange."""
    seed: Annotated[int, shown_as("N")] = 0
    """Seed of the random scenes and of every run."""
    quick: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """100 random scenes at most, every tenth pair and coarse maps: seconds instead of minutes."""
    out: Annotated[Path, shown_as("FILE")] = Path("outputs/extremes.nc")
    """NetCDF file to write; the figures go beside it as .png."""
    plot: bool = True
    """Draw the figures, or not."""


@refusing
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study; return 0, 1 if a scene ended in a silent fault, or 2 if nothing was run or written."""
    options = tyro.cli(Options, prog="python -m studies.extremes", description=__doc__, args=arguments)
    if not 0 <= options.scenes <= 1_000_000:
        raise ValueError(f"--scenes: got {options.scenes}; must be within 0 to 1,000,000; such as --scenes 2000")
    refuse_key("--seed", options.seed)
    from studies import stability, store

    store.probe(options.out)
    scenes = min(options.scenes, 100) if options.quick else options.scenes
    walked = list(walk(scenes, options.seed, 10 if options.quick else 1, progress=True))
    result = stability.maps(judge, 3 if options.quick else 1, progress=True)
    add_walked(result, walked)
    given = sys.argv[1:] if arguments is None else arguments
    result.attrs |= {"seed": options.seed, "history": f"python -m studies.extremes {shlex.join(given)}".strip()}
    written = _write(result, options)
    print(table(result))
    faults = faulty(walked)
    for line in faults:
        print(line, file=sys.stderr)
    silent = len(faults) + stability.faults(result)
    print(f"silent faults: {silent}")
    print("wrote " + " and ".join(map(str, written)))
    return 1 if silent else 0


def base(values: Mapping[str, Any] | None = None) -> Scene:
    """Return the scene that is walked from: the paper's rolls with a shallow bed, in which no limit is hit."""
    values = dict(values or {})
    small = {"resolution.streamlines": 2, "resolution.points": 41, "resolution.cells": 32}
    if values.get("resolution.level", "custom") != "custom":
        small = {}
    return presets.paper().with_values({"rolls.entry_gap": 0.5} | small | values)


def judge(values: Mapping[str, Any], seed: int = 0) -> Outcome:
    """Return how the base scene with other values ends; whatever must not happen is a "fault".

    A fault is an exception or warning that is no refusal, a refusal that does not say field, value, bound and
    remedy, or a result that violates an invariant.
    """
    try:
        scene = base(values)
    except ValidationError as error:
        return _refusal([(".".join(map(str, fault["loc"])), fault["msg"]) for fault in error.errors()])
    except Exception as error:
        return Outcome("fault", message=_crash(error))
    outcome = _run(scene, seed)
    if outcome.passes and outcome.kind != "fault":
        still = _run(scene.with_values(_STILL), seed)  # the same machine, with nothing to break
        if still.kind == "fault":
            return still._replace(message=f"with nothing to break: {still.message}")
    return outcome


def _run(scene: Scene, seed: int) -> Outcome:
    import hpgr
    from hpgr.schema import FLAGS
    from studies import invariants

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            # without the compiler NumPy speaks up when a 64-bit stream wraps, which is what it is there for
            warnings.filterwarnings("ignore", "overflow encountered in scalar", RuntimeWarning, r"hpgr\.kernels")
            budget.refuse_too_large(scene, (ROOM, "this study's own limit"))
            result = hpgr.simulate(scene, seed)
    except ValidationError as error:
        return Outcome("fault", message=_crash(error))
    except (ValueError, MemoryError) as error:
        field, _, message = str(error).partition(": ")
        return _refusal([(field, message)])
    except Exception as error:
        return Outcome("fault", message=_crash(error))
    flags, passes = int(result["flags"]), int(result.get("exchange_passes", 0))
    violated = invariants.violations(result)
    if violated:
        return Outcome("fault", flags, passes, "; ".join(violated))
    limits = flags & ~FLAGS["unusual_machine"]  # how a machine is usually run is no limit of the model
    kind = "substepped" if passes > 1 else "flagged" if limits else "ok"
    return Outcome(kind, flags, passes, ", ".join(invariants.flags_of(result)))


def _crash(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"


_FORM = re.compile(r"got .+?[;:,] .*(must|needs it|has |does nothing|is required|too close|reaches 0 %).*; .+")


def _refusal(told: list[tuple[str, str]]) -> Outcome:
    """Return the refusal if every message has its form: field, got value; bound; remedy."""
    sections = Scene.model_fields
    for field, message in told:
        if field.partition(".")[0] not in sections or not _FORM.fullmatch(message):
            return Outcome("fault", message=f"a refusal without field, value, bound or remedy: {field}: {message}")
    return Outcome("refused", message="; ".join(f"{field}: {message}" for field, message in told))


def catalogue() -> list[Row]:
    """Return the extremes of docs/model.md, each with the outcome it must have."""
    inf, nan = math.inf, math.nan
    absurd = {"resolution.points": 3, "resolution.streamlines": 40, "exchange": {"mixing": 100}}
    refused = [
        ("gap of 0", {"rolls.gap": 0}, "rolls.gap: got 0 mm"),
        ("negative gap", {"rolls.gap": "-5 mm"}, "rolls.gap: got -5 mm"),
        ("gap above the entry gap", {"rolls.gap": 0.501}, "must be at most the entry gap 500 mm"),
        ("rise of the entry above the diameter", {"rolls.entry_gap": 6.07}, "entry angle of 60 degrees"),
        ("NaN", {"rolls.gap": nan}, "must not be NaN"),
        ("infinite gap", {"rolls.gap": inf}, "must be finite"),
        ("speed of 0", {"rolls.speed": 0}, "rolls.speed: got 0 rpm"),
        ("density of 0", {"material.solid_density": 0}, "solid_density: got 0 kg m-3"),
        ("w of 0", {"material.weibull_modulus": 0}, "weibull_modulus: got 0"),
        ("n below 1e-6", {"material.cushioning": 9e-7}, "cushioning: got 9e-07"),
        ("c of -1", {"material.elastic_exponent": -1}, "elastic_exponent: got -1"),
        ("feed above the entry gap", {"feed.top_size": 0.51}, "entry gap rolls.entry_gap 500 mm"),
        ("swaps beyond all substeps", absurd, "predicted cost"),
        ("coinciding points", {"flow.entry_fraction": 1e-9, "resolution.points": 2001}, "of the bed's height apart"),
        ("more cells than memory", {"resolution.cells": 10_000_000}, "bytes"),
    ]  # fmt: skip
    every = {"rolls.gap": nan, "rolls.speed": 0, "material.weibull_modulus": -1, "feed.top_size": 0.6}
    feed = ("no_breakage",)
    return [
        *(Row(name, values, "refused", (says,)) for name, values, says in refused),
        Row("all faults at once", every, "refused", tuple(every)),
        Row("gap = entry gap", {"rolls.gap": 0.5}, "flagged", ("no_compaction", *feed)),
        Row("gap = entry gap, with exchange", {"rolls.gap": 0.5, "exchange": {}}, "flagged", ("no_compaction", *feed)),
        Row("top size of 1.4 gaps", {"feed.top_size": 0.084}, "ok"),
        Row("top size of 1.6 gaps", {"feed.top_size": 0.096}, "flagged", ("single_particle_nipping",)),
        Row("strength above every stress", {"material.strength": 1e15}, "flagged", feed),
        Row("exit solid fraction above its limit", {"rolls.entry_gap": 1.14}, "flagged", ("solid_fraction_capped",)),
        Row("swap sum above 1/2", {"exchange": {}}, "substepped"),
        Row("swap sum below 1/2", {"exchange": {"segregation": 1e-3, "mixing": 1e-3}}, "ok"),
        Row("M = 0", {"resolution.cells": 0}, "ok"),
        Row("M = 1", {"resolution.cells": 1}, "ok"),
        Row("M = 2", {"resolution.cells": 2}, "flagged", ("few_cells",)),
        Row("M = 3", {"resolution.cells": 3}, "flagged", ("few_cells",)),
        Row("w = inf", {"material.weibull_modulus": inf}, "ok"),
        Row("n = inf", {"material.cushioning": inf}, "ok"),
        Row("w = inf and n = inf", {"material.weibull_modulus": inf, "material.cushioning": inf}, "ok"),
        Row("n = inf, closed form", {"material.cushioning": inf, "resolution.record": "product"}, "flagged",
            ("size_floor_reached",)),
        Row("gamma of 1e6", {"material.fragment_exponent": 1e6}, "ok"),
        Row("gamma of 0.001", {"material.fragment_exponent": 1e-3}, "flagged", ("size_floor_reached",)),
        Row("hundreds of breaks", {"material.weibull_modulus": inf, "material.strength": 1.0,
                                   "resolution.points": 801}, "flagged", ("size_floor_reached",)),
        Row("c = 0", {"material.elastic_exponent": 0}, "ok"),
        Row("c below 0", {"material.elastic_exponent": -0.5}, "flagged", ("tension_clamped",)),
        Row("c below 0, Euler", {"material.elastic_exponent": -0.5, "stress.integrator": "euler"}, "flagged",
            ("tension_clamped",)),
    ]  # fmt: skip


def walk(scenes: int, seed: int = 0, every: int = 1, progress: bool = False) -> Iterator[Walked]:
    """Judge the whole catalogue, all ends, what lies outside, every `every`-th pair, and `scenes` random scenes."""
    known = ranges.numeric_fields()
    ends = [(f"{name} = {end:.6g}", hosted) for name in known for end in known[name].ends()
            for hosted in hosts({name: end})]  # fmt: skip
    ends += [(f"{name} = {word}", hosted) for name, words in ranges.choices().items() for word in words
             for hosted in hosts({name: word})]  # fmt: skip
    beyond = [(f"{name} = {value:.17g}", hosts({name: value})[0]) for name in known for value in known[name].outside()]
    corners = list(_pairs(known))[::every]
    rows = catalogue()
    with progress_bar(len(rows) + len(ends) + len(beyond) + len(corners) + scenes, progress, "scenes") as bar:
        for row in rows:
            yield Walked("catalogue", row.name, row.values, _as_wanted(row, judge(row.values, seed)))
            bar.update()
        for part, listed in (("ends", ends), ("outside", beyond), ("pairs", corners)):
            for name, values in listed:
                outcome = judge(values, seed)
                if part == "outside" and outcome.kind not in ("refused", "fault"):
                    outcome = Outcome("fault", message=f"not refused, but {outcome.kind}")
                yield Walked(part, name, values, outcome)
                bar.update()
        for number in range(scenes):
            values = random_values(number, seed)
            yield Walked("random", f"scene {number}", values, judge(values, seed))
            bar.update()


def random_values(number: int, seed: int = 0) -> dict[str, Any]:
    """Return the values of a random scene; every fourth has exchange."""
    import numpy as np

    return ranges.draw(base(), np.random.default_rng([seed, number]), number % 4 == 3, _RANDOM_SECONDS)


def hosts(values: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the values set in every kind of feed that has their fields, and in a scene with exchange if need be."""
    keys = {name.partition(".")[2] for name in values if name.startswith("feed.")}
    if "kind" in keys:
        kinds = [values["feed.kind"]]
    else:
        kinds = [kind for kind, fields in FEEDS.items() if keys <= set(fields)] if keys else ["uniform"]
    rest = {"exchange": {}} if any(name.startswith("exchange.") for name in values) else {}
    if "resolution.level" in values or any(name.startswith("roll_width.") for name in values):
        rest["resolution.record"] = "product"
    if {"flow.nip_angle", "flow.cake_solid_fraction"} & values.keys():
        rest["flow.profile"] = "nip"
    elif values.get("flow.profile") == "nip":
        rest["flow.nip_angle"] = 0.15
    names = ranges.parts()["feed"].model_fields
    return [
        rest | {f"feed.{name}": FEEDS[kind].get(name) for name in names} | {"feed.kind": kind} | dict(values)
        for kind in kinds
    ]


def _pairs(known: Mapping[str, ranges.Range]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield every pair of fields at every combination of their ends; ends that cost too much are left out."""
    cheap = {name: [end for end in each.ends() if _cheap({name: end})] for name, each in known.items()}
    for first, second in combinations(known, 2):
        for one, other in product(cheap[first], cheap[second]):
            values = {first: one, second: other}
            for hosted in hosts(values)[:1]:
                yield f"{first} = {one:.6g}, {second} = {other:.6g}", hosted


def _cheap(values: dict[str, Any]) -> bool:
    try:
        return budget.predict(base(hosts(values)[0])).seconds < _PAIR_SECONDS
    except ValidationError:
        return True  # refused alone, and at no cost


def _as_wanted(row: Row, found: Outcome) -> Outcome:
    """Return the outcome of a row of the catalogue, a fault if it is not the wanted one."""
    if found.kind == row.wanted and all(words in found.message for words in row.says):
        return found
    says = f" saying {', '.join(row.says)}" if row.says else ""
    return found._replace(kind="fault", message=f"wanted {row.wanted}{says}, found {found.kind}: {found.message}")


def add_walked(result: "xr.Dataset", walked: Sequence[Walked]) -> None:
    """Add every scene of the walk to a Dataset, along `scene`, and the drawn values of the random ones."""
    import numpy as np

    from hpgr.scene import field_info

    def texts(values, words):
        return ("scene", np.array(list(values), dtype=object).astype(str), {"long_name": words})

    result["part"] = texts((each.part for each in walked), "part of the walk")
    result["name"] = texts((each.name for each in walked), "what was set")
    result["message"] = texts((each.outcome.message for each in walked), "flags, refusal or fault")
    result["outcome"] = ("scene", np.array([KINDS.index(each.outcome.kind) for each in walked], np.int8), meanings())
    passes = np.array([each.outcome.passes for each in walked], np.int32)
    result["passes"] = ("scene", passes, {"long_name": "exchange passes per time step", "units": "1"})
    result["flags"] = ("scene", np.array([each.outcome.flags for each in walked], np.int32), _flag_attributes())
    fields = list(ranges.numeric_fields())
    drawn = [[_number(each.values.get(name)) for name in fields] for each in walked]
    result["value"] = (("scene", "field"), np.array(drawn, float).reshape(-1, len(fields)),
                       {"long_name": "value set, NaN where the base scene's was kept"})  # fmt: skip
    result.coords["field"] = ("field", fields, {"long_name": "scene field"})
    result["field_units"] = ("field", [field_info(name).unit for name in fields], {"long_name": "unit of its values"})


def _number(value: Any) -> float:
    """Return a value that a float32 of the file can hold; NaN for what is none."""
    if not isinstance(value, int | float):
        return math.nan
    return value if math.isinf(value) else min(max(value, -3e38), 3e38)


def meanings() -> dict[str, Any]:
    """Return the attributes of a variable of outcomes."""
    import numpy as np

    return {"long_name": "how the scene ended", "units": "1", "flag_values": np.arange(len(KINDS), dtype=np.int8),
            "flag_meanings": " ".join(KINDS)}  # fmt: skip


def _flag_attributes() -> dict[str, Any]:
    from hpgr import schema

    return schema.attributes("flags")


def faulty(walked: Sequence[Walked]) -> list[str]:
    """Return every silent fault in words, with its scene as JSON values for `studies.extremes.base`."""
    return [
        f"FAULT in {each.part}, {each.name}: {each.outcome.message}\n  {json.dumps(each.values)}"
        for each in walked
        if each.outcome.kind == "fault"
    ]


def table(result: "xr.Dataset") -> str:
    """Return the counts of outcomes per part, and what refused and flagged the scenes, as text."""
    kinds, parts = result["outcome"].values, result["part"].values
    lines = [f"{'part':<12}{'scenes':>8}" + "".join(f"{kind:>12}" for kind in KINDS)]
    for part in PARTS:
        of_part = kinds[parts == part]
        lines.append(f"{part:<12}{of_part.size:>8}" + "".join(f"{(of_part == k).sum():>12}" for k in range(len(KINDS))))
    lines += ["", "refused for: " + _listed(Counter(_refused_fields(result)))]
    masks, names = result["flags"].attrs["flag_masks"], result["flags"].attrs["flag_meanings"].split()
    flagged = {name: int((result["flags"].values & mask > 0).sum()) for mask, name in zip(masks, names, strict=True)}
    lines += ["flagged with: " + _listed(Counter(flagged))]
    substepped = result["passes"].values[kinds == KINDS.index("substepped")]
    lines += [f"substepped: {substepped.size} scenes, up to {substepped.max(initial=0)} passes per time step"]
    return "\n".join(lines)


def _refused_fields(result: "xr.Dataset") -> Iterator[str]:
    refused = result["outcome"].values == KINDS.index("refused")
    for message in result["message"].values[refused]:
        yield str(message).partition(": ")[0]


def _listed(counts: Counter) -> str:
    return ", ".join(f"{name} {count}" for name, count in counts.most_common() if count) or "none"


def _write(result: "xr.Dataset", options: Options) -> list[Path]:
    """Write the NetCDF file and the figures; return their paths."""
    from studies import store

    out = options.out if options.out.suffix == ".nc" else options.out.with_name(options.out.name + ".nc")
    written = [out]
    try:
        store.write_dataset(result, out)
        for ending, figure in _figures(result).items() if options.plot else ():
            path = out.with_name(f"{out.stem}{ending}.png")
            store.replace(path, lambda part, figure=figure: figure.savefig(part, dpi=75))
            written.append(path)
    except OSError as error:
        raise OSError(f"could not write the result: {error}") from error
    return written


def _figures(result: "xr.Dataset") -> dict[str, Any]:
    from studies.plots import extremes as plots

    return {"": plots.stability_figure(result), "_euler": plots.integrator_figure(result)}


if __name__ == "__main__":
    raise SystemExit(main())
