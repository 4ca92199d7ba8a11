"""Aircraft by MAVLink: units and signs of every door, validity, who is dropped and why, and time."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect
from traffic_scenes import (
    ALT,
    LAT,
    LON,
    OURS,
    UNIX_NS,
    S,
    Sky,
    adsb,
    geoid,
    origin,
    position_int,
    std,
    utm,
    vehicle,
)

from companion.config import parse_config
from companion.errors import ConfigError
from companion.link.inbox import ObstacleInbox
from companion.link.reports import MAX_HELD
from companion.types import DetectionKind

P = (300.0, -400.0, 25.0)  # east, north, up


def one(frames, source):
    """The one detection of the one frame."""
    (frame,) = frames
    assert frame.source == source
    assert frame.kind is DetectionKind.TRACK
    (detection,) = frame.detections
    return detection


# --- units and signs ---------------------------------------------------------------------------------------------


def test_adsb_position_course_speed_and_climb() -> None:
    sky = Sky("adsb")
    sky.tick(vehicle(1.0))
    sky.hear(adsb(P, ver_velocity=-150), system=77, component=156)
    found = one(sky.tick(vehicle(1.0)), "adsb")
    assert found.id == "adsb-a1b2c3"
    np.testing.assert_allclose(found.p_enu, P, atol=0.05)
    # 10 m/s over the ground towards 30 degrees east of north; vertical velocity counts up here
    np.testing.assert_allclose(found.v_enu, [5.0, 8.660254, -1.5], atol=1e-6)
    assert found.radius_m == 5.0
    # the age is told in whole seconds: 0.3 s of 10 m/s on top of 5 m
    np.testing.assert_allclose(std(found), [math.hypot(5, 3), math.hypot(5, 3), 5, 1, 1, 1], rtol=1e-9)


def test_neighbour_position_and_ned_velocity() -> None:
    sky = Sky("neighbours")
    sky.tick(vehicle(1.0))
    sky.hear(position_int(P, v_ned_cm_s=(100, -200, 50)), system=42)
    found = one(sky.tick(vehicle(1.0)), "neighbours")
    assert found.id == "system-42"
    np.testing.assert_allclose(found.p_enu, P, atol=0.05)
    np.testing.assert_allclose(found.v_enu, [-2.0, 1.0, -0.5])
    np.testing.assert_allclose(std(found), [1.5, 1.5, 2.0, 0.3, 0.3, 0.3])
    assert found.radius_m == 1.0


def test_utm_position_ned_velocity_and_stated_accuracy() -> None:
    sky = Sky("utm")
    sky.tick(vehicle(1.0))
    sky.hear(utm(P, vx=100, vy=-200, vz=50, h_acc=1500, v_acc=2500, vel_acc=40), system=42)
    found = one(sky.tick(vehicle(1.0)), "utm")
    assert found.id == "utm-" + bytes(range(18)).hex()
    np.testing.assert_allclose(found.p_enu, P, atol=0.05)
    np.testing.assert_allclose(found.v_enu, [-2.0, 1.0, -0.5])
    np.testing.assert_allclose(std(found), [1.5, 1.5, 2.5, 0.4, 0.4, 0.4])


def test_utm_altitude_is_above_the_ellipsoid() -> None:
    """The geoid is 47 m above the ellipsoid here: an altitude of 100 m by WGS84 is 53 m above mean sea level."""
    sky = Sky("utm", origin_known=False)
    sky.hear(origin(alt_m=0.0), geoid(47.0))
    sky.tick(vehicle(1.0))
    sky.hear(utm(alt=100_000), system=42)
    assert one(sky.tick(vehicle(1.0)), "utm").p_enu[2] == pytest.approx(53.0, abs=1e-3)
    configured = Sky("utm", origin_known=False, geoid_m=40.0)
    configured.hear(origin(alt_m=0.0), geoid(47.0))
    configured.tick(vehicle(1.0))
    configured.hear(utm(alt=100_000), system=42)
    assert one(configured.tick(vehicle(1.0)), "utm").p_enu[2] == pytest.approx(60.0, abs=1e-3)


def test_without_the_geoid_an_ellipsoidal_altitude_is_vague() -> None:
    sky = Sky("utm", origin_known=False)
    sky.hear(origin())
    sky.tick(vehicle(1.0))
    sky.hear(utm(P), system=42)
    assert std(one(sky.tick(vehicle(1.0)), "utm"))[2] == pytest.approx(math.hypot(3.0, 30.0))


def test_z_is_the_difference_of_altitudes_far_away_too() -> None:
    """A tangent plane is 2 km^2 / 2 R = 0.31 m above sea level there; autopilots' local z is not."""
    sky = Sky("adsb", max_range_m=3000.0)
    sky.tick(vehicle(1.0))
    sky.hear(adsb((2000.0, 0.0, 10.0)))
    assert one(sky.tick(vehicle(1.0)), "adsb").p_enu[2] == pytest.approx(10.0, abs=1e-3)


