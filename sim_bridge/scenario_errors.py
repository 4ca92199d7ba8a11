"""msgspec's complaints as one line ``key: what was expected``."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import msgspec

_AT = re.compile(r"^(?P<text>.*) - at `(?:key` in `)?\$(?P<path>.*)`$", re.DOTALL)
_STEP = re.compile(r"\.([A-Za-z0-9_]+)|\[(?:\d+|\.\.\.)\]")


def pointed(message: str, root: type) -> str:
    """``Expected `float`... - at `$.end.reach_m` `` -> ``end.reach_m: Expected `float`...``.

    Where a word is none of those allowed, they are looked up in the JSON Schema of ``root``, which msgspec decoded.
    """
    match = _AT.match(message)
    if match is None:
        return message
    text, path = match["text"], match["path"]
    if text.startswith("Invalid enum value"):
        given = text.removeprefix("Invalid enum value ")
        text = f"expected one of {', '.join(dict.fromkeys(_choices(root, path)))}, got {given}"
    return f"{path.lstrip('.')}: {text}" if path else text


def _choices(root: type, path: str) -> Iterator[str]:
    """The words that the schema allows at ``path``."""
    (schema,), definitions = msgspec.json.schema_components([root], ref_template="{name}")
    found = [schema]
    for step in _STEP.finditer(path):
        found = [inner for outer in found for inner in _inside(outer, step[1], definitions)]
    for place in found:
        for variant in _variants(place, definitions):
            yield from (str(word) for word in variant.get("enum", ()))


def _inside(schema: dict[str, Any], key: str | None, definitions: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for variant in _variants(schema, definitions):
        if key is None and isinstance(variant.get("items"), dict):
            yield variant["items"]
        elif key is not None and key in variant.get("properties", {}):
            yield variant["properties"][key]


def _variants(schema: dict[str, Any], definitions: dict[str, Any]) -> Iterator[dict[str, Any]]:
    if "$ref" in schema:
        yield from _variants(definitions[schema["$ref"]], definitions)
    elif "anyOf" in schema:
        for each in schema["anyOf"]:
            yield from _variants(each, definitions)
    else:
        yield schema
