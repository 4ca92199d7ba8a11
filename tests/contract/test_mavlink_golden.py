"""MAVLink against bytes written by hand from the specification, with a checksum of our own.

Packet: FD, length, incompatibility and compatibility flags, sequence, system, component, message id (3 bytes, little
endian), payload with trailing zeros cut (one byte at least stays), CRC-16/MCRF4XX over all but FD and then the
message's CRC_EXTRA. Payload fields stand by size, largest first. Constants are typed from common.xml.
"""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest

from companion.frames import q_enu_from_flu
from companion.link import mav
from companion.link.events import (
    Attitude,
    Command,
    CommandAck,
    Heartbeat,
    LandedState,
    Position,
    SetpointEcho,
    StatusText,
    SystemTime,
    TimesyncReply,
    TimesyncRequest,
)
from companion.link.geo import TangentPlane
from companion.link.mavlink import MavlinkCodec, SetpointRefused
from companion.link.reposition import CommandRefused, OriginUnknown, reposition_target
from companion.profiles import PROFILES

CRC_EXTRA = {
    0: 50,  # HEARTBEAT
    2: 137,  # SYSTEM_TIME
    31: 246,  # ATTITUDE_QUATERNION
    32: 185,  # LOCAL_POSITION_NED
    75: 158,  # COMMAND_INT
    76: 152,  # COMMAND_LONG
    77: 143,  # COMMAND_ACK
    84: 143,  # SET_POSITION_TARGET_LOCAL_NED
    85: 140,  # POSITION_TARGET_LOCAL_NED
    111: 34,  # TIMESYNC
    245: 130,  # EXTENDED_SYS_STATE
    247: 81,  # COLLISION
    253: 83,  # STATUSTEXT
    331: 91,  # ODOMETRY
    390: 156,  # ONBOARD_COMPUTER_STATUS
}


