"""The battery against Bitcraze's measurement of current, voltage, duty and thrust, and against the flight time."""

import math

import numpy as np
import pytest

from sim_bridge.battery import (
    CAPACITY_MAH,
    ELECTRONICS_W,
    RESISTANCE_OHM,
    WATT_PER_NEWTON,
    Battery,
    available_share,
    loaded_voltage_v,
    open_circuit_v,
)
from sim_bridge.controller import AccelerationSetpoint, Controller
from sim_bridge.crazyflie import Crazyflie
from sim_bridge.physics import Start, World
from sim_bridge.scenario_world import Physics

# Bitcraze, "PWM to thrust": Crazyflie 2.0 on a scale
AMPERE = np.array([0.24, 0.37, 0.56, 0.75, 0.94, 1.15, 1.37, 1.59, 1.83, 2.11, 2.39, 2.71, 3.06, 3.46, 3.88, 4.44])
GRAM = np.array([0.0, 1.6, 4.8, 7.9, 10.9, 13.9, 17.3, 21.0, 24.4, 28.6, 32.8, 37.3, 41.7, 46.0, 51.9, 57.9])
VOLT = np.array([4.01, 3.98, 3.95, 3.92, 3.88, 3.84, 3.80, 3.76, 3.71, 3.67, 3.65, 3.62, 3.56, 3.48, 3.40, 3.30])
DUTY = np.array([0, 6.25, 12.5, 18.75, 25, 31.25, 37.5, 43.25, 50, 56.25, 62.5, 68.75, 75, 81.25, 87.5, 93.75]) / 100
HOVER_N = 0.027 * 9.8


def test_power_is_the_measured_one():
    power_w = ELECTRONICS_W + WATT_PER_NEWTON * GRAM * 9.81e-3
    assert power_w == pytest.approx(AMPERE * VOLT, abs=0.2)


def test_sag_is_the_measured_one():
    """Without load the measurement's cell had about 4.03 V."""
    for ampere, gram, volt in zip(AMPERE, GRAM, VOLT, strict=True):
        power_w = ELECTRONICS_W + WATT_PER_NEWTON * gram * 9.81e-3
        loaded_v = loaded_voltage_v(4.035, power_w)
        assert loaded_v == pytest.approx(volt, abs=0.06)
        assert power_w / loaded_v == pytest.approx(ampere, abs=0.12)


def test_thrust_at_full_duty_is_the_measured_one():
    """At full duty the motors see the whole voltage; voltage times duty gives the same thrust."""
    for gram, motor_v in zip(GRAM, VOLT * DUTY, strict=True):
        assert 60.0 * available_share(motor_v) == pytest.approx(gram, abs=0.1)
    for gram in range(15, 60, 5):  # the firmware's own fit of it
        assert 60.0 * available_share(0.088 * gram - 0.0006239 * gram**2) == pytest.approx(gram, abs=4.5)
    assert available_share(3.2) == 1.0
    assert available_share(0.0) == available_share(-1.0) == 0.0


def test_the_terminals_obey_ohms_law():
    for open_v in (3.2, 3.7, 4.2):
        for power_w in (0.0, 1.0, 7.0, 14.0):
            v = loaded_voltage_v(open_v, power_w)
            assert v == pytest.approx(open_v - RESISTANCE_OHM * power_w / v)
    assert loaded_voltage_v(3.0, 100.0) == 1.5  # most power into the load


def test_the_curve_of_the_firmware():
    shares = np.linspace(0.0, 1.0, 201)
    volts = [open_circuit_v(share) for share in shares]
    assert (np.diff(volts) > 0.0).all()
    assert [open_circuit_v(s) for s in (0.0, 0.1, 0.5, 0.9, 1.0, 1.5)] == [3.0, 3.78, 3.92, 4.10, 4.20, 4.20]


