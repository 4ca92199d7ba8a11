"""The simulated world against mechanics written independently (SciPy), closed forms and PyBullet's own geometry."""

import math

import numpy as np
import pybullet
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from sim_bridge.controller import Controller, PositionSetpoint
from sim_bridge.crazyflie import Crazyflie
from sim_bridge.errors import ScenarioError
from sim_bridge.obstacles import Accelerated, FigureEight, Linear, Static
from sim_bridge.physics import Start, World, control_steps, to_body

OFF = (0.0, 0.0, 0.0, 0.0)


def world(*motions, radii_m=None, vehicle=None, physics_hz=240, start_enu=(0.0, 0.0, 5.0), start_yaw_rad=0.0):
    radii = [0.2] * len(motions) if radii_m is None else radii_m
    return World(
        [Crazyflie() if vehicle is None else vehicle],
        motions,
        radii_m=radii,
        physics_hz=physics_hz,
        starts=[Start(start_enu, start_yaw_rad)],
    )


def body_z(state):
    w, x, y, z = state.q_wxyz
    return Rotation.from_quat([x, y, z, w]).apply([0.0, 0.0, 1.0])


def test_table_2():
    vehicle = Crazyflie()
    assert vehicle.hover_rpm == pytest.approx(14_468, abs=1.0)
    assert vehicle.mass_kg == 0.027
    assert vehicle.inertia_kg_m2 == (2.39e-5, 2.39e-5, 3.23e-5)
    assert (vehicle.k_f, vehicle.k_m, vehicle.g_m_s2, vehicle.radius_m) == (3.16e-10, 7.94e-12, 9.8, 0.2)
    for position in vehicle.rotor_positions_flu:
        assert math.hypot(*position) == pytest.approx(0.0397)


def test_motors_off_falls_at_g():
    with world() as w:
        for _ in range(120):
            w.step([OFF])
        n, dt = 120, 1.0 / 240.0
        assert w.states[0].v_enu == pytest.approx((0.0, 0.0, -9.8 * n * dt), abs=1e-9)
        # semi-implicit Euler, as PyBullet integrates: z = -g dt^2 n (n + 1) / 2
        assert w.states[0].p_enu[2] == pytest.approx(5.0 - 9.8 * dt * dt * n * (n + 1) / 2.0, abs=1e-9)
        assert w.states[0].omega_flu == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)


@pytest.mark.parametrize("dead", range(4))
def test_one_motor_off_tumbles(dead):
    hover = Crazyflie().hover_rpm
    command = tuple(0.0 if rotor == dead else hover for rotor in range(4))
    with world(start_enu=(0.0, 0.0, 50.0)) as w:
        for _ in range(24):
            w.step([command])
        x, y, _ = w.vehicles[0].rotor_positions_flu[dead]
        assert body_z(w.states[0])[:2] @ [x, y] > 0.0  # the dead rotor's side drops first
        uprights = []
        for _ in range(216):
            w.step([command])
            uprights.append(body_z(w.states[0])[2])
        assert min(uprights) < -0.5  # went over
        assert w.states[0].v_enu[2] < -1.0


def test_hovers_at_14468_rpm():
    with world() as w:
        for _ in range(120):  # the rotors spin up meanwhile
            w.step([(14_468.0,) * 4])
        v_before = w.states[0].v_enu
        for _ in range(240):
            w.step([(14_468.0,) * 4])
        # the fall during spin-up is damped by rotor drag, 4 w k_z / m per second, and by nothing else
        drag_per_s = 4 * 14_468 * 2 * math.pi / 60 * 10.311e-7 / 0.027
        assert w.states[0].v_enu[2] == pytest.approx(v_before[2] * math.exp(-drag_per_s), rel=0.01, abs=1e-3)
        assert body_z(w.states[0])[2] == pytest.approx(1.0, abs=1e-12)