# --- validity ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("missing", [1, 2])
def test_adsb_without_valid_place_is_dropped(missing: int) -> None:
    sky = Sky("adsb")
    sky.tick(vehicle(1.0))
    sky.hear(adsb(flags=(1 | 2 | 4 | 8 | 128) & ~missing))
    assert sky.tick(vehicle(1.05)) == ()
    assert sky.inbox.counts == {"traffic_no_position": 1}
    assert sky.reports == ["rejected 1 payloads, the last of adsb: traffic_no_position: "
                           "expected a valid position and altitude"]  # fmt: skip


@pytest.mark.parametrize("missing", [4, 8])
def test_adsb_needs_course_and_speed_for_a_velocity(missing: int) -> None:
    sky = Sky("adsb")
    sky.tick(vehicle(1.0))
    sky.hear(adsb(P, flags=(1 | 2 | 4 | 8 | 128) & ~missing))
    assert one(sky.tick(vehicle(1.0)), "adsb").v_enu is None
    assert sky.tick(vehicle(1.5)) == ()  # nothing to carry it on with


def test_adsb_without_valid_climb_is_level_and_vague() -> None:
    sky = Sky("adsb")
    sky.tick(vehicle(1.0))
    sky.hear(adsb(P, flags=1 | 2 | 4 | 8, ver_velocity=-3000))
    found = one(sky.tick(vehicle(1.0)), "adsb")
    assert found.v_enu[2] == 0.0
    assert std(found)[5] == 5.0


def test_a_pressure_altitude_is_vaguer_than_a_geometric_one() -> None:
    sky = Sky("adsb")
    sky.tick(vehicle(1.0))
    sky.hear(adsb(P, altitude_type=0))
    assert std(one(sky.tick(vehicle(1.0)), "adsb"))[2] == 30.0


@pytest.mark.parametrize("missing", [4, 8])
def test_utm_without_valid_place_is_dropped(missing: int) -> None:
    sky = Sky("utm")
    sky.tick(vehicle(1.0))
    sky.hear(utm(P, flags=(1 | 2 | 4 | 8 | 32 | 64) & ~missing), system=42)
    assert sky.tick(vehicle(1.05)) == ()
    assert sky.inbox.counts == {"traffic_no_position": 1}


def test_utm_flags_of_velocity_and_identity() -> None:
    sky = Sky("utm")
    sky.tick(vehicle(1.0))
    sky.hear(utm(P, flags=4 | 8 | 32, vx=100, vz=900), system=42)
    found = one(sky.tick(vehicle(1.0)), "utm")
    assert found.id == "utm-system42"
    np.testing.assert_allclose(found.v_enu, [0.0, 1.0, 0.0])
    sky.hear(utm(P, flags=4 | 8), system=42)
    assert one(sky.tick(vehicle(1.05)), "utm").v_enu is None


def test_a_neighbour_that_does_not_know_where_it_is() -> None:
    sky = Sky("neighbours")
    sky.tick(vehicle(1.0))
    sky.hear(dialect.MAVLink_global_position_int_message(0, 0, 0, 0, 0, 0, 0, 0, 0), system=42)
    assert sky.tick(vehicle(1.05)) == ()
    assert sky.inbox.counts["traffic_no_position"] == 1


@pytest.mark.parametrize(
    "message",
    [
        adsb(lat=900_000_001),
        adsb(lon=-1_800_000_001),
        adsb(ICAO_address=0x1000000),
        adsb(altitude=2**31 - 1),
        utm(lat=-(2**31)),
        origin(lat_deg=91.0),
    ],
)
def test_numbers_that_are_no_place_on_earth_are_counted_by_the_codec(message) -> None:
    sky = Sky("adsb", "utm", "neighbours")
    sky.tick(vehicle(1.0))
    sky.hear(message)
    assert sky.tick(vehicle(1.05)) == ()
    assert sky.codec.counts["out_of_range"] == 1


