"""The tables of api.md, made when the site is built: the fields of a scene, the variables of a Dataset, the flags."""

import inspect
from collections.abc import Iterable
from typing import Any, get_args

from hpgr.fields import kinds_of, meanings, parts_of, show
from hpgr.results import flags, schema
from hpgr.scene import Scene

SIGNS = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Put the tables in their places; mkdocs calls this for every page."""
    for place, made in {"scene fields": scene_fields, "variables": variables, "flags": flag_table}.items():
        if f"<!-- {place} -->" in markdown:
            markdown = markdown.replace(f"<!-- {place} -->", made())
    return markdown


def table(heads: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a Markdown table."""
    cells = [[str(cell).replace("|", "\\|") for cell in row] for row in rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in [heads, ["---"] * len(heads), *cells]) + "\n"


def scene_fields() -> str:
    """Return a table for each section of a scene, or for each law it may hold."""
    heads = ["field", "symbol", "unit", "default", "bounds", "meaning", "source"]
    parts = []
    for section, holder in Scene.model_fields.items():
        for part in parts_of(holder):
            kind = "".join(f", kind `{kind}`" for kind in kinds_of(part))
            about = inspect.getdoc(part).split("\n\n")[0].replace("``", "`").replace("\n", " ")
            rows = [
                field_row(f"{section}.{key}", field, meanings(part)[key])
                for key, field in part.model_fields.items()
                if key != "kind"
            ]
            parts += [f"### `{section}`{kind}", about, table(heads, rows)]
    return "\n\n".join(parts)


def field_row(name: str, field: Any, meaning: str) -> list[str]:
    """Return what the table says of one field."""
    extra = field.json_schema_extra or {}
    unit, symbol = extra.get("unit", "1"), extra.get("symbol")
    shown = [f"`{name}`", f"`{symbol}`" if symbol else "", unit.replace("1", "") if unit == "1" else unit]
    return [*shown, default(field, unit), bounds(field), meaning, extra.get("source", "")]


def default(field: Any, unit: str) -> str:
    """Return a field's default as a person writes it."""
    value = field.default
    if field.is_required():
        return "required"
    if isinstance(value, tuple):
        return f"{len(value)} values, {show(value[0], unit)} to {show(value[-1], unit)}"
    if isinstance(value, bool) or not isinstance(value, int | float):
        return "none" if value is None else f"`{value!r}`"
    return show(value, unit)


def bounds(field: Any) -> str:
    """Return a field's bounds in its SI unit, or the words it takes."""
    kinds = (field.annotation, *get_args(field.annotation))
    words = dict.fromkeys(word for kind in kinds for word in get_args(kind) if isinstance(word, str))
    limits = [
        f"{sign} {getattr(one, key):g}" for one in field.metadata for key, sign in SIGNS.items() if hasattr(one, key)
    ]
    return ", ".join([*(f"`{word!r}`" for word in words), *limits])


def variables() -> str:
    """Return the tables of coordinates and variables."""
    heads = ["name", "dims", "units", "stored as", "meaning"]
    text = ""
    for title, known in (("Coordinates", schema.COORDINATES), ("Variables", schema.VARIABLES)):
        rows = [
            [f"`{name}`", ", ".join(one.dims), one.units, one.dtype.__name__, "; ".join(filter(None, one[2:4]))]
            for name, one in known.items()
        ]
        text += f"### {title}\n\n{table(heads, rows)}\n"
    return text


def flag_table() -> str:
    """Return the table of flags."""
    return table(["flag", "bit", "meaning"], [[f"`{flag.name}`", flag.bit, flag.meaning] for flag in flags.FLAGS])
