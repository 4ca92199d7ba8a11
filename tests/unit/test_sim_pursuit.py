"""The chasing obstacle: kinematics between steps, limits, capture, the law of proportional navigation."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_bridge.crazyflie import Crazyflie
from sim_bridge.obstacles import AWAY_ENU, Point
from sim_bridge.physics import Start, World
from sim_bridge.pursuit import Pursuit, Reacting

DT_S = 1.0 / 240.0


@dataclass
class Target:
    p_enu: Point
    v_enu: Point

    def at(self, t_s: float) -> Target:
        x, y, z = (p + v * t_s for p, v in zip(self.p_enu, self.v_enu, strict=True))
        return Target((x, y, z), self.v_enu)


def flown(pursuit: Pursuit, target: Target, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities at every step."""
    p, v = [], []
    for k in range(round(seconds / DT_S)):
        p.append(pursuit.position(k * DT_S))
        v.append(pursuit.velocity(k * DT_S))
        pursuit.advance(DT_S, [target.at(k * DT_S)])
    return np.array(p), np.array(v)


coordinate = st.floats(-5.0, 5.0)
point = st.tuples(coordinate, coordinate, coordinate)


@given(origin=point, to=point, v_to=point, law=st.sampled_from(["pure", "proportional"]))
@settings(max_examples=25)
def test_steps_agree_and_limits_hold(origin, to, v_to, law):
    pursuit = Pursuit(origin, target=0, speed_m_s=3.0, accel_m_s2=4.0, law=law)
    p, v = flown(pursuit, Target(to, v_to), 2.0)
    # constant acceleration within a step: the mean of its two velocities is its average velocity
    assert np.diff(p, axis=0) / DT_S == pytest.approx(0.5 * (v[1:] + v[:-1]), abs=1e-9)
    assert np.linalg.norm(v, axis=1).max() <= 3.0 + 1e-9
    assert np.linalg.norm(np.diff(v, axis=0), axis=1).max() <= 4.0 * DT_S + 1e-9


@pytest.mark.parametrize("law", ["pure", "proportional"])
def test_a_faster_pursuer_catches(law):
    pursuit = Pursuit((-6.0, 2.0, 1.0), target=0, speed_m_s=3.0, accel_m_s2=6.0, law=law)
    target = Target((0.0, 0.0, 2.0), (0.8, 0.6, 0.0))
    p, _ = flown(pursuit, target, 6.0)
    truth = np.array([target.at(k * DT_S).p_enu for k in range(len(p))])
    assert np.linalg.norm(p - truth, axis=1).min() < 0.05


def test_pure_pursuit_from_rest_gains_speed_straight_towards_a_resting_target():
    pursuit = Pursuit((0.0, 0.0, 1.0), target=0, speed_m_s=2.0, accel_m_s2=1.0)
    p, v = flown(pursuit, Target((3.0, 4.0, 1.0), (0.0, 0.0, 0.0)), 2.0)
    t = np.arange(len(p)) * DT_S
    assert p == pytest.approx(np.outer(0.5 * t * t, [0.6, 0.8, 0.0]) + np.array([0.0, 0.0, 1.0]), abs=1e-9)
    assert v == pytest.approx(np.outer(t, [0.6, 0.8, 0.0]), abs=1e-9)


def test_proportional_navigation_turns_n_times_as_fast_as_the_line_of_sight():
    """For small angles off a head-on course, closing speed V_c: a = N V_c d(lambda)/dt; then v turns by N d(lambda)."""
    pursuit = Pursuit(
        (0.0, 0.0, 0.0),
        target=0,
        speed_m_s=4.0,
        accel_m_s2=100.0,
        v0_enu=(4.0, 0.0, 0.0),
        law="proportional",
        navigation=3.0,
    )
    target = Target((40.0, 0.0, 0.0), (0.0, 0.3, 0.0))
    p, v = flown(pursuit, target, 4.0)
    truth = np.array([target.at(k * DT_S).p_enu for k in range(len(p))])
    r = truth - p
    sight, course = np.arctan2(r[:, 1], r[:, 0]), np.arctan2(v[:, 1], v[:, 0])
    slope = np.polyfit(sight[240:], course[240:], 1)[0]
    assert slope == pytest.approx(3.0, rel=0.05)
    assert np.linalg.norm(v, axis=1) == pytest.approx(4.0, abs=1e-3)


def test_it_waits_away_starts_late_flies_straight_on_and_leaves():
    pursuit = Pursuit((0.0, 0.0, 1.0), target=0, speed_m_s=2.0, accel_m_s2=8.0, start_s=0.5, until_s=1.0, end_s=2.0)
    target = Target((3.0, 0.0, 1.0), (0.0, 5.0, 0.0))
    p, v = flown(pursuit, target, 2.5)
    launch, ballistic, gone = (round(t_s / DT_S) for t_s in (0.5, 1.0, 2.0))
    assert {tuple(x) for x in p[:launch].tolist()} == {AWAY_ENU}
    assert tuple(p[launch]) == (0.0, 0.0, 1.0)
    assert np.ptp(v[ballistic:gone], axis=0) == pytest.approx(np.zeros(3), abs=1e-12)
    assert np.ptp(v[launch:ballistic, 1]) > 0.5
    assert {tuple(x) for x in p[gone:].tolist()} == {AWAY_ENU}


def test_between_steps_it_goes_on_along_its_velocity():
    pursuit = Pursuit((0.0, 0.0, 1.0), target=0, speed_m_s=2.0, accel_m_s2=8.0)
    flown(pursuit, Target((3.0, 0.0, 1.0), (0.0, 0.0, 0.0)), 1.0)
    now, (vx, _, _) = pursuit.position(1.0), pursuit.velocity(1.0)
    assert pursuit.position(1.01)[0] - now[0] == pytest.approx(0.01 * vx)


def test_the_world_advances_it_with_the_true_vehicle_and_a_new_world_begins_anew():
    pursuit = Pursuit((2.0, 0.0, 0.2), target=0, speed_m_s=2.0, accel_m_s2=4.0)
    assert isinstance(pursuit, Reacting)
    paths = []
    for _ in range(2):
        world = World([Crazyflie()], [pursuit], radii_m=[0.1], physics_hz=240, starts=[Start((0.0, 0.0, 0.2), 0.0)])
        with world:
            for k in range(240):
                if k == 60:
                    world.start_motions()
                world.step([(0.0, 0.0, 0.0, 0.0)])
            paths.append(world.obstacles_enu[0])
            assert world.motion_time_s(world.t_s) == pytest.approx(0.75)
    assert paths[0] == paths[1]
    # 0.5 s at 4 m/s^2, then 0.25 s at 2 m/s: 1 m of the way done
    assert paths[0] == pytest.approx((1.0, 0.0, 0.2), abs=0.02)
    assert math.dist(paths[0], (0.0, 0.0, 0.2)) > 0.5
