"""The Zenoh payloads: one set of structs, accepted as JSON and MessagePack (design 3.2).

Unknown fields are ignored; missing or ill-typed ones reject the frame. Everything here is bytes to values and back;
sockets live in ``link/zenoh.py``.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, TypeVar

import msgspec
import numpy as np
from msgspec import Meta, Struct

from companion.errors import FrameRejected
from companion.frames import enu_covariance_from_ned, enu_from_ned
from companion.types import NS_PER_S, Detection, DetectionFrame, DetectionKind, FloatArray, VehicleState, frozen

JSON = "application/json"
MSGPACK = "application/msgpack"

MAX_OBSTACLES = 1024
MAX_POSITION_M = 1e4
MAX_RADIUS_M = 100.0
MAX_SPEED_M_S = 1e3
MAX_STD_M = 1e4
FUTURE_NS = NS_PER_S // 10

Vec = tuple[float, float, float]
Nanoseconds = Annotated[int, Meta(ge=-(2**63) + 1, le=2**63 - 1)]
Frame = Literal["local_enu", "local_ned"]


class Obstacle(Struct, frozen=True, kw_only=True):
    """One obstacle as a sensor saw it [m], [m/s]; ``covariance``: upper triangle of 6x6 over (position, velocity)."""

    id: Annotated[str, Meta(min_length=1, max_length=64)] | None = None
    position: Vec
    radius: float
    position_std: float | None = None
    velocity: Vec | None = None
    velocity_std: float | None = None
    covariance: Annotated[list[float], Meta(min_length=21, max_length=21)] | None = None


class ObstacleFrame(Struct, frozen=True, kw_only=True):
    """`{prefix}/obstacles/{source}`: everything one source sees at ``stamp_ns``."""

    stamp_ns: Nanoseconds
    clock: Literal["unix", "vehicle"]
    frame: Frame = "local_enu"
    kind: Literal["detection", "track"] = "detection"
    obstacles: list[Obstacle]


class VehicleStateIn(Struct, frozen=True, kw_only=True):
    """`{prefix}/vehicle/state`: the vehicle by Zenoh instead of MAVLink (vehicle.source = "zenoh")."""

    stamp_ns: Nanoseconds
    frame: Frame = "local_enu"
    position: Vec
    velocity: Vec
    attitude: tuple[float, float, float, float] | None = None  # (w, x, y, z), enu_from_flu
    position_std: float | None = None


class TargetCommand(Struct, frozen=True, kw_only=True):
    """`{prefix}/target`: one position, or a list of waypoints flown in order."""

    position: Vec | None = None
    waypoints: Annotated[list[Vec], Meta(max_length=1000)] | None = None
    frame: Frame = "local_enu"
    yaw: float | None = None


class EngageCommand(Struct, frozen=True, kw_only=True):
    """`{prefix}/engage`."""

    engaged: bool


class Reply(Struct, frozen=True, kw_only=True):
    """The answer to a target or engage query."""

    accepted: bool
    reason: str = ""


class SyncMarker(Struct, frozen=True, kw_only=True):
    """`{prefix}/sync/{source}`, lockstep only: all frames through ``through_ns`` are sent, ``frames`` of them new."""

    through_ns: Nanoseconds
    frames: Annotated[int, Meta(ge=0, le=4096)]


class MarginOut(Struct, frozen=True, kw_only=True):
    radii: float
    cushion: float
    sigma: float
    delay: float


class RowOut(Struct, frozen=True, kw_only=True):
    """An active row of the filter: slack in m/s^2, >= 0 where it holds."""

    track: str
    step: int
    slack: float
    margin: MarginOut | None
    epsilon: float
    epsilon_star: float


class SetpointRecord(Struct, frozen=True, kw_only=True):
    """`{prefix}/companion/setpoint`: the intervention record of one tick, in every state."""

    stamp_ns: int
    sent: bool
    messages: int  # MAVLink messages this tick put on the wire besides heartbeats; lockstep waits for them
    state: str
    verdict: str
    u_ref: Vec | None  # net acceleration, ENU [m/s^2]
    u_safe: Vec | None
    wire: Vec | None  # what went into the MAVLink message, ENU [m/s^2]
    rows: list[RowOut]
    worst: RowOut | None
    disturbance: Vec
    tracks: int
    timings_ms: dict[str, float]


class VehicleOut(Struct, frozen=True, kw_only=True):
    """`{prefix}/companion/vehicle`: the vehicle state that the brain used."""

    stamp_ns: int
    position: Vec
    velocity: Vec
    attitude: tuple[float, float, float, float]


class TrackOut(Struct, frozen=True, kw_only=True):
    id: str
    position: Vec
    velocity: Vec
    acceleration: Vec
    radius: float
    covariance: list[float]  # upper triangle of 6x6 over (position, velocity)
    mode_probabilities: tuple[float, float, float]  # CV, CA, CT
    predicted: list[Vec]  # on the barrier grid, from the instant at which the setpoint acts


class TracksOut(Struct, frozen=True, kw_only=True):
    """`{prefix}/companion/tracks`."""

    stamp_ns: int
    tracks: list[TrackOut]


class Status(Struct, frozen=True, kw_only=True):
    """`{prefix}/companion/status`, 5 Hz and on change."""

    state: str
    reason: str
    vehicle_mode: str
    engaged: bool
    armed: bool
    airborne: bool
    target: Vec | None
    tracks: int
    verdict: str
    counts: dict[str, int]  # ticks by verdict, frames by reason of rejection
    tick_ms: dict[str, float]  # p50, p99, max of the last 1000 ticks


T = TypeVar("T", bound=Struct)

INCOMING: dict[str, type[Struct]] = {
    "obstacles/{source}": ObstacleFrame,
    "vehicle/state": VehicleStateIn,
    "target": TargetCommand,
    "engage": EngageCommand,
    "sync/{source}": SyncMarker,
}
OUTGOING: dict[str, type[Struct]] = {
    "companion/status": Status,
    "companion/vehicle": VehicleOut,
    "companion/setpoint": SetpointRecord,
    "companion/tracks": TracksOut,
    "target (reply)": Reply,
    "engage (reply)": Reply,
}


_ENCODER = msgspec.json.Encoder()
_PACKER = msgspec.msgpack.Encoder()
_DECODERS: dict[tuple[type, bool], Any] = {}


def encode(payload: Struct, encoding: str = JSON) -> bytes:
    """Payload to bytes. ``encoding`` is the media type, JSON or MSGPACK."""
    return _PACKER.encode(payload) if encoding == MSGPACK else _ENCODER.encode(payload)


def decode(data: bytes, kind: type[T], encoding: str | None = None) -> T:
    """Bytes to a payload; without a known ``encoding`` the first byte tells JSON (``{`` or space) from MessagePack.

    Raises:
        FrameRejected: reason ``malformed``, with the field and the expectation.
    """
    packed = _is_msgpack(data, encoding)
    decoder = _DECODERS.get((kind, packed))
    if decoder is None:
        decoder = msgspec.msgpack.Decoder(kind) if packed else msgspec.json.Decoder(kind)
        _DECODERS[kind, packed] = decoder
    try:
        payload: T = decoder.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise FrameRejected("malformed", str(error)) from None
    return payload


def json_schemas() -> dict[str, Any]:
    """JSON Schema of every payload, by key suffix."""
    return {key: msgspec.json.schema(kind) for key, kind in {**INCOMING, **OUTGOING}.items()}


def detections_from_frame(
    payload: ObstacleFrame,
    *,
    source: str,
    sequence: int,
    now_ns: int,
    unix_minus_vehicle_ns: int | None,
    max_age_s: float,
) -> DetectionFrame:
    """Check every bound of the wire contract and convert to the internal type (ENU, vehicle clock).

    Args:
        now_ns: the present on the vehicle's clock.
        unix_minus_vehicle_ns: offset of the clocks, None while it is unknown.
    Raises:
        FrameRejected: the frame as a whole, with a short reason.
    """
    if len(payload.obstacles) > MAX_OBSTACLES:
        raise FrameRejected("too_many", f"obstacles: expected at most {MAX_OBSTACLES}, got {len(payload.obstacles)}")
    stamp_ns = payload.stamp_ns
    if payload.clock == "unix":
        if unix_minus_vehicle_ns is None:
            raise FrameRejected("no_time_base", "clock: unix stamps need a settled TIMESYNC with the autopilot")
        stamp_ns -= unix_minus_vehicle_ns
    if stamp_ns - now_ns > FUTURE_NS:
        raise FrameRejected("future", f"stamp_ns: {(stamp_ns - now_ns) / 1e9:.3f} s ahead, expected at most 0.1 s")
    if now_ns - stamp_ns > max_age_s * NS_PER_S:
        raise FrameRejected("stale", f"stamp_ns: {(now_ns - stamp_ns) / 1e9:.3f} s old, expected at most {max_age_s} s")
    named = [o.id for o in payload.obstacles if o.id is not None]
    if len(set(named)) != len(named):
        raise FrameRejected("duplicate_id", "obstacles: expected each id once in a frame")
    ned = payload.frame == "local_ned"
    detections = tuple(_detection(i, o, ned) for i, o in enumerate(payload.obstacles))
    return DetectionFrame(stamp_ns, source, sequence, DetectionKind(payload.kind), detections)


def check_point(name: str, point: Vec) -> None:
    """Raise FrameRejected unless ``point`` is finite and within +-1e4 m."""
    if not all(math.isfinite(x) and abs(x) <= MAX_POSITION_M for x in point):
        raise FrameRejected("out_of_range", f"{name}: expected finite within +-{MAX_POSITION_M:g} m, got {list(point)}")


def triangle(covariance: FloatArray) -> list[float]:
    """Upper triangle of a symmetric (6, 6) matrix, row by row, 21 numbers."""
    values: list[float] = covariance[np.triu_indices(6)].tolist()
    return values


def _is_msgpack(data: bytes, encoding: str | None) -> bool:
    if encoding is not None:
        if encoding.startswith(JSON):
            return False
        if encoding.startswith(MSGPACK):
            return True
    return bool(data) and data[0] not in b"{ \t\r\n"


def _within(name: str, value: float, low: float, high: float, unit: str) -> float:
    if not (math.isfinite(value) and low < value <= high):
        raise FrameRejected("out_of_range", f"{name}: expected within ({low:g}, {high:g}] {unit}, got {value}")
    return value


def _detection(index: int, obstacle: Obstacle, ned: bool) -> Detection:
    at = f"obstacles[{index}]"
    check_point(f"{at}.position", obstacle.position)
    _within(f"{at}.radius", obstacle.radius, 0.0, MAX_RADIUS_M, "m")
    if obstacle.position_std is not None:
        _within(f"{at}.position_std", obstacle.position_std, 0.0, MAX_STD_M, "m")
    if obstacle.velocity_std is not None:
        _within(f"{at}.velocity_std", obstacle.velocity_std, 0.0, MAX_STD_M, "m/s")
    velocity = obstacle.velocity
    if velocity is not None and not all(math.isfinite(x) and abs(x) <= MAX_SPEED_M_S for x in velocity):
        raise FrameRejected("out_of_range", f"{at}.velocity: expected finite within +-{MAX_SPEED_M_S:g} m/s")
    convert = enu_from_ned if ned else np.asarray
    return Detection(
        id=obstacle.id,
        p_enu=frozen(convert(obstacle.position)),
        radius_m=obstacle.radius,
        p_std_m=obstacle.position_std,
        v_enu=None if velocity is None else frozen(convert(velocity)),
        v_std_m_s=obstacle.velocity_std,
        covariance=None if obstacle.covariance is None else _covariance(at, obstacle.covariance, ned),
    )


def _covariance(at: str, values: list[float], ned: bool) -> FloatArray:
    matrix = np.zeros((6, 6))
    matrix[np.triu_indices(6)] = values
    matrix = np.triu(matrix) + np.triu(matrix, 1).T
    if not np.isfinite(matrix).all() or np.abs(matrix).max() > MAX_STD_M**2 or np.linalg.eigvalsh(matrix)[0] <= 0.0:
        raise FrameRejected("out_of_range", f"{at}.covariance: expected a finite positive definite 6x6 upper triangle")
    return frozen(enu_covariance_from_ned(matrix) if ned else matrix)


def vehicle_from_payload(payload: VehicleStateIn) -> VehicleState:
    """The vehicle's state in ENU.

    Raises:
        FrameRejected: a number that is not finite or out of range, an attitude that is no rotation.
    """
    check_point("position", payload.position)
    if not all(math.isfinite(x) and abs(x) <= MAX_SPEED_M_S for x in payload.velocity):
        raise FrameRejected("out_of_range", f"velocity: expected finite within +-{MAX_SPEED_M_S:g} m/s")
    if payload.stamp_ns < 0:
        raise FrameRejected("out_of_range", f"stamp_ns: expected at least 0, got {payload.stamp_ns}")
    if payload.position_std is not None:
        _within("position_std", payload.position_std, 0.0, MAX_STD_M, "m")
    attitude = np.array(payload.attitude or (1.0, 0.0, 0.0, 0.0))
    if not (np.isfinite(attitude).all() and 0.9 < float(np.linalg.norm(attitude)) < 1.1):
        raise FrameRejected("out_of_range", "attitude: expected a unit quaternion (w, x, y, z)")
    convert = enu_from_ned if payload.frame == "local_ned" else np.asarray
    return VehicleState(
        stamp_ns=payload.stamp_ns,
        p_enu=frozen(convert(payload.position)),
        v_enu=frozen(convert(payload.velocity)),
        q_enu_from_flu=frozen(attitude / np.linalg.norm(attitude)),
        p_std_m=payload.position_std or 0.0,
    )
