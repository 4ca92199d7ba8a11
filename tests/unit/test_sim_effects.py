"""Effects of the physics against hand-computed and published numbers; what is off leaves every bit as it was."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sim_bridge.body import BodyState
from sim_bridge.controller import AccelerationSetpoint, Controller, Gains, PositionSetpoint
from sim_bridge.crazyflie import Crazyflie
from sim_bridge.effects import ROTOR_RADIUS_M, downwash_n, ground_factor, ground_factors
from sim_bridge.estimator import Estimator
from sim_bridge.flight import Flight
from sim_bridge.physics import Start, World
from sim_bridge.placement import resolve
from sim_bridge.scenario import parse_scenario
from sim_bridge.scenario_world import EstimatorNoise, Imu, Physics

HOVER = (Crazyflie().hover_rpm,) * 4
WEIGHT_N = 0.027 * 9.8


def world(effects=None, *starts, vehicle=None, physics_hz=240):
    starts = starts or (Start((0.0, 0.0, 5.0)),)
    model = Crazyflie() if vehicle is None else vehicle
    effects = Physics() if effects is None else effects
    return World([model] * len(starts), (), radii_m=(), physics_hz=physics_hz, starts=starts, effects=effects)


# --- motors and drag


def test_motors_without_lag_follow_at_once_and_saturate():
    with world(Physics(motor_lag=False)) as w:
        w.step([(10_000.0, 12_000.0, 30_000.0, -1.0)])
        assert w.bodies[0].rotor_rpm == pytest.approx((10_000.0, 12_000.0, w.vehicles[0].max_rpm, 0.0))


def test_drag_off_conserves_momentum():
    """In free fall with nothing but gravity, and spinning: momentum grows by m g t, angular momentum stays."""
    vehicle = Crazyflie(motor_up_s=1e-9, motor_down_s=1e-9)
    with world(Physics(rotor_drag=False), Start((0.0, 0.0, 200.0)), vehicle=vehicle, physics_hz=2000) as w:
        h = Crazyflie().hover_rpm
        for _ in range(60):
            w.step([(1.02 * h, 0.97 * h, h, 1.01 * h)])
        w.step([(0.0,) * 4])

        def angular(state):
            qw, qx, qy, qz = state.q_wxyz
            return Rotation.from_quat([qx, qy, qz, qw]).apply(np.array(vehicle.inertia_kg_m2) * state.omega_flu)

        start, before = w.states[0], angular(w.states[0])
        assert np.linalg.norm(before) > 1e-6
        for _ in range(2000):
            w.step([(0.0,) * 4])
        gained = np.subtract(w.states[0].v_enu, start.v_enu)
        assert gained == pytest.approx([0.0, 0.0, -9.8], abs=1e-9)
        assert angular(w.states[0]) == pytest.approx(before, rel=5e-3, abs=1e-3 * np.linalg.norm(before))


# --- ground effect


def test_ground_effect_ratios():
    r = ROTOR_RADIUS_M
    assert ground_factor(2.0 * r) == pytest.approx(1.0 + 11.36859 / 64.0)
    # at one rotor radius the published clip (1.63 R) holds: 1 + 4/15, F_max over 15 a rotor
    assert ground_factor(r) == pytest.approx(1.0 + 4.0 / 15.0)
    assert ground_factor(r) == ground_factor(0.0)
    # never less than Cheeseman and Bennett's single rotor, and gone 2 m up
    for z in np.linspace(1.7 * r, 1.0, 50):
        assert ground_factor(z) >= 1.0 / (1.0 - (r / (4.0 * z)) ** 2)
    assert ground_factor(2.0) < 1.0 + 1e-4


@pytest.mark.parametrize("z_m", [0.05, 0.1, 0.3])
def test_ground_effect_lifts_the_vehicle(z_m):
    """At hover speed the surplus thrust is (factor - 1) m g."""
    vehicle = Crazyflie(radius_m=0.03, motor_up_s=1e-9)
    effects = Physics(ground_effect=True, rotor_drag=False)
    with world(effects, Start((0.0, 0.0, z_m)), vehicle=vehicle) as w:
        w.step([HOVER])
        expected = 9.8 * (ground_factor(z_m) - 1.0)
        assert w.states[0].v_enu[2] * 240 == pytest.approx(expected, rel=1e-3)


def test_the_lower_rotor_gains_more_and_none_upside_down():
    roll = math.radians(20.0)
    level = Crazyflie().rotor_positions_flu
    factors = ground_factors((0.0, 0.0, 0.1), (math.cos(roll / 2), math.sin(roll / 2), 0.0, 0.0), level)
    heights = [0.1 + math.sin(roll) * y for _, y, _ in level]  # rolled right: the left side is up
    assert factors == pytest.approx([ground_factor(z) for z in heights])
    assert factors[2] > factors[1]
    assert ground_factors((0.0, 0.0, 0.1), (0.0, 1.0, 0.0, 0.0), level) == (1.0,) * 4


# --- downwash


def test_downwash_numbers():
    """gym-pybullet-drones: 2267.18 (0.0231348 / 4 dz)^2 exp(-(dxy / (0.16 dz - 0.11))^2 / 2)."""
    hover = {"thrust_n": WEIGHT_N, "weight_n": WEIGHT_N}
    for dz, dxy in ((1.0, 0.0), (1.0, 0.05), (2.0, 0.3), (1.5, 0.1)):
        alpha = 2267.18 * (0.0231348 / (4.0 * dz)) ** 2
        assert downwash_n(dz, dxy, **hover) == pytest.approx(alpha * math.exp(-0.5 * (dxy / (0.16 * dz - 0.11)) ** 2))
    assert downwash_n(0.4, 0.0, **hover) == pytest.approx(WEIGHT_N)  # no more than the thrust that drives it
    assert downwash_n(1.0, 0.0, thrust_n=0.5 * WEIGHT_N, weight_n=WEIGHT_N) == pytest.approx(0.5 * 0.07584, rel=1e-3)
    assert downwash_n(-1.0, 0.0, **hover) == downwash_n(0.0, 0.0, **hover) == downwash_n(1.0, 10.0, **hover) == 0.0


def test_downwash_pushes_the_lower_vehicle_alone():
    starts = (Start((0.0, 0.0, 4.0)), Start((0.0, 0.0, 5.0)))
    effects = Physics(downwash=True, motor_lag=False, rotor_drag=False)
    with world(effects, *starts) as w, world(Physics(motor_lag=False, rotor_drag=False), *starts) as without:
        for _ in range(2):  # the wake is that of the last step's thrust
            w.step([HOVER, HOVER])
            without.step([HOVER, HOVER])
        assert w.states[1] == without.states[1]
        pushed = (w.states[0].v_enu[2] - without.states[0].v_enu[2]) * 0.027 * 240
        assert pushed == pytest.approx(-2267.18 * (0.0231348 / 4.0) ** 2, rel=1e-3)


def test_no_wake_from_stopped_rotors():
    with world(Physics(downwash=True), Start((0.0, 0.0, 4.0)), Start((0.0, 0.0, 5.0))) as w:
        for _ in range(5):
            w.step([HOVER, (0.0,) * 4])
        assert w.bodies[0].downwash_n == 0.0


# --- hover thrust


@pytest.mark.parametrize("error", [-0.1, 0.05])
def test_hover_thrust_error_accelerates_by_its_share_of_g(error):
    with world(Physics(rotor_drag=False), Start((0.0, 0.0, 20.0))) as w:
        controller = Controller(w.vehicles[0], 240, hover_thrust_error=error)
        for _ in range(240):
            w.step([controller.rpm(w.states[0], AccelerationSetpoint((0.0, 0.0, 0.0)))])
        before = w.states[0].v_enu[2]
        for _ in range(240):
            w.step([controller.rpm(w.states[0], AccelerationSetpoint((0.0, 0.0, 0.0)))])
        assert w.states[0].v_enu[2] - before == pytest.approx(error * 9.8, rel=1e-3)


def test_the_integral_holds_the_place_against_it():
    offsets = []
    for gains in (Gains(), Gains(integral_hz2=2.0)):
        with world() as w:
            controller = Controller(w.vehicles[0], 240, gains, hover_thrust_error=-0.1)
            for _ in range(240 * 12):
                w.step([controller.rpm(w.states[0], PositionSetpoint((0.0, 0.0, 5.0)))])
            offsets.append(w.states[0].p_enu[2] - 5.0)
    assert offsets[0] == pytest.approx(-0.1 * 9.8 / 0.9 / 6.4, rel=0.3)  # the disturbance over the loops' stiffness
    assert abs(offsets[1]) < 0.005


# --- estimator


def believed(noise=None, imu=None, seed=0, steps=40_000, physics_hz=240):
    """Errors of position, velocity, attitude (rotation vector) and rates while the vehicle stands still."""
    estimator = Estimator(
        EstimatorNoise() if noise is None else noise,
        Imu() if imu is None else imu,
        physics_hz=physics_hz,
        rng=np.random.default_rng(seed),
    )
    turned = (math.cos(0.4), 0.0, 0.0, math.sin(0.4))
    truth = BodyState((1.0, 2.0, 3.0), (0.1, 0.2, 0.3), turned, (0.0, 0.0, 0.0))
    states = [estimator.update(truth) for _ in range(steps)]
    q = np.array([s.q_wxyz for s in states])
    back = Rotation.from_quat([0.0, 0.0, math.sin(0.4), math.cos(0.4)]).inv()
    return (
        np.array([s.p_enu for s in states]) - truth.p_enu,
        np.array([s.v_enu for s in states]) - truth.v_enu,
        (back * Rotation.from_quat(q[:, [1, 2, 3, 0]])).as_rotvec(),
        np.array([s.omega_flu for s in states]),
    )


def test_estimator_errors_have_their_size_and_correlation():
    noise = EstimatorNoise(position_std_m=0.05, velocity_std_m_s=0.1, attitude_std_rad=0.02)
    errors = believed(noise, Imu(gyro_std_rad_s=0.01))
    for error, std, correlation_s in zip(errors, (0.05, 0.1, 0.02, 0.01), (1.0, 0.5, 1.0, 0.0), strict=True):
        assert np.sqrt((error**2).mean()) == pytest.approx(std, rel=0.12)
        lag = max(round(correlation_s * 240), 1)
        correlation = (error[lag:] * error[:-lag]).mean() / (error**2).mean()
        assert correlation == pytest.approx(math.exp(-1.0) if correlation_s else 0.0, abs=0.12)


def test_accelerometer_noise_enters_the_velocity():
    """sigma_a sqrt(dt T / 2): 0.5 m/s^2 at 240 Hz and T = 0.5 s gives 16 mm/s."""
    position, velocity, *_ = believed(imu=Imu(accelerometer_std_m_s2=0.5))
    assert velocity.std() == pytest.approx(0.5 * math.sqrt(0.5 / 240 / 2.0), rel=0.1)
    assert (position == 0.0).all()


def test_the_delay_is_a_buffer_of_states():
    estimator = Estimator(EstimatorNoise(delay_s=0.05), Imu(), physics_hz=240, rng=np.random.default_rng(0))
    truths = [
        BodyState((float(k), 0.0, 0.0), (0.0, float(k), 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, k)) for k in range(40)
    ]
    beliefs = [estimator.update(truth) for truth in truths]
    for k, belief in enumerate(beliefs):
        late = truths[max(0, k - 12)]
        assert (belief.p_enu, belief.v_enu) == (late.p_enu, late.v_enu)
        assert belief.omega_flu == truths[k].omega_flu  # the gyro's path is not delayed


# --- in a flight


def flight(seed=0, **physics):
    raw = {"vehicle": {"start": [0.0, 0.0, 1.5]}, "physics": physics}
    return Flight(resolve("one", parse_scenario(raw, source="one.toml"), seed))


def hold(f, seconds):
    states = []
    for _ in range(round(seconds * 20)):
        f.control()
        for _ in range(12):
            f.advance()
        states.append((f.crafts[0].truth, f.crafts[0].state))
    return states


def test_autopilot_and_controller_see_the_estimate():
    f = flight(estimator={"position_std_m": 0.05, "delay_s": 0.1})
    try:
        truths, beliefs = zip(*hold(f, 10.0), strict=True)
        offsets = np.array([np.subtract(b.p_enu, t.p_enu) for t, b in zip(truths, beliefs, strict=True)])
        assert 0.02 < offsets.std() < 0.1
        # it holds what it believes: the truth wanders by about the error
        assert 0.01 < np.array([t.p_enu for t in truths]).std(axis=0).max() < 0.1
    finally:
        f.close()


EVERYTHING = {
    "battery_sag": True,
    "ground_effect": True,
    "downwash": True,
    "hover_thrust_error": -0.05,
    "battery_start": 0.7,
    "wind": {"steady": [2.0, 1.0, 0.0], "gusts": "light"},
    "estimator": {"position_std_m": 0.02, "velocity_std_m_s": 0.03, "attitude_std_rad": 0.01, "delay_s": 0.02},
    "imu": {"gyro_std_rad_s": 0.01, "accelerometer_std_m_s2": 0.1},
}


def test_everything_at_once_still_holds_and_is_reproducible():
    ends = []
    for seed in (3, 3, 4):
        f = flight(seed, **EVERYTHING)
        try:
            states = hold(f, 8.0)
            assert max(math.dist(t.p_enu, (0.0, 0.0, 1.5)) for t, _ in states) < 0.6
            assert f.crafts[0].battery.consumed_mah > 3.0
            ends.append(states[-1])
        finally:
            f.close()
    assert ends[0] == ends[1]
    assert ends[0] != ends[2]


def test_the_disturbed_vehicle_comes_to_its_place():
    """The integral, which is on where something pushes, lets Hold arrive: takeoff could not end without it."""
    f = flight(hover_thrust_error=-0.1, wind={"steady": [3.0, 0.0, 0.0]})
    try:
        truth, _ = hold(f, 15.0)[-1]
        assert math.dist(truth.p_enu, (0.0, 0.0, 1.5)) < 0.02
        assert f.crafts[0].autopilot.hovering(f.t_ns)
    finally:
        f.close()


def test_what_is_off_leaves_every_bit():
    """Against a flight in a world without the effects' table."""
    off = {
        "battery_sag": False,
        "ground_effect": False,
        "downwash": False,
        "hover_thrust_error": 0.0,
        "battery_start": 0.5,
        "wind": {"steady": [0.0, 0.0, 0.0], "gusts": "none"},
        "estimator": {"delay_s": 0.0},
        "imu": {"gyro_std_rad_s": 0.0},
    }
    plain, explicit = flight(), flight(**off)
    try:
        assert hold(plain, 2.0) == hold(explicit, 2.0)
        assert explicit.crafts[0].state is explicit.crafts[0].truth
    finally:
        plain.close()
        explicit.close()


def test_a_fault_of_the_battery_is_seen_by_its_reading():
    f = flight()
    try:
        assert f.crafts[0].battery.share == 1.0
        f.crafts[0].set_charge(0.1)
        assert f.crafts[0].battery.share == 0.1
        assert f.crafts[0].battery.voltage_v < 3.8
    finally:
        f.close()