def crc_x25(data: bytes) -> int:
    """CRC-16/MCRF4XX bit by bit: reflected polynomial 0x8408, start 0xFFFF, nothing inverted at the end."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ (0x8408 if crc & 1 else 0)
    return crc


def packet(message_id: int, payload: bytes, *, sequence: int = 0, system: int = 1, component: int = 1) -> bytes:
    cut = payload.rstrip(b"\x00") or payload[:1]
    body = bytes([len(cut), 0, 0, sequence, system, component]) + message_id.to_bytes(3, "little") + cut
    return b"\xfd" + body + struct.pack("<H", crc_x25(body + bytes([CRC_EXTRA[message_id]])))


def ours(message_id: int, payload: bytes, sequence: int = 0) -> bytes:
    return packet(message_id, payload, sequence=sequence, system=1, component=196)


def test_own_checksum_has_the_catalogue_value() -> None:
    assert crc_x25(b"123456789") == 0x6F91  # CRC RevEng catalogue, CRC-16/MCRF4XX


# --- out -------------------------------------------------------------------------------------------------------


def test_heartbeat_bytes() -> None:
    # custom_mode u32, type 18, autopilot 8, base_mode 1 (custom), system_status 4, mavlink_version 3
    expected = bytes.fromhex("fd 09 00 00 00 01 c4 00 00 00  00 00 00 00 12 08 01 04 03")
    expected += struct.pack("<H", crc_x25(expected[1:] + b"\x32"))
    assert MavlinkCodec(system=1).encode_heartbeat(mav.STATE_ACTIVE) == expected


@pytest.mark.parametrize("mask", [0x0C3F, 0x043F])
def test_acceleration_setpoint_bytes_and_signs(mask: int) -> None:
    """East 1, north 2, up 3 leaves as north 2, east 1, down -3; counter-clockwise 0.5 rad/s as clockwise -0.5."""
    floats = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2.0, 1.0, -3.0, 0.0, -0.5]
    payload = struct.pack("<I11fHBBB", 12345, *floats, mask, 1, 1, 1)
    codec = MavlinkCodec(system=1)
    sent = codec.encode_setpoint(12345, np.array([1.0, 2.0, 3.0]), mask, yaw_rate_enu=0.5)
    assert sent == ours(84, payload)


def test_velocity_and_acceleration_setpoint_bytes() -> None:
    floats = [0.0, 0.0, 0.0, 5.0, 4.0, -6.0, 2.0, 1.0, -3.0, 0.0, 0.0]
    payload = struct.pack("<I11fHBBB", 7, *floats, 0x0C07, 1, 1, 1)
    a_enu, v_enu = np.array([1.0, 2.0, 3.0]), np.array([4.0, 5.0, 6.0])
    assert MavlinkCodec(system=1).encode_setpoint(7, a_enu, 0x0C07, v_enu=v_enu) == ours(84, payload)


def test_setpoint_addresses_the_latched_system_and_wraps_its_time() -> None:
    codec = MavlinkCodec()
    codec.system = 42
    sent = codec.encode_setpoint(2**32 + 9, np.ones(3), 0x0C3F)
    assert sent[5] == 42
    assert sent[10:14] == struct.pack("<I", 9)
    assert sent[-5:-2] == bytes([42, 1, 1])  # target system, target component, MAV_FRAME_LOCAL_NED


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e39, 1e4])
def test_setpoint_refuses_what_is_no_acceleration(bad: float) -> None:
    codec = MavlinkCodec()
    for axis in range(3):
        a_enu = np.zeros(3)
        a_enu[axis] = bad
        with pytest.raises(SetpointRefused, match="a_enu: expected finite"):
            codec.encode_setpoint(0, a_enu, 0x0C3F)
    with pytest.raises(SetpointRefused, match="yaw_rate"):
        codec.encode_setpoint(0, np.zeros(3), 0x043F, yaw_rate_enu=bad)
    with pytest.raises(SetpointRefused, match="v_enu"):
        codec.encode_setpoint(0, np.zeros(3), 0x0C07, v_enu=np.array([0.0, bad, 0.0]))


@pytest.mark.parametrize(
    ("mask", "named"),
    [
        (0x0E3F, "FORCE"),
        (0x1C3F, "unknown bits"),
        (0x0C38, "position ignored"),
        (0x0C3B, "position ignored"),
        (0x0C7F, "all three accelerations"),
        (0x0DFF, "all three accelerations"),
        (0x0C0F, "all three velocities"),
        (0x0C07, "v_enu: expected a velocity"),
    ],
)
def test_setpoint_refuses_masks_on_which_autopilots_stop_silently(mask: int, named: str) -> None:
    with pytest.raises(SetpointRefused, match=named):
        MavlinkCodec().encode_setpoint(0, np.zeros(3), mask)


def test_every_profile_has_a_mask_that_may_be_sent() -> None:
    for profile in PROFILES.values():
        MavlinkCodec().encode_setpoint(0, np.zeros(3), profile.type_mask)


def test_commands_bytes() -> None:
    codec = MavlinkCodec(system=1)
    interval = struct.pack("<7fHBBB", 32, 20_000, 0, 0, 0, 0, 0, 511, 1, 1, 0)
    assert codec.encode_set_message_interval(32, 50.0) == ours(76, interval, 0)
    offboard = struct.pack("<7fHBBB", 1, 6, 0, 0, 0, 0, 0, 176, 1, 1, 0)
    assert codec.encode_set_mode(PROFILES["px4"].external) == ours(76, offboard, 1)
    request = struct.pack("<7fHBBB", 148, 0, 0, 0, 0, 0, 0, 512, 1, 1, 0)
    assert codec.encode_request_message(148) == ours(76, request, 2)
    command = Command(92, (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), False, 0, 0, 0, 0.0, 245, 190, 1, 196)
    assert codec.encode_command_ack(command, 3) == ours(77, struct.pack("<HBBiBB", 92, 3, 0, 0, 245, 190), 3)


def test_timesync_bytes_and_sequence_numbers() -> None:
    codec = MavlinkCodec(system=1)
    assert codec.encode_timesync_request(77) == ours(111, struct.pack("<qq", 0, 77), 0)
    assert codec.encode_timesync_reply(tc1_ns=5, ts1_ns=77) == ours(111, struct.pack("<qq", 5, 77), 1)
    for _ in range(254):
        codec.encode_timesync_request(1)
    assert codec.encode_timesync_request(1)[4] == 0  # after 255


@pytest.mark.parametrize("length", [0, 1, 49, 50])
def test_short_text_is_one_packet(length: int) -> None:
    text = "x" * length
    expected = ours(253, struct.pack("<B50sHB", 4, text.encode(), 0, 0))
    assert MavlinkCodec(system=1).encode_statustext(4, text) == expected


@pytest.mark.parametrize(("length", "chunks"), [(51, [50, 1]), (100, [50, 50, 0]), (120, [50, 50, 20])])
def test_long_text_is_chunked_and_the_last_chunk_has_room_left(length: int, chunks: list[int]) -> None:
    text = "".join(chr(97 + i % 26) for i in range(length))
    expected, at = b"", 0
    for number, size in enumerate(chunks):
        expected += ours(253, struct.pack("<B50sHB", 4, text[at : at + size].encode(), 1, number), number)
        at += size
    assert MavlinkCodec(system=1).encode_statustext(4, text) == expected


def test_collision_bytes() -> None:
    sent = MavlinkCodec(system=1).encode_collision(
        track_number=9, threat_level=2, time_to_minimum_s=1.5, altitude_minimum_m=0.25, horizontal_minimum_m=0.5
    )
    assert sent == ours(247, struct.pack("<IfffBBB", 9, 1.5, 0.25, 0.5, 0, 0, 2))


def test_onboard_computer_status_bytes() -> None:
    unknown8, unknown32 = 0xFF, 0xFFFFFFFF
    payload = struct.pack("<QIII", 5_000_000, 60_000, 150, 4096)
    payload += struct.pack("<4I4I4I6I6I6I6I6I", *[unknown32] * 42)
    payload += struct.pack("<4h", *[0x7FFF] * 4)
    payload += bytes([0, 10, 30, *[unknown8] * 6, 20, *[unknown8] * 9, *[unknown8] * 14])
    payload += struct.pack("<b8b", *[0x7F] * 9) + struct.pack("<H", 0)
    sent = MavlinkCodec(system=1).encode_onboard_computer_status(
        time_boot_ms=5000, uptime_ms=60_000, cpu_percent=(10, 30), ram_used_mib=150, ram_total_mib=4096
    )
    assert sent == ours(390, payload)


# --- in --------------------------------------------------------------------------------------------------------


def receive(message_id: int, payload: bytes, *, system: int = 1, component: int = 1) -> list[object]:
    return list(MavlinkCodec(system=1).receive(packet(message_id, payload, system=system, component=component)))


def test_heartbeat_of_px4_offboard_armed() -> None:
    payload = struct.pack("<IBBBBB", 6 << 16, 2, 12, 0x81, 4, 3)
    assert receive(0, payload, system=7) == [Heartbeat(7, 1, 12, 2, 0x60000, True, 4)]
    payload = struct.pack("<IBBBBB", 4, 2, 3, 0x01, 3, 3)
    assert receive(0, payload) == [Heartbeat(1, 1, 3, 2, 4, False, 3)]


def test_mavlink_1_heartbeat_is_understood() -> None:
    body = bytes([9, 0, 1, 1, 0]) + struct.pack("<IBBBBB", 0, 2, 12, 0, 3, 3)
    data = b"\xfe" + body + struct.pack("<H", crc_x25(body + b"\x32"))
    assert MavlinkCodec().receive(data) == [Heartbeat(1, 1, 12, 2, 0, False, 3)]


def test_local_position_axes_and_time() -> None:
    (position,) = receive(32, struct.pack("<I6f", 1500, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0))
    assert isinstance(position, Position)
    assert position.stamp_ns == 1_500_000_000
    assert position.p_enu.tolist() == [2.0, 1.0, -3.0]
    assert position.v_enu.tolist() == [5.0, 4.0, -6.0]
    assert not position.p_enu.flags.writeable
    assert position.reset_counter is None


R2 = math.sqrt(0.5)
ATTITUDES = {
    # name: (q of the FRD body in NED (w, x, y, z), q of the FLU body in ENU)
    "level, nose north": ((1, 0, 0, 0), (R2, 0, 0, R2)),
    "level, nose east": ((R2, 0, 0, R2), (1, 0, 0, 0)),
    "level, nose south": ((0, 0, 0, 1), (R2, 0, 0, -R2)),
    "nose up, belly to the north": ((R2, 0, R2, 0), (0.5, 0.5, -0.5, 0.5)),
    "nose north, right wing down": ((R2, R2, 0, 0), (0.5, 0.5, 0.5, 0.5)),
}


def rotated(q: tuple[float, ...], v: tuple[float, float, float]) -> np.ndarray:
    """R(q) v with the rotation matrix written out: independent of companion.frames."""
    w, x, y, z = q
    matrix = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(matrix) @ np.array(v)


@pytest.mark.parametrize("name", ATTITUDES)
def test_attitude_quaternion_conventions(name: str) -> None:
    q_ned, expected = ATTITUDES[name]
    (attitude,) = receive(31, struct.pack("<I11f", 20, *q_ned, 0, 0, 0, 0, 0, 0, 0))
    assert isinstance(attitude, Attitude)
    assert attitude.stamp_ns == 20_000_000
    assert attitude.q_enu_from_flu == pytest.approx(expected, abs=1e-7)
    # the body's axes end up where they are in the world: forward, and left = minus right, up = minus down
    for flu, frd in (((1, 0, 0), (1, 0, 0)), ((0, 1, 0), (0, -1, 0)), ((0, 0, 1), (0, 0, -1))):
        north, east, down = rotated(q_ned, frd)
        assert rotated(tuple(attitude.q_enu_from_flu), flu) == pytest.approx([east, north, -down], abs=1e-6)


def test_attitude_equals_the_general_conversion() -> None:
    rng = np.random.default_rng(1)
    for _ in range(100):
        q = rng.normal(size=4)
        q = (q / np.linalg.norm(q)).astype(np.float32)
        (attitude,) = receive(31, struct.pack("<I11f", 20, *q, 0, 0, 0, 0, 0, 0, 0))
        assert attitude.q_enu_from_flu == pytest.approx(q_enu_from_flu(q / np.linalg.norm(q)), abs=1e-6)
        assert np.linalg.norm(attitude.q_enu_from_flu) == pytest.approx(1.0, abs=1e-12)


def odometry(
    *,
    q: tuple[float, ...],
    velocity: tuple[float, ...],
    frame: int = 1,
    child: int = 12,
    time_usec: int = 1_500_000,
    variances: tuple[float, float, float] | None = None,
) -> bytes:
    pose = [math.nan] * 21
    if variances is not None:
        pose = [0.0] * 21
        pose[0], pose[6], pose[11] = variances
    numbers = [1.0, 2.0, 3.0, *q, *velocity, 0.0, 0.0, 0.0, *pose, *[math.nan] * 21]
    return struct.pack("<Q55fBBBBb", time_usec, *numbers, frame, child, 9, 3, 50)


def test_odometry_velocity_is_rotated_out_of_the_body() -> None:
    """Nose east, flying 5 m/s forward, 1 m/s to the right (south) and 2 m/s down."""
    attitude, position = receive(331, odometry(q=(R2, 0, 0, R2), velocity=(5.0, 1.0, 2.0)))
    assert isinstance(position, Position)
    assert isinstance(attitude, Attitude)
    assert position.stamp_ns == attitude.stamp_ns == 1_500_000_000
    assert position.p_enu.tolist() == [2.0, 1.0, -3.0]
    assert position.v_enu == pytest.approx([5.0, -1.0, -2.0], abs=1e-6)
    assert position.reset_counter == 9
    assert position.p_std_m == 0.0
    assert attitude.q_enu_from_flu == pytest.approx([1.0, 0.0, 0.0, 0.0], abs=1e-7)


def test_odometry_rolled_and_pitched_velocity() -> None:
    q = (0.5, 0.5, 0.5, 0.5)
    _, position = receive(331, odometry(q=q, velocity=(1.0, 2.0, 3.0)))
    north, east, down = rotated(q, (1.0, 2.0, 3.0))
    assert position.v_enu == pytest.approx([east, north, -down], abs=1e-6)


def test_odometry_local_velocity_and_covariance() -> None:
    payload = odometry(q=(R2, 0, 0, R2), velocity=(4.0, 5.0, 6.0), child=1, variances=(0.01, 0.04, 0.09))
    _, position = receive(331, payload)
    assert position.v_enu.tolist() == [5.0, 4.0, -6.0]
    assert position.p_std_m == pytest.approx(0.3, rel=1e-6)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"frame": 20}, "unknown_frame"),
        ({"child": 4}, "unknown_frame"),
        ({"time_usec": 1_700_000_000_000_000}, "unix_stamp"),
    ],
)
def test_odometry_that_cannot_be_used_is_counted(changes: dict[str, int], reason: str) -> None:
    codec = MavlinkCodec()
    assert codec.receive(packet(331, odometry(q=(1, 0, 0, 0), velocity=(0, 0, 0), **changes))) == []
    assert codec.counts[reason] == 1


def test_landed_states() -> None:
    seen = [receive(245, bytes([0, state]))[0] for state in range(6)]
    assert seen == [
        LandedState(1, 1, None, False, False),
        LandedState(1, 1, False, False, False),
        LandedState(1, 1, True, False, False),
        LandedState(1, 1, False, True, False),
        LandedState(1, 1, True, False, True),
        LandedState(1, 1, None, False, False),
    ]


def test_acks_times_and_texts() -> None:
    assert receive(77, struct.pack("<HBBiBB", 176, 4, 0, 0, 1, 196)) == [CommandAck(176, 4, 1, 1, 1, 196)]
    assert receive(111, struct.pack("<qq", 0, 9)) == [TimesyncRequest(1, 1, 9)]
    assert receive(111, struct.pack("<qq", 8, 9)) == [TimesyncReply(1, 1, 8, 9)]
    unix_us = 1_700_000_000_000_000
    assert receive(2, struct.pack("<QI", unix_us, 40)) == [SystemTime(1, 1, unix_us * 1000, 40_000_000)]
    assert receive(253, struct.pack("<B50sHB", 4, b"Arm denied", 0, 0)) == [StatusText(1, 1, 4, "Arm denied")]


def test_chunked_text_is_joined_and_a_lost_chunk_loses_it() -> None:
    def chunk(text: bytes, number: int, text_id: int = 5) -> bytes:
        return packet(253, struct.pack("<B50sHB", 3, text, text_id, number))

    codec = MavlinkCodec()
    assert codec.receive(chunk(b"a" * 50, 0)) == []
    assert codec.receive(chunk(b"b" * 50, 0, text_id=6)) == []  # interleaved
    assert codec.receive(chunk("ü".encode() * 10, 1)) == [StatusText(1, 1, 3, "a" * 50 + "ü" * 10)]
    assert codec.receive(chunk(b"late", 2, text_id=6)) == []
    assert codec.receive(chunk(b"c" * 50, 0, text_id=6) + chunk(b"", 1, text_id=6)) == [StatusText(1, 1, 3, "c" * 50)]


def test_setpoint_echo_keeps_what_the_mask_uses() -> None:
    nan = math.nan
    payload = struct.pack("<I11fHB", 30, nan, nan, nan, nan, nan, nan, 2.0, 1.0, -3.0, nan, nan, 0x0C3F, 1)
    (echo,) = receive(85, payload)
    assert isinstance(echo, SetpointEcho)
    assert (echo.stamp_ns, echo.type_mask, echo.frame) == (30_000_000, 0x0C3F, 1)
    assert echo.a_enu.tolist() == [1.0, 2.0, 3.0]
    assert echo.v_enu.tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("slot", range(6))
@pytest.mark.parametrize(("bad", "reason"), [(math.nan, "not_finite"), (math.inf, "not_finite"), (2e5, "out_of_range")])
def test_position_that_cannot_be_true_is_dropped_and_counted(slot: int, bad: float, reason: str) -> None:
    numbers = [0.0] * 6
    numbers[slot] = bad
    codec = MavlinkCodec()
    assert codec.receive(packet(32, struct.pack("<I6f", 5, *numbers))) == []
    assert codec.counts[reason] == 1


@pytest.mark.parametrize("q", [(0, 0, 0, 0), (0.5, 0, 0, 0), (1, 1, 1, 1), (math.nan, 0, 0, 1)])
def test_attitude_that_is_none_is_dropped(q: tuple[float, ...]) -> None:
    assert receive(31, struct.pack("<I11f", 20, *q, 0, 0, 0, 0, 0, 0, 0)) == []


# --- commands --------------------------------------------------------------------------------------------------


def command_int(
    *, x: int = 0, y: int = 0, z: float = 0.0, frame: int = 1, system: int = 1, component: int = 196
) -> bytes:
    return struct.pack("<4fiifHBBBBB", -1.0, 1.0, 0.0, math.nan, x, y, z, 192, system, component, frame, 0, 0)


def test_reposition_in_local_ned_is_a_target_in_enu() -> None:
    """12.3456 m north, 2 m west, 1.5 m up."""
    (command,) = receive(75, command_int(x=123_456, y=-20_000, z=-1.5), system=255, component=190)
    assert isinstance(command, Command)
    assert (command.command, command.is_int, command.frame) == (mav.CMD_DO_REPOSITION, True, 1)
    assert (command.from_system, command.from_component) == (255, 190)
    assert reposition_target(command) == pytest.approx([-2.0, 12.3456, 1.5])


@pytest.mark.parametrize("frame", [0, 5])
def test_reposition_in_a_global_frame_goes_through_the_origin(frame: int) -> None:
    """A thousandth of a degree at 47.4 N is 111.179 m north or 75.487 m east (WGS84 radii of curvature)."""
    origin = TangentPlane(47.4, 8.5, 0.0)
    (command,) = receive(75, command_int(x=474_010_000, y=85_010_000, z=12.0, frame=frame))
    assert reposition_target(command, origin) == pytest.approx([75.487, 111.179, 12.0], abs=0.005)
    with pytest.raises(OriginUnknown) as caught:
        reposition_target(command)
    assert caught.value.result == mav.RESULT_TEMPORARILY_REJECTED == 1


@pytest.mark.parametrize(
    ("change", "result"),
    [
        ({"frame": 6}, 9),
        ({"z": math.nan}, 2),
        ({"frame": 0, "x": 910_000_000}, 2),
        ({"frame": 0, "y": -1_810_000_000}, 2),
    ],
)
def test_reposition_refusals_carry_their_result(change: dict[str, float], result: int) -> None:
    (command,) = receive(75, command_int(**change))
    with pytest.raises(CommandRefused) as caught:
        reposition_target(command, TangentPlane(0.0, 0.0, 0.0))
    assert caught.value.result == result


def test_reposition_as_command_long_is_answered_int_only() -> None:
    (command,) = receive(76, struct.pack("<7fHBBB", 0, 0, 0, 0, 1, 2, 3, 192, 1, 196, 0))
    with pytest.raises(CommandRefused) as caught:
        reposition_target(command)
    assert caught.value.result == mav.RESULT_COMMAND_INT_ONLY == 8


def test_engage_command_and_who_is_addressed() -> None:
    def to(system: int, component: int) -> list[object]:
        return receive(76, struct.pack("<7fHBBB", 1, 0, 0, 0, 0, 0, 0, 92, system, component, 0), system=245)

    expected = Command(92, (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), False, 0, 0, 0, 0.0, 245, 1, 1, 196)
    assert to(1, 196) == [expected]
    assert len(to(0, 196)) == 1
    assert to(1, 0) == to(0, 0) == to(1, 1) == to(2, 196) == []
