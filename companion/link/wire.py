"""The Zenoh payloads: one set of structs, accepted as JSON and MessagePack (design 3.2).

Unknown fields are ignored; missing or ill-typed ones reject the frame. Everything here is bytes to payloads and back;
their bounds are checked in ``link/ingress.py``, sockets live in ``link/zenoh.py``.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeVar

import msgspec
from msgspec import Meta, Struct

from companion.errors import FrameRejected

JSON = "application/json"
MSGPACK = "application/msgpack"

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
    """`{prefix}/vehicle/state`: the vehicle by Zenoh instead of MAVLink (vehicle.source = "zenoh").

    ``stamp_ns`` is on the vehicle's clock, ``frame`` that of position and velocity; ``attitude`` (w, x, y, z) turns FLU
    into ENU in either. ``covariance``: upper triangle of 6x6 over (position, velocity), in place of ``position_std``.
    """

    stamp_ns: Nanoseconds
    frame: Frame = "local_enu"
    position: Vec
    velocity: Vec
    attitude: tuple[float, float, float, float] | None = None
    position_std: float | None = None
    covariance: Annotated[list[float], Meta(min_length=21, max_length=21)] | None = None


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
    """What a row's keep-out distance is made of [m]."""

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
    messages: int  # MAVLink messages this tick put on the wire besides what wall time sends; lockstep waits for them
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
    detour: bool = False  # the answer to a reference along the obstacle's boundary, not to u_ref


class VehicleOut(Struct, frozen=True, kw_only=True):
    """`{prefix}/companion/vehicle`: the vehicle state that the brain used."""

    stamp_ns: int
    position: Vec
    velocity: Vec
    attitude: tuple[float, float, float, float]
    reset_counter: int | None = None  # of the estimator, where the autopilot tells
    arrived_unix_ns: int | None = None  # at the daemon, on its computer's clock


class TrackOut(Struct, frozen=True, kw_only=True):
    """One track, local ENU [m], [m/s], [m/s^2]; its obstacle is a sphere of ``radius``."""

    id: str
    position: Vec
    velocity: Vec
    acceleration: Vec
    radius: float
    covariance: list[float]  # upper triangle of 6x6 over (position, velocity)
    mode_probabilities: tuple[float, float, float]  # CV, CA, CT
    predicted: list[Vec]  # on the barrier grid, from the instant at which the setpoint acts; empty for a tentative one
    status: str  # "tentative", "confirmed", "coasting"
    sources: list[str]  # that see it
    surprise: float  # root mean square of its predictions' innovations, 1 where its models are true
    growth: float  # how much faster than its models say its predicted covariance grows


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
    profile: str  # of the vehicle, "auto" while that is open
    warnings: list[str]  # what stands without changing the state: setpoints not followed, a second sender, lost streams
    target: Vec | None
    tracks: int
    agile: list[str]  # tracks that break their assumed agility: their predictions are widened at least twofold
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


def _is_msgpack(data: bytes, encoding: str | None) -> bool:
    if encoding is not None:
        if encoding.startswith(JSON):
            return False
        if encoding.startswith(MSGPACK):
            return True
    return bool(data) and data[0] not in b"{ \t\r\n"