def newton_euler(vehicle, rpm, state, duration_s):
    """An independent plant: rigid body, four rotors at constant speed, rotor drag; SciPy integrates it."""
    inertia = np.diag(vehicle.inertia_kg_m2)
    rotors = np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]]) * 0.0397 / math.sqrt(2.0)
    thrust = np.stack([np.zeros(4), np.zeros(4), 3.16e-10 * np.square(rpm)], axis=1)
    torque = np.cross(rotors, thrust).sum(axis=0)
    torque[2] += 7.94e-12 * np.dot([-1, 1, -1, 1], np.square(rpm))
    drag = np.array([9.1785e-7, 9.1785e-7, 10.311e-7]) * np.sum(rpm) * 2.0 * math.pi / 60.0

    def derivative(_t, y):
        v, q, omega = y[3:6], y[6:10], y[10:]
        rotation = Rotation.from_quat(q)
        force = rotation.apply(thrust.sum(axis=0) - drag * rotation.inv().apply(v))
        q_dot = 0.5 * np.array(
            [
                q[3] * omega[0] + q[1] * omega[2] - q[2] * omega[1],
                q[3] * omega[1] + q[2] * omega[0] - q[0] * omega[2],
                q[3] * omega[2] + q[0] * omega[1] - q[1] * omega[0],
                -q[:3] @ omega,
            ]
        )
        omega_dot = np.linalg.solve(inertia, torque - np.cross(omega, inertia @ omega))
        return np.concatenate([v, force / 0.027 + [0.0, 0.0, -9.8], q_dot, omega_dot])

    w, x, y, z = state.q_wxyz
    start = np.concatenate([state.p_enu, state.v_enu, [x, y, z, w], state.omega_flu])
    return solve_ivp(derivative, (0.0, duration_s), start, rtol=1e-9, atol=1e-11).y[:, -1]


