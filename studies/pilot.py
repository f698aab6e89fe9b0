"""Calibrate on some pilot tests and predict the others blind: `python -m studies.pilot`.

Beside the model stand two population balance models, fitted to the same tests.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from hpgr import presets
from hpgr.fields import values_of
from hpgr.scene import Scene
from studies.command import (
    Out,
    Overwrite,
    Plot,
    Report,
    SceneName,
    base_scene,
    command,
    figure,
    shown_as,
)

if TYPE_CHECKING:
    import xarray as xr

PARTS = ("centre", "edge", "total")
FIGURES = ("throughput", "power", "specific_energy")
_FIT = ("sigma_m", "w", "gamma", "n", "K", "alpha", "kappa", "T_0")
_FIRST = ("K-P1", "K-P3")  # one test does not fix how fineness answers to force
_EDGE_SHARE = 0.2  # where it was not measured
_SLICES = 4
_QUARTZ = (  # what is fitted starts from the paper's
    "strength.reference_strength",
    "strength.weibull_modulus",
    "strength.cushioning",
    "fragments.exponent",
    "elasticity.bulk_modulus",
    "elasticity.shear_modulus",
)


@dataclass(frozen=True)
class Options:
    """Options of the pilot study."""

    tests: Annotated[Path, shown_as("FILE")] = presets.DATA / "khd_porphyry_psd.csv"
    """Size distributions, CSV: test, size_mm, feed, total and, if measured, centre and edge, in percent passing."""
    operations: Annotated[Path, shown_as("FILE")] = presets.DATA / "khd_porphyry_operations.csv"
    """Operations, CSV: test, U_m_s, Fsp_N_mm2 and, if measured, flake_mm, gap_mm, Q_tph, P_kW, W_kWh_t, Rp_bar ..."""
    calibrate_on: Annotated[tuple[str, ...] | None, shown_as("TEST ...")] = None
    """Tests to fit to (default: K-P1 and K-P3); all others are predicted blind."""
    fit: Annotated[tuple[str, ...], shown_as("SYMBOL ...")] = _FIT
    """Parameters to fit: sigma_m, w, gamma, n, K, alpha, kappa, T_0; those that the tests cannot tell are left out."""
    scene: SceneName = "khd_pilot"
    streamlines: Annotated[int, shown_as("N")] = 3
    """Streamlines from the mid-plane to the roll."""
    points: Annotated[int, shown_as("N")] = 100
    """Material points per streamline."""
    cells: Annotated[int, shown_as("N")] = 2000
    """Cells per material point; 0 is refused."""
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


@command("pilot", __doc__)
def main(options: Options) -> Report:
    """Run the study of the command line; of a preset strength and elasticity start from the paper's quartz."""
    from hpgr.tables import read_pilot_tests

    if options.cells < 1:
        raise ValueError(f"--cells: got {options.cells}; must be at least 1; such as --cells 2000")
    try:
        tests = read_pilot_tests(options.tests, options.operations)
    except OSError as error:
        raise OSError(
            f"cannot read {error.filename}: {error.strerror}; give --tests and --operations the paths of CSV files"
        ) from None
    known = _chosen(options.calibrate_on, tests)
    scene, fit = starting_scene(options, known)
    models = _models(scene, known, fit, options.baselines)
    result = assemble(tests, [test.name for test in known], models, scene)
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


def starting_scene(options: Options, known: Sequence[Any]) -> tuple[Scene, list[str]]:
    """Return the scene to start from and the parameters that the tests can tell.

    The edge share is that which the measured distributions mix to their totals with.
    """
    scene = base_scene(options)
    values: dict[str, Any] = {"resolution.record": "product"}
    if options.scene in presets.NAMES:
        quartz = values_of(presets.paper())
        values |= {name: quartz[name] for name in _QUARTZ} | {"rolls.idle_torque": 0.0}
    apart = [test for test in known if _measured(test.centre) and _measured(test.edge)]
    fit = list(options.fit)
    if apart and scene.roll_width is None:
        values["roll_width"] = {"edge_share": edge_share(apart), "slices": _SLICES}
    unknown = {
        "kappa": not apart,
        "alpha": scene.flow.kind != "nip",
        "T_0": all(math.isnan(test.power) for test in known),
    }
    return scene.with_values(values), [name for name in fit if not unknown.get(name)]


def _measured(values: Any) -> bool:
    return bool((values == values).any())


def edge_share(tests: Sequence[Any]) -> float:
    """Return e of total = (1 - e) centre + e edge, by least squares over all sieves of the tests."""
    import numpy as np

    gaps = [(test.total - test.centre, test.edge - test.centre) for test in tests]
    whole, edge = (np.concatenate(part) for part in zip(*gaps, strict=True))
    kept = np.isfinite(whole) & np.isfinite(edge)
    scale = float(edge[kept] @ edge[kept])
    share = float(whole[kept] @ edge[kept]) / scale if scale > 0 else _EDGE_SHARE
    return share if 0 < share < 1 else _EDGE_SHARE


def _models(scene: Scene, known: Sequence[Any], fit: list[str], baselines: bool) -> list[Model]:
    """Return the fitted models, the lattice first."""
    from hpgr.calibration import fit_tests, predict

    print(f"fitting {', '.join(fit)} to {', '.join(test.name for test in known)} (about a minute)", flush=True)
    found = fit_tests(scene, known, fit)
    models = [Model("hpgr", found.predict, str(found))]
    if any(not math.isnan(test.cake_thickness) for test in known):
        models.append(
            Model(
                "hpgr, gap given",
                lambda test: predict(found.scene, test, floating=False),
                "the same with the measured cake thickness as the gap, the force following",
            )
        )
    if baselines:
        models += _baselines(scene, known)
    return models


