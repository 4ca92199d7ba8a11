"""Bytes of the simulated autopilot against packets written by hand from the MAVLink specification."""

from __future__ import annotations

import math
import random
import struct

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sim_bridge.mavlink import Decoder, Encoder, Packet, q_ned_from_frd
from sim_bridge.messages import (
    Ack,
    AttitudeTarget,
    Command,
    LocalSetpoint,
    MissionRequest,
    ParamRead,
    ParamWrite,
    Ping,
    Result,
    Sender,
    Severity,
    StationHeartbeat,
    Sticks,
    Text,
    Timesync,
)


def crc_x25(data: bytes) -> int:
    """CRC-16/MCRF4XX as the specification's C code has it."""
    crc = 0xFFFF
    for byte in data:
        t = (byte ^ crc) & 0xFF
        t = (t ^ t << 4) & 0xFF
        crc = (crc >> 8 ^ t << 8 ^ t << 3 ^ t >> 4) & 0xFFFF
    return crc


def packet(message_id: int, payload: bytes, crc_extra: int, *, seq: int = 0, sender: tuple[int, int] = (1, 1)) -> bytes:
    payload = payload.rstrip(b"\0") or b"\0"  # MAVLink 2 cuts trailing zeros
    head = struct.pack("<BBBBBB", len(payload), 0, 0, seq, *sender) + message_id.to_bytes(3, "little")
    return b"\xfd" + head + payload + struct.pack("<H", crc_x25(head + payload + bytes([crc_extra])))


def read(raw: bytes) -> Packet:
    (only,) = Decoder().packets(raw)
    return only


def test_heartbeat_bytes() -> None:
    # custom_mode u32, type, autopilot, base_mode, system_status, mavlink_version; CRC_EXTRA 50
    payload = struct.pack("<IBBBBB", 6 << 16, 2, 12, 0x9D, 4, 3)
    message = dialect.MAVLink_heartbeat_message(2, 12, 0x9D, 6 << 16, 4, 3)
    assert Encoder().pack(message) == packet(0, payload, 50)


def test_command_ack_bytes_name_the_receiver_and_count_up() -> None:
    # command u16, result u8, progress u8, result_param2 i32, target_system u8, target_component u8; CRC_EXTRA 143
    encoder = Encoder()
    for seq in range(258):
        payload = struct.pack("<HBBiBB", 400, 1, 0, 0, 245, 190)
        ack = Ack(400, Result.TEMPORARILY_REJECTED, Sender(245, 190))
        assert encoder.ack(ack) == packet(77, payload, 143, seq=seq % 256)


def test_statustext_and_timesync_bytes() -> None:
    payload = struct.pack("<B50sHB", 2, b"Failsafe", 0, 0)  # severity, text, id, chunk_seq; CRC_EXTRA 83
    assert Encoder().text(Text(Severity.CRITICAL, "Failsafe")) == packet(253, payload, 83)
    payload = struct.pack("<qq", 5_000_000_000, 77)  # tc1, ts1; CRC_EXTRA 34
    assert Encoder().timesync(Timesync(0, 77, Sender(1, 196)), 5_000_000_000) == packet(111, payload, 34)


def test_long_texts_go_in_chunks() -> None:
    text = "Failsafe: ground station lost, holding 5 s, then returning"  # 58 characters
    first = struct.pack("<B50sHB", 2, text[:50].encode(), 1, 0)
    second = struct.pack("<B50sHB", 2, text[50:].encode(), 1, 1)
    encoder = Encoder()
    expected = packet(253, first, 83) + packet(253, second, 83, seq=1)
    assert encoder.text(Text(Severity.CRITICAL, text)) == expected
    chunks = dialect.MAVLink(None).parse_buffer(encoder.text(Text(Severity.CRITICAL, "x" * 100)))
    # a full chunk does not end the text: an empty one follows
    assert [(m.text, m.id, m.chunk_seq) for m in chunks] == [("x" * 50, 2, 0), ("x" * 50, 2, 1), ("", 2, 2)]


