"""How a scene ends: well, flagged, in substeps or refused; anything else is a silent fault."""

import math
import re
import warnings
from collections.abc import Mapping
from typing import Any, NamedTuple

from pydantic import ValidationError

import hpgr
from hpgr import presets
from hpgr.fields import kinds_of
from hpgr.scene import Scene
from studies import Late
from studies.guard import ranges

cost, flags, invariants = Late("hpgr.cost"), Late("hpgr.results.flags"), Late("studies.guard.invariants")

KINDS = ("ok", "flagged", "substepped", "refused", "fault")
NO_LIMITS = {"unusual_machine", "feed_below_critical"}  # what machine and ore are usually like is no limit of the model
ROOM = 256_000_000  # bytes that a scene of this study may take: what is refused must not depend on the machine
_STILL = {  # no stress reaches any strength, and every time step is a snapshot: what swaps conserve shows
    "strength.reference_strength": 1e15,
    "strength.weibull_modulus": math.inf,
    "elasticity.bulk_modulus": 1.0,
    "elasticity.shear_modulus": 1.0,
    "elasticity.exponent": 1.0,
    "exchange.interval": 1,
    "resolution.snapshots": 3,
    "resolution.record": "cells",
}
SAMPLES: dict[str, dict[str, dict[str, Any]]] = {  # of laws that have fields without a default
    "feed": {
        "uniform": {"bottom_size": 0.008, "top_size": 0.06},
        "single": {"size": 0.06},
        "power_law": {"top_size": 0.06, "exponent": 0.7},
        "rosin_rammler": {"size": 0.03, "exponent": 1.3, "top_size": 0.06},
        "table": {"table": ((0.004, 0.0), (0.016, 40.0), (0.06, 100.0)), "top_size": None},
    },
    "flow": {"nip": {"nip_angle": 0.15}},
}


class Outcome(NamedTuple):
    """How a scene ended: one of `KINDS`, its flags and exchange substeps, and what there is to say."""

    kind: str
    flags: int = 0
    substeps: int = 0
    message: str = ""


class Row:
    """One extreme of docs/model.md: its words, the values, the kind of outcome wanted, and words it must hold."""

    def __init__(self, name: str, values: dict[str, Any], wanted: str, *says: str):
        self.name, self.values, self.wanted, self.says = name, values, wanted, says


def base(values: Mapping[str, Any] | None = None) -> Scene:
    """Return the scene that is walked from: the paper's rolls with a shallow bed, in which no limit is hit."""
    small = {"resolution.streamlines": 2, "resolution.points": 41, "resolution.cells": 32}
    return presets.paper().with_values({"rolls.entry_gap": 0.5} | small | dict(values or {}))


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
    if outcome.substeps and outcome.kind != "fault":
        still = _run(scene.with_values(_STILL), seed)  # the same machine, with nothing to break
        if still.kind == "fault":
            return still._replace(message=f"with nothing to break: {still.message}")
    return outcome


def _run(scene: Scene, seed: int) -> Outcome:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            # without the compiler NumPy speaks up when a 64-bit stream wraps, which is what it is there for
            warnings.filterwarnings("ignore", "overflow encountered in scalar", RuntimeWarning, r"hpgr\.grains")
            cost.refuse_too_large(scene, lambda: (ROOM, "this study's own limit"))
            result = hpgr.simulate(scene, seed)
    except ValidationError as error:
        return Outcome("fault", message=_crash(error))
    except (ValueError, MemoryError) as error:
        field, _, message = str(error).partition(": ")
        return _refusal([(field, message)])
    except Exception as error:
        return Outcome("fault", message=_crash(error))
    bits, substeps = int(result["flags"]), int(result.get("exchange_substeps", 0))
    violated = invariants.violations(result)
    if violated:
        return Outcome("fault", bits, substeps, "; ".join(violated))
    limits = set(flags.names(bits)) - NO_LIMITS
    kind = "substepped" if substeps > 1 else "flagged" if limits else "ok"
    return Outcome(kind, bits, substeps, ", ".join(flags.names(bits)))


