"""The documents: every block of Python runs and prints what it says, every command line is taken by its study."""

import dataclasses
import importlib
import io
import re
import shlex
from contextlib import redirect_stdout
from pathlib import Path

import matplotlib
import pytest
import tyro
from support import SCENE_TOML

from hpgr.scene import Scene
from studies import gap_sweep

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.glob("*.md"))]
RUN = [page for page in PAGES if page.name == "tutorial.md" or page.name.startswith("howto_")]
ARROW = "# ->"
NEAR = 0.02  # relative, of printed numbers
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+\.?\d*(?:e[-+]?\d+)?(?![\w])")


def text_of(page):
    return page.read_text(encoding="utf-8")


def blocks(page, language):
    return re.findall(rf"^```{language}\n(.*?)^```", text_of(page), re.MULTILINE | re.DOTALL)


def expected(block):
    """Return the lines that a block says it prints."""
    return [line[len(ARROW) + 1 :] for line in block.splitlines() if line.startswith(ARROW)]


def assert_near(printed, told, where):
    """Assert that lines agree word by word, numbers within NEAR."""
    assert len(printed) == len(told), (where, printed, told)
    for one, other in zip(printed, told, strict=True):
        assert re.sub(r"\s+", "", NUMBER.sub("#", one)) == re.sub(r"\s+", "", NUMBER.sub("#", other)), (where, one)
        for found, said in zip(NUMBER.findall(one), NUMBER.findall(other), strict=True):
            assert float(found) == pytest.approx(float(said), rel=NEAR), (where, one, other)


def run(page):
    """Run the blocks of a page in one namespace."""
    namespace = {"__name__": "page"}
    for number, block in enumerate(blocks(page, "python"), start=1):
        where = f"{page.name}, block {number}"
        printed = io.StringIO()
        with redirect_stdout(printed):
            exec(compile(block, where, "exec"), namespace)
        if expected(block):
            assert_near(printed.getvalue().splitlines(), expected(block), where)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Run in an empty folder, drawing to files."""
    monkeypatch.chdir(tmp_path)
    shown = matplotlib.get_backend()
    matplotlib.use("Agg")
    yield tmp_path
    import matplotlib.pyplot as plt

    plt.close("all")
    matplotlib.use(shown)


@pytest.mark.parametrize("page", RUN, ids=lambda page: page.name)
def test_pages_run(page, folder, capfd):
    run(page)


def test_tutorial_says_what_it_prints():
    assert sum(len(expected(block)) for block in blocks(DOCS / "tutorial.md", "python")) >= 25


@pytest.mark.parametrize(
    ("printed", "told"), [("1.00", "1.03"), ("12 of 12", "12 of 13"), ("a 1", "b 1"), ("-1.0", "1.0"), ("[1 2]", "[1]")]
)
def test_what_is_printed_must_be_near(printed, told):
    assert_near([told], [told], "itself")
    with pytest.raises((AssertionError, ValueError)):
        assert_near([printed], [told], "another")


def test_readme_runs(folder, capfd):
    small = ["--cells", "40", "--points", "30", "--streamlines", "2", "--replicates", "1", "--no-plot"]
    assert gap_sweep.main(small) == 0
    [toml] = blocks(ROOT / "README.md", "toml")
    Path("my_sieves.csv").write_text("size_mm,percent_passing\n1,5\n20,60\n45,100\n")
    Path("mine.toml").write_text(toml + "\n[resolution]\nstreamlines = 2\npoints = 21\ncells = 20\n")
    assert Scene.from_file("mine.toml").feed.kind == "table"
    run(ROOT / "README.md")


def commands(page):
    """Return (study, arguments) of every command line on a page, in blocks or in the text."""
    found = re.findall(r"python -m studies\.(\w+)([^`\n&|]*)", text_of(page))
    return [(study, shlex.split(rest, comments=True)) for study, rest in found]


class Parsed(BaseException):
    """Raised where a study has taken its arguments, so that it stops there."""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_studies_take_the_commands(page, folder, monkeypatch, capsys):
    taken = tyro.cli

    def stop(*arguments, **options):
        taken(*arguments, **options)
        raise Parsed

    monkeypatch.setattr(tyro, "cli", stop)
    Path("mine.toml").write_text(SCENE_TOML)
    for study, arguments in commands(page):
        try:
            importlib.import_module(f"studies.{study}").main(arguments)
        except Parsed:
            continue
        except SystemExit as end:
            assert end.code == 0, (study, arguments, capsys.readouterr())  # --help
            continue
        pytest.fail(f"{page.name}: {study} {arguments} was not parsed")


def test_there_are_commands_to_take():
    assert sum(len(commands(page)) for page in PAGES) >= 20
    assert all(commands(page) for page in PAGES if page.name in ("README.md", "tutorial.md", "howto_calibrate.md"))


def test_options_named_in_the_text_are_known():
    """Every --option in inline code is one of a study's, or of pip's and pytest's."""
    known = {"--help", "--no-plot"}
    for path in (ROOT / "studies").glob("*.py"):
        options = getattr(importlib.import_module(f"studies.{path.stem}"), "Options", None)
        known |= {"--" + field.name.replace("_", "-") for field in dataclasses.fields(options)} if options else set()
    for page in PAGES:
        prose = re.sub(r"^```.*?^```", "", text_of(page), flags=re.MULTILINE | re.DOTALL)
        named = {name for code in re.findall(r"`([^`\n]+)`", prose) for name in re.findall(r"(?<![\w-])--[a-z-]+", code)}
        assert named <= known, (page.name, named - known)


def test_links_lead_somewhere():
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text_of(page)):
            if not target.startswith("http"):
                assert (page.parent / target).exists(), (page.name, target)
