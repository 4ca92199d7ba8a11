"""The cascaded controller on the simulated vehicle: signs, step responses, holding, limits."""

import itertools
import math

import numpy as np
import pytest

from sim_bridge.controller import (
    AccelerationSetpoint,
    Controller,
    MotorsOff,
    PositionSetpoint,
    VelocitySetpoint,
)
from sim_bridge.crazyflie import Crazyflie
from sim_bridge.physics import BodyState, Start, World

PHYSICS_HZ = 240


def airborne(vehicle, physics_hz=PHYSICS_HZ, yaw_rad=0.0):
    """A world with the vehicle at rest in hover and its controller."""
    world = World([vehicle], (), radii_m=(), physics_hz=physics_hz, starts=[Start((0.0, 0.0, 5.0), yaw_rad)])
    controller = Controller(vehicle, physics_hz)
    fly(world, controller, PositionSetpoint((0.0, 0.0, 5.0), yaw_rad), 4.0)
    return world, controller


def fly(world, controller, setpoint, seconds):
    """Advance; states after each step."""
    states = []
    for _ in range(round(seconds * world.physics_hz)):
        world.step([controller.rpm(world.states[0], setpoint)])
        states.append(world.states[0])
    return states


def upright(state):
    _, x, y, _ = state.q_wxyz
    return 1.0 - 2.0 * (x * x + y * y)


def step_response(a_enu, *, physics_hz=PHYSICS_HZ, seconds=1.0, yaw_rad=0.0):
    """Acceleration along ``a_enu`` over its length, after a step from hover, without drag; and the path."""
    world, controller = airborne(Crazyflie(drag_xy_kg_rad=0.0, drag_z_kg_rad=0.0), physics_hz, yaw_rad)
    with world:
        before = world.states[0]
        states = [before, *fly(world, controller, AccelerationSetpoint(a_enu, yaw_rad), seconds)]
    velocities = np.array([state.v_enu for state in states])
    acceleration = np.diff(velocities, axis=0) * physics_hz
    return acceleration @ np.array(a_enu) / np.dot(a_enu, a_enu), velocities


def rise_time_s(response, physics_hz=PHYSICS_HZ):
    return (int(np.argmax(response >= 0.632)) + 1) / physics_hz


LEVEL_STEPS = [(2.0, 0.0, 0.0), (-2.0, 0.0, 0.0), (0.0, 2.0, 0.0), (0.0, -3.0, 0.0), (3.0, 3.0, 0.0), (0.5, 0.0, 0.0)]


@pytest.mark.parametrize("a_enu", LEVEL_STEPS)
def test_level_acceleration_step(a_enu):
    response, velocities = step_response(a_enu)
    assert 0.06 < rise_time_s(response) < 0.1
    assert response.max() < 1.05
    assert response[-60:] == pytest.approx(1.0, abs=1e-3)  # settled, no oscillation
    across = velocities @ np.array([-a_enu[1], a_enu[0], 0.0])
    assert across == pytest.approx(0.0, abs=1e-2)
    assert abs(velocities[-1, 2]) < 0.06  # neither lifted nor dropped


@pytest.mark.parametrize("a_z", [2.0, -2.0, 3.0, -3.0])
def test_vertical_acceleration_step(a_z):
    response, velocities = step_response((0.0, 0.0, a_z))
    assert rise_time_s(response) < 0.035  # the motors' lag alone
    assert response.max() < 1.01
    assert response[-60:] == pytest.approx(1.0, abs=1e-3)
    assert velocities[:, :2] == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("physics_hz", [200, 300, 500, 1000])
def test_step_response_does_not_depend_on_the_physics_rate(physics_hz):
    response, _ = step_response((2.0, 0.0, 0.0), physics_hz=physics_hz)
    reference, _ = step_response((2.0, 0.0, 0.0))
    assert rise_time_s(response, physics_hz) == pytest.approx(rise_time_s(reference), abs=0.008)
    assert response.max() < 1.05


def test_lag_of_the_level_acceleration():
    """Dead time plus time constant (the area over the response), which the daemon's predictor and training use."""
    response, _ = step_response((2.0, 0.0, 0.0))
    assert np.sum(1.0 - response) / PHYSICS_HZ == pytest.approx(0.076, abs=0.01)


def test_acceleration_is_the_same_towards_any_heading():
    east, _ = step_response((2.0, 0.0, 0.0))
    turned, _ = step_response((2.0, 0.0, 0.0), yaw_rad=2.3)
    assert turned == pytest.approx(east, abs=0.05)


