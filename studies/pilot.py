"""Calibrate on some pilot tests and predict the others blind: `python -m studies.pilot`.

Beside the model stand two population balance models, fitted to the same tests. `--compare` sets combinations of laws
beside each other by leaving out one and two tests of all.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np

from hpgr import presets
from hpgr.fields import values_of
from hpgr.scene import Scene, field_info
from studies import Late
from studies.command import Flag, Out, Overwrite, Plot, Report, SceneName, base_scene, command, figure, shown_as

if TYPE_CHECKING:
    import xarray as xr

calibration, schema, report = Late("hpgr.calibration"), Late("hpgr.results.schema"), Late("studies.show.report")
models_of = Late("hpgr.baselines")

PARTS = ("centre", "edge", "total")
FIGURES = ("throughput", "power", "specific_energy")
_FIRST = ("K-P1", "K-P3")  # one test does not fix how fineness answers to force
_EDGE_SHARE = 0.2  # where it was not measured
_SLICES = 4
_SAMPLES = 200  # of the posterior
_FORCES = 0.1  # least range of forces, in logs, that tells an exponent
# Laws of real machines with what is held of them, and where the fit of a preset starts: between ores, so that a blind
# test is none of those the preset is fitted to (docs/validation.md).
START = {
    "flow.slip": 0.33,
    "elasticity.exponent": 0.0,
    "elasticity.densification": 3.0,
    "elasticity.recovery_modulus": 2e9,
    "strength.weibull_modulus": 3.0,
    "strength.scatter": 0.5,
    "strength.cushioning": math.inf,
    "fragments.exponent": 0.8,
    "fragments.size_exponent": 0.0,
    "fragments.reference_size": 0.01,
    "flow.nip_angle": 0.25,
    "rolls.idle_torque": 0.0,
}
_HILL = {"kind": "friction_hill", "edge_ratio": 0.1}


@dataclass(frozen=True)
class Options:
    """Options of the pilot study."""

    tests: Annotated[Path, shown_as("FILE")] = presets.DATA / "khd_porphyry_psd.csv"
    """Size distributions, CSV: test, size_mm, feed, total and, if measured, centre and edge, in percent passing."""
    operations: Annotated[Path, shown_as("FILE")] = presets.DATA / "khd_porphyry_operations.csv"
    """Operations, CSV: test, U_m_s, Fsp_N_mm2 and, if measured, flake_mm, gap_mm, Q_tph, P_kW, P_idle_kW, D_mm ..."""
    calibrate_on: Annotated[tuple[str, ...] | None, shown_as("TEST ...")] = None
    """Tests to fit to (default: K-P1 and K-P3); all others are predicted blind."""
    fit: Annotated[tuple[str, ...] | None, shown_as("SYMBOL ...")] = None
    """Parameters to fit (default: sigma_m, w, k, gamma, nu, epsilon, alpha, K)."""
    scene: SceneName = "khd_pilot"
    streamlines: Annotated[int, shown_as("N")] = 1
    """Streamlines from the mid-plane to the roll."""
    points: Annotated[int, shown_as("N")] = 80
    """Material points per streamline."""
    compare: Flag = False
    """Compare combinations of laws over all tests instead, leaving out one and two; takes many minutes."""
    baselines: bool = True
    """Fit Torres & Casali and Hinde & Kalala to the same tests, or not."""
    out: Out = Path("outputs/pilot.nc")
    plot: Plot = True
    overwrite: Overwrite = False


class Model(NamedTuple):
    """A model fitted to the calibration tests: its name, what it predicts of a test, and what it says of itself."""

    name: str
    predict: Any
    words: str


class Laws(NamedTuple):
    """A combination of laws: its name, the scene fields that differ from the recommended laws, and what is fitted."""

    name: str
    values: dict[str, Any]
    fit: tuple[str, ...]


_MACHINE, _ORE = ("alpha", "K"), ("sigma_m", "w", "gamma")
_NO_SLIP, _NO_RECOVERY = {"flow.slip": 0.0, "flow.nip_angle": 0.16}, {"elasticity.recovery_modulus": None}
_POWER_LAW = {"elasticity.densification": 0.0, "elasticity.exponent": 0.5}
_PARABOLA, _THRESHOLD = {"roll_width": {"kind": "parabola"}}, {"strength.scatter": math.inf}
_PAPER = _NO_SLIP | _NO_RECOVERY | _POWER_LAW | _PARABOLA | _THRESHOLD
COMBINATIONS = (
    Laws("paper's laws", _PAPER, (*_ORE, "kappa", *_MACHINE)),
    Laws("the same, idle torque fitted", _PAPER, (*_ORE, "kappa", *_MACHINE, "T_0")),
    Laws("bed: slip", _NO_RECOVERY | _POWER_LAW | _PARABOLA | _THRESHOLD, (*_ORE, "kappa", *_MACHINE)),
    Laws("bed: slip, densification", _NO_RECOVERY | _PARABOLA | _THRESHOLD, (*_ORE, "kappa", *_MACHINE)),
    Laws("bed: slip, densification, recovery", _PARABOLA | _THRESHOLD, (*_ORE, "kappa", *_MACHINE)),
    Laws("bed + friction hill", _THRESHOLD, (*_ORE, "epsilon", *_MACHINE)),
    Laws("bed + hill + parent", _THRESHOLD, (*_ORE, "nu", "epsilon", *_MACHINE)),
    Laws("bed + hill + scatter", {}, (*_ORE, "k", "epsilon", *_MACHINE)),
    Laws("bed + parabola + scatter + parent", _PARABOLA, (*_ORE, "k", "nu", "kappa", *_MACHINE)),
    Laws("bed + hill + scatter + parent", {}, (*_ORE, "k", "nu", "epsilon", *_MACHINE)),
)


@command("pilot", __doc__)
def main(options: Options) -> Report:
    """Run the study of the command line."""
    from hpgr.tables import read_pilot_tests

    try:
        tests = read_pilot_tests(options.tests, options.operations)
    except OSError as error:
        raise OSError(
            f"cannot read {error.filename}: {error.strerror}; give --tests and --operations the paths of CSV files"
        ) from None
    if options.compare:
        result = comparison(starting_scene(options, tests), tests, options.baselines)
        return Report([compared(result)], [result])
    known = _chosen(options.calibrate_on, tests)
    scene = starting_scene(options, known)
    models, fitted, samples = _models(scene, known, options.fit, options.baselines)
    result = assemble(tests, [test.name for test in known], models, fitted, samples)
    from studies.show.plots.pilot import pilot_figure

    return Report(words(result, models), [result, figure(lambda: pilot_figure(result), dpi=130)])


def _chosen(names: Sequence[str] | None, tests: Sequence[Any]) -> list[Any]:
    known = {test.name: test for test in tests}
    wanted = _FIRST if names is None and set(_FIRST) <= known.keys() else names
    unknown = [name for name in wanted or () if name not in known]
    if unknown or not wanted:
        raise ValueError(
            f"--calibrate-on: got {unknown[0] if unknown else 'nothing'}; must be among {', '.join(known)}; name tests "
            "to fit to, best two of different force"
        )
    return [known[name] for name in dict.fromkeys(wanted)]


def starting_scene(options: Options, known: Sequence[Any]) -> Scene:
    """Return the scene to start from; the edge share is that which measured distributions mix to their totals with."""
    scene = base_scene(options)
    values: dict[str, Any] = {"resolution.record": "product"}
    if options.scene in presets.NAMES:
        values |= START
    if scene.roll_width is None:
        apart = [test for test in known if np.isfinite(test.centre).any() and np.isfinite(test.edge).any()]
        values["roll_width"] = _HILL | {"edge_share": edge_share(apart), "slices": _SLICES}
    return scene.with_values(values)


def edge_share(tests: Sequence[Any]) -> float:
    """Return e of total = (1 - e) centre + e edge, by least squares over all sieves of the tests."""
    gaps = [(test.total - test.centre, test.edge - test.centre) for test in tests]
    whole, edge = (np.concatenate(part) for part in zip(*gaps, strict=True)) if gaps else np.zeros((2, 1))
    kept = np.isfinite(whole) & np.isfinite(edge)
    scale = float(edge[kept] @ edge[kept])
    share = float(whole[kept] @ edge[kept]) / scale if scale > 0 else _EDGE_SHARE
    return share if 0 < share < 1 else _EDGE_SHARE


def _models(
    scene: Scene, known: Sequence[Any], fit: Any, baselines: bool
) -> tuple[list[Model], Scene, dict[str, np.ndarray]]:
    """Return the fitted models, ours first, its scene, with the sieves of `scene`, and samples of its fields."""
    print(f"fitting to {', '.join(test.name for test in known)} (under a minute)", flush=True)
    found = calibration.fit_tests(scene, known, fit)
    found = calibration.validated(found) if len(known) > 2 else found
    fitted = [calibration.PARAMETERS[name] for name in found.problem.names]
    fields = [field for one in fitted for field in (one.field, one.follower) if field]
    drawn = [values_of(one) for one in found.sample(_SAMPLES, seed=0)]
    samples = {name: np.array([one[name] for one in drawn]) for name in fields}
    models = [Model("hpgr", found.predict, str(found))]
    for name, fit_model in (models_of.MODELS if baselines else {}).items():
        try:
            other = fit_model(known, scene)
        except ValueError as error:
            print(f"{name} left out: {error}")
            continue
        models.append(Model(name, other.predict, f"fitted to {other.rmse:.2f} percent passing"))
    remark = f"fitted to {', '.join(test.name for test in known)}"
    fitted_scene = found.scene.with_values({"resolution.sieves": scene.resolution.sieves, "remark": remark})
    return models, fitted_scene, samples


# ---- comparing

_ERRORS = {  # figure -> unit, what it is
    "total_median": ("percent", "median over tests of the root mean square error of the total product"),
    "total_largest": ("percent", "largest root mean square error of the total product"),
    "centre_median": ("percent", "median root mean square error of the centre product"),
    "edge_median": ("percent", "median root mean square error of the edge product"),
    "throughput_largest": ("percent", "largest error of the throughput"),
    "power_largest": ("percent", "largest error of the net power, the measured idle power taken off"),
    "energy_largest": ("percent", "largest error of the specific energy"),
    "gap_exponent": ("1", "exponent of the gap on force"),
    "energy_exponent": ("1", "exponent of the specific energy on force"),
    "coverage": ("percent", "measured points within their 90 % intervals"),
    "width": ("percent", "mean width of the 90 % interval of the total product"),
}


def comparison(scene: Scene, tests: Sequence[Any], baselines: bool) -> "xr.Dataset":
    """Return the errors of every combination of laws, fitted to all tests and with one and two of them left out."""
    named = [(laws.name, _refit(scene, laws)) for laws in COMBINATIONS]
    others = models_of.MODELS if baselines else {}
    named += [(name, lambda known, fit=fit: fit(known, scene)) for name, fit in others.items()]
    values = np.full((1 + len(named), 3, len(_ERRORS)), np.nan)
    constants = np.zeros(len(values), int)
    measured = _exponents([(test, SimpleNamespace(**_measured(test))) for test in tests])
    values[0, 0] = [measured.get(name, math.nan) for name in _ERRORS]
    for k, (name, fit) in enumerate(named, start=1):
        for out in range(3):
            try:
                found, constants[k] = _left_out(tests, fit, out)
            except ValueError as refused:  # laws under which no gap carries the force of a test
                print(f"{name}, {out} left out: {refused}", flush=True)
                continue
            values[k, out] = [_errors(found).get(error, math.nan) for error in _ERRORS]
        print(name, *(f"{median:.2f}/{largest:.2f}" for median, largest in values[k, :, :2]), flush=True)
    names = ["measured", *(name for name, _ in named)]
    figures = [f"{name}: {words} [{unit}]" for name, (unit, words) in _ERRORS.items()]
    own = schema.Variable
    told = "error by combination of laws", "; ".join(figures)
    table = {
        "error": own(("laws", "left_out", "figure"), "", *told, np.float64),
        "constants": own(("laws",), "1", "number of fitted constants", dtype=np.int32),
        "laws": own(("laws",), "", "combination of laws", dtype=object),
        "left_out": own(("left_out",), "1", "tests left out at a time; 0: errors of the fit", dtype=np.int32),
        "figure": own(("figure",), "", "figure of merit", dtype=object),
    }
    data = {"error": values, "constants": constants, "left_out": range(3)}
    data |= {"laws": np.array(names, object), "figure": np.array(list(_ERRORS), object)}
    attrs = schema.dataset_attributes("Combinations of laws against pilot tests", scene=scene.model_dump_json())
    return schema.to_dataset(data, attrs, table)


def _refit(scene: Scene, laws: Laws) -> Callable[[list[Any]], Any]:
    """Return what fits a combination of laws to tests, each time from the first fit that was made."""
    share = {"edge_share": scene.roll_width.edge_share, "slices": scene.roll_width.slices}
    width = {"roll_width": laws.values["roll_width"] | share} if "roll_width" in laws.values else {}
    scene, first = scene.with_values(laws.values | width), []

    def fit(tests: list[Any]) -> Any:
        found = calibration.fit_tests(scene, tests, laws.fit, near=next(iter(first), None))
        first[:] = first or [found]
        return found

    return fit


def _left_out(tests: Sequence[Any], fit: Callable[[list[Any]], Any], count: int) -> tuple[list[tuple[Any, Any]], int]:
    """Return every test with its prediction by a fit to others, `count` of them left out at a time, or to all.

    And the number of constants. Intervals are those that the other tests tell when each of them is left out.
    """
    fitted, found = None, []
    for out in combinations(range(len(tests)), count):
        fitted = fit([test for k, test in enumerate(tests) if k not in out])
        found += [(tests[k], fitted) for k in out or range(len(tests))]
    if not hasattr(fitted, "discrepancy"):
        return [(test, one.predict(test)) for test, one in found], len(fitted.constants)
    if count != 1:
        return [(test, one.predict(test, intervals=False)) for test, one in found], len(fitted.estimates)
    pairs = [(test, one._replace(discrepancy={}).predict(test)) for test, one in found]
    told = [calibration.discrepancy(pairs[:k] + pairs[k + 1 :]) for k in range(len(pairs))]
    pairs = [(test, one._replace(discrepancy=off).predict(test)) for (test, one), off in zip(found, told, strict=True)]
    return pairs, len(fitted.estimates)


def _errors(pairs: Sequence[tuple[Any, Any]]) -> dict[str, float]:
    """Return the errors of predictions by name."""
    rmse = {name: [_rms(getattr(said, name) - getattr(test, name)) for test, said in pairs] for name in PARTS}
    found = {f"{name}_median": float(np.nanmedian(values)) for name, values in rmse.items()}
    found["total_largest"] = max(rmse["total"])
    for name in ("throughput", "power"):
        found[f"{name}_largest"] = max(abs(_off(test, said, name)) for test, said in pairs)
    found["energy_largest"] = max(abs(_off(test, said, "specific_energy")) for test, said in pairs)
    return found | _exponents(pairs) | _coverage(pairs)


def _off(test: Any, said: Any, name: str) -> float:
    idle = 0.0 if math.isnan(test.idle_power) or name == "throughput" else test.idle_power
    if name == "specific_energy":
        return 100 * ((said.power - idle) / said.throughput / ((test.power - idle) / test.throughput) - 1)
    return 100 * (getattr(said, name) - getattr(test, name)) / (getattr(test, name) - idle)


def _rms(off: np.ndarray) -> float:
    return 100 * math.sqrt(np.nanmean(off**2)) if np.isfinite(off).any() else math.nan


def _exponents(pairs: Sequence[tuple[Any, Any]]) -> dict[str, float]:
    """Return the exponents of gap and specific energy on force, over tests of the first feed."""
    kept = [(test, said) for test, said in pairs if np.array_equal(test.feed, pairs[0][0].feed)]
    force = np.log([test.specific_pressing_force for test, _ in kept])
    values = {
        "gap_exponent": np.array([getattr(said, "gap", math.nan) for _, said in kept]),
        "energy_exponent": np.array([said.specific_energy for _, said in kept]),
    }
    known = {name: one for name, one in values.items() if np.isfinite(one).all() and np.ptp(force) > _FORCES}
    return {name: float(np.polyfit(force, np.log(one), 1)[0]) for name, one in known.items()}


def _coverage(pairs: Sequence[tuple[Any, Any]]) -> dict[str, float]:
    """Return the part of the measured points within the intervals of their predictions, and the mean width of these."""
    inside, widths = [], []
    for test, said in pairs:
        for name in PARTS if getattr(said, "lower", {}) else ():
            low, high, value = said.lower[name], said.upper[name], getattr(test, name)
            seen = np.isfinite(value) & (value < 1)  # beyond the largest grain there is nothing to miss
            inside += ((low - 5e-3 <= value) & (value <= high + 5e-3))[seen].tolist()
            widths += (100 * (high - low))[seen].tolist() if name == "total" else []
    return {"coverage": 100 * float(np.mean(inside)), "width": float(np.mean(widths))} if inside else {}


def compared(result: "xr.Dataset") -> str:
    """Return the comparison as a table: median / largest error of the total product, and the rest."""
    rows = []
    for name in result["laws"].values:
        one = result["error"].sel(laws=name)
        row = [name, str(result["constants"].sel(laws=name).item() or "")]
        for out in range(3):
            at = {figure: one.sel(left_out=out, figure=figure).item() for figure in _ERRORS}
            row.append(f"{_figure(at['total_median'], '.2f')} / {_figure(at['total_largest'], '.2f')}")
            if out == 1:
                row += [_figure(at[key], ".1f") for key in list(_ERRORS)[2:7]]
                row.append(f"{_figure(at['coverage'], '.0f')}, {_figure(at['width'], '.1f')}")
        row += [_figure(one.sel(left_out=0, figure=key).item(), ".2f") for key in ("gap_exponent", "energy_exponent")]
        rows.append(row)
    headings = ["laws", "n", "fit", "leave 1 out", "centre", "edge", *(f"{name} [%]" for name in "QPW")]
    headings += ["inside, width [%]", "leave 2 out", "gap exp.", "W exp."]
    return report.aligned(headings, rows, words=1)


# ---- one split


def assemble(
    tests: Sequence[Any], known: Sequence[str], models: Sequence[Model], scene: Scene, samples: dict[str, np.ndarray]
) -> "xr.Dataset":
    """Return measured and predicted figures of every test as one Dataset; NaN is not measured, or not predicted."""
    sizes, shape = np.unique(np.concatenate([test.sizes for test in tests])), (1 + len(models), len(tests))
    values: dict[str, Any] = {"failure": np.full(shape, "", object)}
    for side in ("", "_lower", "_upper"):
        values[f"passing{side}"] = np.full((*shape, len(PARTS), sizes.size), np.nan)
        values |= {f"{name}{side}": np.full(shape, np.nan) for name in (*FIGURES, "gap")}
    for t, test in enumerate(tests):
        at = np.searchsorted(sizes, test.sizes)
        for m, row in enumerate([_measured(test), *(_predicted(model, test) for model in models)]):
            values["failure"][m, t] = row.get("failure", "")
            for side in ("", "_lower", "_upper"):
                found = row.get(side[1:], {}) if side else row
                for p, part in enumerate(PARTS):
                    if found.get(part) is not None:
                        values[f"passing{side}"][m, t, p, at] = found[part]
                for name in (*FIGURES, "gap"):
                    values[f"{name}{side}"][m, t] = found.get(name, np.nan)
    values |= samples | {
        "blind": [test.name not in known for test in tests],
        "source": np.array(["measured", *(model.name for model in models)], object),
        "test": np.array([test.name for test in tests], object),
        "part": np.array(PARTS, object),
        "sieve": sizes,
    }
    told = "\n".join(f"{model.name}: {model.words}" for model in models)
    attrs = schema.dataset_attributes("Pilot tests, measured and predicted", models=told, scene=scene.model_dump_json())
    result = schema.to_dataset(values, attrs, _own(samples))
    return result.assign(rmse=_rmse(result))


def _measured(test: Any) -> dict[str, Any]:
    return test._asdict() | {name: calibration.measured(test, name).item() for name in ("gap", "specific_energy")}


def _own(samples: dict[str, np.ndarray]) -> dict[str, Any]:
    """Return the table of the study's own variables."""
    dims = ("source", "test")
    figures = {name: schema.VARIABLES[name]._replace(dims=dims, dtype=np.float64) for name in FIGURES} | {
        "gap": schema.Variable(dims, "m", "gap", "measured: working gap, or thickness of the cake", np.float64),
        "passing": schema.Variable((*dims, "part", "sieve"), "1", "mass fraction passing"),
    }
    ends = {
        f"{name}_{side}": one._replace(long_name=f"{side} end of the 90 % interval of {one.long_name}")
        for name, one in figures.items()
        for side in ("lower", "upper")
    }
    words = {"source": "measurement or model", "test": "pilot test", "part": "part of the roll width"}
    told = {
        "blind": schema.Variable(("test",), "1", "whether the test was left out of the fit", dtype=np.int8),
        "failure": schema.Variable(dims, "", "why a model predicts nothing of a test", dtype=object),
    }
    told |= {name: schema.Variable((name,), "", each, dtype=object) for name, each in words.items()}
    for name, info in zip(samples, map(field_info, samples), strict=True):
        drawn = f"{info.symbol}, drawn with its covariance"
        told[name] = schema.Variable(("sample",), info.unit, drawn, dtype=np.float64)
    return figures | ends | told