def test_ping_missions_and_protocol_version_bytes() -> None:
    # time_usec u64, seq u32, target_system u8, target_component u8; CRC_EXTRA 237
    request = struct.pack("<QIBB", 123_456_789_012, 7, 0, 0)
    ping = read(packet(4, request, 237, sender=(245, 190))).content
    assert ping == Ping(123_456_789_012, 7, Sender(245, 190))
    assert Encoder().ping(ping) == packet(4, struct.pack("<QIBB", 123_456_789_012, 7, 245, 190), 237)
    answer = packet(4, struct.pack("<QIBB", 1, 7, 1, 1), 237)
    assert read(answer).content is None  # an answer, not a request
    wanted = read(packet(43, struct.pack("<BBB", 1, 1, 1), 132, sender=(245, 190))).content  # of the fence
    assert wanted == MissionRequest(43, 1, 0, Sender(245, 190))
    # count u16, target_system, target_component, mission_type; CRC_EXTRA 221 (opaque_id, an extension, is 0)
    assert Encoder().no_mission(wanted) == packet(44, struct.pack("<HBBB", 0, 245, 190, 1), 221)
    announced = MissionRequest(44, 0, 3, Sender(245, 190))  # target_system, target_component, type 4: NO_SPACE
    assert Encoder().no_mission(announced) == packet(47, struct.pack("<BBBB", 245, 190, 4, 0), 153)
    # version, min, max u16, two hashes of 8; CRC_EXTRA 217
    assert Encoder(3).protocol_version() == packet(300, struct.pack("<HHH16x", 200, 100, 200), 217, sender=(3, 1))


def test_body_frame_global_and_attitude_setpoints() -> None:
    values = (0.0, 0.0, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 0.25, 0.5)  # forward, right, down
    payload = struct.pack("<I11fHBBB", 1250, *values, 0x0DC7, 1, 1, 8)
    got = read(packet(84, payload, 143, sender=(1, 196))).content
    assert isinstance(got, LocalSetpoint)
    assert (got.v_enu, got.a_enu, got.frame) == ((1.0, -2.0, -3.0), (4.0, -5.0, -6.0), 8)  # FLU
    # time u32, lat lon i32, alt vx vy vz ax ay az yaw yaw_rate f32, mask u16, targets, frame; CRC_EXTRA 5
    place = (473977420 + 89932, 85455940, 490.0)  # 8.9932e-3 deg north: 1000 m
    payload = struct.pack("<Iii9fHBBB", 1250, *place, 1.0, 2.0, 3.0, 0, 0, 0, 0.25, 0.5, 0x0DF8, 1, 1, 6)
    got = read(packet(86, payload, 5, sender=(1, 196))).content
    assert isinstance(got, LocalSetpoint)
    assert got.p_enu == pytest.approx((0.0, 1000.0, 490.0), abs=0.01)
    assert (got.v_enu, got.frame, got.is_global) == ((2.0, 1.0, -3.0), 6, True)
    # time u32, q 4 f32, three rates f32, thrust f32, target_system, target_component, type_mask; CRC_EXTRA 49
    half = math.sqrt(0.5)  # NED from FRD: heading east
    payload = struct.pack("<I8fBBB", 1250, half, 0.0, 0.0, half, 0.1, 0.2, 0.3, 0.45, 1, 1, 0x03)
    target = read(packet(82, payload, 49, sender=(1, 196))).content
    assert isinstance(target, AttitudeTarget)
    assert target.q_wxyz == pytest.approx((1.0, 0.0, 0.0, 0.0), abs=1e-6)  # east, level
    assert target.omega_flu == pytest.approx((0.1, -0.2, -0.3))
    assert (target.thrust, target.type_mask) == (pytest.approx(0.45), 0x03)


