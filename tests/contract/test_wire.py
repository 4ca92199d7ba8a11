"""The Zenoh payloads of the wire contract: what is accepted, what is refused and under which name."""

from __future__ import annotations

import json
import math
from typing import Any

import msgspec
import numpy as np
import pytest

from companion.errors import FrameRejected
from companion.link import ingress, wire
from companion.types import DetectionFrame, DetectionKind

NOW_NS = 10_000_000_000
UNIX_MINUS_VEHICLE_NS = 1_700_000_000_000_000_000

# the example of the wire contract, as a sensor host writes it
EXAMPLE = (
    '{"stamp_ns": 1700000009990000000, "clock": "unix", "frame": "local_enu", "kind": "detection", "obstacles":'
    ' [{"id": "ball-1", "position": [1.0, 2.0, 1.5], "radius": 0.2, "position_std": 0.22, "velocity": null,'
    ' "velocity_std": null, "covariance": null}]}'
)


def obstacle(**changes: Any) -> dict[str, Any]:
    return {"id": "ball", "position": [1.0, 2.0, 1.5], "radius": 0.2} | changes


def frame(*obstacles: dict[str, Any], **changes: Any) -> dict[str, Any]:
    return {"stamp_ns": NOW_NS, "clock": "vehicle", "obstacles": list(obstacles) or [obstacle()]} | changes


def accept(payload: bytes | dict[str, Any], encoding: str | None = None, **changes: Any) -> DetectionFrame:
    data = payload if isinstance(payload, bytes) else json.dumps(payload).encode()
    settings: dict[str, Any] = {
        "source": "lidar",
        "sequence": 3,
        "now_ns": NOW_NS,
        "unix_minus_vehicle_ns": UNIX_MINUS_VEHICLE_NS,
        "max_age_s": 0.5,
    }
    return ingress.detections_from_frame(wire.decode(data, wire.ObstacleFrame, encoding), **(settings | changes))


def refuse(payload: bytes | dict[str, Any], encoding: str | None = None, **changes: Any) -> FrameRejected:
    with pytest.raises(FrameRejected) as caught:
        accept(payload, encoding, **changes)
    assert "\n" not in str(caught.value)
    return caught.value


def test_the_contract_example() -> None:
    accepted = accept(EXAMPLE.encode())
    assert (accepted.stamp_ns, accepted.source, accepted.sequence) == (9_990_000_000, "lidar", 3)
    assert accepted.kind is DetectionKind.DETECTION
    (ball,) = accepted.detections
    assert (ball.id, ball.radius_m, ball.p_std_m, ball.v_enu, ball.covariance) == ("ball-1", 0.2, 0.22, None, None)
    assert ball.p_enu.tolist() == [1.0, 2.0, 1.5]
    assert not ball.p_enu.flags.writeable


def test_an_empty_frame_says_that_nothing_is_there() -> None:
    assert accept(frame(obstacles=[])).detections == ()


def test_unknown_fields_are_ignored_and_defaults_apply() -> None:
    accepted = accept(frame(obstacle(colour="red"), sensor={"name": "x"}))
    assert accepted.detections[0].id == "ball"
    assert accepted.kind is DetectionKind.DETECTION


@pytest.mark.parametrize("missing", ["stamp_ns", "clock", "obstacles"])
def test_missing_fields_of_the_frame_are_named(missing: str) -> None:
    payload = frame()
    del payload[missing]
    error = refuse(payload)
    assert error.reason == "malformed"
    assert missing in error.detail


@pytest.mark.parametrize(
    ("payload", "field"),
    [
        (frame(stamp_ns=1.5), "stamp_ns"),
        (frame(stamp_ns="1"), "stamp_ns"),
        (frame(stamp_ns=10**30), "stamp_ns"),
        (frame(stamp_ns=2**63), "stamp_ns"),
        (frame(stamp_ns=-(10**400)), "stamp_ns"),
        (frame(clock="gps"), "clock"),
        (frame(frame="body"), "frame"),
        (frame(kind="guess"), "kind"),
        (frame(obstacles=None), "obstacles"),
        (frame(obstacle(position=[1.0, 2.0])), "position"),
        (frame(obstacle(position=[1.0, 2.0, 3.0, 4.0])), "position"),
        (frame(obstacle(position=[1.0, None, 3.0])), "position"),
        (frame(obstacle(radius="0.2")), "radius"),
        (frame(obstacle(radius=True)), "radius"),
        (frame(obstacle(id=7)), "id"),
        (frame(obstacle(id="")), "id"),
        (frame(obstacle(id="x" * 65)), "id"),
        (frame(obstacle(covariance=[1.0] * 20)), "covariance"),
    ],
)
def test_ill_typed_fields_are_named(payload: dict[str, Any], field: str) -> None:
    error = refuse(payload)
    assert error.reason == "malformed"
    assert field in error.detail


