"""The MAVLink doors under whatever the fields can carry: no exception, and what comes out keeps the wire's bounds."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect
from traffic_scenes import ALL_DOORS, OURS, Sky, origin, vehicle

from companion.link.ingress import MAX_POSITION_M, MAX_RADIUS_M
from companion.link.traffic_events import TrafficEvent

KINDS = [
    dialect.MAVLink_adsb_vehicle_message,
    dialect.MAVLink_global_position_int_message,
    dialect.MAVLink_utm_global_position_message,
    dialect.MAVLink_obstacle_distance_message,
    dialect.MAVLink_obstacle_distance_3d_message,
    dialect.MAVLink_gps_global_origin_message,
    dialect.MAVLink_gps_raw_int_message,
]
NEAR = {"lat": (473_000_000, 474_500_000), "lon": (85_000_000, 86_000_000)}
NEAR |= {"altitude": (0, 2_000_000), "alt": (0, 2_000_000), "x": (-30, 30), "y": (-30, 30), "z": (-30, 30)}
BITS = {"uint8_t": (0, 2**8 - 1), "uint16_t": (0, 2**16 - 1), "uint32_t": (0, 2**32 - 1), "uint64_t": (0, 2**64 - 1)}
BITS |= {"int8_t": (-(2**7), 2**7 - 1), "int16_t": (-(2**15), 2**15 - 1), "int32_t": (-(2**31), 2**31 - 1)}


@st.composite
def messages(draw: st.DrawFn) -> tuple[object, int]:
    kind, near = draw(st.sampled_from(KINDS)), draw(st.booleans())
    fields = []
    types = dict(zip(kind.fieldnames, kind.fieldtypes, strict=True))
    lengths = {kind.ordered_fieldnames[k]: length for k, length in enumerate(kind.array_lengths)}
    for name in kind.fieldnames:
        low, high = NEAR[name] if near and name in NEAR else BITS.get(types[name], (0, 0))
        if types[name] == "char":
            fields.append(draw(st.binary(max_size=8)))
        elif types[name] == "float":
            any_float = st.floats(width=32, allow_nan=True, allow_infinity=True)
            fields.append(draw(st.floats(-30, 30, width=32) if near else any_float))
        elif lengths.get(name, 0):
            fields.append(draw(st.lists(st.integers(low, high), min_size=lengths[name], max_size=lengths[name])))
        else:
            fields.append(draw(st.integers(low, high)))
    return kind(*fields), draw(st.sampled_from([OURS, 2, 255]))


@settings(max_examples=150, deadline=None)
@given(st.lists(messages(), min_size=1, max_size=6), st.sampled_from([None, 0, 10**18, -(10**18)]))
def test_any_fields_make_bounded_obstacles_or_none(sent: list[tuple[object, int]], offset_ns: int | None) -> None:
    sky = Sky(*ALL_DOORS, origin_known=False)
    sky.unix_minus_vehicle_ns = offset_ns
    sky.hear(origin())
    sky.tick(vehicle(1.0, (3.0, 2.0, 1.0)))
    frames = []
    for message, system in sent:
        sky.hear(message, system=system)
        frames += sky.tick(vehicle(1.05, (3.0, 2.0, 1.0)))
    frames += sky.tick(vehicle(2.0, (3.0, 2.0, 1.0)))
    assert set(sky.inbox.counts) <= {
        "frames",
        *(f"traffic_{why}" for why in ("own", "far", "many", "stale", "no_position", "no_origin")),
    }, "the doors' own frames keep the contract"
    for frame in frames:
        for found in frame.detections:
            assert np.isfinite(found.p_enu).all()
            assert np.abs(found.p_enu).max() <= MAX_POSITION_M
            assert 0.0 < found.radius_m <= MAX_RADIUS_M


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=400), st.sampled_from([24, 33, 49, 246, 330, 340, 11037]))
def test_any_payload_of_these_messages_is_survived(payload: bytes, message_id: int) -> None:
    """A packet with a right checksum about arbitrary bytes, cut or full, as MAVLink 2 allows."""
    sky = Sky(*ALL_DOORS)
    sky.tick(vehicle(1.0))
    payload = payload[:255]
    body = bytes([len(payload), 0, 0, 0, 2, 1]) + message_id.to_bytes(3, "little") + payload
    crc = dialect.x25crc(body)
    crc.accumulate(bytes([dialect.mavlink_map[message_id].crc_extra]))
    for event in sky.codec.receive(b"\xfd" + body + crc.crc.to_bytes(2, "little")):
        assert isinstance(event, TrafficEvent)
        sky.doors.handle(event, OURS, None)
    sky.tick(vehicle(1.05))
