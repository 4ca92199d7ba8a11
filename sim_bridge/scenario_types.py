"""Number ranges and names that the tables of a scenario file share."""

from __future__ import annotations

from typing import Annotated, TypeAlias

from msgspec import Meta, Struct

Coordinate = Annotated[float, Meta(ge=-1e3, le=1e3)]
Point: TypeAlias = tuple[Coordinate, Coordinate, Coordinate]
Positive = Annotated[float, Meta(gt=0.0, le=1e4)]
NonNegative = Annotated[float, Meta(ge=0.0, le=1e4)]
Probability = Annotated[float, Meta(ge=0.0, le=1.0)]
Degrees = Annotated[float, Meta(ge=-360.0, le=360.0)]
Name = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_-]{1,32}$")]
Tick = Annotated[int, Meta(ge=0, le=10_000_000)]


class Table(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One table of the file: frozen, and a key that it does not know is an error."""