def test_zero_acceleration_keeps_hovering():
    world, controller = airborne(Crazyflie())
    with world:
        fly(world, controller, AccelerationSetpoint((0.0, 0.0, 0.0)), 10.0)
        assert world.states[0].p_enu == pytest.approx((0.0, 0.0, 5.0), abs=0.02)


def test_takes_off_and_holds_within_2_cm():
    vehicle = Crazyflie()
    with World([vehicle], (), radii_m=(), physics_hz=PHYSICS_HZ, starts=[Start((1.0, -1.0, 0.2))]) as world:
        controller = Controller(vehicle, PHYSICS_HZ)
        hold = PositionSetpoint((1.0, -1.0, 1.5), 0.0, 1.0)
        climb = fly(world, controller, hold, 5.0)
        assert max(state.v_enu[2] for state in climb) < 1.05
        assert max(state.p_enu[2] for state in climb) < 1.52
        held = fly(world, controller, hold, 10.0)
        assert max(math.dist(state.p_enu, hold.p_enu) for state in held) < 0.02


@pytest.mark.parametrize("v_max_m_s", [0.5, 2.0, 4.0])
def test_flies_to_a_position_no_faster_than_asked(v_max_m_s):
    world, controller = airborne(Crazyflie())
    goal = (4.0, -3.0, 6.0)
    with world:
        seconds = math.dist((0.0, 0.0, 5.0), goal) / v_max_m_s + 5.0
        states = fly(world, controller, PositionSetpoint(goal, 1.0, v_max_m_s), seconds)
    assert max(math.hypot(*state.v_enu) for state in states) < 1.03 * v_max_m_s
    assert max(state.p_enu[0] for state in states) < 4.05  # overshoot
    assert math.dist(states[-1].p_enu, goal) < 0.02
    w, x, y, z = states[-1].q_wxyz
    assert math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)) == pytest.approx(1.0, abs=0.01)


def test_velocity_setpoint():
    world, controller = airborne(Crazyflie())
    with world:
        fly(world, controller, VelocitySetpoint((1.0, -1.0, 0.5)), 3.0)
        # rotor drag, which nothing integrates away, costs a few per cent
        assert world.states[0].v_enu == pytest.approx((1.0, -1.0, 0.5), rel=0.08)
        fly(world, controller, VelocitySetpoint((0.0, 0.0, 0.0)), 3.0)
        assert world.states[0].v_enu == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)


@pytest.mark.parametrize(("start_rad", "goal_rad"), [(0.0, 1.5), (3.0, -3.0), (-1.0, 2.0)])
def test_turns_the_short_way_to_its_heading(start_rad, goal_rad):
    world, controller = airborne(Crazyflie(), yaw_rad=start_rad)
    with world:
        states = fly(world, controller, PositionSetpoint((0.0, 0.0, 5.0), goal_rad), 3.0)
    turn = sum(state.omega_flu[2] for state in states) / PHYSICS_HZ
    assert turn == pytest.approx(math.remainder(goal_rad - start_rad, 2 * math.pi), abs=0.02)
    assert max(math.dist(state.p_enu, (0.0, 0.0, 5.0)) for state in states) < 0.02


def test_tilt_is_limited():
    world, controller = airborne(Crazyflie())
    with world:
        states = fly(world, controller, AccelerationSetpoint((50.0, 0.0, 0.0)), 0.6)
    assert max(math.degrees(math.acos(upright(state))) for state in states) < 37.0
    assert min(state.p_enu[2] for state in states) > 4.8  # height comes before reach


def test_recovers_from_a_tumble():
    world, controller = airborne(Crazyflie())
    with world:
        hover = world.vehicles[0].hover_rpm
        for _ in range(60):
            world.step([(0.0, hover, hover, hover)])
        assert upright(world.states[0]) < 0.5
        controller.reset()
        fly(world, controller, PositionSetpoint((0.0, 0.0, 5.0)), 6.0)
        assert world.states[0].p_enu == pytest.approx((0.0, 0.0, 5.0), abs=0.05)


def test_motors_off():
    world, controller = airborne(Crazyflie())
    with world:
        assert controller.rpm(world.states[0], MotorsOff()) == (0.0,) * 4


def test_a_stranger_as_setpoint_is_refused():
    world, controller = airborne(Crazyflie())
    with world, pytest.raises(TypeError, match="setpoint: expected one of"):
        controller.rpm(world.states[0], None)


