"""Numerical extremes: every scene ends well, flagged, in substeps or refused, and never silently wrong.

Walks the catalogue of docs/model.md, every scene field to its ends and just beyond, pairs of fields at their corners
and random scenes, checks each result against `studies.guard.invariants`, and maps where the model is stable.
"""

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
from pydantic import ValidationError

from studies import Late
from studies import command as cli
from studies.guard import maps, ranges
from studies.guard.judge import KINDS, Outcome, as_wanted, base, catalogue, hosts, judge

if TYPE_CHECKING:
    import xarray as xr

cost, flags, schema = Late("hpgr.cost"), Late("hpgr.results.flags"), Late("hpgr.results.schema")

PARTS = ("catalogue", "ends", "outside", "pairs", "random")
_PAIR_SECONDS = 0.05  # predicted cost from which the upper end of a field takes no part in pairs
_RANDOM_SECONDS = 0.15  # and most that a random scene may cost


class Walked(NamedTuple):
    """One scene of the walk: where it belongs, what was set in it, and how it ended."""

    part: str
    name: str
    values: dict[str, Any]
    outcome: Outcome


@dataclass(frozen=True)
class Options:
    """Options of the study."""

    scenes: Annotated[int, cli.shown_as("N")] = 2000
    """Random scenes; every fourth has exchange."""
    seed: cli.Seed = 0
    quick: cli.Quick = False
    out: cli.Out = Path("outputs/extremes.nc")
    plot: cli.Plot = True
    overwrite: cli.Overwrite = False


def _files(options: Options) -> list[Path]:
    out, *picture = cli.beside(options)
    return [out, *picture, *(one.with_stem(f"{one.stem}_euler") for one in picture)]


@cli.command("extremes", __doc__, files=_files)
def main(options: Options) -> cli.Report:
    """Run the study of the command line; with --quick 100 random scenes at most, every tenth pair and coarse maps."""
    if not 0 <= options.scenes <= 1_000_000:
        raise ValueError(f"--scenes: got {options.scenes}; must be within 0 to 1,000,000; such as --scenes 2000")
    scenes = min(options.scenes, 100) if options.quick else options.scenes
    walked = list(walk(scenes, options.seed, 10 if options.quick else 1, progress=True))
    result = dataset(walked, maps.maps(judge, 3 if options.quick else 1, progress=True), options.seed)
    told, silent = faulty(walked), maps.faults(result)
    told += [f"FAULT in {silent} scenes of the maps"] if silent else []
    from studies.show.plots import extremes as plots

    pictures = [cli.figure(lambda draw=draw: draw(result), dpi=75) for draw in (plots.stability, plots.integrators)]
    lines = [*table(result).splitlines(), f"silent faults: {silent + len(faulty(walked))}"]
    return cli.Report(lines, [result, *pictures], told)


def walk(scenes: int, seed: int = 0, every: int = 1, progress: bool = False) -> Iterator[Walked]:
    """Judge the whole catalogue, all ends, what lies outside, every `every`-th pair, and `scenes` random scenes."""
    known, rows = ranges.numeric_fields(), catalogue()
    ends = [(name, end) for name in known for end in known[name].ends()]
    ends += [(name, word) for name, words in ranges.choices().items() for word in words]
    listed = [("ends", f"{name} = {_text(end)}", values) for name, end in ends for values in hosts({name: end})]
    beyond = [(name, value) for name in known for value in known[name].outside()]
    listed += [("outside", f"{name} = {_text(end, 17)}", one) for name, end in beyond for one in hosts({name: end})[:1]]
    listed += [("pairs", name, values) for name, values in list(_pairs(known))[::every]]
    with cli.progress_bar(len(rows) + len(listed) + scenes, progress, "scenes") as bar:
        for row in rows:
            yield Walked("catalogue", row.name, row.values, as_wanted(row, judge(row.values, seed)))
            bar.update()
        for part, name, values in listed:
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
    return ranges.draw(base(), np.random.default_rng([seed, number]), number % 4 == 3, _RANDOM_SECONDS)


def _text(value: Any, digits: int = 6) -> str:
    return f"{value:.{digits}g}" if isinstance(value, float) else str(value)


def _pairs(known: Mapping[str, ranges.Range]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield every pair of fields at every combination of their ends; ends that cost too much are left out."""
    cheap = {name: [end for end in each.ends() if _cheap({name: end})] for name, each in known.items()}
    for first, second in combinations(known, 2):
        for one, other in product(cheap[first], cheap[second]):
            for hosted in hosts({first: one, second: other})[:1]:
                yield f"{first} = {_text(one)}, {second} = {_text(other)}", hosted


def _cheap(values: dict[str, Any]) -> bool:
    try:
        return cost.predict(base(hosts(values)[0])).seconds < _PAIR_SECONDS
    except ValidationError:
        return True  # refused alone, and at no cost


def dataset(walked: Sequence[Walked], mapped: "xr.Dataset", seed: int = 0) -> "xr.Dataset":
    """Return every scene of the walk along `scene`, beside the maps."""
    values, own = maps.outcome_variables("", ("scene",), [each.outcome for each in walked], (len(walked),))
    texts = {
        "part": ("part of the walk", [each.part for each in walked]),
        "name": ("what was set", [each.name for each in walked]),
        "values": ("values of the scene", [json.dumps(each.values) for each in walked]),
        "message": ("flags, refusal or fault", [each.outcome.message for each in walked]),
    }
    own |= {name: schema.Variable(("scene",), "", words, dtype=None) for name, (words, _) in texts.items()}
    values |= {name: each for name, (_, each) in texts.items()}
    attrs = schema.dataset_attributes("Numerical extremes: outcomes and stability maps", seed=seed)
    return schema.to_dataset(values, attrs, own).merge(mapped)


def faulty(walked: Sequence[Walked]) -> list[str]:
    """Return every silent fault in words, with its scene as JSON values for `studies.guard.judge.base`."""
    bad = [each for each in walked if each.outcome.kind == "fault"]
    return [f"FAULT in {one.part}, {one.name}: {one.outcome.message}\n  {json.dumps(one.values)}" for one in bad]


def table(result: "xr.Dataset") -> str:
    """Return the counts of outcomes per part, and what refused and flagged the scenes, as text."""
    from studies.show.report import aligned

    kinds, parts, bits = (result[name].values for name in ("outcome", "part", "flags"))
    found = ([kinds[parts == part].size, *(((parts == part) & (kinds == k)).sum() for k in range(5))] for part in PARTS)
    rows = [[part, *map(str, row)] for part, row in zip(PARTS, found, strict=True)]
    messages = result["message"].values[kinds == KINDS.index("refused")]
    refused = Counter(str(message).partition(": ")[0] for message in messages)
    flagged = Counter({name: int((bits & bit > 0).sum()) for name, bit in flags.BITS.items()})
    told = {"refused for": refused, "flagged with": flagged}
    listed = {words: ", ".join(f"{name} {n}" for name, n in each.most_common() if n) for words, each in told.items()}
    lines = [f"{words}: {each or 'none'}" for words, each in listed.items()]
    most = f"exchange substeps per time step: up to {result['substeps'].values.max(initial=0)}"
    return "\n".join([aligned(["part", "scenes", *KINDS], rows, words=1), "", *lines, most])


if __name__ == "__main__":
    raise SystemExit(main())
