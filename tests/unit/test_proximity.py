"""OBSTACLE_DISTANCE and OBSTACLE_DISTANCE_3D: bearings, frames, what is nothing, and few spheres that hold it all."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect
from traffic_scenes import S, Sky, distances, vehicle

from companion.link.proximity import MAX_SPHERES, RADIUS_MAX_M
from companion.types import DetectionKind, VehicleState, frozen

HERE = (10.0, 20.0, 5.0)


def ring(message, state=None, *, sky=None, system=1):
    """The detections that one OBSTACLE_DISTANCE makes about ``state``."""
    sky = sky or Sky("obstacle_distance", origin_known=False)
    state = state or vehicle(1.0, HERE)
    sky.tick(state)
    sky.hear(message, system=system, component=196)
    (frame,) = sky.tick(state)
    assert (frame.source, frame.kind) == ("obstacle_distance", DetectionKind.DETECTION)
    return frame.detections


def offset(detection, centre=HERE):
    return detection.p_enu - np.array(centre)


# --- OBSTACLE_DISTANCE ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("heading_deg", "index", "east", "north"),
    [(0, 0, 0, 4), (0, 18, 4, 0), (0, 54, -4, 0), (90, 0, 4, 0), (90, 18, 0, -4), (180, 36, 0, 4), (-45, 9, 0, 4)],
)
def test_bins_go_clockwise_from_the_nose(heading_deg, index, east, north) -> None:
    (found,) = ring(distances({index: 400}), vehicle(1.0, HERE, heading_deg=heading_deg))
    np.testing.assert_allclose(offset(found), [east, north, 0.0], atol=1e-9)
    assert (found.id, found.v_enu, found.p_std_m) == (None, None, 0.1)
    # the bin is 5 degrees wide: half of 4 m by 5 degrees
    assert found.radius_m == pytest.approx(4.0 * math.radians(2.5), rel=1e-2)


@pytest.mark.parametrize("frame", [0, 1])
def test_north_aligned_frames_ignore_the_heading(frame) -> None:
    (found,) = ring(distances({18: 400}, frame=frame), vehicle(1.0, HERE, heading_deg=77.0))
    np.testing.assert_allclose(offset(found), [4.0, 0.0, 0.0], atol=1e-9)


@pytest.mark.parametrize(
    ("change", "bearing_deg"),
    [
        ({"angle_offset": 90.0}, 95.0),
        ({"angle_offset": -45.0}, -40.0),
        ({"increment_f": 2.5}, 2.5),
        ({"increment_f": -5.0}, -5.0),  # counter-clockwise
    ],
)
def test_offset_and_increment(change, bearing_deg) -> None:
    (found,) = ring(distances({1: 400}, **change))
    east, north = 4.0 * math.sin(math.radians(bearing_deg)), 4.0 * math.cos(math.radians(bearing_deg))
    np.testing.assert_allclose(offset(found), [east, north, 0.0], atol=1e-6)


def test_what_is_nothing_and_what_is_too_near() -> None:
    """65535 unknown, max + 1 nothing there; 0 is valid and touches: it lies where the sensor begins to see."""
    found = ring(distances({0: 65535, 10: 3001, 20: 3000, 36: 0, 54: 10}))
    ranges = sorted(math.hypot(*offset(d)[:2]) for d in found)
    np.testing.assert_allclose(ranges, [0.2, 0.2, 30.0])
    assert max(d.radius_m for d in found) == pytest.approx(30.0 * math.radians(2.5), rel=1e-2)


def test_a_wide_bin_far_away_is_bounded() -> None:
    (found,) = ring(distances({0: 6000}, increment=30, max_distance=10000))
    assert found.radius_m == RADIUS_MAX_M


def test_bins_beyond_a_full_circle_are_not_read_twice() -> None:
    assert len(ring(distances({35: 400, 36: 400, 71: 400}, increment=10))) == 1


def test_an_all_clear_is_heard_too() -> None:
    sky = Sky("obstacle_distance")
    assert ring(distances({}), sky=sky) == ()
    assert sky.inbox.newest_stamp_ns("obstacle_distance") == 1 * S


@pytest.mark.parametrize("jagged", [False, True])
def test_neighbouring_bins_become_few_spheres_that_hold_all(jagged) -> None:
    """A wall 3 m ahead: each edge of each bin lies in a sphere, none reaches past a quarter of its distance."""
    rng = np.random.default_rng(3)
    ranges = {}
    for k in range(-12, 13):
        noise = rng.uniform(0.8, 1.2) if jagged else 1.0
        ranges[k % 72] = round(300.0 * noise / math.cos(math.radians(5.0 * k)))
    found = ring(distances(ranges))
    assert len(found) <= (22 if jagged else 13)
    for k, range_cm in ranges.items():
        for side in (-2.5, 2.5):
            bearing = math.radians(5.0 * k + side)
            edge = 0.01 * range_cm * np.array([math.sin(bearing), math.cos(bearing), 0.0])
            assert min(np.linalg.norm(offset(d) - edge) - d.radius_m for d in found) <= 1e-9
    for d in found:
        assert d.radius_m <= 0.5
        assert d.radius_m <= 0.26 * np.linalg.norm(offset(d))


def test_the_nearest_of_a_full_ring_stay() -> None:
    ranges = {k: 100 + 300 * (k % 2) + k for k in range(72)}  # no two neighbours alike
    found = ring(distances(ranges))
    assert len(found) == MAX_SPHERES
    assert sum(np.linalg.norm(offset(d)) < 2.0 for d in found) == 36


def test_two_sensors_between_two_states_make_one_frame() -> None:
    sky = Sky("obstacle_distance")
    sky.tick(vehicle(1.0, HERE))
    sky.hear(distances({0: 500}), component=196)
    sky.hear(distances({0: 400}), component=196)  # newer
    sky.hear(distances({36: 300}), component=197)
    (frame,) = sky.tick(vehicle(1.05, HERE))
    assert sorted(round(offset(d)[1], 6) for d in frame.detections) == [-3.0, 4.0]
    assert sky.tick(vehicle(1.1, HERE)) == ()


def test_ranges_count_from_where_the_vehicle_is_then() -> None:
    now = [0]
    sky = Sky("obstacle_distance", clock_ns=lambda: now[0])
    sky.tick(vehicle(1.0, HERE, (0.0, 10.0, 0.0)))
    now[0] += 40_000_000
    sky.hear(distances({0: 400}))
    (frame,) = sky.tick(vehicle(1.05, HERE))
    assert frame.stamp_ns == round(1.04 * S)
    np.testing.assert_allclose(offset(frame.detections[0]), [0.0, 4.4, 0.0], atol=1e-9)


def test_a_state_that_was_long_under_way_does_not_make_the_frame_one_of_the_future() -> None:
    now = [0]
    sky = Sky("obstacle_distance", clock_ns=lambda: now[0])
    sky.tick(vehicle(1.0, HERE))
    now[0] += 400_000_000
    sky.hear(distances({0: 400}))
    (frame,) = sky.tick(vehicle(1.05, HERE))
    assert frame.stamp_ns == round(1.05 * S)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"increment": 0}, "out_of_range"),
        ({"increment_f": 400.0}, "out_of_range"),
        ({"angle_offset": 1e9}, "out_of_range"),
        ({"min_distance": 4000}, "out_of_range"),
        ({"increment_f": math.nan}, "not_finite"),
        ({"angle_offset": math.inf}, "not_finite"),
        ({"frame": 2}, "unknown_frame"),
    ],
)
def test_absurd_rings_are_counted_and_dropped(change, reason) -> None:
    sky = Sky("obstacle_distance")
    sky.tick(vehicle(1.0))
    sky.hear(distances({0: 400}, **change))
    assert sky.tick(vehicle(1.0)) == ()
    assert sky.codec.counts[reason] == 1


def test_sensors_of_other_vehicles_say_nothing_about_our_surroundings() -> None:
    sky = Sky("obstacle_distance", "obstacle_distance_3d")
    sky.tick(vehicle(1.0))
    sky.hear(distances({0: 400}), point(1.0, 0.0, 0.0), system=2)
    assert sky.tick(vehicle(1.0)) == ()


# --- OBSTACLE_DISTANCE_3D ------------------------------------------------------------------------------------------


def point(x, y, z, *, frame=12, obstacle_id=65535, max_distance=20.0):
    return dialect.MAVLink_obstacle_distance_3d_message(0, 0, frame, obstacle_id, x, y, z, 0.2, max_distance)


def points(*messages, state=None):
    sky = Sky("obstacle_distance_3d", origin_known=False)
    state = state or vehicle(1.0, HERE, heading_deg=90.0)
    sky.tick(state)
    sky.hear(*messages, component=196)
    frames = sky.tick(state)
    return frames[0].detections if frames else ()


def test_a_point_in_the_body_frame_is_forward_right_down() -> None:
    """The nose points east: right is south."""
    (found,) = points(point(4.0, 1.0, -0.5))
    np.testing.assert_allclose(offset(found), [4.0, -1.0, 0.5], atol=1e-9)
    assert (found.id, found.radius_m, found.p_std_m) == (None, 0.3, 0.1)


def test_a_point_in_the_body_frame_pitches_with_it() -> None:
    """Facing north, the nose 30 degrees down (FLU: a turn about the left axis)."""
    yaw = (math.cos(math.pi / 4), 0.0, 0.0, math.sin(math.pi / 4))
    half = math.radians(15.0)
    c, s = math.cos(half), math.sin(half)
    q = (yaw[0] * c, -yaw[3] * s, yaw[0] * s, yaw[3] * c)  # yaw times (c, 0, s, 0)
    (found,) = points(point(4.0, 0.0, 0.0), state=VehicleState(S, frozen(HERE), frozen([0, 0, 0]), frozen(q)))
    np.testing.assert_allclose(offset(found), [0.0, 4.0 * math.cos(2 * half), -4.0 * math.sin(2 * half)], atol=1e-9)


def test_a_point_in_local_ned_is_a_place_and_in_the_offset_frame_a_vector() -> None:
    (place,) = points(point(21.0, 12.0, -7.0, frame=1, max_distance=5.0))
    np.testing.assert_allclose(place.p_enu, [12.0, 21.0, 7.0])
    (vector,) = points(point(1.0, 2.0, -3.0, frame=7))
    np.testing.assert_allclose(offset(vector), [2.0, 1.0, 3.0])


def test_points_between_two_states_make_one_frame_with_each_id_once() -> None:
    found = points(point(4, 0, 0, obstacle_id=7), point(5, 0, 0), point(6, 0, 0), point(4.5, 0, 0, obstacle_id=7))
    assert [(d.id, offset(d)[0]) for d in found] == [(None, 5.0), (None, 6.0), ("7", 4.5)]


def test_points_beyond_the_sensor_or_not_finite_are_none() -> None:
    assert points(point(21.0, 0.0, 0.0)) == ()
    assert points(point(math.nan, 0.0, 0.0), point(0.0, math.inf, 0.0), point(0.0, 0.0, 1e9)) == ()
    assert points(point(1.0, 0.0, 0.0, frame=0)) == ()


def test_a_flood_of_points_is_bounded() -> None:
    sky = Sky("obstacle_distance_3d")
    sky.tick(vehicle(1.0))
    sky.hear(*(point(4.0, 0.01 * k, 0.0) for k in range(300)))
    assert len(sky.tick(vehicle(1.0))[0].detections) == 256
    assert sky.inbox.counts["traffic_many"] == 44