@pytest.mark.parametrize(
    "data",
    [
        *(b"", b" ", b"{", b"[]", b"null", b"{}", b"\x00", b"\xff\xfe", b"\xc1", b"[" * 100_000, b"\x91" * 100_000),
        *(EXAMPLE.encode()[:-1], EXAMPLE.encode() + b"x", EXAMPLE.replace("1.5", "NaN").encode()),
        *(EXAMPLE.replace("1.5", "1e400").encode(), EXAMPLE.replace("1.5", "1" * 5000).encode()),
        EXAMPLE.replace("ball-1", "\udcff").encode("utf-8", "surrogatepass"),
    ],
)
def test_malformed_payloads(data: bytes) -> None:
    for encoding in (None, wire.JSON, wire.MSGPACK, "zenoh/bytes"):
        assert refuse(data, encoding).reason == "malformed"


def packed(payload: dict[str, Any]) -> bytes:
    return msgspec.msgpack.encode(payload)  # unlike JSON, it carries NaN and infinities


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e300])
@pytest.mark.parametrize(
    ("field", "make"),
    [
        ("position", lambda bad: {"position": [0.0, bad, 0.0]}),
        ("radius", lambda bad: {"radius": bad}),
        ("position_std", lambda bad: {"position_std": bad}),
        ("velocity", lambda bad: {"velocity": [0.0, 0.0, bad]}),
        ("velocity_std", lambda bad: {"velocity_std": bad}),
        ("covariance", lambda bad: {"covariance": [bad] * 21}),
    ],
)
def test_numbers_that_are_not_finite_or_absurd(field: str, make: Any, bad: float) -> None:
    error = refuse(packed(frame(obstacle(id="a"), obstacle(**make(bad)))))
    assert error.reason == "out_of_range"
    assert f"obstacles[1].{field}" in error.detail


@pytest.mark.parametrize(
    ("changes", "accepted"),
    [
        ({"position": [1e4, -1e4, 1e4]}, True),
        ({"position": [0, 0, 10001]}, False),
        ({"radius": 100}, True),
        ({"radius": 100.1}, False),
        ({"radius": 0}, False),
        ({"radius": -0.2}, False),
        ({"position_std": 0}, False),
        ({"velocity": [1e3, 0, 0]}, True),
        ({"velocity": [1001, 0, 0]}, False),
        ({"covariance": [0.0] * 21}, False),  # not positive definite
    ],
)
def test_bounds(changes: dict[str, Any], accepted: bool) -> None:
    payload = frame(obstacle(**changes))
    if accepted:
        accept(payload)
    else:
        assert refuse(payload).reason == "out_of_range"


def test_at_most_1024_obstacles() -> None:
    many = [obstacle(id=None) for _ in range(1025)]
    assert len(accept(frame(*many[:1024])).detections) == 1024
    assert refuse(frame(*many)).reason == "too_many"


def test_an_id_stands_once_in_a_frame_but_anonymous_ones_are_free() -> None:
    assert refuse(frame(obstacle(), obstacle())).reason == "duplicate_id"
    assert len(accept(frame(obstacle(id=None), obstacle(id=None))).detections) == 2


@pytest.mark.parametrize(
    ("stamp_ns", "reason"),
    [
        (NOW_NS + 100_000_000, None),
        (NOW_NS + 100_000_001, "future"),
        (NOW_NS - 500_000_000, None),
        (NOW_NS - 500_000_001, "stale"),
        (-(2**62), "stale"),
        (2**62, "future"),
    ],
)
def test_stamps(stamp_ns: int, reason: str | None) -> None:
    for payload in (
        frame(stamp_ns=stamp_ns),
        frame(stamp_ns=stamp_ns + UNIX_MINUS_VEHICLE_NS, clock="unix"),
    ):
        if reason is None:
            assert accept(payload).stamp_ns == stamp_ns
        else:
            assert refuse(payload).reason == reason