@pytest.mark.parametrize("seed", range(4))
def test_agrees_with_independent_newton_euler(seed):
    rng = np.random.default_rng(seed)
    physics_hz = 10_000
    # no lag, so that both plants see the same rotor speeds
    vehicle = Crazyflie(motor_up_s=1e-9, motor_down_s=1e-9)
    rpm = 14_468.0 * rng.uniform(0.95, 1.05, 4)
    with world(vehicle=vehicle, physics_hz=physics_hz, start_yaw_rad=rng.uniform(-3.0, 3.0)) as w:
        for _ in range(physics_hz // 10):  # tilt, speed and rates first, so that every term matters
            w.step([tuple(rpm)])
        expected = newton_euler(vehicle, rpm, w.states[0], 0.2)
        for _ in range(physics_hz // 5):
            w.step([tuple(rpm)])
        assert abs(body_z(w.states[0])[2]) < 0.97  # it did tilt
        assert w.states[0].p_enu == pytest.approx(expected[:3], abs=1e-3)
        assert w.states[0].v_enu == pytest.approx(expected[3:6], abs=1e-2)
        qw, qx, qy, qz = w.states[0].q_wxyz
        turn = Rotation.from_quat([qx, qy, qz, qw]) * Rotation.from_quat(expected[6:10]).inv()
        assert turn.magnitude() < 5e-3
        assert w.states[0].omega_flu == pytest.approx(expected[10:], rel=5e-3, abs=5e-3)


def test_drag_opposes_the_motion_of_the_body():
    with (
        world(start_enu=(0.0, 0.0, 100.0)) as w,
        world(start_enu=(0.0, 0.0, 100.0), vehicle=Crazyflie(drag_xy_kg_rad=0.0, drag_z_kg_rad=0.0)) as without,
    ):
        for _ in range(480):
            w.step([(13_000.0,) * 4])
            without.step([(13_000.0,) * 4])
        assert without.states[0].v_enu[2] < w.states[0].v_enu[2] < 0.0


def test_motor_lag_is_first_order():
    with world() as w:
        top = w.vehicles[0].max_rpm
        for _ in range(3):  # 12.5 ms up
            w.step([(30_000.0,) * 4])
        assert w.bodies[0].rotor_rpm == pytest.approx((top * (1.0 - math.exp(-1.0)),) * 4)
        for _ in range(240):
            w.step([(30_000.0,) * 4])
        assert w.bodies[0].rotor_rpm == pytest.approx((top,) * 4)  # a motor gives no more than it has
        for _ in range(6):  # 25 ms down
            w.step([(-5.0,) * 4])
        assert w.bodies[0].rotor_rpm == pytest.approx((top * math.exp(-1.0),) * 4)


def test_closest_points_agree_with_the_formula():
    motions = (
        FigureEight((1.0, 0.5, 2.0), 1.5, 5.0, tilt_rad=0.4),
        Linear((-4.0, 1.0, 1.0), (1.7, -0.3, 0.2)),
        Accelerated((3.0, -5.0, 2.0), (0.0, 1.0, 0.0), (-0.4, 0.5, 0.1)),
        Static((0.0, 8.0, 3.0)),
    )
    radii_m = (0.2, 0.5, 0.1, 1.3)
    with world(*motions, radii_m=radii_m, start_enu=(0.0, 0.0, 1.0)) as w:
        w.start_motions()
        controller = Controller(w.vehicles[0], 240)
        for _ in range(480):
            w.step([controller.rpm(w.states[0], PositionSetpoint((1.0, 3.0, 2.5), 0.0))])
            if w.step_count % 40:
                continue
            expected = []
            for index, (motion, radius_m) in enumerate(zip(motions, radii_m, strict=True)):
                distance = np.linalg.norm(np.subtract(w.states[0].p_enu, motion.position(w.t_s)))
                expected.append(distance - 0.2 - radius_m)
                assert w.closest_points_m(index) == pytest.approx(expected[-1], abs=1e-3)
            assert w.clearances_m[0] == pytest.approx(min(expected), abs=1e-12)


@pytest.mark.parametrize("speed_m_s", [0.05, 0.5, 3.0])
@pytest.mark.parametrize("who", ["vehicle", "obstacle"])
def test_no_contact_without_a_collision_seen(speed_m_s, who):
    """PyBullet must not turn the vehicle away before its clearance has come to zero."""
    hit = Static((0.0, 0.0, 1.0)) if who == "vehicle" else Linear((0.0, 0.0, 1.0), (0.0, 0.0, speed_m_s))
    # falls on the sphere from the height that gives the speed, or is struck from below while hovering
    drop_m = speed_m_s**2 / (2 * 9.8) if who == "vehicle" else 0.01
    with world(hit, start_enu=(0.0, 0.0, 1.4 + drop_m)) as w:
        w.start_motions()
        controller = Controller(w.vehicles[0], 240)
        hold = PositionSetpoint(w.states[0].p_enu)
        for _ in range(240):
            w.step([OFF if who == "vehicle" else controller.rpm(w.states[0], hold)])
            if w.clearances_m[0] <= 0.0:
                break
            contacts = pybullet.getContactPoints(w.bodies[0].number, w._spheres[0], physicsClientId=w._client)
            assert all(contact[9] == 0.0 for contact in contacts)  # normal force
        assert w.min_clearances_m[0] <= 0.0


def test_flight_sets_no_pose_or_velocity_of_the_vehicle(monkeypatch):
    """Only obstacles are ever placed; the vehicle is pushed."""
    placed = []

    def recorder(name):
        original = getattr(pybullet, name)

        def call(body, *args, **kwargs):
            placed.append((name, body))
            return original(body, *args, **kwargs)

        return call

    with world(FigureEight((3.0, 0.0, 1.0), 1.0, 4.0), start_enu=(0.0, 0.0, 0.2)) as w:
        names = [name for name in dir(pybullet) if name.startswith("reset") and name != "resetSimulation"]
        assert "resetBasePositionAndOrientation" in names
        assert "resetBaseVelocity" in names
        for name in names:
            monkeypatch.setattr(pybullet, name, recorder(name))
        controller = Controller(w.vehicles[0], 240)
        w.start_motions()
        for _ in range(240):
            w.step([controller.rpm(w.states[0], PositionSetpoint((0.5, 0.5, 1.0)))])
        assert w.states[0].p_enu[2] > 0.5
        assert {body for _, body in placed} == {w._spheres[0]}


def test_same_inputs_give_bit_equal_states():
    def fly():
        with world(FigureEight((1.0, 0.0, 1.0), 1.0, 4.0), Static((1.2, 0.2, 0.9)), start_enu=(0.0, 0.0, 0.2)) as w:
            controller = Controller(w.vehicles[0], 240)
            states = []
            for step in range(720):
                if step == 100:
                    w.start_motions()
                w.step([controller.rpm(w.states[0], PositionSetpoint((2.0, 0.3, 1.0), 0.5))])
                states.append((w.states[0], w.clearances_m[0]))
            assert w.min_clearances_m[0] < 0.0  # contacts included
            return states

    assert fly() == fly()


def test_worlds_in_one_process_do_not_touch_each_other():
    with world() as alone:
        for _ in range(50):
            alone.step([(15_000.0, 14_000.0, 14_500.0, 14_468.0)])
        expected = alone.states[0]
    with world() as first, world(Static((0.0, 0.0, 4.7))) as second:
        for _ in range(50):
            first.step([(15_000.0, 14_000.0, 14_500.0, 14_468.0)])
            second.step([OFF])
        assert first.states[0] == expected
        assert first.clearances_m[0] == math.inf


def test_obstacles_wait_until_their_clock_starts():
    motion = Linear((5.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    with world(motion) as w:
        for _ in range(120):
            w.step([OFF])
        assert w.obstacle_positions(w.t_s) == [(5.0, 0.0, 1.0)]
        assert w.obstacle_velocities(w.t_s) == [(0.0, 0.0, 0.0)]
        w.start_motions()
        for _ in range(120):
            w.step([OFF])
        assert w.t_s == 1.0
        assert w.obstacle_positions(w.t_s) == [(5.5, 0.0, 1.0)]
        assert w.obstacle_positions(0.75) == [(5.25, 0.0, 1.0)]
        assert w.obstacle_positions(0.2) == [(5.0, 0.0, 1.0)]
        assert w.obstacle_velocities(w.t_s) == [(1.0, 0.0, 0.0)]
        assert w.closest_points_m(0) == pytest.approx(math.dist(w.states[0].p_enu, (5.5, 0.0, 1.0)) - 0.4, abs=1e-3)


def test_least_clearance_is_remembered_until_reset():
    with world(Linear((0.0, 0.0, 3.0), (0.0, 0.0, -20.0)), start_enu=(0.0, 0.0, 5.0)) as w:
        before = w.clearances_m[0]
        assert before == pytest.approx(1.6)
        w.start_motions()
        for _ in range(48):
            w.step([(14_468.0,) * 4])
        assert w.clearances_m[0] > before
        assert w.min_clearances_m[0] == pytest.approx(before)
        w.reset_min_clearance()
        assert w.min_clearances_m[0] == w.clearances_m[0]


def test_falls_to_the_ground_and_rests_there():
    with world(start_enu=(0.0, 0.0, 0.5)) as w:
        assert not w.bodies[0].on_ground
        assert not w.touched_ground[0]
        for _ in range(480):
            w.step([OFF])
        assert w.bodies[0].on_ground
        assert w.touched_ground[0]
        assert w.states[0].p_enu == pytest.approx((0.0, 0.0, 0.2), abs=1e-3)
        assert w.states[0].v_enu == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)
        controller = Controller(w.vehicles[0], 240)
        for _ in range(480):
            w.step([controller.rpm(w.states[0], PositionSetpoint((0.0, 0.0, 1.0)))])
        assert not w.bodies[0].on_ground
        assert w.touched_ground[0]
        w.reset_min_clearance()
        assert not w.touched_ground[0]


def test_rates():
    assert control_steps(240, 20) == 12
    assert control_steps(300, 50) == 6
    assert control_steps(500, 100) == 5
    for physics_hz, control_hz in ((240, 50), (240, 100), (10, 20), (240, 0), (0, 20)):
        with pytest.raises(ScenarioError, match=r"^(physics|control)_hz: expected"):
            control_steps(physics_hz, control_hz)
    with pytest.raises(ScenarioError, match="control_hz: expected a divisor of 1000"):
        control_steps(240, 30)


def test_bad_worlds_are_refused_in_one_line():
    with pytest.raises(ScenarioError, match=r"^radii_m: expected 1 values, one for each motion, got 0$"):
        world(Static((0.0, 0.0, 1.0)), radii_m=[])
    with pytest.raises(ScenarioError, match=r"^start: expected z at least the radius 0.2 m, got 0.1$"):
        world(start_enu=(0.0, 0.0, 0.1))
    with pytest.raises(ScenarioError, match=r"^physics_hz: expected"):
        world(physics_hz=0)


def test_body_components_match_scipy():
    rng = np.random.default_rng(3)
    for rotation in Rotation.random(20, rng=rng):
        x, y, z, w = rotation.as_quat().tolist()
        v = rng.normal(size=3)
        assert to_body((w, x, y, z), tuple(v)) == pytest.approx(rotation.inv().apply(v), abs=1e-12)


def test_closing_twice_is_harmless():
    w = world()
    w.close()
    w.close()
