"""Who may import whom, read from the source: the rooms stay apart."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import hpgr

ROOMS = Path(hpgr.__file__).parent
STUDIES = ROOMS.parent / "studies"
MODULES = {path.stem: ast.parse(path.read_text(encoding="utf-8")) for path in sorted(ROOMS.glob("*.py"))}
STUDY_MODULES = {
    path.relative_to(STUDIES).with_suffix("").as_posix(): ast.parse(path.read_text(encoding="utf-8"))
    for path in sorted(STUDIES.rglob("*.py"))
}
WRITERS = {
    "write_text", "write_bytes", "to_netcdf", "to_zarr", "to_csv", "save", "savez", "savetxt", "savefig", "mkdir",
    "unlink", "dump",
}  # fmt: skip


def imports(tree):
    """Yield every imported module, `from a import b` as "a.b" too, wherever in the file it stands."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide who imports whom"
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def packages(tree):
    return {name.partition(".")[0] for name in imports(tree)}


def rooms(tree):
    """Names of the hpgr modules that a module imports."""
    parts = [name.split(".") for name in imports(tree)]
    return {part[1] for part in parts if part[0] == "hpgr" and len(part) > 1 and part[1] in MODULES}


def test_the_walk_sees_the_rooms():
    assert {"scene", "kernels", "pipeline"} <= set(MODULES)
    assert rooms(MODULES["pipeline"]) >= {"scene", "flow", "geometry", "stress", "solve", "schema"}
    assert "numba" in packages(MODULES["kernels"])


def test_scene_knows_only_how_to_read():
    assert rooms(MODULES["scene"]) == {"tables", "units"}
    assert rooms(MODULES["tables"]) == {"units"}
    assert rooms(MODULES["units"]) == set()
    assert rooms(MODULES["presets"]) == {"scene"}


def test_kernels_see_numpy_numba_and_math_only():
    assert packages(MODULES["kernels"]) == {"numpy", "numba", "math"}
    assert [name for name, tree in MODULES.items() if "numba" in packages(tree)] == ["kernels"]


def test_geometry_flow_and_stress_run_one_way():
    assert rooms(MODULES["geometry"]) == {"scene"}
    assert rooms(MODULES["flow"]) == {"geometry", "scene"}
    assert rooms(MODULES["stress"]) == {"flow", "scene"}


@pytest.mark.parametrize("name", MODULES)
def test_no_room_is_imported_in_a_circle(name):
    seen, front = set(), rooms(MODULES[name])
    while front:
        seen |= front
        front = set().union(*(rooms(MODULES[room]) for room in front)) - seen
    assert name not in seen


def test_xarray_enters_at_the_schema():
    assert {name for name, tree in MODULES.items() if "xarray" in packages(tree)} <= {"schema", "run", "metrics"}


@pytest.mark.parametrize("name", MODULES)
def test_fan_out_and_figures_live_in_studies(name):
    assert not packages(MODULES[name]) & {
        "dask", "distributed", "matplotlib", "cmcrameri", "tqdm", "tyro", "netCDF4", "studies",
    }  # fmt: skip


@pytest.mark.parametrize("name", MODULES)
def test_rooms_write_no_files(name):
    for node in ast.walk(MODULES[name]):
        if isinstance(node, ast.Attribute):
            assert node.attr not in WRITERS, f"{name}.py line {node.lineno}: {node.attr}"
        if isinstance(node, ast.Call) and getattr(node.func, "id", getattr(node.func, "attr", "")) == "open":
            text = ast.unparse(node)
            assert not any(f"'{mode}" in text for mode in ("w", "a", "x")), f"{name}.py line {node.lineno}: {text}"


@pytest.mark.parametrize("name", MODULES)
def test_rooms_draw_no_unseeded_numbers(name):
    for node in ast.walk(MODULES[name]):
        text = ast.unparse(node) if isinstance(node, ast.Call) else ""
        assert not text.startswith(("np.random.seed", "np.random.rand", "np.random.default_rng()", "random."))


NAMED_TUPLE = {"_replace", "_asdict", "_fields"}  # public, whatever their underscore


def underscored(name):
    return any(
        part.startswith("_") and not part.startswith("__") for part in name.split(".") if part not in NAMED_TUPLE
    )


@pytest.mark.parametrize("name", MODULES)
def test_no_room_reaches_into_anothers_privates(name):
    """`other._name` across modules, for modules of this package."""
    known = rooms(MODULES[name])
    for node in ast.walk(MODULES[name]):
        if isinstance(node, ast.Attribute) and underscored(node.attr) and isinstance(node.value, ast.Name):
            assert node.value.id not in known, f"{name}.py line {node.lineno}: {ast.unparse(node)}"


def test_studies_use_public_names_only():
    for study, tree in STUDY_MODULES.items():
        assert not [name for name in imports(tree) if name.startswith("hpgr") and underscored(name)], study
        aliases = {
            alias.asname or alias.name.partition(".")[0]
            for node in ast.walk(tree)
            if isinstance(node, ast.Import | ast.ImportFrom)
            for alias in node.names
            if (getattr(node, "module", None) or alias.name).startswith("hpgr")
        }
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and ast.unparse(node).partition(".")[0] in aliases:
                assert not underscored(ast.unparse(node)), f"{study}.py line {node.lineno}: {ast.unparse(node)}"


def test_figures_and_files_have_one_room_each():
    """Only studies/plots/ draws, only studies/store.py writes NetCDF."""
    drawing = {name for name, tree in STUDY_MODULES.items() if packages(tree) & {"matplotlib", "cmcrameri"}}
    assert {name.partition("/")[0] for name in drawing} == {"plots"}
    writing = {
        name
        for name, tree in STUDY_MODULES.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and node.attr == "to_netcdf"
    }
    assert writing <= {"store"}


def test_importing_scenes_loads_no_compiler():
    """A study's --help must not wait for numba, xarray or pint."""
    code = "import sys, hpgr; hpgr.Scene, hpgr.presets.paper; print(sorted({'numba', 'xarray'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("name", MODULES)
def test_every_public_name_is_documented(name):
    for node in MODULES[name].body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            assert ast.get_docstring(node), f"{name}.{node.name}"
