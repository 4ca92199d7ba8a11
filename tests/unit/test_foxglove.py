"""What Foxglove is given, against its published schemas; the table below was written by hand from
schemas/jsonschema in github.com/foxglove/foxglove-sdk, not made from our structs."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from companion import foxglove as fox
from companion.config import Config
from companion.link.geo import TangentPlane
from companion.link.wire import MarginOut, RowOut, SetpointRecord, TrackOut, TracksOut, VehicleOut, encode
from companion.record import Recorder
from companion.scene import Artist, Moment, ellipsoid, location, scene, transform

# every field is required; a list holds items of its one type, a tuple of numbers is an enumeration
TIME = {"sec": "time", "nsec": "nsec"}
DURATION = {"sec": int, "nsec": "nsec"}
VECTOR = {"x": float, "y": float, "z": float}
QUATERNION = {**VECTOR, "w": float}
POSE = {"position": VECTOR, "orientation": QUATERNION}
COLOR = {"r": "unit", "g": "unit", "b": "unit", "a": "unit"}
ARROW = {"pose": POSE, "shaft_length": float, "shaft_diameter": float, "head_length": float, "head_diameter": float}
ENTITY = {
    "timestamp": TIME,
    "frame_id": str,
    "id": str,
    "lifetime": DURATION,
    "frame_locked": bool,
    "metadata": [{"key": str, "value": str}],
    "arrows": [{**ARROW, "color": COLOR}],
    "cubes": [{"pose": POSE, "size": VECTOR, "color": COLOR}],
    "spheres": [{"pose": POSE, "size": VECTOR, "color": COLOR}],
    "cylinders": [],
    "lines": [
        {
            "type": (0, 1, 2),
            "pose": POSE,
            "thickness": float,
            "scale_invariant": bool,
            "points": [VECTOR],
            "color": COLOR,
            "colors": [COLOR],
            "indices": [int],
        }
    ],
    "triangles": [],
    "texts": [
        {
            "pose": POSE,
            "billboard": bool,
            "font_size": float,
            "scale_invariant": bool,
            "color": COLOR,
            "text": str,
        }
    ],
    "models": [],
}
PUBLISHED: dict[str, dict[str, Any]] = {
    "foxglove.FrameTransform": {
        "timestamp": TIME,
        "parent_frame_id": str,
        "child_frame_id": str,
        "translation": VECTOR,
        "rotation": QUATERNION,
    },
    "foxglove.SceneUpdate": {"deletions": [{"timestamp": TIME, "type": (0, 1), "id": str}], "entities": [ENTITY]},
    "foxglove.PosesInFrame": {"timestamp": TIME, "frame_id": str, "poses": [POSE]},
    "foxglove.LocationFix": {
        "timestamp": TIME,
        "frame_id": str,
        "latitude": float,
        "longitude": float,
        "altitude": float,
        "position_covariance": [float],
        "position_covariance_type": (0, 1, 2, 3),
    },
    "foxglove.Log": {
        "timestamp": TIME,
        "level": (0, 1, 2, 3, 4, 5),
        "message": str,
        "name": str,
        "file": str,
        "line": int,
    },
}


def check(value: Any, kind: Any, at: str) -> None:
    """Whether ``value`` is what the table says."""
    if isinstance(kind, dict):
        assert isinstance(value, dict), at
        assert value.keys() == kind.keys(), at
        for name, part in kind.items():
            check(value[name], part, f"{at}.{name}")
    elif isinstance(kind, list):
        assert isinstance(value, list), at
        assert kind or not value, at
        for index, item in enumerate(value):
            check(item, kind[0], f"{at}[{index}]")
    elif isinstance(kind, tuple):
        assert value in kind, at
    elif kind == "time":
        assert type(value) is int and value >= 0, at  # noqa: PT018
    elif kind == "nsec":
        assert type(value) is int and 0 <= value < 1_000_000_000, at  # noqa: PT018
    elif kind == "unit":
        assert 0.0 <= value <= 1.0, at
    elif kind is float:
        assert isinstance(value, int | float) and math.isfinite(value), at  # noqa: PT018
    else:
        assert type(value) is kind, at


def moment() -> Moment:
    margin = MarginOut(radii=0.4, cushion=0.1, sigma=0.3, delay=0.05)
    row = RowOut(track="cam/ball", step=3, slack=0.0, margin=margin, epsilon=0.5, epsilon_star=0.0)
    record = SetpointRecord(
        stamp_ns=1_500_000_000,
        sent=True,
        messages=1,
        state="ACTIVE",
        verdict="adjusted",
        u_ref=(3.0, 0.0, 0.0),
        u_safe=(-1.0, 2.0, 0.5),
        wire=(-1.0, 2.0, 0.5),
        rows=[row],
        worst=row,
        disturbance=(0.0, 0.0, 0.0),
        tracks=2,
        timings_ms={"total": 1.0},
    )
    covariance = np.diag([0.04, 0.01, 0.09, 1.0, 1.0, 1.0])[np.triu_indices(6)].tolist()
    track = TrackOut(
        id="cam/ball",
        position=(2.0, 1.0, 2.0),
        velocity=(0.0, 1.0, 0.0),
        acceleration=(0.0, 0.0, 0.0),
        radius=0.2,
        covariance=covariance,
        mode_probabilities=(0.5, 0.3, 0.2),
        predicted=[(2.0, 1.0 + 0.05 * k, 2.0) for k in range(23)],
        status="confirmed",
        sources=["cam"],
        surprise=1.0,
        growth=1.0,
    )
    vehicle = VehicleOut(
        stamp_ns=1_500_000_000, position=(1.0, 2.0, 3.0), velocity=(0, 0, 0), attitude=(0.6, 0, 0, 0.8)
    )
    tracks = TracksOut(stamp_ns=1_500_000_000, tracks=[track])
    arena = ((-10.0, -10.0, 0.0), (10.0, 10.0, 8.0))
    return Moment(vehicle, record, tracks, (6.0, 0.0, 2.0), 0.2, arena, TangentPlane(47.0, 8.0, 400.0))


def entity(name: str) -> dict[str, Any]:
    drawn = json.loads(encode(scene(moment())))
    found: dict[str, Any] = next(one for one in drawn["entities"] if one["id"] == name)
    return found


def test_every_message_is_what_foxglove_publishes() -> None:
    messages = [*Artist().draw(moment()), ("/foxglove/log", fox.log_of(7, 4, "look out", "companion"))]
    assert {topic for topic, _ in messages} == set(fox.TOPICS)
    for topic, message in messages:
        name, _ = fox.schema_of(fox.TOPICS[topic])
        check(json.loads(encode(message)), PUBLISHED[name], name)


def test_the_log_names_the_schemas_without_references(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "flight.mcap", Config())
    recorder.text(0, 6, "companion READY: vehicle fresh")
    recorder.close()
    with recorder.path.open("rb") as file:
        summary = make_reader(file).get_summary()
    named = {}
    for channel in summary.channels.values():
        schema = summary.schemas[channel.schema_id]
        assert (channel.message_encoding, schema.encoding) == ("json", "jsonschema")
        assert b"$ref" not in schema.data
        assert json.loads(schema.data)["type"] == "object"
        named[channel.topic] = schema
    assert {topic: named[topic].name for topic in fox.TOPICS} == {
        topic: f"foxglove.{kind.__name__}" for topic, kind in fox.TOPICS.items()
    }
    for topic in fox.TOPICS:
        stated = json.loads(named[topic].data)
        assert stated["properties"].keys() == PUBLISHED[named[topic].name].keys()
        time = stated["properties"].get("timestamp")
        assert time is None or time["title"] == "time"  # by this Foxglove knows a time


def test_the_body_is_where_the_vehicle_is() -> None:
    told = transform(moment())
    assert (told.parent_frame_id, told.child_frame_id) == ("local_enu", "base_link")
    assert told.translation == fox.Vector3(1.0, 2.0, 3.0)
    assert told.rotation == fox.Quaternion(0.0, 0.0, 0.8, 0.6)  # (w, x, y, z) on our side
    fix = location(moment())
    assert fix is not None
    north_m = math.radians(fix.latitude - 47.0) * 6_367_500
    east_m = math.radians(fix.longitude - 8.0) * 6_378_137 * math.cos(math.radians(47.0))
    assert (east_m, north_m, fix.altitude - 400.0) == pytest.approx((1.0, 2.0, 3.0), rel=0.01)


def test_an_obstacle_is_its_sphere_its_ellipsoid_its_keep_out_and_its_prediction() -> None:
    drawn = entity("track cam/ball")
    body, sigma, keep_out = drawn["spheres"]
    assert body["size"] == {"x": 0.4, "y": 0.4, "z": 0.4}
    assert sorted(sigma["size"].values()) == pytest.approx([0.4, 0.8, 1.2])  # 2 sigma to either side
    assert keep_out["size"]["x"] == pytest.approx(2 * (0.4 + 0.1 + 0.3 + 0.05))
    assert drawn["lines"][0]["points"][22] == pytest.approx({"x": 2.0, "y": 2.1, "z": 2.0})
    assert entity("vehicle")["metadata"][1] == {"key": "verdict", "value": "adjusted"}


def rotated(q: fox.Quaternion, v: Any) -> Any:
    u, w = np.array([q.x, q.y, q.z]), q.w
    return v + 2.0 * np.cross(u, np.cross(u, v) + w * np.asarray(v))


def test_arrows_point_along_the_acceleration() -> None:
    for shown, a in zip(entity("vehicle")["arrows"], ((3.0, 0.0, 0.0), (-1.0, 2.0, 0.5)), strict=True):
        direction = rotated(fox.Quaternion(**shown["pose"]["orientation"]), np.array([1.0, 0.0, 0.0]))
        assert direction == pytest.approx(np.array(a) / np.linalg.norm(a))
        assert shown["shaft_length"] + shown["head_length"] == pytest.approx(np.linalg.norm(a) / 3.0)


@pytest.mark.parametrize("seed", range(8))
def test_ellipsoids_are_those_of_their_covariance(seed: int) -> None:
    root = np.random.default_rng(seed).normal(size=(3, 3))
    covariance = root @ root.T
    pose, size = ellipsoid((0.0, 0.0, 0.0), covariance, 2.0)
    q = pose.orientation
    assert math.hypot(q.x, q.y, q.z, q.w) == pytest.approx(1.0)
    for axis, diameter in zip(np.eye(3), (size.x, size.y, size.z), strict=True):
        tip = rotated(q, 0.5 * diameter * axis)
        assert tip @ np.linalg.solve(covariance, tip) == pytest.approx(4.0)
