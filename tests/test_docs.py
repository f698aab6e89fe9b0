"""The documents: Python runs and prints what it says, command lines are taken, and what is named exists.

The README's own code, and the examples in docstrings, run in tests/test_ready.py and tests/test_run.py. The site is
built strictly by .ci/run.
"""

import dataclasses
import importlib
import importlib.util
import inspect
import pkgutil
import pydoc
import re
import shlex
from pathlib import Path

import matplotlib
import pytest
import tyro
from support import SCENE_TOML

import hpgr
import studies
from hpgr.results import flags, schema

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.glob("*.md"))]


def module(name):
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    found = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(found)
    return found


regenerate = module("regenerate")


def text_of(page):
    return page.read_text(encoding="utf-8")


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


@pytest.mark.parametrize("page", regenerate.PAGES, ids=lambda page: page.name)
def test_pages_print_what_they_say(page, folder, capfd):
    assert regenerate.renewed(page) == text_of(page), "look at it, then: python docs/regenerate.py pages"


def test_tutorial_says_what_it_prints():
    assert text_of(DOCS / "tutorial.md").count(f"\n{regenerate.ARROW}") >= 25


def code(page):
    """Return the lines of fenced and indented blocks, and the code within the text, its line breaks undone."""
    fenced = re.findall(r"^```.*?\n(.*?)^```", text_of(page), re.MULTILINE | re.DOTALL)
    prose = re.sub(r"^```.*?^```", "", text_of(page), flags=re.MULTILINE | re.DOTALL)
    inline = [" ".join(one.split()) for one in re.findall(r"`([^`]+)`", prose)]
    return "".join(fenced).splitlines(), re.findall(r"^    (\S.*)", prose, re.MULTILINE), inline


def commands(page):
    """Return (study, arguments) of every command line on a page; a study named without any is none."""
    found = [re.findall(r"python -m studies\.(\w+)([^&|]*)", line) for part in code(page) for line in part]
    split = [(study, shlex.split(rest, comments=True)) for line in found for study, rest in line]
    return [(study, arguments) for study, arguments in split if arguments]


class Parsed(BaseException):
    """Raised where a study has taken its arguments, so that it stops there."""


def test_studies_take_the_commands(folder, monkeypatch, capsys):
    taken = tyro.cli

    def stop(*arguments, **options):
        taken(*arguments, **options)
        raise Parsed

    monkeypatch.setattr(tyro, "cli", stop)
    Path("mine.toml").write_text(SCENE_TOML)
    found = [(page.name, *command) for page in PAGES for command in commands(page)]
    assert len(found) >= 20
    for page, study, arguments in found:
        with pytest.raises((Parsed, SystemExit)) as ended:
            importlib.import_module(f"studies.{study}").main(arguments)
        helped = "--help" in arguments and getattr(ended.value, "code", 1) == 0
        assert helped or ended.type is Parsed, (page, study, arguments, capsys.readouterr())


def test_options_named_in_the_text_are_known():
    known = {"--help", "--nthreads", "--strict"}  # the latter of dask and of mkdocs
    names = [module.name for module in pkgutil.walk_packages(studies.__path__, "studies.")]
    for options in filter(None, (getattr(importlib.import_module(name), "Options", None) for name in names)):
        for field in dataclasses.fields(options):
            known |= {f"--{no}{field.name.replace('_', '-')}" for no in ("", "no-")}
    for page in PAGES:
        ours = [one for one in code(page)[-1] if one.startswith(("--", "python -m studies."))]  # or other programs'
        named = {name for one in ours for name in re.findall(r"(?<![\w-])--[a-z-]+", one)}
        assert named <= known, (page.name, named - known)


def test_what_is_named_exists():
    for page in PAGES:
        for study in re.findall(r"studies\.([a-z]\w*)", text_of(page)):
            assert hasattr(studies, study) or importlib.util.find_spec(f"studies.{study}"), (page.name, study)
        for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text_of(page)):
            assert target.startswith("http") or (page.parent / target).exists(), (page.name, target)
        for folder, file in re.findall(r"`((?:hpgr|tests|studies|docs)/)?([\w/]+\.py)(?:::\w+)?`", text_of(page)):
            homes = [folder] if folder else ["hpgr/", "tests/"]
            assert any((ROOT / home / file).exists() for home in homes), (page.name, file)


def test_tables_of_the_site_have_every_field_variable_and_flag():
    page = module("tables").on_page_markdown(text_of(DOCS / "api.md"))
    assert "<!--" not in page
    assert "| `rolls.gap` | `s_b` | m | required | ≥ 1e-06, ≤ 1000 | Gap where the rolls are closest. |" in page
    assert "| `strength.reference_strength` | `sigma_m` | Pa | 0.84 MPa | ≥ 1, ≤ 1e+15 |" in page
    assert "### `flow`, kind `nip`" in page
    assert all(f"| `{name}` |" in page for name in (*schema.VARIABLES, *schema.COORDINATES, *flags.BITS))


def test_what_users_call_has_an_example():
    listed = [pydoc.locate(name) for name in re.findall(r"^::: ([\w.]+)$", text_of(DOCS / "api.md"), re.MULTILINE)]
    assert None not in listed
    face = [getattr(hpgr, name) for name in hpgr.__all__]
    given = [inspect.getdoc(one) or "" for one in (*listed, *face) if not inspect.ismodule(one)]
    assert len(given) >= 20
    assert not [words for words in given if ">>> " not in words], "give these an Examples section"
    assert not [words for words in given if "+SKIP" in words], "these examples do not run"
