"""Make docs/api.md anew from the docstrings and tables of the package: `python docs/api.py`, in a second."""

import ast
import inspect
import re
import textwrap
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any, get_args

import hpgr
from hpgr import schema, units
from hpgr.scene import Scene

PAGE = Path(__file__).parent / "api.md"

# Modules whose public names are all listed, and single functions of others that a user calls.
MODULES = ("metrics", "machine", "calibration", "tables", "feed", "limits", "baselines")
STUDIES = (
    ("studies.sweep", "sweep"),
    ("studies", "open_cases"),
    ("studies.store", "write_dataset"),
    ("studies.store", "open_result"),
)

HEAD = """# API reference

Made from the docstrings by `python docs/api.py`; `tests/test_docs.py` asserts that it is up to date. Numbers are in
SI units; array shapes are in parentheses, such as (streamline, point). A field of a scene takes a number, or text with
a unit.

- [Scene fields](#scene-fields): everything that can be set or swept
- [Variables of a Dataset](#variables-of-a-dataset), and its [flags](#flags)
- [`hpgr`](#hpgr): what most users call
- [`studies`](#studies): sweeps and files
- {modules}
"""

FLAGS = {
    "no_breakage": "no grain broke: the product is the feed",
    "no_compaction": "the bed is not compacted: no pressure, and the product is the feed",
    "solid_fraction_capped": "mass continuity would need more than `max_solid_fraction` at the exit; held there",
    "single_particle_nipping": "grains above 1.5 gaps, which rolls nip singly; not modelled",
    "size_floor_reached": "part of the product is below the size floor, where nothing breaks",
    "few_cells": "2 or 3 cells, where every cell neighbours every other",
    "tension_clamped": "the elastic law asked for tension or reverse shear; stresses held at 0 there",
    "unusual_machine": "diameter, force, energy, gap or density outside the range of usual machines",
    "no_force_angle": "the bed takes more power than the force can give at any angle",
}


def page() -> str:
    """Return the whole page."""
    links = "\n- ".join(f"[`hpgr.{name}`](#hpgr{name})" for name in MODULES)
    parts = [HEAD.format(modules=links), scene_fields(), variables(), flags()]
    parts += ["## `hpgr`\n", *(entry(name, getattr(hpgr, name)) for name in hpgr.__all__)]
    parts += ["## `studies`\n", *(entry(f"{where}.{name}", thing) for where, name, thing in studies())]
    for name in MODULES:
        module = import_module(f"hpgr.{name}")
        parts += [f"## `hpgr.{name}`\n", prose(inspect.getdoc(module)) + "\n"]
        parts += [entry(f"{name}.{key}", thing) for key, thing in public(module) if key not in hpgr.__all__]
    return re.sub(r"\n{3,}", "\n\n", "\n".join(parts)).rstrip() + "\n"


def public(module: Any) -> Iterator[tuple[str, Any]]:
    """Yield the public functions and classes that a module defines, in the order of its text."""
    for name, thing in vars(module).items():
        own = getattr(thing, "__module__", None) == module.__name__
        if own and not name.startswith("_") and (inspect.isfunction(thing) or inspect.isclass(thing)):
            yield name, thing


def studies() -> Iterator[tuple[str, str, Any]]:
    """Yield module, name and function of what users call in `studies`, as far as it is there."""
    for where, name in STUDIES:
        thing = getattr(import_module(where), name, None)
        if thing is not None:
            yield where, name, thing


def listed() -> Iterator[tuple[str, Any]]:
    """Yield every function and class that the page describes, methods not."""
    yield from ((f"hpgr.{name}", getattr(hpgr, name)) for name in hpgr.__all__ if name != "presets")
    yield from ((f"{where}.{name}", thing) for where, name, thing in studies())
    for module in MODULES:
        yield from ((f"hpgr.{module}.{name}", thing) for name, thing in public(import_module(f"hpgr.{module}")))
    yield from (("hpgr.presets." + name, thing) for name, thing in public(hpgr.presets))


def entry(name: str, thing: Any) -> str:
    """Return the section of one function, class or module."""
    lines = [f"### `{name}{signature(thing)}`", ""]
    if inspect.ismodule(thing):
        lines += [prose(inspect.getdoc(thing)), ""]
        lines += [f"- `presets.{key}()`: {inspect.getdoc(made).splitlines()[0]}" for key, made in public(thing)]
        return "\n".join([*lines, "- `presets.DATA`: folder of the pilot tests and the feed, as CSV", ""])
    lines += [rendered(inspect.getdoc(thing)), ""]
    if hasattr(thing, "model_fields") and thing is not Scene:
        lines += [f"Its fields are in [Scene fields](#{thing.__name__.lower()}).", ""]
    if inspect.isclass(thing):
        if "Attributes\n---" not in inspect.getdoc(thing):
            lines += named_fields(thing)
        for key, method in vars(thing).items():
            method = getattr(method, "__func__", method)
            if not key.startswith("_") and inspect.isfunction(method) and method.__doc__:
                lines += [f"#### `{name}.{key}{signature(method)}`", "", rendered(inspect.getdoc(method)), ""]
    return "\n".join(lines)


def signature(thing: Any) -> str:
    """Return the parameters of a function as its text has them; nothing for a class or module."""
    if not inspect.isfunction(thing):
        return ""
    tree = ast.parse(textwrap.dedent(inspect.getsource(thing))).body[0]
    tree.args.args = [one for one in tree.args.args if one.arg not in ("self", "cls")]
    back = f" -> {ast.unparse(tree.returns)}" if tree.returns else ""
    return f"({ast.unparse(tree.args)}){back}"


