"""The messages of the brain's journal: each call as JSON that is read back to the bit.

Floats are written in the shortest form that is read back exactly; what JSON has no number for is a string, "nan",
"inf" or "-inf". A configuration is named by its hash and stands in full on ``/companion/config``; an obstacle frame is
named by (source, sequence) and stands on ``/companion/input/obstacles`` before the first call that uses it.
"""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct

from companion.errors import CompanionError
from companion.numerics import Machine
from companion.pilot import PilotInput, PilotOutput, Task
from companion.types import Detection, DetectionFrame, DetectionKind, VehicleState, frozen

TOPIC = "/companion/brain"
FRAMES_TOPIC = "/companion/input/obstacles"

Number = float | str  # a string only for nan, inf and -inf
Numbers = list[Number]


class Construct(Struct, frozen=True, kw_only=True, tag_field="call", tag="construct"):
    """A new pilot. ``artifact`` is the SHA-256 of the policy's manifest, None for a reference law of its own."""

    n: int
    config: str
    artifact: str | None
    version: str
    machine: Machine


class Configure(Struct, frozen=True, kw_only=True, tag_field="call", tag="configure"):
    """A new pilot with the same policy: the vehicle's profile is settled."""

    n: int
    config: str


class Retune(Struct, frozen=True, kw_only=True, tag_field="call", tag="retune"):
    """Live parameters changed: the same pilot flies on under another configuration."""

    n: int
    config: str


class Reset(Struct, frozen=True, kw_only=True, tag_field="call", tag="reset"):
    """Everything forgotten: the vehicle's clock began anew, or the brain had failed."""

    n: int


class Observe(Struct, frozen=True, kw_only=True, tag_field="call", tag="observe"):
    """Frames tracked before their vehicle state was there (lockstep)."""

    n: int
    stamp_ns: int
    frames: list[tuple[str, int]]
    error: str | None = None


class Answer(Struct, frozen=True, kw_only=True):
    """What the brain returned that the tick's other records do not hold; accelerations ENU [m/s^2]."""

    wire: Numbers
    v_next: Numbers  # [m/s]
    detour: bool
    solver: str
    iterations: int
    policy_valid: bool
    origin_moved_m: Number | None


class Step(Struct, frozen=True, kw_only=True, tag_field="call", tag="step"):
    """One tick: the vehicle as the brain saw it (ENU, SI), the frames, the task; None for ``answer`` if it raised."""

    n: int
    stamp_ns: int
    p: Numbers
    v: Numbers
    q: Numbers
    p_std_m: Number
    reset_counter: int | None
    frames: list[tuple[str, int]]
    task: Task
    target: Numbers | None
    sent: bool
    answer: Answer | None
    error: str | None = None


Call = Construct | Configure | Retune | Reset | Observe | Step


class Seen(Struct, frozen=True, kw_only=True):
    """One obstacle of a frame, as `wire.Obstacle`."""

    id: str | None
    position: Numbers
    radius: Number
    position_std: Number | None
    velocity: Numbers | None
    velocity_std: Number | None
    covariance: Numbers | None  # upper triangle; the brain's matrices are symmetric to the bit


class SeenFrame(Struct, frozen=True, kw_only=True):
    """One frame, as `wire.ObstacleFrame` and who sent it."""

    stamp_ns: int
    clock: str
    frame: str
    source: str
    sequence: int
    kind: DetectionKind
    arrived_unix_ns: int | None = None  # here; no part of the brain's input
    obstacles: list[Seen]


_CALLS: msgspec.json.Decoder[Call] = msgspec.json.Decoder(Call)
_FRAMES = msgspec.json.Decoder(SeenFrame)
_UPPER = np.triu_indices(6)


def schema() -> dict[str, Any]:
    """JSON Schema of the messages of `TOPIC`."""
    return {"type": "object", **msgspec.json.schema(Call)}


def decode_call(payload: bytes) -> Call:
    """A message of `TOPIC`. Raises CompanionError with what was expected."""
    try:
        return _CALLS.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise CompanionError(f"{TOPIC}: {error}") from None


