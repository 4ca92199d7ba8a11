"""Whatever arrives: nothing raises, nothing that is not finite gets in, memory stays bounded."""

from __future__ import annotations

import dataclasses
import json
import math
import struct
from contextlib import suppress

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.errors import FrameRejected
from companion.link import wire
from companion.link.decode import DECODERS
from companion.link.events import Command
from companion.link.inbox import ObstacleInbox
from companion.link.mavlink import MavlinkCodec, SetpointRefused
from companion.link.reposition import CommandRefused, reposition_target
from companion.link.timesync import TimeSync

any_float = st.floats(width=64) | st.sampled_from([math.nan, math.inf, -math.inf, 1e308, -0.0, 5e-324])
any_int64 = st.integers(-(2**63), 2**63 - 1)


def assert_finite(event: object) -> None:
    if isinstance(event, Command):
        return  # parameters pass as sent: NaN means "default" in many commands
    for field in dataclasses.fields(event):  # type: ignore[arg-type]
        value = getattr(event, field.name)
        if isinstance(value, np.ndarray | float):
            assert np.isfinite(value).all()


@settings(max_examples=300, deadline=None)
@given(st.lists(st.binary(max_size=400), max_size=8))
def test_random_bytes_never_raise_and_do_not_pile_up(chunks: list[bytes]) -> None:
    codec = MavlinkCodec()
    for chunk in chunks:
        codec.receive(chunk)
    assert len(codec._framer._pending) <= 280


@st.composite
def valid_packets(draw: st.DrawFn) -> bytes:
    """A packet with a right checksum and any payload at all, of a message that the daemon reads."""
    message_id = draw(st.sampled_from([*DECODERS, 75, 76, 253]))
    kind = dialect.mavlink_map[message_id]
    payload = draw(st.binary(min_size=1, max_size=kind.unpacker.size))
    body = bytes([len(payload), 0, 0, 0, 1, 1]) + message_id.to_bytes(3, "little") + payload
    crc = dialect.x25crc(body + bytes([kind.crc_extra])).crc
    return b"\xfd" + body + struct.pack("<H", crc)


@settings(max_examples=400, deadline=None)
@given(st.lists(valid_packets(), min_size=1, max_size=5))
def test_valid_packets_with_any_content_give_finite_events(packets: list[bytes]) -> None:
    codec = MavlinkCodec()
    for event in codec.receive(b"".join(packets)):
        assert_finite(event)
        if isinstance(event, Command):
            with suppress(CommandRefused):
                assert np.isfinite(reposition_target(event)).all()
    assert codec.counts["messages"] == len(packets)


@settings(max_examples=300, deadline=None)
@given(st.integers(0, 2**40), st.tuples(any_float, any_float, any_float), st.integers(0, 0xFFFF), any_float)
def test_a_setpoint_leaves_finite_or_not_at_all(
    time_boot_ms: int, a: tuple[float, float, float], mask: int, rate: float
) -> None:
    codec = MavlinkCodec()
    try:
        data = codec.encode_setpoint(time_boot_ms, np.array(a), mask, yaw_rate_enu=rate)
    except SetpointRefused:
        return
    (message,) = dialect.MAVLink(None).parse_buffer(data)
    numbers = [message.afx, message.afy, message.afz, message.vx, message.yaw_rate]
    assert all(math.isfinite(number) for number in numbers)
    assert not message.type_mask & 0x0200


@settings(max_examples=100, deadline=None)
@given(st.text(max_size=400))
def test_any_text_survives_its_chunks(text: str) -> None:
    codec = MavlinkCodec()
    clean = text.encode("utf-8", "replace").decode().replace("\x00", " ")
    events = codec.receive(codec.encode_statustext(6, text))
    assert [event.text for event in events] == [clean]


