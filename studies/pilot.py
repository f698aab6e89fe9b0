"""Calibrate on some pilot tests and predict the others blind: `python -m studies.pilot`.

Beside the model stand two population balance models, fitted to the same tests.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import tyro

from hpgr import presets
from hpgr.scene import Material, Scene
from studies.command import base_scene, refusing, shown_as

if TYPE_CHECKING:
    import xarray as xr

PARTS = ("centre", "edge", "total")
FIGURES = ("throughput", "power", "specific_energy")
_FIT = ("sigma_m", "w", "gamma", "n", "K", "alpha", "kappa", "T_0")
_FIRST = ("K-P1", "K-P3")  # one test does not fix how fineness answers to force
_EDGE_SHARE = 0.2  # where it was not measured
_SLICES = 4


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
    scene: Annotated[str, shown_as("PRESET|FILE")] = "khd_pilot"
    """Machine and bed: a preset or a scene file. Of a preset, strength and elasticity start from the paper's quartz."""
    streamlines: Annotated[int, shown_as("N")] = 3
    """Streamlines from the mid-plane to the roll."""
    points: Annotated[int, shown_as("N")] = 100
    """Material points per streamline."""
    cells: Annotated[int, shown_as("N")] = 2000
    """Cells per material point; 0 is refused."""
    baselines: bool = True
    """Fit Torres & Casali and Hinde & Kalala to the same tests, or not."""
    out: Annotated[Path, shown_as("FILE")] = Path("outputs/pilot.nc")
    """NetCDF file to write; the figure goes beside it as .png."""
    plot: bool = True
    """Draw the figure, or not."""


class Model(NamedTuple):
    """A model fitted to the calibration tests: its name, what it predicts of a test, and what it says of itself."""

    name: str
    predict: Any
    words: str


