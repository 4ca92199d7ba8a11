"""What the sections of the configuration have in common: their base, and bounded numbers and names."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta, Struct

Positive = Annotated[float, Meta(gt=0.0, le=1e6)]
NonNegative = Annotated[float, Meta(ge=0.0, le=1e6)]
Acceleration = Annotated[float, Meta(gt=0.0, le=1e3)]  # what a setpoint on the wire may hold
Coordinate = Annotated[float, Meta(ge=-1e4, le=1e4)]
Name = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_-]{1,32}$")]
SourceName = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_-]{1,128}$")]
Stay = Annotated[float, Meta(gt=0.34, lt=1.0)]
Point = tuple[Coordinate, Coordinate, Coordinate]


class Section(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A table of the file."""
