"""The pictures of README.md and docs/, and the command that makes them anew."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"


@pytest.fixture
def regenerate(tmp_path, monkeypatch):
    """Return docs/regenerate.py as a module that writes to an empty folder."""
    spec = importlib.util.spec_from_file_location("regenerate", DOCS / "regenerate.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    (tmp_path / "docs").mkdir()
    monkeypatch.setattr(module, "DOCS", tmp_path / "docs")
    return module


def test_every_picture_has_its_command_and_is_shown_where_it_stands(regenerate):
    drawn = {path.name for path in DOCS.iterdir() if path.suffix in {".png", ".gif"}}
    assert drawn == set(regenerate.PICTURES) | set(regenerate.BY_HAND)
    page = (DOCS / "files.md").read_text(encoding="utf-8")
    assert all(f"`{name}`" in page for name in drawn)
    for path in DOCS.glob("paper_*"):
        assert path.stat().st_size < (1_500_000 if path.suffix == ".gif" else 250_000), path


def test_a_study_runs_once_for_all_its_pictures(regenerate, monkeypatch, capsys):
    """Two pictures of 480 kB of noise, which are reduced to fewer colours."""
    calls = []

    def study(arguments):
        calls.append(arguments)
        noise = np.random.default_rng(0).integers(0, 256, (400, 400, 3)).astype(np.uint8)
        for name in ("first.png", "second.png"):
            Image.fromarray(noise).save(Path(arguments[1]).parent / name)
        return 0

    monkeypatch.setattr(regenerate, "PICTURES", {"first.png": (study, "a.nc"), "second.png": (study, "a.nc")})
    assert regenerate.main(["second.png"]) == 0
    assert [path.name for path in regenerate.DOCS.iterdir()] == ["second.png"]
    assert regenerate.main([]) == 0
    assert len(calls) == 2  # once a command
    assert calls[0][0] == "--out"
    for name in ("first.png", "second.png"):
        with Image.open(regenerate.DOCS / name) as picture:
            assert (picture.size, picture.mode) == ((400, 400), "P")
    assert not (regenerate.DOCS / "a.nc").exists()


def test_unknown_pictures_and_failed_studies(regenerate, monkeypatch, capsys):
    assert regenerate.main(["nothing.png"]) == 2
    assert "got nothing.png; must be among gap_sweep.png" in capsys.readouterr().err
    monkeypatch.setattr(regenerate, "PICTURES", {"first.png": (lambda _: 2, "a.nc")})
    assert regenerate.main([]) == 1
    assert not list(regenerate.DOCS.iterdir())
