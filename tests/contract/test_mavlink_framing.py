"""Finding packets in a dirty stream. Packets are made by pymavlink as another program would make them."""

from __future__ import annotations

import random

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.link.events import Heartbeat, TimesyncReply
from companion.link.framing import Framer
from companion.link.mavlink import MavlinkCodec


@pytest.fixture
def autopilot() -> dialect.MAVLink:
    return dialect.MAVLink(None, 1, 1)


def reply(autopilot: dialect.MAVLink, number: int) -> bytes:
    return dialect.MAVLink_timesync_message(number, 0xFDFE).pack(autopilot)


def test_one_byte_at_a_time(autopilot: dialect.MAVLink) -> None:
    codec = MavlinkCodec()
    data = b"".join(reply(autopilot, number) for number in range(1, 6))
    events = [event for byte in data for event in codec.receive(bytes([byte]))]
    assert events == [TimesyncReply(1, 1, number, 0xFDFE) for number in range(1, 6)]
    assert codec.counts == {"messages": 5}


@pytest.mark.parametrize("garbage", [b"noise", b"\xfd", b"\xfe", b"\xfd\xff", b"\xfd\x09\x00", bytes(range(256)) * 3])
def test_garbage_between_packets_costs_nothing_but_itself(autopilot: dialect.MAVLink, garbage: bytes) -> None:
    codec = MavlinkCodec()
    data = b"".join(reply(autopilot, number) + garbage for number in range(1, 30))
    events = codec.receive(data + bytes(300))
    assert [event.tc1_ns for event in events] == list(range(1, 30))


def test_a_damaged_header_does_not_hold_back_the_next_datagram(autopilot: dialect.MAVLink) -> None:
    codec = MavlinkCodec()
    assert codec.receive(b"\xfd\xff\x00\x00\x00\x01\x01") == []  # claims 267 bytes that never come
    assert codec.receive(reply(autopilot, 5)) == [TimesyncReply(1, 1, 5, 0xFDFE)]
    assert codec.counts == {"bad_packets": 1, "garbage_bytes": 6, "messages": 1}


def test_every_single_bit_flip_is_caught(autopilot: dialect.MAVLink) -> None:
    good, following = reply(autopilot, 5), reply(autopilot, 6)
    for bit in range(8 * len(good)):
        damaged = bytearray(good)
        damaged[bit // 8] ^= 1 << bit % 8
        codec = MavlinkCodec()
        events = codec.receive(bytes(damaged) + following + bytes(300))
        assert events == [TimesyncReply(1, 1, 6, 0xFDFE)], f"bit {bit}"


def test_unknown_messages_are_counted_once_and_hide_nothing(autopilot: dialect.MAVLink) -> None:
    payload = b"\xfd\xfe\x09\x00 some text \xfd\x00\x00"
    unknown = b"\xfd" + bytes([len(payload), 0, 0, 0, 1, 1, 0xAA, 0xAA, 0xAA]) + payload + b"\x12\x34"
    codec = MavlinkCodec()
    assert codec.receive(unknown + reply(autopilot, 8)) == [TimesyncReply(1, 1, 8, 0xFDFE)]
    assert codec.receive(unknown) == []
    assert codec.receive(reply(autopilot, 9)) == [TimesyncReply(1, 1, 9, 0xFDFE)]
    assert codec.counts["unknown"] == 2
    assert codec.counts["messages"] == 2
    assert codec.counts["garbage_bytes"] == 0


def test_incompatible_flags_are_refused_and_signed_packets_are_measured_right(autopilot: dialect.MAVLink) -> None:
    plain = bytearray(reply(autopilot, 5))
    plain[2] = 0x02
    codec = MavlinkCodec()
    assert codec.receive(bytes(plain) + bytes(300)) == []
    autopilot.signing.secret_key, autopilot.signing.sign_outgoing = bytes(32), True
    signed = reply(autopilot, 5)
    assert signed[2] == 1
    assert len(signed) == len(plain) + 13
    assert MavlinkCodec().receive(signed + signed) == [TimesyncReply(1, 1, 5, 0xFDFE)] * 2


def test_a_longer_stream_cut_at_random_equals_the_uncut_one(autopilot: dialect.MAVLink) -> None:
    rng = random.Random(3)
    data = b"".join(
        dialect.MAVLink_heartbeat_message(2, 12, 0x81, number, 4, 3).pack(autopilot) + rng.randbytes(rng.randrange(8))
        for number in range(200)
    ) + bytes(300)
    whole = [event for event in MavlinkCodec().receive(data) if isinstance(event, Heartbeat)]
    assert [event.custom_mode for event in whole] == list(range(200))
    codec, events, at = MavlinkCodec(), [], 0
    while at < len(data):
        size = rng.randrange(1, 60)
        events += codec.receive(data[at : at + size])
        at += size
    assert [event.custom_mode for event in events if isinstance(event, Heartbeat)] == list(range(200))


def test_memory_stays_bounded_under_headers_that_claim_much() -> None:
    framer = Framer()
    for _ in range(2000):
        framer.push(b"\xfd\xff\x00")
    assert len(framer._pending) <= 280