def named_fields(thing: type) -> list[str]:
    """Return the fields of a NamedTuple with the comments beside them."""
    found = []
    for name in getattr(thing, "_fields", ()):
        match = re.search(rf"^    {name}: ([^#=\n]+?)(?: = [^#\n]*)?(?:  # (.*))?$", inspect.getsource(thing), re.M)
        kind, comment = match.groups() if match else ("", "")
        found.append(f"- `{name}`: {kind}" + (f" ({comment})" if comment else ""))
    return [*found, ""]


def prose(text: str) -> str:
    """Return text with its code in single backticks."""
    return text.replace("``", "`")


def rendered(doc: str) -> str:
    """Return a docstring in numpy's form as Markdown."""
    titled = re.split(r"^(\w[\w ]*)\n-{3,}\n", doc, flags=re.MULTILINE)
    parts = [prose(titled[0].strip())]
    for title, body in zip(titled[1::2], titled[2::2], strict=True):
        parts.append(f"**{title}**\n")
        if title.startswith("Example"):
            parts.append(f"```pycon\n{body.strip()}\n```")
        elif title in ("Notes", "See Also"):
            parts.append(prose(body.strip()))
        else:
            parts.append(items(body))
    return "\n\n".join(parts).replace("**\n\n\n", "**\n\n")


def items(body: str) -> str:
    """Return the entries of a section, each a heading and its indented text, as a list."""
    found: list[tuple[str, list[str]]] = []
    for line in body.strip().splitlines():
        if line.startswith(" ") and found:
            found[-1][1].append(line.strip())
        elif line.strip():
            found.append((line.strip(), []))
    return "\n".join(f"- `{head}`: {prose(' '.join(text))}" if text else f"- {prose(head)}" for head, text in found)


def table(heads: list[str], rows: list[list[str]]) -> str:
    """Return a Markdown table."""
    cells = [[str(cell).replace("|", "\\|") for cell in row] for row in rows]
    lines = [heads, ["---"] * len(heads), *cells]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def scene_fields() -> str:
    """Return the tables of every field of a scene, part by part."""
    parts = ["## Scene fields", "", "A sweep's axis, or a key of `Scene.with_values`, is `part.field`, such as "
             "`rolls.gap`. In a scene file the part is a table: `[rolls]`, then `gap = \"19 mm\"`.", ""]  # fmt: skip
    heads = ["field", "symbol", "unit", "default", "bounds", "meaning", "source"]
    for name, holder in Scene.model_fields.items():
        kind = next(
            (one for one in (holder.annotation, *get_args(holder.annotation)) if hasattr(one, "model_fields")), 0
        )
        if not kind:
            continue
        rows = [field_row(f"{name}.{key}", field) for key, field in kind.model_fields.items()]
        words = prose(inspect.getdoc(kind).split("\n\nExamples\n")[0])
        parts += [f"### `{kind.__name__}`", "", f"`{name}`: {words}", "", table(heads, rows)]
    return "\n".join(parts)


def field_row(name: str, field: Any) -> list[str]:
    """Return what the table says of one field."""
    extra = field.json_schema_extra or {}
    unit = extra.get("unit", "1")
    meaning = field.description
    if extra:
        meaning = meaning.removesuffix(f" ({extra['symbol']}, {unit}). Source: {extra['source']}.")
    return [
        f"`{name}`", f"`{extra['symbol']}`" if extra else "", unit if unit != "1" else "", default(field, unit),
        bounds(field), meaning, extra.get("source", ""),
    ]  # fmt: skip


def default(field: Any, unit: str) -> str:
    """Return a field's default as a person writes it."""
    if field.is_required():
        return "required"
    value = field.default
    if isinstance(value, tuple):
        return f"{len(value)} values, {units.show(value[0], unit)} to {units.show(value[-1], unit)}"
    if isinstance(value, bool) or not isinstance(value, int | float):
        return "none" if value is None else f"`{value!r}`"
    return units.show(value, unit)


def bounds(field: Any) -> str:
    """Return a field's bounds in its unit, or its words."""
    words = [one for kind in (field.annotation, *get_args(field.annotation)) for one in get_args(kind)]
    words = [repr(one) for one in (*words, *get_args(field.annotation)) if isinstance(one, str)]
    if words:
        return ", ".join(f"`{word}`" for word in dict.fromkeys(words))
    signs = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}
    found = [f"{sign} {getattr(one, key):g}" for one in field.metadata for key, sign in signs.items()
             if hasattr(one, key)]  # fmt: skip
    return ", ".join(found)


def variables() -> str:
    """Return the table of every coordinate and variable."""
    heads = ["name", "dims", "units", "stored as", "meaning"]
    text = (
        "## Variables of a Dataset\n\n`hpgr.simulate` returns those that the scene asks for; a sweep those without "
        "point, cell and time, with its axes and `replicate` before the dims given here, and `status`, `message` and "
        "`notes` besides. In files `time` is called `photograph` ([files.md](files.md)).\n"
    )
    for title, known in (("Coordinates", schema.COORDINATES), ("Variables", schema.VARIABLES)):
        rows = [[f"`{name}`", ", ".join(one.dims) or "-", one.units, one.dtype.__name__, one.long_name]
                for name, one in known.items()]  # fmt: skip
        text += f"\n### {title}\n\n{table(heads, rows)}"
    return text


def flags() -> str:
    """Return the table of flags."""
    rows = [[f"`{name}`", str(bit), FLAGS.get(name, "see `notes`")] for name, bit in schema.FLAGS.items()]
    about = (
        "`flags` is a bit mask, the sum of what was hit; `notes` (an attribute of `hpgr.simulate`'s Dataset, a "
        "variable of a sweep's) says each in words with its figures.\n"
    )
    return f"### Flags\n\n{about}\n{table(['flag', 'bit', 'meaning'], rows)}"


def main() -> int:
    """Write the page."""
    PAGE.write_text(page(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