def decode_frame(payload: bytes) -> DetectionFrame:
    """A message of `FRAMES_TOPIC` as the brain was given it. Raises CompanionError with what was expected."""
    try:
        frame = _FRAMES.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise CompanionError(f"{FRAMES_TOPIC}: {error}") from None
    return DetectionFrame(
        stamp_ns=frame.stamp_ns,
        source=frame.source,
        sequence=frame.sequence,
        kind=frame.kind,
        detections=tuple([_detection(seen) for seen in frame.obstacles]),
        arrived_unix_ns=frame.arrived_unix_ns,
    )


def frame_of(frame: DetectionFrame) -> SeenFrame:
    """A frame as a message of `FRAMES_TOPIC`."""
    seen = [
        Seen(
            id=one.id,
            position=_exact(one.p_enu.tolist()),
            radius=_number(one.radius_m),
            position_std=_optional(one.p_std_m),
            velocity=None if one.v_enu is None else _exact(one.v_enu.tolist()),
            velocity_std=_optional(one.v_std_m_s),
            covariance=None if one.covariance is None else _exact(one.covariance[_UPPER].tolist()),
        )
        for one in frame.detections
    ]
    return SeenFrame(
        stamp_ns=frame.stamp_ns,
        clock="vehicle",
        frame="local_enu",
        source=frame.source,
        sequence=frame.sequence,
        kind=frame.kind,
        arrived_unix_ns=frame.arrived_unix_ns,
        obstacles=seen,
    )


def inputs_of(step: Step, frames: tuple[DetectionFrame, ...]) -> PilotInput:
    """The brain's input of a recorded tick, bit for bit."""
    vehicle = VehicleState(
        stamp_ns=step.stamp_ns,
        p_enu=_array(step.p),
        v_enu=_array(step.v),
        q_enu_from_flu=_array(step.q),
        p_std_m=float(step.p_std_m),
        reset_counter=step.reset_counter,
    )
    target = None if step.target is None else _array(step.target)
    return PilotInput(vehicle=vehicle, frames=frames, task=step.task, target_enu=target)


def answer_of(output: PilotOutput) -> Answer:
    """What `Step` keeps of the brain's answer."""
    return Answer(
        wire=_exact(output.wire.tolist()),
        v_next=_exact(output.v_next.tolist()),
        detour=output.result.detour,
        solver=output.result.solver,
        iterations=output.result.iterations,
        policy_valid=output.policy_valid,
        origin_moved_m=_optional(output.origin_moved_m),
    )


def step_of(n: int, inputs: PilotInput, sent: bool, output: PilotOutput | None, error: str | None) -> Step:
    vehicle, target = inputs.vehicle, inputs.target_enu
    return Step(
        n=n,
        stamp_ns=vehicle.stamp_ns,
        p=_exact(vehicle.p_enu.tolist()),
        v=_exact(vehicle.v_enu.tolist()),
        q=_exact(vehicle.q_enu_from_flu.tolist()),
        p_std_m=_number(vehicle.p_std_m),
        reset_counter=vehicle.reset_counter,
        frames=names_of(inputs.frames),
        task=inputs.task,
        target=None if target is None else _exact(target.tolist()),
        sent=sent,
        answer=None if output is None else answer_of(output),
        error=error,
    )


def names_of(frames: tuple[DetectionFrame, ...]) -> list[tuple[str, int]]:
    return [(frame.source, frame.sequence) for frame in frames]


def _detection(seen: Seen) -> Detection:
    covariance = None
    if seen.covariance is not None:
        covariance = np.empty((6, 6))
        covariance[_UPPER] = covariance.T[_UPPER] = _array(seen.covariance)
    return Detection(
        id=seen.id,
        p_enu=_array(seen.position),
        radius_m=float(seen.radius),
        p_std_m=None if seen.position_std is None else float(seen.position_std),
        v_enu=None if seen.velocity is None else _array(seen.velocity),
        v_std_m_s=None if seen.velocity_std is None else float(seen.velocity_std),
        covariance=None if covariance is None else frozen(covariance),
    )


def _array(values: Numbers) -> Any:
    return frozen([float(value) for value in values])


def _exact(values: list[float]) -> Numbers:
    """``values`` as JSON can carry them."""
    total = sum(values)
    return values if total - total == 0.0 else [_number(value) for value in values]  # type: ignore[return-value]


def _number(value: float) -> Number:
    return value if math.isfinite(value) else repr(float(value))


def _optional(value: float | None) -> Number | None:
    return None if value is None else _number(value)
