"""Motions through points: against finite differences, against SciPy's spline, and what recorded tracks are refused."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline

from sim_bridge.errors import ScenarioError
from sim_bridge.obstacles import AWAY_ENU, Circle, Linear, Timed
from sim_bridge.paths import Polyline, read_track, spline, waypoints

coordinate = st.floats(-10.0, 10.0)
point = st.tuples(coordinate, coordinate, coordinate)
steps = st.lists(st.floats(0.2, 3.0), min_size=1, max_size=6)


@st.composite
def knots(draw):
    times = [0.5, *(0.5 + np.cumsum(draw(steps))).tolist()]
    return times, [draw(point) for _ in times]


@given(knots=knots(), t_s=st.floats(0.0, 20.0))
def test_spline_is_scipys_clamped_one(knots, t_s):
    times, points = knots
    ours, theirs = spline(times, points), CubicSpline(times, points, bc_type="clamped")
    inside = min(max(t_s, times[0]), times[-1])
    assert ours.position(t_s) == pytest.approx(theirs(inside), abs=1e-9)
    speed = theirs(inside, 1) if inside == t_s else np.zeros(3)
    assert ours.velocity(t_s) == pytest.approx(speed, abs=1e-8)


@given(knots=knots(), t_s=st.floats(0.0, 20.0))
def test_spline_velocity_is_the_derivative_of_position(knots, t_s):
    curve, h = spline(*knots), 1e-6
    after, before = np.array(curve.position(t_s + h)), np.array(curve.position(t_s - h))
    assert curve.velocity(t_s) == pytest.approx((after - before) / (2 * h), abs=2e-3)


@given(knots=knots(), t_s=st.floats(0.0, 20.0))
def test_polyline_is_linear_interpolation_and_holds_its_ends(knots, t_s):
    times, points = knots
    line = Polyline(tuple(times), tuple(points))
    expected = [np.interp(t_s, times, [p[axis] for p in points]) for axis in range(3)]
    assert line.position(t_s) == pytest.approx(expected, abs=1e-9)
    if all(abs(t_s - knot) > 1e-4 for knot in times):
        h = 1e-6
        slope = (np.array(line.position(t_s + h)) - line.position(t_s - h)) / (2 * h)
        assert line.velocity(t_s) == pytest.approx(slope, abs=1e-6)


@given(points=st.lists(point, min_size=2, max_size=6, unique=True), speed=st.floats(0.1, 5.0), loop=st.booleans())
@settings(max_examples=50)
def test_waypoints_are_passed_in_turn_at_the_speed(points, speed, loop):
    gaps = [math.dist(a, b) for a, b in zip(points, points[1:] + points[:1], strict=True)]
    if min(gaps) < 1e-3:
        return
    path = waypoints(points, speed, loop=loop)
    t_s = 0.0
    for start, gap in zip(points, gaps if loop else [*gaps[:-1], math.inf], strict=True):
        assert path.position(t_s) == pytest.approx(start, abs=1e-9)
        if gap < math.inf:
            assert math.hypot(*path.velocity(t_s + gap / speed / 2)) == pytest.approx(speed)
            t_s += gap / speed
    if loop:
        assert path.position(2.5 * t_s) == pytest.approx(path.position(0.5 * t_s), abs=1e-6)
    else:
        assert path.position(t_s + 9.0) == points[-1]
        assert path.velocity(t_s + 9.0) == (0.0, 0.0, 0.0)


@given(
    circle=st.builds(
        Circle,
        point,
        st.floats(0.1, 5.0),
        st.floats(1.0, 30.0),
        coordinate,
        coordinate,
        st.floats(-3.0, 3.0),
        st.booleans(),
    ),
    t_s=st.floats(0.0, 20.0),
)
def test_circle(circle, t_s):
    """On its sphere, in its plane, at constant speed, turning the stated way."""
    r = np.array(circle.position(t_s)) - circle.center_enu
    v = np.array(circle.velocity(t_s))
    h = 1e-5
    slope = (np.array(circle.position(t_s + h)) - circle.position(t_s - h)) / (2 * h)
    speed = 2 * math.pi * circle.radius_m / circle.period_s
    assert v == pytest.approx(slope, rel=1e-6, abs=1e-4)
    assert np.linalg.norm(r) == pytest.approx(circle.radius_m)
    yaw, tilt = circle.axis_yaw_rad, circle.tilt_rad
    normal = [math.sin(yaw) * math.sin(tilt), -math.cos(yaw) * math.sin(tilt), math.cos(tilt)]
    assert np.cross(r, v) == pytest.approx(
        np.array(normal) * circle.radius_m * speed * (-1 if circle.clockwise else 1), abs=1e-9
    )


def test_an_obstacle_is_there_from_its_start_until_its_end():
    timed = Timed(Linear((0.0, 0.0, 1.0), (1.0, 0.0, 0.0)), 2.0, 5.0)
    assert timed.position(1.999) == timed.position(5.0) == AWAY_ENU
    assert timed.position(2.0) == (2.0, 0.0, 1.0)  # its path runs on while it is not there
    assert timed.velocity(4.9) == (1.0, 0.0, 0.0)
    assert timed.velocity(5.0) == (0.0, 0.0, 0.0)


def test_a_track_is_read_as_written(tmp_path: Path):
    file = tmp_path / "track.csv"
    file.write_text("t_s,x,y,z\n0.0,1,2,3\n\n0.5, 1.5,2,3\n2,1e1,-2,3\n")
    assert read_track(file) == ((0.0, 0.5, 2.0), ((1.0, 2.0, 3.0), (1.5, 2.0, 3.0), (10.0, -2.0, 3.0)))


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "expected the header t_s,x,y,z"),
        ("time,x,y,z\n0,0,0,0\n1,1,1,1\n", "expected the header t_s,x,y,z, got time,x,y,z"),
        ("t_s,x,y,z\n0,0,0,0\n", "at least 2 rows, got 1"),
        ("t_s,x,y,z\n0,0,0,0\n1,0,0\n", "row 2: expected four numbers, got 1,0,0"),
        ("t_s,x,y,z\n0,0,0,0\n1,0,zero,0\n", "row 2: expected four numbers"),
        ("t_s,x,y,z\n0,0,0,0\n1,0,nan,0\n", "row 2: expected numbers within"),
        ("t_s,x,y,z\n0,0,0,0\n1,0,0,0\n1,0,0,0\n", "row 3: t_s: expected after 1.0, got 1.0"),
    ],
)
def test_refused_tracks_name_file_and_row(text: str, named: str, tmp_path: Path):
    file = tmp_path / "track.csv"
    file.write_text(text)
    with pytest.raises(ScenarioError) as refusal:
        read_track(file)
    assert str(refusal.value).startswith(f"{file}: ")
    assert named in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_track_that_is_not_there(tmp_path: Path):
    with pytest.raises(ScenarioError, match=r"no\.csv: cannot be read"):
        read_track(tmp_path / "no.csv")