# --- who is not an obstacle ----------------------------------------------------------------------------------------


def test_our_own_transponder_is_no_obstacle() -> None:
    sky = Sky("adsb", own_icao="A1B2C3")
    sky.tick(vehicle(1.0))
    sky.hear(adsb((0.0, 0.0, 0.0)), adsb(P, ICAO_address=0xA1B2C4))
    assert one(sky.tick(vehicle(1.0)), "adsb").id == "adsb-a1b2c4"
    assert sky.inbox.counts["traffic_own"] == 1


def test_our_own_position_is_no_neighbour() -> None:
    sky = Sky("neighbours")
    sky.tick(vehicle(1.0))
    sky.hear(position_int(P), system=OURS)
    assert sky.tick(vehicle(1.05)) == ()
    assert sky.inbox.counts == {}


def test_our_own_utm_identity_is_learned_from_the_autopilot() -> None:
    sky = Sky("utm")
    sky.tick(vehicle(1.0))
    sky.hear(utm(P), system=OURS)  # what the autopilot tells the world about itself
    sky.hear(utm(P), system=200, component=50)  # and a service repeats to us
    assert sky.tick(vehicle(1.05)) == ()
    assert sky.inbox.counts == {"traffic_own": 2}
    configured = Sky("utm", own_uas_id=bytes(range(18)).hex())
    configured.tick(vehicle(1.0))
    configured.hear(utm(P), system=200)
    assert configured.tick(vehicle(1.05)) == ()


def test_far_traffic_is_not_tracked() -> None:
    sky = Sky("adsb", max_range_m=500.0)
    sky.tick(vehicle(1.0, (400.0, 0.0, 0.0)))
    sky.hear(adsb((901.0, 0.0, 0.0)), adsb((899.0, 0.0, 0.0), ICAO_address=5))
    assert one(sky.tick(vehicle(1.0, (400.0, 0.0, 0.0))), "adsb").id == "adsb-000005"
    assert sky.inbox.counts["traffic_far"] == 1


def test_one_that_flies_away_is_shown_no_more_and_spoils_no_frame() -> None:
    sky = Sky("adsb", max_range_m=1e4, carry_s=30.0)
    here = (9000.0, 0.0, 0.0)
    sky.tick(vehicle(1.0, here))
    # the wire ends at 10 km from the origin
    sky.hear(adsb((9990.0, 0.0, 0.0), heading=9000), adsb((9000.0, 50.0, 0.0), ICAO_address=5, hor_velocity=0))
    assert len(sky.tick(vehicle(1.0, here))[0].detections) == 2
    assert one(sky.tick(vehicle(6.0, here)), "adsb").id == "adsb-000005"
    sky.hear(adsb((11000.0, 0.0, 0.0)))
    assert sky.inbox.counts == {"frames": 2, "traffic_far": 1}


def test_a_flood_of_aircraft_keeps_the_nearest() -> None:
    sky = Sky("adsb")
    sky.tick(vehicle(1.0))
    for number in range(MAX_HELD + 40):
        sky.hear(adsb((1500.0 - 5.0 * number, 0.0, 0.0), ICAO_address=number))
    sky.hear(adsb((1501.0, 0.0, 0.0), ICAO_address=0xFFFFFF))
    (frame,) = sky.tick(vehicle(1.0))
    assert {d.id for d in frame.detections} == {f"adsb-{number:06x}" for number in range(40, MAX_HELD + 40)}
    assert sky.inbox.counts["traffic_many"] == 1


def test_closed_doors_let_nothing_in() -> None:
    sky = Sky()
    sky.tick(vehicle(1.0))
    sky.hear(adsb(P), position_int(P), utm(P), system=42)
    assert sky.tick(vehicle(1.0)) == ()
    assert sky.inbox.counts == {}
    sky.doors.poll(0)
    assert sky.asked == []


# --- the origin ----------------------------------------------------------------------------------------------------


def test_without_an_origin_nothing_can_be_placed() -> None:
    sky = Sky("adsb", "neighbours", "utm", origin_known=False)
    sky.tick(vehicle(1.0))
    sky.hear(adsb(P), position_int(P), utm(P), system=42)
    assert sky.tick(vehicle(1.0)) == ()
    assert sky.inbox.counts == {"traffic_no_origin": 3}