def test_unix_stamps_need_a_time_base() -> None:
    assert refuse(EXAMPLE.encode(), unix_minus_vehicle_ns=None).reason == "no_time_base"
    accept(frame(), unix_minus_vehicle_ns=None)


def test_local_ned_is_turned_into_enu() -> None:
    payload = frame(obstacle(position=[1, 2, 3], velocity=[4, 5, 6]), frame="local_ned")
    (ball,) = accept(payload).detections
    assert ball.p_enu.tolist() == [2.0, 1.0, -3.0]
    assert ball.v_enu is not None
    assert ball.v_enu.tolist() == [5.0, 4.0, -6.0]


def test_covariance_is_the_upper_triangle_row_by_row() -> None:
    rng = np.random.default_rng(5)
    root = rng.normal(size=(6, 6))
    ned = root @ root.T + np.eye(6)
    triangle = [ned[i, j] for i in range(6) for j in range(i, 6)]
    (enu_ball,) = accept(frame(obstacle(covariance=triangle))).detections
    assert enu_ball.covariance == pytest.approx(ned)
    (ball,) = accept(frame(obstacle(covariance=triangle), frame="local_ned")).detections
    assert ball.covariance is not None
    # independent: the variance along a direction does not depend on the axes it is written in
    north_up_ned, north_up_enu = np.array([1, 0, -1, 0, 2, 0.0]), np.array([0, 1, 1, 2, 0, 0.0])
    assert north_up_enu @ ball.covariance @ north_up_enu == pytest.approx(north_up_ned @ ned @ north_up_ned)


def test_msgpack_equals_json() -> None:
    payload = frame(obstacle(velocity=[1, 2, 3], velocity_std=0.5, position_std=0.1), kind="track")
    as_json = accept(json.dumps(payload).encode(), wire.JSON)
    for encoding in (wire.MSGPACK, f"{wire.MSGPACK};schema", None, "zenoh/bytes"):
        as_msgpack = accept(packed(payload), encoding)
        assert as_msgpack.stamp_ns == as_json.stamp_ns
        assert as_msgpack.kind is as_json.kind is DetectionKind.TRACK
        for mine, other in zip(as_msgpack.detections, as_json.detections, strict=True):
            assert (mine.id, mine.radius_m, mine.p_std_m, mine.v_std_m_s) == (
                (other.id, other.radius_m, other.p_std_m, other.v_std_m_s)
            )
            assert np.array_equal(mine.p_enu, other.p_enu)
            assert np.array_equal(mine.v_enu, other.v_enu)  # type: ignore[arg-type]


def test_media_type_wins_over_the_guess() -> None:
    assert refuse(packed(frame()), wire.JSON).reason == "malformed"
    assert refuse(json.dumps(frame()).encode(), wire.MSGPACK).reason == "malformed"


def vehicle(**changes: Any) -> dict[str, Any]:
    return {"stamp_ns": NOW_NS, "position": [1.0, 2.0, 3.0], "velocity": [4.0, 5.0, 6.0]} | changes


def test_the_vehicle_by_zenoh_comes_in_either_frame() -> None:
    level_facing_north = [math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]
    for frame_name, position, velocity in (
        ("local_enu", [1.0, 2.0, 3.0], [4.0, 5.0, 6.0]),
        ("local_ned", [2.0, 1.0, -3.0], [5.0, 4.0, -6.0]),
    ):
        payload = vehicle(frame=frame_name, position=position, velocity=velocity, attitude=level_facing_north)
        state = ingress.vehicle_from_payload(wire.decode(json.dumps(payload).encode(), wire.VehicleStateIn))
        assert state.stamp_ns == NOW_NS
        assert state.p_enu.tolist() == [1.0, 2.0, 3.0]
        assert state.v_enu.tolist() == [4.0, 5.0, 6.0]
        assert state.q_enu_from_flu == pytest.approx(level_facing_north)
        assert state.p_std_m == 0.0


