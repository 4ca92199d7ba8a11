"""The messages that Foxglove draws without set-up: its published schemas as structs, encoded as JSON.

Field names, enumerations and what is required are those of schemas/jsonschema in github.com/foxglove/foxglove-sdk.
Positions are in the frame ``local_enu`` [m], quaternions (x, y, z, w), colours 0..1.
"""

from __future__ import annotations

from typing import Any

import msgspec
from msgspec import Struct

from companion.types import NS_PER_S

WORLD, BODY = "local_enu", "base_link"


class Time(Struct, frozen=True):
    sec: int
    nsec: int


class Duration(Struct, frozen=True):
    sec: int
    nsec: int


class Vector3(Struct, frozen=True):
    x: float
    y: float
    z: float


class Point3(Struct, frozen=True):
    x: float
    y: float
    z: float


class Quaternion(Struct, frozen=True):
    x: float
    y: float
    z: float
    w: float


class Color(Struct, frozen=True):
    r: float
    g: float
    b: float
    a: float


class Pose(Struct, frozen=True):
    position: Vector3
    orientation: Quaternion


class KeyValuePair(Struct, frozen=True):
    key: str
    value: str


class ArrowPrimitive(Struct, frozen=True, kw_only=True):
    """Along +x of its pose, the tail at its position."""

    pose: Pose
    shaft_length: float
    shaft_diameter: float
    head_length: float
    head_diameter: float
    color: Color


class SpherePrimitive(Struct, frozen=True, kw_only=True):
    """``size``: the diameters along the axes of its pose, so an ellipsoid as well."""

    pose: Pose
    size: Vector3
    color: Color


class CubePrimitive(Struct, frozen=True, kw_only=True):
    pose: Pose
    size: Vector3
    color: Color


class LinePrimitive(Struct, frozen=True, kw_only=True):
    """``type``: 0 strip, 1 loop, 2 list of pairs."""

    type: int
    pose: Pose
    thickness: float
    scale_invariant: bool
    points: list[Point3]
    color: Color
    colors: list[Color] = []
    indices: list[int] = []


class TextPrimitive(Struct, frozen=True, kw_only=True):
    pose: Pose
    billboard: bool
    font_size: float
    scale_invariant: bool
    color: Color
    text: str


class SceneEntity(Struct, frozen=True, kw_only=True):
    """What is drawn together; replaces the entity of the same ``id``. ``lifetime`` 0: for ever."""

    timestamp: Time
    frame_id: str
    id: str
    lifetime: Duration
    frame_locked: bool = False
    metadata: list[KeyValuePair] = []
    arrows: list[ArrowPrimitive] = []
    cubes: list[CubePrimitive] = []
    spheres: list[SpherePrimitive] = []
    cylinders: list[dict[str, Any]] = []
    lines: list[LinePrimitive] = []
    triangles: list[dict[str, Any]] = []
    texts: list[TextPrimitive] = []
    models: list[dict[str, Any]] = []


class SceneEntityDeletion(Struct, frozen=True, kw_only=True):
    """``type``: 0 the entity of this id, 1 all."""

    timestamp: Time
    type: int
    id: str


class SceneUpdate(Struct, frozen=True, kw_only=True):
    deletions: list[SceneEntityDeletion] = []
    entities: list[SceneEntity]


class FrameTransform(Struct, frozen=True, kw_only=True):
    timestamp: Time
    parent_frame_id: str
    child_frame_id: str
    translation: Vector3
    rotation: Quaternion


class PosesInFrame(Struct, frozen=True, kw_only=True):
    timestamp: Time
    frame_id: str
    poses: list[Pose]


class LocationFix(Struct, frozen=True, kw_only=True):
    """``position_covariance``: ENU, by rows [m^2]; its type: 0 unknown, 1 approximated, 2 diagonal known, 3 known."""

    timestamp: Time
    frame_id: str
    latitude: float
    longitude: float
    altitude: float
    position_covariance: list[float] = msgspec.field(default_factory=lambda: [0.0] * 9)
    position_covariance_type: int = 0


class Log(Struct, frozen=True, kw_only=True):
    """``level``: 0 unknown, 1 debug, 2 info, 3 warning, 4 error, 5 fatal."""

    timestamp: Time
    level: int
    message: str
    name: str
    file: str = ""
    line: int = 0


TOPICS: dict[str, type[Struct]] = {
    "/foxglove/tf": FrameTransform,
    "/foxglove/scene": SceneUpdate,
    "/foxglove/path": PosesInFrame,
    "/foxglove/location": LocationFix,
    "/foxglove/log": Log,
}

_LEVELS = (5, 5, 5, 4, 3, 2, 2, 1)  # by MAV_SEVERITY: emergency, alert, critical, error, warning, notice, info, debug


def schema_of(kind: type[Struct]) -> tuple[str, dict[str, Any]]:
    """The name that Foxglove knows, and a JSON Schema without references (it follows none)."""
    return f"foxglove.{kind.__name__}", inlined(msgspec.json.schema(kind), "foxglove.")


def inlined(schema: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """A JSON Schema with each reference replaced by what it refers to; titles of its types get ``prefix``."""
    definitions = schema.get("$defs", {})

    def resolved(node: Any) -> Any:
        if isinstance(node, list):
            return [resolved(item) for item in node]
        if not isinstance(node, dict):
            return node
        if "$ref" in node:
            return resolved(definitions[node["$ref"].rpartition("/")[2]])
        out = {key: resolved(value) for key, value in node.items() if key != "$defs"}
        title = out.get("title")
        if isinstance(title, str) and prefix:
            out["title"] = title.lower() if title in ("Time", "Duration") else prefix + title
        return out

    found: dict[str, Any] = resolved(schema)
    return found


def time_of(stamp_ns: int) -> Time:
    """A vehicle time; none is before zero.

    >>> time_of(1_500_000_000)
    Time(sec=1, nsec=500000000)
    """
    return Time(*divmod(max(0, stamp_ns), NS_PER_S))


def log_of(stamp_ns: int, severity: int, text: str, name: str) -> Log:
    """A STATUSTEXT; ``severity`` is a MAV_SEVERITY."""
    return Log(timestamp=time_of(stamp_ns), level=_LEVELS[min(max(severity, 0), 7)], message=text, name=name)
