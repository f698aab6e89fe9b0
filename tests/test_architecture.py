"""Who may import whom, read from the source: the rooms stay apart."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

import hpgr

PACKAGE = Path(hpgr.__file__).parent
ROOMS = ["fields", "tables", "laws", "scene", "bed", "grains", "results", "cost", "tolerance", "run"]  # lowest first
LEVELS = {room: level for level, room in enumerate(ROOMS)} | {"presets": 4, "compiler": 0}
WRITERS = {"write_text", "write_bytes", "to_netcdf", "to_zarr", "to_csv", "mkdir"}
WRITERS |= {"save", "savez", "savetxt", "savefig"}


def sources(folder):
    """The parsed modules of a package, by path relative to its parent, without what only type checkers read."""
    found = {path.relative_to(folder.parent): ast.parse(path.read_text("utf-8")) for path in folder.rglob("*.py")}
    for tree in found.values():
        tree.body = [node for node in tree.body if not isinstance(node, ast.If)]
    return found


HPGR, STUDIES = sources(PACKAGE), sources(PACKAGE.parent / "studies")


def imports(tree, late=True):
    """Every imported module, `from a import b` as "a.b" too; without `late`, only those at the top of the file."""
    for node in ast.walk(tree) if late else tree.body:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide who imports whom"
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif late and isinstance(node, ast.Call) and ast.unparse(node.func) == "Late":
            yield node.args[0].value


def packages(tree):
    return {name.partition(".")[0] for name in imports(tree)}


def room(path):
    return path.with_suffix("").parts[1]


def test_rooms_import_only_what_lies_below_them():
    seen = set()
    for path, tree in HPGR.items():
        own = LEVELS.get(room(path), len(ROOMS))
        below = {name.split(".")[1] for name in imports(tree, late=False) if name.startswith("hpgr.")}
        for other in below - {room(path), "__version__"}:
            assert LEVELS.get(other, len(ROOMS)) <= own - (other in LEVELS), f"{path} imports hpgr.{other}"
            seen.add((room(path), other))
    assert {("laws", "fields"), ("scene", "laws"), ("bed", "scene"), ("grains", "bed"), ("run", "grains")} <= seen


def test_laws_see_no_scene_and_compiled_files_no_other_module():
    for path, tree in HPGR.items():
        if path.name == "kernels.py":
            assert packages(tree) <= {"numpy", "numba", "llvmlite", "math", "typing", "hpgr"}, path
            ours = {name for name in imports(tree) if name.startswith("hpgr.") and not name.startswith("hpgr.laws")}
            assert ours == {"hpgr.compiler"}, path
        else:
            assert "numba" not in packages(tree) or path.name == "compiler.py"
        if room(path) == "laws":
            assert "hpgr.scene" not in imports(tree), path


def test_fan_out_figures_and_writing_live_in_studies():
    for path, tree in HPGR.items():
        foreign = {"dask", "distributed", "matplotlib", "cmcrameri", "tqdm", "tyro", "netCDF4", "studies"}
        assert not packages(tree) & foreign, path
        for node in ast.walk(tree):
            assert not (isinstance(node, ast.Attribute) and node.attr in WRITERS), f"{path} line {node.lineno}"
    drawing = {path.parts[1:-1] for path, tree in STUDIES.items() if packages(tree) & {"matplotlib", "cmcrameri"}}
    assert drawing == {("show", "plots")}
    nodes = ((path.name, node) for path, tree in STUDIES.items() for node in ast.walk(tree))
    writing = {name for name, node in nodes if isinstance(node, ast.Attribute) and node.attr == "to_netcdf"}
    assert writing <= {"netcdf.py"}


def test_no_unseeded_numbers_and_no_private_names_of_others():
    public = {"_replace", "_asdict", "_fields"}
    for path, tree in (HPGR | STUDIES).items():
        assert not re.search(r"random\.(seed|rand|default_rng)\(\)", ast.unparse(tree)), path
        ours = {name for name in imports(tree) if name.startswith(("hpgr", "studies"))}
        assert not [name for name in ours if re.search(r"\._[a-z]", name)], path
        known = {name.rpartition(".")[2] for name in ours}
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in known:
                private = node.attr.startswith("_") and not node.attr.startswith("__") and node.attr not in public
                assert not private, f"{path} line {node.lineno}: {ast.unparse(node)}"


@pytest.mark.parametrize(
    ("code", "unneeded"),
    [("hpgr.Scene, hpgr.presets.paper()", {"numba", "xarray", "pint"}), ("hpgr.simulate", {"xarray", "pint"})],
)
def test_what_is_not_needed_yet_is_not_imported(code, unneeded):
    """A study's --help must not wait for numba, xarray or pint."""
    code = f"import sys, hpgr; {code}; print(sorted({unneeded} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