def test_the_vehicle_s_covariance_counts_by_its_worst_axis() -> None:
    """Independent of the library: a diagonal turned by 45 degrees in the horizontal plane keeps its largest value."""
    cosine = math.sqrt(0.5)
    turn = np.array([[cosine, -cosine, 0.0], [cosine, cosine, 0.0], [0.0, 0.0, 1.0]])
    matrix = np.eye(6)
    matrix[:3, :3] = turn @ np.diag([0.25, 0.04, 0.09]) @ turn.T
    triangle = [matrix[i, j] for i in range(6) for j in range(i, 6)]
    for frame_name in ("local_enu", "local_ned"):
        payload = vehicle(frame=frame_name, covariance=triangle, position_std=9.0)
        assert ingress.vehicle_from_payload(
            wire.decode(json.dumps(payload).encode(), wire.VehicleStateIn)
        ).p_std_m == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"position": [1e5, 0, 0]}, "position"),
        ({"velocity": [0, math.nan, 0]}, "velocity"),
        ({"velocity": [0, 1e4, 0]}, "velocity"),
        ({"stamp_ns": -1}, "stamp_ns"),
        ({"position_std": 0.0}, "position_std"),
        ({"attitude": [0.0, 0.0, 0.0, 0.0]}, "attitude"),
        ({"attitude": [math.nan, 0.0, 0.0, 1.0]}, "attitude"),
        ({"covariance": [0.0] * 21}, "covariance"),
        ({"covariance": [math.inf] * 21}, "covariance"),
    ],
)
def test_a_vehicle_state_out_of_bounds_is_refused(changes: dict[str, Any], field: str) -> None:
    payload = wire.decode(packed(vehicle(**changes)), wire.VehicleStateIn)
    with pytest.raises(FrameRejected, match=rf"^out_of_range: {field}: expected") as caught:
        ingress.vehicle_from_payload(payload)
    assert "\n" not in str(caught.value)


def test_commands_and_markers() -> None:
    assert wire.decode(b'{"engaged":true}', wire.EngageCommand) == wire.EngageCommand(engaged=True)
    target = wire.decode(b'{"position":[1,2,3],"frame":"local_enu","yaw":null}', wire.TargetCommand)
    assert target == wire.TargetCommand(position=(1.0, 2.0, 3.0))
    route = wire.decode(b'{"waypoints":[[1,2,3],[4,5,6]]}', wire.TargetCommand)
    assert route.waypoints == [(1.0, 2.0, 3.0), (4.0, 5.0, 6.0)]
    assert wire.decode(b'{"through_ns":5,"frames":0}', wire.SyncMarker) == wire.SyncMarker(through_ns=5, frames=0)
    for data, kind in (
        (b'{"engaged":1}', wire.EngageCommand),
        (b'{"position":[1,2]}', wire.TargetCommand),
        (b'{"through_ns":5,"frames":-1}', wire.SyncMarker),
    ):
        with pytest.raises(FrameRejected):
            wire.decode(data, kind)


def test_every_payload_has_a_schema_that_names_its_fields() -> None:
    schemas = wire.json_schemas()
    assert set(schemas) == set(wire.INCOMING) | set(wire.OUTGOING)
    fields = schemas["obstacles/{source}"]["$defs"]["Obstacle"]["properties"]
    assert set(fields) == set(json.loads(EXAMPLE)["obstacles"][0])
    json.dumps(schemas)


@pytest.mark.parametrize("encoding", [wire.JSON, wire.MSGPACK])
def test_what_is_encoded_can_be_decoded(encoding: str) -> None:
    record = wire.SetpointRecord(
        stamp_ns=5,
        sent=True,
        messages=1,
        state="ACTIVE",
        verdict="adjusted",
        u_ref=(1.0, 2.0, 3.0),
        u_safe=None,
        wire=(0.1, 0.2, 0.3),
        rows=[wire.RowOut(track="a/b", step=2, slack=0.5, margin=None, epsilon=1.0, epsilon_star=0.0)],
        worst=None,
        disturbance=(0.0, 0.0, 0.0),
        tracks=1,
        timings_ms={"filter": 0.4},
    )
    assert wire.decode(wire.encode(record, encoding), wire.SetpointRecord, encoding) == record
