"""docs/reference/configuration.md: every key of the daemon, from its types and from configs/default.toml.

The types say what a value may be; what a key means is said by the comment behind it in `configs/default.toml`, or,
where there is none, by the one behind the field.
"""

from __future__ import annotations

import re
from pathlib import Path

import msgspec

from companion.config import PRESETS, Config
from docgen.pages import table
from docgen.structs import Field, Struct, fields_of, tables_in

DEFAULT_FILE = Path(__file__).parents[2] / "configs" / "default.toml"
_SECTION = re.compile(r"^\[(?P<name>[\w.]+)\]\s*(?:#\s*(?P<comment>.*))?$")
_KEY = re.compile(r"^(?:# )?(?P<key>[a-z_0-9]+) =(?P<rest>.*)$")


def sections() -> dict[str, Struct]:
    """Every table of the file by its dotted name, the top one under ""."""
    found: dict[str, Struct] = {"": Config}

    def walk(prefix: str, struct: Struct) -> None:
        for field in fields_of(struct):
            for inner in tables_in(field.type):
                name = f"{prefix}.{field.name}" if prefix else field.name
                found[name] = inner
                walk(name, inner)

    walk("", Config)
    return found


def comments(text: str) -> dict[str, str]:
    """What `configs/default.toml` says behind each section and each key, by dotted name.

    >>> comments('a = 1  # one\\n[b]  # table\\n# c =  # none')
    {'a': 'one', 'b': 'table', 'b.c': 'none'}
    """
    found: dict[str, str] = {}
    section = ""
    for line in text.splitlines():
        if head := _SECTION.match(line):
            section = head["name"]
            found[section] = head["comment"] or ""
        elif key := _KEY.match(line):
            name = f"{section}.{key['key']}" if section else key["key"]
            found[name] = _after_value(key["rest"])
    return found


def meanings() -> dict[str, str]:
    """The meaning of every key, by dotted name."""
    said = comments(DEFAULT_FILE.read_text(encoding="utf-8"))
    found = {}
    for section, struct in sections().items():
        for field in fields_of(struct):
            if not list(tables_in(field.type)):
                name = f"{section}.{field.name}" if section else field.name
                found[name] = said.get(name) or field.comment
    return found


def page() -> str:
    """The tables of all sections."""
    said, meaning = comments(DEFAULT_FILE.read_text(encoding="utf-8")), meanings()
    blocks = []
    for section, struct in sections().items():
        keys = [field for field in fields_of(struct) if not list(tables_in(field.type))]
        if not keys:
            continue
        blocks.append(f"## `[{section}]`" if section else "## At the top of the file")
        if about := _about(struct, said.get(section, "")):
            blocks.append(about)
        blocks.append(_keys(section, keys, meaning))
    return "\n\n".join(blocks)


def presets() -> str:
    """What `preset = "paper"` sets, beside the defaults."""
    rows = []
    for section, tables in PRESETS.items():
        default = getattr(Config(), section)
        for name, values in tables.items():
            for key, value in values.items():
                shown = tuple(_plain(each) for each in (value, getattr(default, key)))
                rows.append((f'`[{section}]` `preset = "{name}"`', f"`{key}`", *shown))
    return table(("section", "key", "preset", "default"), rows)


def _keys(section: str, keys: list[Field], meaning: dict[str, str]) -> str:
    rows = []
    for field in keys:
        name = f"{section}.{field.name}" if section else field.name
        default = field.default if field.default == "unset" else f"`{field.default}`"
        rows.append((f"`{field.name}`", field.kind, default, _tidy(meaning[name])))
    return table(("key", "value", "default", "meaning"), rows)


def _about(struct: Struct, comment: str) -> str:
    said = (struct.__doc__ or "").strip()
    own = "" if said == (struct.__base__.__doc__ or "").strip() else said
    return _sentence(comment or own.replace("``", "`"))


def _sentence(text: str) -> str:
    text = " ".join(text.split())
    if not text:
        return ""
    return text[0].upper() + text[1:] + ("" if text.endswith(".") else ".")


def _tidy(text: str) -> str:
    return text.replace("None:", "unset:").replace("``", "`").replace("<", "\\<")


def _plain(value: object) -> str:
    return f"`{msgspec.json.encode(value).decode()}`"


def _after_value(rest: str) -> str:
    """The comment of a TOML line; a # within quotes is none."""
    bare = re.sub(r'"[^"]*"', lambda match: "_" * len(match[0]), rest)
    at = bare.find("#")
    return "" if at < 0 else rest[at + 1 :].strip()