def test_the_origin_is_that_of_our_autopilot() -> None:
    sky = Sky("adsb", origin_known=False)
    sky.hear(origin(), system=42)
    sky.hear(origin(), system=OURS, component=191)
    assert sky.doors.origin is None
    sky.hear(origin())
    assert sky.doors.origin is not None
    assert (sky.doors.origin.lat_deg, sky.doors.origin.lon_deg) == pytest.approx((LAT, LON))
    assert sky.doors.origin.alt_m == ALT


def test_the_origin_is_asked_for_until_known_and_again_after_a_reboot() -> None:
    sky = Sky("adsb", origin_known=False)
    for half_second in range(9):
        sky.doors.poll(half_second * S // 2)
    assert sky.asked == [49, 49, 49]  # at 0, 2 and 4 s
    sky.hear(origin())
    sky.doors.poll(60 * S)
    assert len(sky.asked) == 3
    sky.doors.reset()
    assert sky.doors.origin is None
    sky.doors.poll(60 * S)
    assert len(sky.asked) == 4


def test_the_geoid_is_asked_for_where_it_is_needed() -> None:
    sky = Sky("utm", origin_known=False)
    sky.doors.poll(0)
    assert sky.asked == [49, 24]
    sky.hear(geoid())
    sky.doors.poll(2 * S)
    assert sky.asked == [49, 24, 49]


def test_another_origin_voids_what_was_placed_by_the_last() -> None:
    sky = Sky("adsb")
    sky.tick(vehicle(1.0))
    sky.hear(adsb(P))
    sky.hear(origin())
    assert len(sky.tick(vehicle(1.0))) == 1  # the same again changes nothing
    sky.hear(origin(lat_deg=LAT + 0.001))
    assert sky.tick(vehicle(1.5)) == ()


def test_without_a_vehicle_nothing_can_be_placed_in_time() -> None:
    sky = Sky("adsb")
    sky.hear(adsb(P))
    assert sky.inbox.counts == {"traffic_no_vehicle": 1}


# --- time ----------------------------------------------------------------------------------------------------------


def test_an_aircraft_is_carried_on_between_its_reports() -> None:
    sky = Sky("adsb")
    sky.tick(vehicle(1.0))
    sky.hear(adsb((0.0, 500.0, 50.0), heading=9000, ver_velocity=200))
    shown = [sky.tick(vehicle(1.0 + 0.05 * k)) for k in range(80)]
    stamps = [frames[0].stamp_ns / S for frames in shown if frames]
    assert stamps[0] == 1.0
    np.testing.assert_allclose(np.diff(stamps), 0.2)  # five times a second
    assert stamps[-1] == 4.0  # for traffic.carry_s
    last = shown[60][0].detections[0]
    np.testing.assert_allclose(last.p_enu, [30.0, 500.0, 56.0], atol=0.05)
    # 1 m/s and 2 m/s^2 unknown for 3 s
    np.testing.assert_allclose(std(last)[2:4], [math.sqrt(25 + 9 + 81), math.sqrt(1 + 36)], rtol=1e-9)
    assert np.linalg.eigvalsh(last.covariance)[0] > 0.0


def test_a_stated_age_is_caught_up_with() -> None:
    sky = Sky("adsb")
    sky.tick(vehicle(10.0))
    sky.hear(adsb((0.0, 500.0, 50.0), heading=9000, tslc=2))
    found = sky.tick(vehicle(10.0))[0]
    assert found.stamp_ns == 10 * S
    np.testing.assert_allclose(found.detections[0].p_enu, [20.0, 500.0, 50.0], atol=0.05)
    sky.hear(adsb((0.0, 500.0, 50.0), tslc=4, ICAO_address=5))
    sky.hear(adsb((0.0, 500.0, 50.0), tslc=1, ICAO_address=6, flags=3))
    assert sky.inbox.counts["traffic_stale"] == 2


def test_a_unix_stamp_counts_where_the_clocks_are_known() -> None:
    sky = Sky("utm")
    sky.tick(vehicle(10.0))
    sky.unix_minus_vehicle_ns = UNIX_NS - 9 * S  # the report was true at 9 s of the vehicle's clock
    sky.hear(utm((0.0, 100.0, 0.0), vx=500), system=42)
    np.testing.assert_allclose(one(sky.tick(vehicle(10.0)), "utm").p_enu, [0.0, 105.0, 0.0], atol=0.05)
    sky.unix_minus_vehicle_ns = UNIX_NS - 1 * S
    sky.hear(utm(vx=500, uas_id=[9] * 18), system=42)
    assert sky.inbox.counts["traffic_stale"] == 1
    sky.unix_minus_vehicle_ns = UNIX_NS - 3600 * S  # a clock that is ahead says nothing
    sky.hear(utm((0.0, 100.0, 0.0), vx=500), system=42)
    np.testing.assert_allclose(one(sky.tick(vehicle(10.05)), "utm").p_enu, [0.0, 100.25, 0.0], atol=0.05)


def test_outside_lockstep_arrival_counts_by_our_clock() -> None:
    """A report that arrives 40 ms after a vehicle state is 10 ms old at the next, 50 ms later."""
    now = [5 * S]
    sky = Sky("adsb", clock_ns=lambda: now[0])
    sky.tick(vehicle(1.0))
    now[0] += 40_000_000
    sky.hear(adsb((0.0, 500.0, 0.0), heading=9000, hor_velocity=10000))
    now[0] += 10_000_000
    (frame,) = sky.tick(vehicle(1.05))
    assert frame.detections[0].p_enu[0] == pytest.approx(1.0, abs=0.05)


def test_in_lockstep_the_tick_after_gets_them_whether_its_frames_were_taken_ahead_or_not() -> None:
    taken = set()
    for ahead in (False, True):
        sky = Sky("adsb", clock_ns=None)
        seen = []
        for k in range(4):
            state = vehicle(1.0 + 0.05 * k)
            if ahead:
                seen.append(sky.inbox.drain(state.stamp_ns))
            sky.doors.on_vehicle(state)
            if not ahead:
                seen.append(sky.inbox.drain(state.stamp_ns))
            sky.doors.frames_taken()
            if k == 0:
                sky.hear(adsb(P))
        taken.add(tuple(tuple(frame.stamp_ns for frame in frames) for frames in seen))
    assert taken == {((), (), (1_050_000_000,), ())}


def test_a_slow_tick_gets_all_aircraft_in_one_frame() -> None:
    sky = Sky("adsb")
    sky.tick(vehicle(1.0))
    sky.hear(*(adsb(P, ICAO_address=number) for number in range(50)))
    (frame,) = sky.tick(vehicle(1.0))
    assert len(frame.detections) == 50
    sky.hear(adsb(P, ICAO_address=7))
    assert one(sky.tick(vehicle(1.05)), "adsb").id == "adsb-000007"  # at once; the others when they are due
    assert len(sky.tick(vehicle(1.2))[0].detections) == 50


# --- the inbox and the configuration -------------------------------------------------------------------------------


def test_nobody_else_speaks_under_the_name_of_a_door() -> None:
    inbox = ObstacleInbox(queue=4, max_age_s=0.5, doors=("adsb",))
    inbox.push("adsb", b'{"stamp_ns": 0, "clock": "vehicle", "obstacles": []}')
    assert inbox.drain(0) == ()
    assert inbox.counts == {"reserved_source": 1}


def test_a_full_queue_of_a_door_is_bounded_as_all_others() -> None:
    sky = Sky("adsb")
    for number in range(100):
        sky.hear(adsb(P, ICAO_address=number % 5))
        sky.doors.on_vehicle(vehicle(1.0 + 0.001 * number))
    assert len(sky.inbox.drain(round(1.1 * S))) == 64
    assert sky.inbox.counts["dropped"] == 99 - 64


@pytest.mark.parametrize("door", ["adsb", "utm"])
def test_an_open_door_without_authentication_cannot_be_trusted(door: str) -> None:
    with pytest.raises(ConfigError, match=rf'x.toml: tracking.untrusted: expected "{door}" in it'):
        parse_config({"tracking": {"untrusted": ["net"]}, "traffic": {door: {"enabled": True}}}, source="x.toml")
    parse_config({"tracking": {"untrusted": ["net"]}})
    parse_config({"tracking": {"untrusted": []}, "traffic": {"neighbours": {"enabled": True}}})


@pytest.mark.parametrize(
    ("traffic", "key"),
    [
        ({"own_icao": "A1B2"}, "traffic.own_icao"),
        ({"adsb": {"radius_m": 0.0}}, "traffic.adsb.radius_m"),
        ({"adsb": {"on": True}}, "traffic.adsb"),
        ({"max_range_m": 2e4}, "traffic.max_range_m"),
    ],
)
def test_mistakes_are_pointed_at(traffic, key: str) -> None:
    with pytest.raises(ConfigError, match=f"x.toml: {key}: "):
        parse_config({"traffic": traffic}, source="x.toml")