json_values = st.recursive(
    st.none() | st.booleans() | any_int64 | any_float | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=6) | st.dictionaries(st.text(max_size=10), inner, max_size=6),
    max_leaves=20,
)
triples = st.tuples(any_float, any_float, any_float) | st.lists(any_float, max_size=4)
obstacles = st.fixed_dictionaries(
    {"position": triples | json_values, "radius": any_float | json_values},
    optional={
        "id": st.text(max_size=70) | json_values,
        "position_std": any_float | json_values,
        "velocity": triples | json_values,
        "velocity_std": any_float | json_values,
        "covariance": st.lists(any_float, min_size=21, max_size=21) | json_values,
    },
)
frames = st.fixed_dictionaries(
    {
        "stamp_ns": any_int64 | json_values,
        "clock": st.sampled_from(["unix", "vehicle"]) | json_values,
        "obstacles": st.lists(obstacles, max_size=4) | json_values,
    },
    optional={"frame": st.sampled_from(["local_enu", "local_ned"]) | json_values, "kind": json_values},
)


@settings(max_examples=150, deadline=None)
@given(
    st.lists(
        st.binary(max_size=200) | frames.map(msgspec.msgpack.encode) | frames.map(lambda f: json.dumps(f).encode()),
        max_size=6,
    ),
    any_int64,
    st.none() | any_int64,
)
def test_obstacle_ingress_never_raises_and_lets_only_finite_numbers_in(
    payloads: list[bytes], now_ns: int, offset_ns: int | None
) -> None:
    inbox = ObstacleInbox(queue=4, max_age_s=0.5, on_report=lambda line: None)
    for payload in payloads:
        inbox.push("s", payload)
        inbox.push_marker("t", payload)
    for frame in inbox.drain(now_ns, unix_minus_vehicle_ns=offset_ns):
        assert now_ns - 500_000_000 <= frame.stamp_ns <= now_ns + 100_000_000
        for detection in frame.detections:
            assert np.isfinite(detection.p_enu).all()
            assert 0.0 < detection.radius_m <= 100.0
            for array in (detection.v_enu, detection.covariance):
                assert array is None or np.isfinite(array).all()


@settings(max_examples=300, deadline=None)
@given(st.tuples(*[st.floats(-1e4, 1e4)] * 3), st.floats(1e-3, 100.0), st.booleans())
def test_a_good_frame_passes_unchanged_in_both_encodings(
    position: tuple[float, float, float], radius: float, ned: bool
) -> None:
    ball = wire.Obstacle(position=position, radius=radius)
    frame = wire.ObstacleFrame(stamp_ns=5, clock="vehicle", frame="local_ned" if ned else "local_enu", obstacles=[ball])
    x, y, z = position
    expected = [y, x, -z] if ned else [x, y, z]
    for encoding in (wire.JSON, wire.MSGPACK):
        inbox = ObstacleInbox(queue=4, max_age_s=0.5)
        inbox.push("s", wire.encode(frame, encoding), encoding)
        ((detection,),) = [arrived.detections for arrived in inbox.drain(5)]
        assert detection.p_enu.tolist() == expected
        assert detection.radius_m == radius


@pytest.mark.parametrize("kind", sorted(wire.INCOMING.values(), key=lambda kind: kind.__name__))
@settings(max_examples=100, deadline=None)
@given(data=st.binary(max_size=100) | json_values.map(msgspec.msgpack.encode))
def test_decode_raises_nothing_but_frame_rejected(kind: type, data: bytes) -> None:
    for encoding in (None, wire.JSON, wire.MSGPACK):
        with suppress(FrameRejected):
            assert isinstance(wire.decode(data, kind, encoding), kind)


@settings(max_examples=300, deadline=None)
@given(st.lists(st.tuples(any_int64, st.integers(0, 3), st.integers(0, 10**12)), max_size=20))
def test_timesync_takes_any_reply(replies: list[tuple[int, int, int]]) -> None:
    sync, now_ns = TimeSync(), 1
    for tc1_ns, pick, step_ns in replies:
        ts1_ns = sync.request(now_ns)
        now_ns += step_ns
        sync.reply(tc1_ns=tc1_ns, ts1_ns=ts1_ns - pick, now_ns=now_ns, unix_ns=now_ns)
        assert sync.settled == (sync.unix_minus_vehicle_ns is not None)