def test_hover_takes_2_a_and_lasts_7_minutes():
    """6 to 7 minutes are what the Crazyflie 2.1 is known for (with the stock cell)."""
    battery = Battery()
    battery.draw([HOVER_N / 4] * 4, 1.0)
    power_w = 1.07 + 24.0 * HOVER_N
    assert battery.state.current_a == pytest.approx(power_w / battery.state.voltage_v)
    assert 1.8 < battery.state.current_a < 2.1
    seconds = 1.0
    while battery.share > 0.0:
        battery.draw([HOVER_N / 4] * 4, 1.0)
        seconds += 1.0
    assert seconds / 60.0 == pytest.approx(7.2, abs=0.3)
    assert battery.state.consumed_mah == pytest.approx(CAPACITY_MAH, abs=1.0)
    assert battery.available == 0.0


def test_charge_is_the_integral_of_the_current():
    battery = Battery(0.8)
    rng = np.random.default_rng(0)
    coulomb = 0.0
    for _ in range(1000):
        battery.draw(rng.uniform(0.0, 0.15, 4), 0.05)
        coulomb += battery.state.current_a * 0.05
    assert battery.state.consumed_mah == pytest.approx(coulomb / 3.6, rel=1e-4)
    assert 0.8 - battery.share == pytest.approx(battery.state.consumed_mah / 250.0)


# --- in the world


def world(effects, z=5.0):
    return World([Crazyflie()], (), radii_m=(), physics_hz=240, starts=[Start((0.0, 0.0, z))], effects=effects)


def full_throttle_m_s2(effects):
    """Acceleration after 0.25 s at full throttle, without drag."""
    with world(effects) as w:
        for _ in range(60):
            w.step([(30_000.0,) * 4])
        before = w.states[0].v_enu[2]
        for _ in range(24):
            w.step([(30_000.0,) * 4])
        return (w.states[0].v_enu[2] - before) * 10.0


def test_available_thrust_falls_with_the_charge():
    plain = full_throttle_m_s2(Physics(rotor_drag=False, battery_start=0.05))
    assert plain == pytest.approx(9.8 * 1.25, rel=1e-3)  # thrust to weight 2.25, whatever the charge
    accelerations = [
        full_throttle_m_s2(Physics(rotor_drag=False, battery_sag=True, battery_start=share))
        for share in (1.0, 0.3, 0.1, 0.05)
    ]
    assert accelerations[0] == pytest.approx(plain, rel=1e-3)
    assert accelerations == sorted(accelerations, reverse=True)
    # 10 %: U = 3.78 V; f and V = U/2 + sqrt(U^2/4 - R (P_e + c_p f)) meet where f is what V can give
    thrust_n = 2.25 * HOVER_N
    for _ in range(200):
        v = 0.5 * (3.78 + math.sqrt(3.78**2 - 4 * 0.163 * (1.07 + 24.0 * thrust_n)))
        thrust_n += 0.2 * (2.25 * HOVER_N * min(1.0, available_share(v)) - thrust_n)
    assert accelerations[2] == pytest.approx(thrust_n / 0.027 - 9.8, rel=0.03)


def test_without_sag_the_battery_only_counts():
    with world(Physics()) as plain, world(Physics(battery_sag=True)) as sagging:
        controller = Controller(plain.vehicles[0], 240)
        for _ in range(240):
            command = controller.rpm(plain.states[0], AccelerationSetpoint((0.5, 0.0, 0.0)))
            plain.step([command])
            sagging.step([command])
        assert plain.states == sagging.states  # a full battery gives what is asked for
        consumed = [w.batteries[0].state.consumed_mah for w in (plain, sagging)]
        assert consumed[0] == pytest.approx(consumed[1], rel=0.03)
        assert consumed[1] == pytest.approx(2.0 / 3.6, rel=0.15)  # 2 A for 1 s


def test_an_empty_battery_drops_the_vehicle():
    with world(Physics(battery_sag=True, battery_start=0.0005)) as w:
        controller = Controller(w.vehicles[0], 240)
        for _ in range(480):
            w.step([controller.rpm(w.states[0], AccelerationSetpoint((0.0, 0.0, 0.0)))])
        assert w.batteries[0].share == 0.0
        assert w.bodies[0].rotor_rpm == pytest.approx((0.0,) * 4, abs=1.0)
        assert w.states[0].p_enu[2] == pytest.approx(0.2, abs=1e-2)
        assert w.touched_ground == [True]
