"""Step responses of attitude and acceleration within stated bands; docs/explanation/simulator-physics.md has them.

Dead time: to 10 % of the step. Rise time: from 10 to 90 %. Settling: the last time outside 5 %. 1 kHz physics, so that
times are exact to a millisecond; the vehicle flies at 240 Hz within 8 ms of the same (test_sim_controller.py).
"""

import math
from dataclasses import dataclass

import numpy as np
import pytest

from sim_bridge.controller import AccelerationSetpoint, Controller, PositionSetpoint
from sim_bridge.crazyflie import Crazyflie
from sim_bridge.physics import Start, World

HZ = 1000
NO_DRAG = Crazyflie(drag_xy_kg_rad=0.0, drag_z_kg_rad=0.0)


@dataclass(frozen=True)
class Response:
    dead_ms: int
    rise_ms: int
    settling_ms: int
    overshoot: float
    end: float  # share of the step after 1 s


def measured(share):
    """Of a response that should go from 0 to 1."""
    share = np.asarray(share)
    dead, ninety = int(np.argmax(share >= 0.1)), int(np.argmax(share >= 0.9))
    outside = np.nonzero(np.abs(share - 1.0) > 0.05)[0]
    return Response(dead, ninety - dead, int(outside[-1]) + 1, float(share.max()) - 1.0, float(share[-1]))


def fly(vehicle, a_enu):
    """States from hover on, one a millisecond, under an acceleration setpoint."""
    with World([vehicle], (), radii_m=(), physics_hz=HZ, starts=[Start((0.0, 0.0, 20.0))]) as world:
        controller = Controller(vehicle, HZ)
        for _ in range(3 * HZ):
            world.step([controller.rpm(world.states[0], PositionSetpoint((0.0, 0.0, 20.0)))])
        states = [world.states[0]]
        for _ in range(HZ):
            world.step([controller.rpm(world.states[0], AccelerationSetpoint(a_enu))])
            states.append(world.states[0])
        return states


@pytest.mark.parametrize("degrees", [10.0, 20.0])
def test_roll_step(degrees):
    """The acceleration that wants this roll: g tan(roll), to the right."""
    states = fly(Crazyflie(), (0.0, -9.8 * math.tan(math.radians(degrees)), 0.0))
    roll = [math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)) for w, x, y, z in (s.q_wxyz for s in states)]
    response = measured(np.degrees(roll) / degrees)
    assert 25 <= response.dead_ms <= 40
    assert 80 <= response.rise_ms <= 110
    assert response.settling_ms <= 160
    assert -0.001 <= response.overshoot <= 0.03
    assert response.end == pytest.approx(1.0, abs=1e-3)


def acceleration(states, a_enu):
    v = np.array([s.v_enu for s in states])
    return np.diff(v, axis=0) @ np.array(a_enu) * HZ / np.dot(a_enu, a_enu)


@pytest.mark.parametrize("a_m_s2", [1.0, 2.0, 3.0])
def test_level_acceleration_step(a_m_s2):
    response = measured(acceleration(fly(NO_DRAG, (a_m_s2, 0.0, 0.0)), (a_m_s2, 0.0, 0.0)))
    assert 25 <= response.dead_ms <= 40
    assert 80 <= response.rise_ms <= 110
    assert response.settling_ms <= 160
    assert response.overshoot <= 0.03
    assert response.end == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("a_m_s2", [1.0, 3.0])
def test_vertical_acceleration_step(sign, a_m_s2):
    """The motors' lag alone: 90 - 10 % of a first-order lag takes ln 9 time constants, of 12.5 or 25 ms."""
    a_enu = (0.0, 0.0, sign * a_m_s2)
    response = measured(acceleration(fly(NO_DRAG, a_enu), a_enu))
    time_constant_ms = 12.5 if sign > 0 else 25.0
    assert response.dead_ms <= 4
    assert response.rise_ms == pytest.approx(math.log(9.0) * time_constant_ms, rel=0.06)
    assert response.overshoot <= 1e-3
    assert response.end == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("a_m_s2", [1.0, 2.0, 3.0])
def test_drag_is_the_steady_error(a_m_s2):
    """Nothing closes a velocity loop: after 1 s drag takes k v / m of the acceleration, and k = 0.206 m/s in hover."""
    states = fly(Crazyflie(), (a_m_s2, 0.0, 0.0))
    end = acceleration(states, (a_m_s2, 0.0, 0.0))[-1]
    assert end == pytest.approx(1.0 - 0.206 * states[-1].v_enu[0] / a_m_s2, abs=0.01)
    assert 0.81 < end < 0.84
