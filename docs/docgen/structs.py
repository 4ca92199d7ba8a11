"""msgspec structs as tables: every field with its type, range and default, and what its comment in the source says."""

from __future__ import annotations

import ast
import inspect
import io
import json
import textwrap
import tokenize
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import msgspec
from msgspec.inspect import (
    BoolType,
    CollectionType,
    DictType,
    FloatType,
    IntType,
    ListType,
    LiteralType,
    Metadata,
    NoneType,
    StrType,
    StructType,
    TupleType,
    Type,
    UnionType,
    VarTupleType,
)

Struct = type[msgspec.Struct]


@dataclass(frozen=True, slots=True)
class Field:
    """One key: ``kind`` in words, ``default`` as TOML (empty where it must be stated), ``comment`` from the source."""

    name: str
    kind: str
    default: str
    comment: str
    type: Type


def fields_of(struct: Struct) -> list[Field]:
    """The fields of a struct, in their order; those that are tables themselves among them."""
    info = msgspec.inspect.type_info(struct)
    assert isinstance(info, StructType)
    comments = _comments(struct)
    return [
        Field(field.encode_name, words(field.type), _default(field), comments.get(field.name, ""), field.type)
        for field in info.fields
    ]


def tables_in(kind: Type) -> Iterator[Struct]:
    """The structs that a field's value may be."""
    kind = _bare(kind)
    if isinstance(kind, StructType):
        yield kind.cls
    elif isinstance(kind, UnionType):
        for each in kind.types:
            yield from tables_in(each)
    elif isinstance(kind, CollectionType):
        yield from tables_in(kind.item_type)


def words(kind: Type) -> str:
    """A type in words: ``number > 0``, ``"a" or "b"``, ``list of strings``."""
    kind = _bare(kind)
    if isinstance(kind, UnionType):
        return " or ".join(words(each) for each in kind.types if not isinstance(each, NoneType))
    if isinstance(kind, LiteralType):
        return " or ".join(f"`{_toml(value)}`" for value in kind.values)
    if isinstance(kind, BoolType):
        return "`true` or `false`"
    if isinstance(kind, FloatType | IntType):
        return _number(kind)
    if isinstance(kind, StrType):
        return _string(kind)
    if isinstance(kind, TupleType):
        return _tuple(kind)
    if isinstance(kind, VarTupleType | ListType | CollectionType):
        count = "" if kind.max_length is None else f" of at most {kind.max_length}"
        if kind.min_length:
            count = f" of {kind.min_length} or more" if not count else f" of {kind.min_length} to {kind.max_length}"
        return f"list{count}: {words(kind.item_type)}"
    if isinstance(kind, DictType):
        return f"table of {words(kind.value_type)}"
    if isinstance(kind, StructType):
        return f"table {kind.cls.__name__}"
    return type(kind).__name__.removesuffix("Type").lower()


def _bare(kind: Type) -> Type:
    return kind.type if isinstance(kind, Metadata) else kind


def _number(kind: FloatType | IntType) -> str:
    name = "whole number" if isinstance(kind, IntType) else "number"
    low, high = (kind.gt if kind.ge is None else kind.ge), (kind.lt if kind.le is None else kind.le)
    if low is None and high is None:
        return name
    left = f"({low:g}" if kind.ge is None else f"[{low:g}"
    right = f"{high:g})" if kind.le is None else f"{high:g}]"
    return f"{name} in {left}, {right}"


def _string(kind: StrType) -> str:
    if kind.pattern is not None:
        return f"string `{kind.pattern}`"
    if kind.max_length is not None:
        return f"string of {kind.min_length or 0} to {kind.max_length} characters"
    return "string"


def _tuple(kind: TupleType) -> str:
    each = [words(item) for item in kind.item_types]
    if len(set(each)) == 1:
        return f"[{len(each)} of: {each[0]}]"
    return f"[{', '.join(each)}]"


def _default(field: msgspec.inspect.Field) -> str:
    value: Any = field.default
    if value is msgspec.NODEFAULT:
        if field.default_factory is msgspec.NODEFAULT:
            return ""
        value = field.default_factory()
    return "unset" if value is None else _toml(value)


def _toml(value: Any) -> str:
    """A value as TOML writes it."""
    if isinstance(value, msgspec.Struct | dict):
        return "" if isinstance(value, msgspec.Struct) else "{}"
    if isinstance(value, tuple | list):
        return f"[{', '.join(_toml(item) for item in value)}]"
    return repr(value) if isinstance(value, float) else json.dumps(value)


@cache
def _comments(struct: Struct) -> dict[str, str]:
    """The comment that stands behind each field in the source, of the struct and those it extends."""
    found: dict[str, str] = {}
    for base in reversed(struct.__mro__):
        if base is msgspec.Struct or not issubclass(base, msgspec.Struct):
            continue
        source = textwrap.dedent(inspect.getsource(base))
        by_line = {
            token.start[0]: token.string.lstrip("# ")
            for token in tokenize.generate_tokens(io.StringIO(source).readline)
            if token.type == tokenize.COMMENT
        }
        body = ast.parse(source).body[0]
        assert isinstance(body, ast.ClassDef)
        for node in body.body:
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                lines = range(node.lineno, (node.end_lineno or node.lineno) + 1)
                found[node.target.id] = " ".join(by_line[line] for line in lines if line in by_line)
    return found
