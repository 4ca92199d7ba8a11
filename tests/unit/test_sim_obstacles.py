"""Motions of obstacles: velocity against finite differences, shape, timing."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_bridge.obstacles import Accelerated, FigureEight, Linear, Static

coordinate = st.floats(-10.0, 10.0)
point = st.tuples(coordinate, coordinate, coordinate)
angle = st.floats(-math.pi, math.pi)
eights = st.builds(FigureEight, point, st.floats(0.1, 5.0), st.floats(1.0, 30.0), angle, angle, angle)
motions = st.one_of(
    st.builds(Static, point), st.builds(Linear, point, point), st.builds(Accelerated, point, point, point), eights
)


@given(motion=motions, t_s=st.floats(0.0, 20.0))
def test_velocity_is_the_derivative_of_position(motion, t_s):
    h = 1e-5
    after, before = np.array(motion.position(t_s + h)), np.array(motion.position(t_s - h))
    assert motion.velocity(t_s) == pytest.approx((after - before) / (2 * h), rel=1e-6, abs=1e-4)


def test_linear_and_accelerated_closed_forms():
    assert Linear((1.0, 2.0, 3.0), (0.5, -1.0, 0.0)).position(4.0) == (3.0, -2.0, 3.0)
    assert Accelerated((1.0, 2.0, 3.0), (0.5, -1.0, 0.0), (1.0, 0.0, -0.5)).position(2.0) == (4.0, 0.0, 2.0)
    assert Static((1.0, 2.0, 3.0)).position(7.0) == (1.0, 2.0, 3.0)


@given(eight=eights)
def test_eight_repeats_stays_in_size_and_crosses_its_centre_fastest(eight):
    times = np.linspace(0.0, eight.period_s, 401)
    path = np.array([eight.position(t_s) for t_s in times.tolist()])
    speed = np.array([math.hypot(*eight.velocity(t_s)) for t_s in times.tolist()])
    assert path[0] == pytest.approx(path[-1], abs=1e-9)
    along = (path - eight.center_enu) @ [math.cos(eight.axis_yaw_rad), math.sin(eight.axis_yaw_rad), 0.0]
    assert np.abs(along).max() == pytest.approx(eight.size_m, rel=1e-3)
    assert np.linalg.norm(path - eight.center_enu, axis=1).max() <= eight.size_m * 1.001
    crossing_s = -eight.phase_rad / (2 * math.pi) * eight.period_s  # theta = 0
    assert eight.position(crossing_s) == pytest.approx(eight.center_enu, abs=1e-9)
    fastest = 2 * math.pi * math.sqrt(2.0) * eight.size_m / eight.period_s
    assert math.hypot(*eight.velocity(crossing_s)) == pytest.approx(fastest)
    assert speed.max() <= fastest * (1 + 1e-9)


def test_eight_satisfies_the_curve_of_gerono():
    """x^4 = A^2 (x^2 - y^2) in the plane of the eight."""
    eight = FigureEight((1.0, 2.0, 3.0), 1.5, 6.0, 0.3, axis_yaw_rad=0.8, tilt_rad=0.5)
    e1 = np.array([math.cos(0.8), math.sin(0.8), 0.0])
    e3 = np.cross(e1, [0.0, 0.0, 1.0])
    e2 = -e3 * math.cos(0.5) + np.array([0.0, 0.0, 1.0]) * math.sin(0.5)
    for t_s in np.linspace(0.0, 6.0, 50).tolist():
        r = np.array(eight.position(t_s)) - (1.0, 2.0, 3.0)
        x, y = r @ e1, r @ e2
        assert x**4 == pytest.approx(1.5**2 * (x**2 - y**2), abs=1e-9)
        assert np.linalg.norm(r) ** 2 == pytest.approx(x**2 + y**2, abs=1e-9)  # in that plane


def test_tilt_lifts_the_second_axis():
    flat = FigureEight((0.0, 0.0, 2.0), 1.0, 4.0)
    upright = FigureEight((0.0, 0.0, 2.0), 1.0, 4.0, tilt_rad=math.pi / 2)
    assert flat.position(0.5) == pytest.approx((math.sqrt(0.5), 0.5, 2.0))
    assert upright.position(0.5) == pytest.approx((math.sqrt(0.5), 0.0, 2.5))