def test_sticks_and_the_heartbeats_of_ground_stations() -> None:
    # x y z r i16, buttons u16, target u8; CRC_EXTRA 243: forward, right, throttle 0 to 1000, clockwise
    payload = struct.pack("<hhhhHB", 500, 250, 750, -100, 0, 1)
    sticks = read(packet(69, payload, 243, sender=(245, 190)))
    assert sticks.target == Sender(1, 0)
    assert sticks.content == Sticks(0.5, -0.25, 0.5, 0.1, Sender(245, 190))
    payload = struct.pack("<hhhhHB", 0x7FFF, 0, 500, 0, 0, 1)
    assert read(packet(69, payload, 243)).content is None
    # eight channels u16, target_system, target_component; CRC_EXTRA 124: roll, pitch, throttle, yaw
    payload = struct.pack("<8HBB", 1625, 1750, 1250, 1500, 0, 0, 0, 0, 1, 1)
    assert read(packet(70, payload, 124, sender=(245, 190))).content == Sticks(
        0.5, -0.25, -0.5, 0.0, Sender(245, 190), radio=True
    )
    payload = struct.pack("<8HBB", 0, 0, 0, 0, 0, 0, 0, 0, 1, 1)
    released = read(packet(70, payload, 124)).content
    assert isinstance(released, Sticks)
    assert released.released
    station = struct.pack("<IBBBBB", 0, 6, 8, 0, 4, 3)
    assert read(packet(0, station, 50, sender=(245, 190))).content == StationHeartbeat(Sender(245, 190))
    assert read(packet(0, struct.pack("<IBBBBB", 0, 18, 8, 0, 4, 3), 50)).content is None


def test_integer_parameters_travel_bytewise() -> None:
    payload = struct.pack("<iHH16sB", 5, 8, 2, b"COM_OBL_RC_ACT", 6)  # CRC_EXTRA 220
    assert Encoder().param("COM_OBL_RC_ACT", 5, 2, 8) == packet(22, payload, 220)
    payload = struct.pack("<fHH16sB", 1.5, 8, 4, b"MIS_TAKEOFF_ALT", 9)
    assert Encoder().param("MIS_TAKEOFF_ALT", 1.5, 4, 8) == packet(22, payload, 220)


def test_setpoint_ned_to_enu() -> None:
    # time u32, x y z vx vy vz ax ay az yaw yaw_rate f32, type_mask u16, targets, frame; CRC_EXTRA 143
    values = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 0.25, 0.5)  # north, east, down
    payload = struct.pack("<I11fHBBB", 1250, *values, 0x0C3F, 1, 1, 1)
    got = read(packet(84, payload, 143, sender=(1, 196)))
    assert got.time_boot_ms == 1250
    assert got.target == Sender(1, 1)
    assert got.content == LocalSetpoint(
        1250,
        1,
        0x0C3F,
        (2.0, 1.0, -3.0),
        (5.0, 4.0, -6.0),
        (8.0, 7.0, -9.0),
        0.5 * math.pi - 0.25,
        -0.5,
        Sender(1, 196),
    )


def test_commands_long_int_and_set_mode() -> None:
    payload = struct.pack("<7fHBBB", 1.0, 6.0, 0, 0, 0, 0, 0, 176, 1, 0, 0)  # CRC_EXTRA 152
    expected = Command(176, (1.0, 6.0, 0.0, 0.0, 0.0, 0.0, 0.0), Sender(245, 190), 1, 0)
    assert read(packet(76, payload, 152, sender=(245, 190))).content == expected
    payload = struct.pack("<4fiifHBBBBB", 1.0, 0, 0, 0, 30, -40, 5.0, 22, 1, 1, 1, 0, 0)  # CRC_EXTRA 158
    got = read(packet(75, payload, 158, sender=(245, 190))).content
    assert got == Command(22, (1.0, 0.0, 0.0, 0.0, 30.0, -40.0, 5.0), Sender(245, 190), 1, 1, frame=1)
    payload = struct.pack("<4fiifHBBBBB", -1.0, 1.0, 0, 0.5, 473977420, -85455940, 490.0, 192, 1, 1, 5, 0, 0)
    got = read(packet(75, payload, 158, sender=(245, 190))).content
    assert isinstance(got, Command)
    assert got.frame == 5
    assert got.params == pytest.approx((-1.0, 1.0, 0.0, 0.5, 47.397742, -8.545594, 490.0), abs=1e-9)
    payload = struct.pack("<4fiifHBBBBB", -1.0, 1.0, 0, 0, 0x7FFFFFFF, 0x7FFFFFFF, 490.0, 192, 1, 1, 5, 0, 0)
    got = read(packet(75, payload, 158, sender=(245, 190))).content
    assert isinstance(got, Command)
    assert math.isnan(got.params[4])
    assert math.isnan(got.params[5])
    payload = struct.pack("<IBB", 4 << 16 | 3 << 24, 1, 129)  # custom_mode, target, base_mode; CRC_EXTRA 89
    got = read(packet(11, payload, 89, sender=(245, 190))).content
    assert got == Command(176, (129.0, 4.0, 3.0, 0.0, 0.0, 0.0, 0.0), Sender(245, 190), 1, 1)


