"""Bytes of component 196's services, written by hand from common.xml: what pymavlink must not decide alone."""

from __future__ import annotations

import struct

import pytest
from contract.test_mavlink_golden import crc_x25

from companion.link.events import Command
from companion.link.identity import autopilot_version, component_information_basic
from companion.link.mavlink import MavlinkCodec, packet_count
from companion.link.params import ParamList, ParamRead, ParamSet, value_message


def packet(message_id: int, extra: int, payload: bytes, *, system: int = 1, component: int = 196) -> bytes:
    cut = payload.rstrip(b"\x00") or payload[:1]
    body = bytes([len(cut), 0, 0, 0, system, component]) + message_id.to_bytes(3, "little") + cut
    return b"\xfd" + body + struct.pack("<H", crc_x25(body + bytes([extra])))


def test_param_value() -> None:
    # value f32, count u16, index u16, id 16 characters without a terminator, type 9 REAL32; CRC_EXTRA 220
    payload = struct.pack("<fHH16sB", 0.25, 19, 3, b"ABCDEFGHIJKLMNOP", 9)
    message = value_message("ABCDEFGHIJKLMNOP", 0.25, index=3, count=19)
    assert MavlinkCodec(system=1).encode(message) == packet(22, 220, payload)


def test_param_requests() -> None:
    codec = MavlinkCodec(system=1)
    station = {"system": 255, "component": 190}
    listing = packet(21, 159, struct.pack("<BB", 1, 196), **station)
    read = packet(20, 214, struct.pack("<hBB16s", -1, 1, 196, b"CA_KAPPA"), **station)
    by_index = packet(20, 214, struct.pack("<hBB16s", 5, 1, 0, b""), **station)
    setting = packet(23, 168, struct.pack("<fBB16sB", 1.5, 0, 0, b"CA_KAPPA", 9), **station)
    assert codec.receive(listing + read + by_index + setting) == [
        ParamList(),
        ParamRead("CA_KAPPA", -1),
        ParamRead("", 5),
        ParamSet("CA_KAPPA", 1.5, 9),
    ]


def test_commands_to_all_components_are_still_left_to_the_autopilot() -> None:
    codec = MavlinkCodec(system=1)
    command = struct.pack("<7fHBBB", 148.0, *[0.0] * 6, 512, 1, 0, 0)
    assert codec.receive(packet(76, 152, command, system=255, component=190)) == []
    command = struct.pack("<7fHBBB", 148.0, *[0.0] * 6, 512, 1, 196, 0)
    (event,) = codec.receive(packet(76, 152, command, system=255, component=190))
    assert isinstance(event, Command)


def test_autopilot_version() -> None:
    # capabilities u64 (PARAM_FLOAT 2, COMMAND_INT 8, PARAM_ENCODE_BYTEWISE 16, MAVLINK2 8192), uid u64, versions 4 u32,
    # vendor and product u16, three hashes of 8 bytes, uid2; CRC_EXTRA 178
    payload = struct.pack("<QQIIIIHH", 8218, 0, 0x020305FF, 0, 0, 0, 0, 0) + bytes(42)
    assert MavlinkCodec(system=1).encode(autopilot_version("2.3.5")) == packet(148, 178, payload)


def test_component_information_basic() -> None:
    """CRC_EXTRA from the names and types of common.xml, as the MAVLink guide describes it."""
    fields = [
        ("uint64_t", "capabilities", 0),
        ("uint32_t", "time_boot_ms", 0),
        ("uint32_t", "time_manufacture_s", 0),
        ("char", "vendor_name", 32),
        ("char", "model_name", 32),
        ("char", "software_version", 24),
        ("char", "hardware_version", 24),
        ("char", "serial_number", 32),
    ]
    text = b"COMPONENT_INFORMATION_BASIC "
    for kind, name, length in fields:
        text += f"{kind} {name} ".encode() + (bytes([length]) if length else b"")
    crc = crc_x25(text)
    extra = (crc & 0xFF) ^ (crc >> 8)
    payload = (
        struct.pack("<QII", 8218, 12_345, 0) + bytes(32) + b"companion".ljust(32, b"\0") + b"2.3.5".ljust(80, b"\0")
    )
    assert len(payload) == 160
    sent = MavlinkCodec(system=1).encode(component_information_basic("2.3.5", time_boot_ms=12_345))
    assert sent == packet(396, extra, payload)
    assert packet_count(sent) == 1


@pytest.mark.parametrize("version", ["", "unknown", "1.2"])
def test_a_version_that_is_none_is_zero(version: str) -> None:
    assert autopilot_version(version).flight_sw_version == 0