@refusing
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study and return the exit code; `arguments` default to the command line's."""
    options = tyro.cli(Options, prog="python -m studies.pilot", description=__doc__, args=arguments)
    if options.cells < 1:
        raise ValueError(f"--cells: got {options.cells}; must be at least 1; such as --cells 2000")
    from hpgr.tables import read_pilot_tests
    from studies import store

    store.probe(options.out)
    try:
        tests = read_pilot_tests(options.tests, options.operations)
    except OSError as error:
        raise OSError(
            f"cannot read {error.filename}: {error.strerror}; give --tests and --operations the paths of CSV files"
        ) from None
    known = _chosen(options.calibrate_on, tests)
    scene, fit = starting_scene(options, known)
    models = _models(scene, known, fit, options.baselines)
    result = assemble(tests, [test.name for test in known], models)
    result.attrs["scene"] = scene.model_dump_json()
    print("\n".join(words(result, models)))
    store.write_dataset(result, options.out)
    written = [str(options.out)]
    if options.plot:
        from studies.plots import pilot as plots

        picture = options.out.with_suffix(".png")
        figure = plots.pilot_figure(result)
        store.replace(picture, lambda part: figure.savefig(part, dpi=130))
        written.append(str(picture))
    print("wrote " + " and ".join(written))
    return 0


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
    scene = base_scene(options.scene, streamlines=options.streamlines, points=options.points, cells=options.cells)
    values: dict[str, Any] = {"resolution.record": "product"}
    if options.scene in presets.PRESETS:
        quartz = Material()
        names = ("strength", "weibull_modulus", "cushioning", "fragment_exponent", "bulk_modulus", "shear_modulus")
        values |= {f"material.{name}": getattr(quartz, name) for name in names} | {"rolls.idle_torque": 0.0}
    apart = [test for test in known if _measured(test.centre) and _measured(test.edge)]
    fit = list(options.fit)
    if apart and scene.roll_width is None:
        values["roll_width"] = {"edge_share": edge_share(apart), "slices": _SLICES}
    unknown = {
        "kappa": not apart,
        "alpha": scene.flow.profile != "nip",
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
    rolls, ore = scene.rolls, scene.material
    densities = [t.throughput / (getattr(t, opening) * rolls.width * t.surface_speed) for t in known]
    densities = [density for density in densities if math.isfinite(density)]
    cake = sum(densities) / len(densities) if densities else 0.85 * ore.solid_density
    machine = baselines.Machine(
        rolls.diameter, rolls.width, ore.solid_density, ore.solid_density * ore.feed_solid_fraction, cake
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


def assemble(tests: Sequence[Any], known: Sequence[str], models: Sequence[Model]) -> "xr.Dataset":
    """Return measured and predicted figures of every test as one Dataset; NaN is not measured, or not predicted."""
    import numpy as np
    import xarray as xr

    sizes = np.unique(np.concatenate([test.sizes for test in tests]))
    passing = np.full((1 + len(models), len(tests), len(PARTS), sizes.size), np.nan, np.float32)
    figures = {name: np.full((1 + len(models), len(tests)), np.nan) for name in (*FIGURES, "gap")}
    failures = np.full((1 + len(models), len(tests)), "", object)
    for t, test in enumerate(tests):
        at = np.searchsorted(sizes, test.sizes)
        rows = [test, *(_predicted(model, test) for model in models)]
        for m, row in enumerate(rows):
            if isinstance(row, str):
                failures[m, t] = row
                continue
            for p, part in enumerate(PARTS):
                values = getattr(row, part)
                if values is not None:
                    passing[m, t, p, at] = values
            for name in FIGURES:
                figures[name][m, t] = getattr(row, name)
            figures["gap"][m, t] = test.cake_thickness if m == 0 else getattr(row, "gap", np.nan)
    energy = figures["specific_energy"]
    energy[0] = np.where(np.isnan(energy[0]), figures["power"][0] / figures["throughput"][0], energy[0])
    dims = ("source", "test")
    result = xr.Dataset(
        {
            "passing": ((*dims, "part", "sieve"), passing, {"units": "1", "long_name": "mass fraction passing"}),
            **{name: (dims, values, _ATTRIBUTES[name]) for name, values in figures.items()},
            "blind": ("test", np.array([test.name not in known for test in tests], np.int8),
                      {"units": "1", "long_name": "whether the test was left out of the fit"}),
            "failure": (dims, failures, {"long_name": "why a model predicts nothing of a test"}),
        },
        {
            "source": ("source", np.array(["measured", *(model.name for model in models)], object),
                       {"long_name": "measurement or model"}),
            "test": ("test", np.array([test.name for test in tests], object), {"long_name": "pilot test"}),
            "part": ("part", np.array(PARTS, object), {"long_name": "part of the roll width"}),
            "sieve": ("sieve", sizes, {"units": "m", "long_name": "sieve size"}),
        },
        {"Conventions": "CF-1.11", "title": "Pilot tests, measured and predicted",
         "models": "\n".join(f"{model.name}: {model.words}" for model in models)},
    )  # fmt: skip
    return result.assign(rmse=_rmse(result))


_ATTRIBUTES = {
    "throughput": {"units": "kg s-1", "long_name": "solids through the whole gap"},
    "power": {"units": "W", "long_name": "power of both drives"},
    "specific_energy": {"units": "J kg-1", "long_name": "power over throughput"},
    "gap": {"units": "m", "long_name": "gap; of the measurement the thickness of the cake"},
}


def _predicted(model: Model, test: Any) -> Any:
    """Return the prediction, or why there is none."""
    try:
        return model.predict(test)
    except ValueError as error:
        return str(error)


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
        lines += [f"{model.name}: {model.words}", *_table(result, model.name)]
    lines += ["blind tests, percent passing of the total product:", *blind_summary(result)]
    return lines


def _table(result: "xr.Dataset", name: str) -> list[str]:
    lines = [f"{'test':>10}{'centre':>9}{'edge':>9}{'total':>9}   RMSE, %{'Q':>9}{'P':>9}{'W':>9}   error, %"]
    for test in result["test"].values:
        one, measured = (result.sel(source=source, test=test) for source in (name, "measured"))
        if one["failure"].item():
            lines.append(f"{test:>10}  {one['failure'].item()}")
            continue
        shown = [_figure(one["rmse"].sel(part=part).item(), "9.2f") for part in PARTS]
        errors = [_figure(100 * (one[key] / measured[key] - 1).item(), "+9.1f") for key in FIGURES]
        blind = " blind" if one["blind"].item() else ""
        lines.append(f"{test:>10}{''.join(shown)}          {''.join(errors)}{blind:>10}")
    return lines


def _figure(value: float, form: str) -> str:
    return f"{'-':>9}" if math.isnan(value) else format(value, form)


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
        errors = ", ".join(f"{key} within {_figure(value, '.1f').strip()} %"
                           for key, value in zip(("throughput", "power"), worst, strict=True))  # fmt: skip
        lines.append(f"  {name}: median {float(total.median()):.2f}, largest {float(total.max()):.2f}; {errors}")
    return lines


if __name__ == "__main__":
    raise SystemExit(main())
