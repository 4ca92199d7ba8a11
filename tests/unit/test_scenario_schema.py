"""The printed JSON Schema, read by a validator of our own test: it accepts what ships and refuses what is wrong."""

from __future__ import annotations

import io
import json
import re
import tomllib
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import pytest

from sim_bridge.cli import main
from sim_bridge.scenario import scenario_names

TYPES: dict[str, type | tuple[type, ...]] = {
    "object": dict,
    "array": list,
    "string": str,
    "boolean": bool,
    "null": type(None),
    "integer": int,
    "number": (int, float),
}
KNOWN = {
    *("$ref", "$defs", "$schema", "title", "description", "default", "discriminator", "type", "anyOf", "enum"),
    *("const", "minimum", "maximum", "exclusiveMinimum", "pattern", "minLength", "maxLength", "properties"),
    *("required", "additionalProperties", "propertyNames", "items", "prefixItems", "minItems", "maxItems"),
}


@pytest.fixture(scope="module")
def schema() -> dict[str, Any]:
    with redirect_stdout(io.StringIO()) as printed:
        assert main(["schema"]) == 0
    text = printed.getvalue()
    decoded: dict[str, Any] = json.loads(text)
    return decoded


def valid(value: Any, schema: dict[str, Any], root: dict[str, Any]) -> bool:
    """JSON Schema 2020-12, the keywords that occur here; any other fails the test."""
    assert schema.keys() <= KNOWN, schema.keys() - KNOWN
    if "$ref" in schema:
        return valid(value, root["$defs"][schema["$ref"].removeprefix("#/$defs/")], root)
    if "anyOf" in schema:
        return any(valid(value, each, root) for each in schema["anyOf"])
    if "enum" in schema and value not in schema["enum"]:
        return False
    if "const" in schema and value != schema["const"]:
        return False
    kind = schema.get("type")
    number_like = isinstance(value, bool) and kind in ("integer", "number")
    if kind is not None and (number_like or not isinstance(value, TYPES[kind])):
        return False
    if isinstance(value, str):
        return re.search(schema.get("pattern", ""), value) is not None and schema.get("minLength", 0) <= len(
            value
        ) <= schema.get("maxLength", 10**9)
    if isinstance(value, int | float) and not isinstance(value, bool):
        above = "exclusiveMinimum" not in schema or value > schema["exclusiveMinimum"]
        return above and schema.get("minimum", value) <= value <= schema.get("maximum", value)
    if isinstance(value, list):
        return valid_array(value, schema, root)
    return valid_object(value, schema, root) if isinstance(value, dict) else True


def valid_array(value: list[Any], schema: dict[str, Any], root: dict[str, Any]) -> bool:
    if not schema.get("minItems", 0) <= len(value) <= schema.get("maxItems", 10**9):
        return False
    heads = schema.get("prefixItems", [])
    rest = schema.get("items", True)
    if not all(valid(item, head, root) for item, head in zip(value, heads, strict=False)):
        return False
    tail = value[len(heads) :]
    return not tail if rest is False else rest is True or all(valid(item, rest, root) for item in tail)


def valid_object(value: dict[str, Any], schema: dict[str, Any], root: dict[str, Any]) -> bool:
    known = schema.get("properties", {})
    more = schema.get("additionalProperties", True)
    names = schema.get("propertyNames", {})
    return (
        all(key in value for key in schema.get("required", ()))
        and all(valid(key, names, root) for key in value)
        and all(valid(item, known[key], root) for key, item in value.items() if key in known)
        and all(more if isinstance(more, bool) else valid(value[key], more, root) for key in value if key not in known)
    )


@pytest.mark.parametrize("path", scenario_names().values(), ids=lambda path: path.stem)
def test_shipped_files_are_valid(path: Path, schema: dict[str, Any]) -> None:
    assert valid(tomllib.loads(path.read_text()), schema, schema)


@pytest.mark.parametrize(
    "wrong",
    [
        {"typo": 1},
        {"physics_hz": 0},
        {"physics_hz": True},
        {"vehicle": {"start": [0.0, 0.0]}},
        {"vehicle": {"name": "a/b"}},
        {"vehicle": {"personality": "betaflight"}},
        {"vehicle": {"parameters": {"lower": 1}}},
        {"obstacles": [{"id": "a", "motion": "zigzag", "origin": [0, 0, 0]}]},
        {"obstacles": [{"id": "a", "motion": "linear", "origin": [0, 0, 0]}]},
        {"obstacles": [{"id": "a", "motion": "linear", "origin": [0, 0, 0], "velocity": [1, 0, 0], "speed_m_s": 1}]},
        {"sensors": [{"dropout": 1.5}]},
        {"physics": {"wind": {"gusts": "strong"}}},
        {"faults": [{"what": "drop"}]},
        {"faults": [{"what": "drop", "on": "onboard", "expect": {"state": "DONE"}}]},
        {"expect": {"never_state": ["NONE"]}},
    ],
)
def test_wrong_files_are_not(wrong: dict[str, Any], schema: dict[str, Any]) -> None:
    assert not valid(wrong, schema, schema)