def _crash(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"


_FORM = re.compile(r"got .+?[;:,] .*(must|needs it|does nothing|is required|too close|reaches 0 %).*; .+")


def _refusal(told: list[tuple[str, str]]) -> Outcome:
    """Return the refusal if every message has its form: field, got value; bound; remedy."""
    for field, message in told:
        if field.partition(".")[0] not in Scene.model_fields or not _FORM.fullmatch(message):
            return Outcome("fault", message=f"a refusal without field, value, bound or remedy: {field}: {message}")
    return Outcome("refused", message="; ".join(f"{field}: {message}" for field, message in told))


def hosts(values: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the values set in every law that has their fields; none if no law has them all."""
    found = [dict(values)]
    for section in {name.partition(".")[0] for name in values if "." in name}:
        keys = {name.partition(".")[2] for name in values if name.startswith(f"{section}.")}
        fitting = [law for law in ranges.laws()[section] if keys <= law.model_fields.keys()]
        kinds = [kind for law in fitting for kind in kinds_of(law) if values.get(f"{section}.kind") in (None, kind)]
        if len(ranges.laws()[section]) > 1:
            found = [{f"{section}.kind": kind} | _sample(section, kind, keys) | one for kind in kinds for one in found]
    width = any(name.startswith("roll_width.") for name in values)
    return [{"resolution.record": "product"} | one for one in found] if width else found


def _sample(section: str, kind: str, keys: set[str]) -> dict[str, Any]:
    """Return values of the fields that a kind of law cannot do without."""
    sample = {} if "cake_solid_fraction" in keys else SAMPLES.get(section, {}).get(kind, {})  # in place of a nip angle
    return {f"{section}.{name}": value for name, value in sample.items()}


def as_wanted(row: Row, found: Outcome) -> Outcome:
    """Return the outcome of a row of the catalogue, a fault if it is not the wanted one."""
    if found.kind == row.wanted and all(words in found.message for words in row.says):
        return found
    says = f" saying {', '.join(row.says)}" if row.says else ""
    return found._replace(kind="fault", message=f"wanted {row.wanted}{says}, found {found.kind}: {found.message}")


def catalogue() -> list[Row]:
    """Return the extremes of docs/model.md, each with the outcome it must have."""
    inf, nan = math.inf, math.nan
    absurd = {"resolution.points": 3, "resolution.streamlines": 40, "exchange": {"mixing": 100}}
    every = {"rolls.gap": nan, "rolls.speed": 0, "strength.weibull_modulus": -1, "feed.top_size": 0.6}
    closed, euler = {"resolution.record": "product"}, {"elasticity.integrator": "euler"}
    hundreds = {"strength.weibull_modulus": inf, "strength.reference_strength": 1.0, "resolution.points": 801}
    return [
        Row("gap of 0", {"rolls.gap": 0}, "refused", "rolls.gap: got 0 mm"),
        Row("negative gap", {"rolls.gap": "-5 mm"}, "refused", "rolls.gap: got -5 mm"),
        Row("gap above the entry gap", {"rolls.gap": 0.501}, "refused", "must be at most the entry gap 500 mm"),
        Row("rise of the entry above the diameter", {"rolls.entry_gap": 6.07}, "refused", "entry angle of 60 degrees"),
        Row("NaN", {"rolls.gap": nan}, "refused", "must not be NaN"),
        Row("infinite gap", {"rolls.gap": inf}, "refused", "must be finite"),
        Row("speed of 0", {"rolls.speed": 0}, "refused", "rolls.speed: got 0 rpm"),
        Row("density of 0", {"bed.solid_density": 0}, "refused", "solid_density: got 0 kg m-3"),
        Row("w of 0", {"strength.weibull_modulus": 0}, "refused", "weibull_modulus: got 0"),
        Row("n below 1e-6", {"strength.cushioning": 9e-7}, "refused", "cushioning: got 9e-07"),
        Row("c of -1", {"elasticity.exponent": -1}, "refused", "elasticity.exponent: got -1"),
        Row("feed above the entry gap", {"feed.top_size": 0.51}, "refused", "entry gap rolls.entry_gap 500 mm"),
        Row("swaps beyond all substeps", absurd, "refused", "predicted cost"),
        Row("coinciding points", {"flow.entry_fraction": 1e-9, "resolution.points": 2001}, "refused", "height apart"),
        Row("more cells than memory", {"resolution.cells": 10_000_000}, "refused", "bytes"),
        Row("all faults at once", every, "refused", *every),
        Row("gap = entry gap", {"rolls.gap": 0.5}, "flagged", "no_compaction", "no_breakage"),
        Row("the same, with exchange", {"rolls.gap": 0.5, "exchange": {}}, "flagged", "no_compaction", "no_breakage"),
        Row("largest grain of 1.6 gaps", {"feed.top_size": 0.096}, "flagged", "single_particle_nipping"),
        Row("strength above every stress", {"strength.reference_strength": 1e15}, "flagged", "no_breakage"),
        Row("exit solid fraction above its limit", {"rolls.entry_gap": 1.14}, "flagged", "solid_fraction_capped"),
        Row("M = 2", {"resolution.cells": 2}, "flagged", "few_cells"),
        Row("M = 3", {"resolution.cells": 3}, "flagged", "few_cells"),
        Row("n = inf, closed form", {"strength.cushioning": inf} | closed, "flagged", "size_floor_reached"),
        Row("gamma of 0.001", {"fragments.exponent": 1e-3}, "flagged", "size_floor_reached"),
        Row("hundreds of breaks", hundreds, "flagged", "size_floor_reached"),
        Row("c below 0", {"elasticity.exponent": -0.5}, "flagged", "tension_clamped", "no_limit_of_steps"),
        Row("c below 0, Euler", {"elasticity.exponent": -0.5} | euler, "flagged", "tension_clamped"),
        Row("largest grain of 1.4 gaps", {"feed.top_size": 0.084}, "ok"),
        Row("swap sum below 1/2", {"exchange": {"segregation": 1e-3, "mixing": 1e-3}}, "ok"),
        Row("swap sum above 1/2", {"exchange": {}}, "substepped"),
        Row("M = 0", {"resolution.cells": 0}, "ok"),
        Row("M = 1", {"resolution.cells": 1}, "ok"),
        Row("w = inf", {"strength.weibull_modulus": inf}, "ok"),
        Row("n = inf", {"strength.cushioning": inf}, "ok"),
        Row("w = n = inf", {"strength.weibull_modulus": inf, "strength.cushioning": inf}, "ok"),
        Row("gamma of 1e6", {"fragments.exponent": 1e6}, "ok"),
        Row("c = 0", {"elasticity.exponent": 0}, "ok"),
    ]