@pytest.mark.parametrize(
    ("torque", "axis", "drift"),
    [
        ((1e-4, 0.0, 0.0), 0, (0.0, -1.0)),  # roll right wing down: to the right, -y
        ((0.0, 1e-4, 0.0), 1, (1.0, 0.0)),  # nose down: forward
        ((0.0, 0.0, 1e-4), 2, (0.0, 0.0)),  # counter-clockwise from above: on the spot
    ],
)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_torques_turn_the_body_as_they_say(torque, axis, drift, sign):
    world, controller = airborne(Crazyflie())
    with world:
        command = controller.mix(world.vehicles[0].weight_n, tuple(sign * part for part in torque))
        for _ in range(36):
            world.step([command])
        rates = np.array(world.states[0].omega_flu)
        assert sign * rates[axis] > 0.3
        assert np.delete(rates, axis) == pytest.approx(0.0, abs=1e-2)
        moved = sign * np.array(world.states[0].v_enu[:2])
        assert moved @ drift >= 0.01 * np.dot(drift, drift)
        assert moved @ np.array([-drift[1], drift[0]]) == pytest.approx(0.0, abs=1e-3)
        assert abs(world.states[0].v_enu[2]) < 0.05


def wrench(command, vehicle):
    """Thrust and torque of four rotor speeds, by their definition."""
    f = vehicle.k_f * np.square(command)
    d = vehicle.arm_m / math.sqrt(2.0)
    x, y = np.array([d, -d, -d, d]), np.array([d, d, -d, -d])
    return f.sum(), y @ f, -x @ f, vehicle.k_m / vehicle.k_f * (np.array([-1, 1, -1, 1]) @ f)


def test_mixer_inverts_the_rotors():
    vehicle = Crazyflie()
    controller = Controller(vehicle, PHYSICS_HZ)
    rng = np.random.default_rng(0)
    for _ in range(100):
        wanted = (rng.uniform(0.2, 0.4), *rng.uniform(-5e-4, 5e-4, 2), rng.uniform(-3e-4, 3e-4))
        assert wrench(controller.mix(wanted[0], wanted[1:]), vehicle) == pytest.approx(wanted, rel=1e-9, abs=1e-12)


def test_mixer_gives_up_yaw_before_collective_before_tilt():
    vehicle = Crazyflie()
    controller = Controller(vehicle, PHYSICS_HZ)
    for collective_n, roll, pitch, yaw in itertools.product(
        (0.0, 0.1, 0.26, 0.45, 9.0), (-3e-3, 0.0, 3e-3), (-1e-3, 0.0, 2e-3), (-1.0, -1e-4, 0.0, 1e-2)
    ):
        command = controller.mix(collective_n, (roll, pitch, yaw))
        assert min(command) >= vehicle.idle_rpm * (1 - 1e-9)
        assert max(command) <= vehicle.max_rpm * (1 + 1e-9)
        _, got_roll, got_pitch, got_yaw = wrench(command, vehicle)
        assert (got_roll, got_pitch) == pytest.approx((roll, pitch), abs=1e-12)
        assert abs(got_yaw) <= abs(yaw) + 1e-12
        assert got_yaw * yaw >= -1e-15
    # more tilt torque than the motors have: shrunk, its direction kept
    _, got_roll, got_pitch, _ = wrench(controller.mix(0.26, (0.02, 0.01, 0.0)), vehicle)
    assert got_roll > 3e-3
    assert got_pitch / got_roll == pytest.approx(0.5)


def test_reset_forgets_the_last_rate():
    world, controller = airborne(Crazyflie())
    with world:
        fly(world, controller, AccelerationSetpoint((3.0, 1.0, 0.0)), 0.05)
        setpoint = AccelerationSetpoint((0.0, 0.0, 0.0))
        fresh = Controller(world.vehicles[0], PHYSICS_HZ).rpm(world.states[0], setpoint)
        controller.reset()
        assert controller.rpm(world.states[0], setpoint) == fresh


def test_torque_balances_the_gyroscopic_moment():
    """At the wanted attitude, I omega' = tau - omega x I omega: the error gives I k (0 - omega), the rest balances."""
    vehicle = Crazyflie()
    controller = Controller(vehicle, PHYSICS_HZ)
    omega = (0.6, -0.5, 2.0)
    state = BodyState((0.0, 0.0, 5.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), omega)
    thrust, *torque = wrench(controller.rpm(state, AccelerationSetpoint((0.0, 0.0, 0.0))), vehicle)
    inertia = np.diag(vehicle.inertia_kg_m2)
    gains = np.array([controller.gains.rate_hz, controller.gains.rate_hz, controller.gains.yaw_rate_hz])
    expected = inertia @ (-gains * omega) + np.cross(omega, inertia @ omega)
    assert thrust == pytest.approx(vehicle.weight_n)
    assert torque == pytest.approx(expected, rel=1e-9)