def _baselines(scene: Scene, known: Sequence[Any]) -> list[Model]:
    """Return the population balance models that the tests allow; one that cannot be fitted says why."""
    from hpgr import baselines

    models = []
    force = "specific_pressing_force" if any(math.isnan(t.hydraulic_pressure) for t in known) else "hydraulic_pressure"
    opening = "gap" if any(math.isnan(t.cake_thickness) for t in known) else "cake_thickness"
    rolls, bed = scene.rolls, scene.bed
    densities = [t.throughput / (getattr(t, opening) * rolls.width * t.surface_speed) for t in known]
    densities = [density for density in densities if math.isfinite(density)]
    cake = sum(densities) / len(densities) if densities else 0.85 * bed.solid_density
    machine = baselines.Machine(
        rolls.diameter, rolls.width, bed.solid_density, bed.solid_density * bed.feed_solid_fraction, cake
    )
    for name, fit in (
        ("Torres & Casali", lambda: baselines.fit_torres_casali(known, machine, opening=opening, force=force)),
        ("Hinde & Kalala", lambda: baselines.fit_hinde_kalala(known)),
    ):
        try:
            found = fit()
        except ValueError as error:
            print(f"{name} left out: {error}")
            continue
        models.append(Model(name, found.predict, f"fitted to {found.rmse:.2f} percent passing"))
    return models


def assemble(tests: Sequence[Any], known: Sequence[str], models: Sequence[Model], scene: Scene) -> "xr.Dataset":
    """Return measured and predicted figures of every test as one Dataset; NaN is not measured, or not predicted."""
    import numpy as np

    from hpgr.results import schema

    sizes, shape = np.unique(np.concatenate([test.sizes for test in tests])), (1 + len(models), len(tests))
    passing = np.full((*shape, len(PARTS), sizes.size), np.nan)
    figures = {name: np.full(shape, np.nan) for name in (*FIGURES, "gap")}
    failures = np.full(shape, "", object)
    for t, test in enumerate(tests):
        at = np.searchsorted(sizes, test.sizes)
        measured = test._asdict() | {"gap": test.cake_thickness}
        for m, row in enumerate([measured, *(_predicted(model, test) for model in models)]):
            failures[m, t] = row.get("failure", "")
            for p, part in enumerate(PARTS):
                if row.get(part) is not None:
                    passing[m, t, p, at] = row[part]
            for name, values in figures.items():
                values[m, t] = row.get(name, np.nan)
    energy = figures["specific_energy"]
    energy[0] = np.where(np.isnan(energy[0]), figures["power"][0] / figures["throughput"][0], energy[0])
    values = figures | {
        "passing": passing,
        "blind": [test.name not in known for test in tests],
        "failure": failures,
        "source": np.array(["measured", *(model.name for model in models)], object),
        "test": np.array([test.name for test in tests], object),
        "part": np.array(PARTS, object),
        "sieve": sizes,
    }
    told = "\n".join(f"{model.name}: {model.words}" for model in models)
    attrs = schema.dataset_attributes("Pilot tests, measured and predicted", models=told, scene=scene.model_dump_json())
    result = schema.to_dataset(values, attrs, _own())
    return result.assign(rmse=_rmse(result))


def _own() -> dict[str, Any]:
    """Return the table of the study's own variables."""
    import numpy as np

    from hpgr.results.schema import VARIABLES, Variable

    dims = ("source", "test")
    return {
        **{name: VARIABLES[name]._replace(dims=dims, dtype=np.float64) for name in FIGURES},
        "gap": Variable(dims, "m", "gap", "of the measurement the thickness of the cake", np.float64),
        "passing": Variable((*dims, "part", "sieve"), "1", "mass fraction passing"),
        "blind": Variable(("test",), "1", "whether the test was left out of the fit", dtype=np.int8),
        "failure": Variable(dims, "", "why a model predicts nothing of a test", dtype=object),
        "source": Variable(("source",), "", "measurement or model", dtype=object),
        "test": Variable(("test",), "", "pilot test", dtype=object),
        "part": Variable(("part",), "", "part of the roll width", dtype=object),
    }


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
    from studies.show.report import aligned

    rows = []
    for test in result["test"].values:
        one, measured = (result.sel(source=source, test=test) for source in (name, "measured"))
        shown = [_figure(one["rmse"].sel(part=part).item(), ".2f") for part in PARTS]
        errors = [_figure(100 * (one[key] / measured[key] - 1).item(), "+.1f") for key in FIGURES]
        rows.append([test, *shown, *errors, "blind" if one["blind"].item() else "", one["failure"].item()])
    headings = ["test", *(f"RMSE {part} [%]" for part in PARTS), "error of Q [%]", "P [%]", "W [%]", "", ""]
    return aligned(headings, rows, words=1)


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
        worst = [float(abs(100 * (one[key] / measured[key] - 1)).max()) for key in ("throughput", "power")]
        named = zip(("throughput", "power"), worst, strict=True)
        errors = ", ".join(f"{key} within {_figure(value, '.1f')} %" for key, value in named)
        lines.append(f"  {name}: median {float(total.median()):.2f}, largest {float(total.max()):.2f}; {errors}")
    return lines


if __name__ == "__main__":
    raise SystemExit(main())