def test_parameter_requests() -> None:
    payload = struct.pack("<hBB16s", -1, 1, 1, b"COM_OF_LOSS_T")  # CRC_EXTRA 214
    assert read(packet(20, payload, 214)).content == ParamRead("COM_OF_LOSS_T", -1)
    payload = struct.pack("<iBB16sB", 4, 1, 1, b"COM_OBL_RC_ACT", 6)  # CRC_EXTRA 168
    assert read(packet(23, payload, 168)).content == ParamWrite("COM_OBL_RC_ACT", 4, is_int=True)
    payload = struct.pack("<fBB16sB", 2.5, 1, 1, b"COM_OF_LOSS_T", 9)
    assert read(packet(23, payload, 168)).content == ParamWrite("COM_OF_LOSS_T", 2.5, is_int=False)


def test_packets_are_found_in_rubbish_and_never_span_datagrams() -> None:
    good = packet(0, struct.pack("<IBBBBB", 0, 18, 8, 0, 4, 3), 50, sender=(1, 196))
    broken = bytearray(good)
    broken[-1] ^= 0x40
    decoder = Decoder()
    got = list(decoder.packets(b"\xfd\x05rubbish" + bytes(broken) + good + b"\xfe" + good + good[:10]))
    assert [each.raw for each in got] == [good, good]
    assert [each.sender for each in got] == [Sender(1, 196)] * 2
    assert decoder.damaged > 0
    assert list(decoder.packets(good[10:])) == []


def test_random_bytes_never_raise() -> None:
    rng = random.Random(7)
    decoder = Decoder()
    for _ in range(3000):
        data = bytearray(rng.randbytes(rng.randrange(300)))
        for at in range(0, len(data), 17):
            data[at] = rng.choice((0xFD, 0xFE))
        list(decoder.packets(bytes(data)))
    # intact packets of every known message with random payload: nothing raises on their content either
    for message_id, kind in sorted(dialect.mavlink_map.items()):
        raw = packet(message_id, rng.randbytes(kind.unpacker.size), kind.crc_extra)
        assert len(list(decoder.packets(raw))) <= 1


@pytest.mark.parametrize(
    ("yaw_enu_deg", "heading_deg"),
    [(0.0, 90.0), (90.0, 0.0), (180.0, -90.0), (-90.0, 180.0), (45.0, 45.0)],
)
def test_headings(yaw_enu_deg: float, heading_deg: float) -> None:
    half = math.radians(yaw_enu_deg) / 2
    w, x, y, z = q_ned_from_frd((math.cos(half), 0.0, 0.0, math.sin(half)))
    assert (x, y) == pytest.approx((0.0, 0.0), abs=1e-12)
    turn = math.degrees(2.0 * math.atan2(z, w)) - heading_deg
    assert math.remainder(turn, 360.0) == pytest.approx(0.0, abs=1e-9)


def test_attitude_maps_body_vectors_like_the_axes_do() -> None:
    """R_ned_frd = P R_enu_flu diag(1, -1, -1) with P swapping ENU to NED, checked against SciPy's rotations."""
    from scipy.spatial.transform import Rotation

    for seed in range(50):
        q = Rotation.random(random_state=seed)
        x, y, z, w = q.as_quat()
        nw, nx, ny, nz = q_ned_from_frd((w, x, y, z))
        got = Rotation.from_quat([nx, ny, nz, nw]).as_matrix()
        swap = [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]
        expected = swap @ q.as_matrix() @ [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]
        assert got == pytest.approx(expected, abs=1e-12)