def _predicted(model: Model, test: Any) -> dict[str, Any]:
    """Return the prediction by name, or why there is none as its failure."""
    try:
        return model.predict(test)._asdict()
    except ValueError as error:
        return {"failure": str(error)}


def _rmse(result: "xr.Dataset") -> "xr.DataArray":
    measured = result["passing"].sel(source="measured", drop=True)
    off = 100 * (result["passing"] - measured)
    found = (off**2).mean("sieve") ** 0.5
    found.attrs = {"units": "percent", "long_name": "root mean square error of the percent passing over the sieves"}
    return found.where(found["source"] != "measured")


def words(result: "xr.Dataset", models: Sequence[Model]) -> list[str]:
    """Return the tables of the study: fitted values, errors of every test, and what they come to blind."""
    lines = []
    for model in models:
        lines += [f"{model.name}: {model.words}", *_table(result, model.name).splitlines()]
    return [*lines, "blind tests, percent passing of the total product:", *blind_summary(result)]


def _table(result: "xr.Dataset", name: str) -> str:
    rows = []
    for test in result["test"].values:
        one, measured = (result.sel(source=source, test=test) for source in (name, "measured"))
        shown = [_figure(one["rmse"].sel(part=part).item(), ".2f") for part in PARTS]
        errors = [_figure(100 * (one[key] / measured[key] - 1).item(), "+.1f") for key in FIGURES]
        rows.append([test, *shown, *errors, "blind" if one["blind"].item() else "", one["failure"].item()])
    headings = ["test", *(f"RMSE {part} [%]" for part in PARTS), "error of Q [%]", "P [%]", "W [%]", "", ""]
    return report.aligned(headings, rows, words=1)


def _figure(value: float, form: str) -> str:
    return "-" if math.isnan(value) else format(value, form)


def blind_summary(result: "xr.Dataset") -> list[str]:
    """Return a line per model: median and largest RMSE of the total product over the blind tests, and worst Q and P."""
    blind = result.sel(test=result["blind"].values == 1)
    if not blind.sizes["test"]:
        return ["  none: every test was fitted"]
    lines = []
    measured = blind.sel(source="measured")
    for name in result["source"].values[1:]:
        one = blind.sel(source=name)
        total = one["rmse"].sel(part="total")
        worst = {key: float(abs(100 * (one[key] / measured[key] - 1)).max()) for key in ("throughput", "power")}
        errors = [f"{key} within {value:.1f} %" for key, value in worst.items() if not math.isnan(value)]
        told = f"  {name}: median {float(total.median()):.2f}, largest {float(total.max()):.2f}"
        lines.append("; ".join(filter(None, (told, ", ".join(errors)))))
    return lines


if __name__ == "__main__":
    raise SystemExit(main())
