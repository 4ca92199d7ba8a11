"""What the brain was asked comes back from the log bit for bit."""

from __future__ import annotations

import math
import struct

import msgspec
import numpy as np
import pytest
from tracking_scenes import frame, seen, vehicle

from companion.config import Config
from companion.errors import CompanionError, FrameRejected
from companion.journal import Journal
from companion.journal_format import (
    FRAMES_TOPIC,
    TOPIC,
    decode_call,
    decode_frame,
    frame_of,
    inputs_of,
    schema,
    step_of,
)
from companion.link import wire
from companion.link.ingress import detections_from_frame
from companion.pilot import Pilot, PilotInput, Task
from companion.types import DetectionFrame, DetectionKind, VehicleState, frozen

ODD = (-0.0, 0.1 + 0.2, 5e-324, -1.7976931348623157e308, math.pi, math.inf, -math.inf, math.nan)


class Sink:
    """Keeps what a recorder would be given."""

    def __init__(self) -> None:
        self.messages: list[tuple[str, int, bytes]] = []

    def later(self, topic, stamp_ns, build, size=0) -> None:
        self.messages.append((topic, stamp_ns, msgspec.json.encode(build())))

    def calls(self) -> list[object]:
        return [decode_call(data) for topic, _, data in self.messages if topic == TOPIC]


def bits(values) -> bytes:
    return np.asarray(values, dtype=np.float64).tobytes()


@pytest.mark.parametrize("odd", ODD)
def test_every_float_of_a_vehicle_comes_back_to_the_bit(odd: float) -> None:
    state = VehicleState(
        123456789012345678, frozen([odd, 1.0, -0.0]), frozen([0.0, odd, 1e-17]), frozen([1.0, 0.0, -0.0, odd]), odd, 7
    )
    inputs = PilotInput(state, (), Task.HOLD, frozen([odd, 2.0, 3.0]))
    data = msgspec.json.encode(step_of(3, inputs, True, None, "BrainFailure"))
    step = decode_call(data)
    again = inputs_of(step, ())
    assert (step.n, step.sent, step.error, step.answer, again.task) == (3, True, "BrainFailure", None, Task.HOLD)
    assert (again.vehicle.stamp_ns, again.vehicle.reset_counter) == (state.stamp_ns, 7)
    for name in ("p_enu", "v_enu", "q_enu_from_flu"):
        assert bits(getattr(again.vehicle, name)) == bits(getattr(state, name)), name
    assert struct.pack("<d", again.vehicle.p_std_m) == struct.pack("<d", state.p_std_m)
    assert again.target_enu is not None
    assert bits(again.target_enu) == bits(inputs.target_enu)


@pytest.mark.parametrize("odd", ODD)
def test_every_part_of_a_frame_comes_back_to_the_bit(odd: float) -> None:
    root = np.random.default_rng(1).normal(size=(6, 6))
    covariance = root @ root.T
    covariance = np.triu(covariance) + np.triu(covariance, 1).T
    full = seen("a", [odd, 2.0, -0.0], std=odd, radius=0.1 + 0.2, v=[0.0, odd, 1.0], v_std=odd, covariance=covariance)
    bare = seen(None, [1.0, 2.0, 3.0], std=None)
    given = frame(1.5, full, bare, source="radar", sequence=9, kind=DetectionKind.TRACK)
    again = decode_frame(msgspec.json.encode(frame_of(given)))
    assert (again.stamp_ns, again.source, again.sequence, again.kind) == (
        1_500_000_000,
        "radar",
        9,
        DetectionKind.TRACK,
    )
    one, other = again.detections
    assert (one.id, other.id) == ("a", None)
    for name in ("p_enu", "radius_m", "p_std_m", "v_enu", "v_std_m_s", "covariance"):
        assert bits(getattr(one, name)) == bits(getattr(full, name)), name
    assert (other.p_std_m, other.v_enu, other.v_std_m_s, other.covariance) == (None, None, None, None)
    assert not one.covariance.flags.writeable


@pytest.mark.parametrize("axes", ["local_enu", "local_ned"])
def test_a_covariance_from_the_wire_is_symmetric_to_the_bit(axes: str) -> None:
    root = np.random.default_rng(2).normal(size=(6, 6))
    upper = (root @ root.T)[np.triu_indices(6)].tolist()
    obstacle = wire.Obstacle(position=(1.0, 2.0, 3.0), radius=0.2, covariance=upper)
    payload = wire.ObstacleFrame(stamp_ns=0, clock="vehicle", frame=axes, obstacles=[obstacle])
    try:
        got = detections_from_frame(
            payload, source="s", sequence=0, now_ns=0, unix_minus_vehicle_ns=None, max_age_s=1.0
        )
    except FrameRejected as error:
        pytest.fail(str(error))
    matrix = got.detections[0].covariance
    assert bits(matrix) == bits(matrix.T)


def test_the_calls_are_noted_in_their_order_and_frames_written_once() -> None:
    pilot, sink = Pilot(Config()), Sink()
    journal = Journal(pilot, Config(), artifact=pilot.artifact)
    journal.reset()
    frames = (frame(0.1, seen("ball", [3.0, 0.0, 2.0])),)
    journal.observe(frames, 100_000_000)
    journal.write(sink)
    journal.step(PilotInput(vehicle(0.1, [0.0, 0.0, 2.0]), frames), sent=False)
    journal.write(sink, frames)
    unused: tuple[DetectionFrame, ...] = (frame(0.15, seen("ball", [3.0, 0.0, 2.0]), sequence=1),)
    journal.write(sink, unused)  # a tick in FAULT: the brain was not asked
    kinds = [type(call).__name__ for call in sink.calls()]
    assert kinds == ["Construct", "Reset", "Observe", "Step"]
    assert [call.n for call in sink.calls()] == [0, 1, 2, 3]
    assert [topic for topic, *_ in sink.messages] == [TOPIC, TOPIC, FRAMES_TOPIC, TOPIC, TOPIC, FRAMES_TOPIC]
    assert sink.calls()[3].frames == [("cam", 0)]
    assert sink.calls()[0].artifact == pilot.artifact


def test_a_brain_that_raises_is_noted_and_raises() -> None:
    pilot, sink = Pilot(Config()), Sink()
    journal = Journal(pilot, Config(), artifact=None)
    with pytest.raises(CompanionError):
        journal.step(PilotInput(vehicle(0.1, [math.nan, 0.0, 2.0])), sent=True)
    journal.write(sink)
    step = sink.calls()[-1]
    assert (step.error, step.answer, step.p[0]) == ("BrainFailure", None, "nan")


def test_a_message_that_is_no_call_names_the_topic() -> None:
    with pytest.raises(CompanionError, match="/companion/brain"):
        decode_call(b'{"call": "dance", "n": 1}')
    assert schema()["type"] == "object"
