"""Whatever comes on a ROS 2 topic: nothing raises, it is counted, and what gets in is finite and within bounds."""

from __future__ import annotations

import struct

import numpy as np
import pytest
import ros2_oracle as oracle
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.config_links import Ros2Config
from companion.link.inbox import ObstacleInbox
from companion.link.ros2 import subscriptions

S = 1_000_000_000
STAMP = 1_700_000_000 * S
CONFIG = Ros2Config(detections=("d",), tracked_objects=("t",))
INBOX = ObstacleInbox(queue=64, max_age_s=0.5)
HANDLERS = subscriptions(CONFIG, INBOX)
KEYS = {key: key.replace("*", "TypeHashNotSupported") for key in HANDLERS}
WHOLE = {
    "Detection3DArray": oracle.Detection3DArray(
        oracle.header(STAMP), [oracle.detection(1.0, 2.0, 3.0, name=name) for name in ("a", "")]
    ),
    "TrackedObjects": oracle.TrackedObjects(oracle.header(STAMP), [oracle.tracked(1), oracle.tracked(2)]),
}
finite = st.floats(-1e3, 1e3)
any_float = st.floats(width=64) | st.sampled_from([0.0, -1.0, 1e9, 1e308, 5e-324])


def put(key: str, payload: bytes) -> int:
    """Obstacles that came through; every payload is either a frame or counted by one reason."""
    before = sum(INBOX.counts.values())
    HANDLERS[key](KEYS[key], payload, "")
    frames = INBOX.drain(S, unix_minus_vehicle_ns=STAMP - S)
    assert sum(INBOX.counts.values()) == before + 1
    for frame in frames:
        for detection in frame.detections:
            assert np.isfinite(detection.p_enu).all()
            assert 0.0 < detection.radius_m <= 100.0
            assert detection.v_enu is None or np.isfinite(detection.v_enu).all()
            if detection.covariance is not None:
                assert np.linalg.eigvalsh(detection.covariance)[0] > 0.0
    return sum(len(frame.detections) for frame in frames)


@pytest.mark.parametrize("key", HANDLERS, ids=lambda key: key.split("/")[1])
@settings(max_examples=400, deadline=None)
@given(data=st.data())
def test_random_bytes(key: str, data: st.DataObject) -> None:
    head = data.draw(st.sampled_from([b"", b"\x00\x00\x00\x00", b"\x00\x01\x00\x00"]))
    put(key, head + data.draw(st.binary(max_size=600)))


@pytest.mark.parametrize("key", HANDLERS, ids=lambda key: key.split("/")[1])
@settings(max_examples=600, deadline=None)
@given(data=st.data())
def test_damaged_messages(key: str, data: st.DataObject) -> None:
    """A right message with some words of it overwritten, and perhaps cut off."""
    whole = next(message for name, message in WHOLE.items() if name in key)
    payload = bytearray(oracle.cdr(whole, data.draw(st.sampled_from(["little", "big"]))))
    for _ in range(data.draw(st.integers(1, 4))):
        at = 4 * data.draw(st.integers(0, len(payload) // 4 - 2))
        word = data.draw(any_float.map(lambda x: struct.pack("<d", x)) | st.binary(min_size=1, max_size=8))
        payload[at : at + len(word)] = word
    put(key, bytes(payload[: data.draw(st.sampled_from([len(payload)]) | st.integers(0, len(payload)))]))


@settings(max_examples=300, deadline=None)
@given(
    p=st.tuples(any_float, any_float, any_float),
    v=st.tuples(any_float, any_float, any_float),
    size=st.tuples(any_float, any_float, any_float),
    spread=st.lists(any_float, min_size=36, max_size=36),
    shape=st.integers(0, 255),
)
def test_any_numbers(
    p: tuple[float, ...], v: tuple[float, ...], size: tuple[float, ...], spread: list[float], shape: int
) -> None:
    item = oracle.tracked(1)
    item.kinematics.pose_with_covariance.pose.position = oracle.Xyz(*p)
    item.kinematics.twist_with_covariance.twist.linear = oracle.Xyz(*v)
    item.kinematics.twist_with_covariance.covariance = spread
    item.shape = oracle.Shape(shape, oracle.Polygon(), oracle.Xyz(*size))
    (_, key) = KEYS
    put(key, oracle.cdr(oracle.TrackedObjects(oracle.header(STAMP), [item])))


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(finite, finite, finite, st.floats(-3.0, 3.0)), max_size=20))
def test_what_is_right_gets_in(items: list[tuple[float, float, float, float]]) -> None:
    objects = []
    for number, (x, y, z, angle) in enumerate(items):
        item = oracle.tracked(number + 1, orientation=oracle.yaw(angle))
        item.kinematics.pose_with_covariance.pose.position = oracle.Xyz(x, y, z)
        objects.append(item)
    (_, key) = KEYS
    assert put(key, oracle.cdr(oracle.TrackedObjects(oracle.header(STAMP), objects))) == len(items)
