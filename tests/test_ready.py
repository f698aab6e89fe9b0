"""What a stranger needs of the project, beside the code: doctests, README, pages, and names that hold."""

import doctest
import importlib
import pkgutil
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import hpgr
import studies
from studies import gap_sweep

ROOT = Path(__file__).parents[1]
MODULES = [module.name for module in pkgutil.walk_packages(studies.__path__, "studies.") if not module.ispkg]


def text(name):
    return (ROOT / name).read_text(encoding="utf-8")


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```", text("README.md"), re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("name", MODULES)
def test_examples_in_docstrings(name):
    assert doctest.testmod(importlib.import_module(name), globs={}).failed == 0


def test_version_is_told_once_and_in_the_changelog():
    assert hpgr.__version__ == tomllib.loads(text("pyproject.toml"))["project"]["version"]
    assert hpgr.__version__ in text("CHANGELOG.md")
    assert text("LICENSE").strip()


def test_readme_has_two_commands():
    set_up = [block for block in blocks("sh") if "venv" in block]
    assert len(set_up) == 2
    assert ["-m studies.gap_sweep" in block for block in set_up] == [True, False]
    assert ["-m pytest" in block for block in set_up] == [False, True]
    for block in set_up:
        assert len(block.strip().splitlines()) == 1  # pasted alone, it works alone
        assert "install" in block
    assert "[test]" in set_up[1]


def test_readme_code_runs(tmp_path, monkeypatch, capsys):
    """The scene and the Python of the README, in one folder and a coarse resolution."""
    [scene], codes = blocks("toml"), blocks("python")
    assert len(codes) >= 2
    monkeypatch.chdir(tmp_path)
    Path("mine.toml").write_text(scene + "\n[resolution]\ncells = 60\npoints = 40\nstreamlines = 3\n", encoding="utf-8")
    small = ["--cells", "60", "--points", "40", "--streamlines", "3"]
    assert gap_sweep.main([*small, "--no-plot"]) == 0  # what the first command leaves behind
    capsys.readouterr()
    monkeypatch.setenv("MPLBACKEND", "agg")
    # without the compiler NumPy speaks up when a 64-bit stream wraps, which is what it is there for
    monkeypatch.setenv("PYTHONWARNINGS", "ignore:overflow encountered in scalar:RuntimeWarning")
    done = subprocess.run([sys.executable, "-c", "\n".join(codes)], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "Warning" not in done.stderr


def tracked():
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=False)
    if listed.returncode:  # not a clone
        pytest.skip("no git repository")
    return [ROOT / name for name in listed.stdout.decode().split("\0") if name]


def test_no_file_names_a_private_folder():
    # joined here, so that this file does not name them either
    private = [b"/" + b"work" + b"/", b"." + b"library"]
    paths = tracked()
    assert ROOT / "pyproject.toml" in paths
    for path in paths:
        if path.exists():
            content = path.read_bytes()
            assert not [word for word in private if word in content], path


def test_outputs_are_not_tracked():
    assert [path.name for path in tracked() if path.parent == ROOT / "outputs"] == [".gitkeep"]
