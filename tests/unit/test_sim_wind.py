"""Wind: Dryden's spectra and scales against the specification, and what wind does to the vehicle."""

import math

import numpy as np
import pytest
from scipy import signal
from scipy.linalg import expm

from sim_bridge.controller import AccelerationSetpoint, Controller, PositionSetpoint
from sim_bridge.crazyflie import Crazyflie
from sim_bridge.errors import ScenarioError
from sim_bridge.physics import Start, World
from sim_bridge.scenario_world import Physics, Wind
from sim_bridge.wind import W20_M_S, Dryden, _second_order, dryden_parameters

HOVER = (Crazyflie().hover_rpm,) * 4
DRAG_PER_S = 4 * 14_468 * 2 * math.pi / 60 * 9.1785e-7 / 0.027  # rotor drag in hover over mass, 0.206 1/s


def world(effects, *, rngs=(), z=20.0):
    return World(
        [Crazyflie()], (), radii_m=(), physics_hz=240, starts=[Start((0.0, 0.0, z))], effects=effects, rngs=rngs
    )


def test_scales_of_the_specification():
    """MIL-F-8785C at 100 ft by hand: 0.177 + 0.0823 = 0.2593; light, W20 = 15 kt = 7.717 m/s."""
    at = dryden_parameters(W20_M_S["light"], 100 * 0.3048)
    assert at.sigma_w_m_s == pytest.approx(0.7717, abs=1e-4)
    assert at.sigma_uv_m_s == pytest.approx(0.7717 / 0.2593**0.4, rel=1e-4)
    assert (at.length_w_m, at.length_uv_m) == pytest.approx((30.48, 30.48 / 0.2593**1.2))
    top = dryden_parameters(W20_M_S["severe"], 304.8)  # isotropic at 1000 ft: 0.177 + 0.823 = 1
    assert top.sigma_uv_m_s == pytest.approx(top.sigma_w_m_s)
    assert top.length_uv_m == pytest.approx(top.length_w_m)
    assert dryden_parameters(8.0, 1.0) == dryden_parameters(8.0, 3.048)  # not below 10 ft


@pytest.mark.parametrize("a", [1e-4, 9.9e-3, 1.01e-2, 0.3])
def test_the_second_order_filter_is_discretised_exactly(a):
    """Against SciPy's matrix exponential (Van Loan): transition and covariance of the noise."""
    A, B = np.array([[-1.0, 0.0], [1.0, -1.0]]), np.array([[1.0], [0.0]])  # in units of the time constant
    block = np.block([[-A, B @ B.T], [np.zeros((2, 2)), A.T]]) * a
    e = expm(block)
    transition = e[2:, 2:].T
    covariance = transition @ e[:2, 2:]
    moved = np.array([_second_order(x, a, 0.0, 0.0) for x in ((1.0, 0.0), (0.0, 1.0))]).T
    assert moved == pytest.approx(transition)
    root = np.array([_second_order((0.0, 0.0), a, *n) for n in ((1.0, 0.0), (0.0, 1.0))]).T
    assert root @ root.T == pytest.approx(covariance, rel=1e-5)


@pytest.fixture(scope="module")
def gusts():
    """20 000 s at 5 m/s and 30 m, sampled every 0.1 s."""
    field = Dryden(W20_M_S["moderate"], heading_rad=0.0, dt_s=0.1, rng=np.random.default_rng(1))
    return np.array([field.step(5.0, 30.0) for _ in range(200_000)])


def test_variance_and_correlation_length(gusts):
    at = dryden_parameters(W20_M_S["moderate"], 30.0)
    sigmas = np.array([at.sigma_uv_m_s, at.sigma_uv_m_s, at.sigma_w_m_s])
    assert gusts.std(axis=0) == pytest.approx(sigmas, rel=0.1)
    assert gusts.mean(axis=0) == pytest.approx(0.0, abs=0.3 * sigmas.max())
    # longitudinal: R(tau) = s^2 exp(-tau V / L)
    u = gusts[:, 0] - gusts[:, 0].mean()
    lag = round(at.length_uv_m / 5.0 / 0.1)
    assert (u[:-lag] @ u[lag:]) / (u @ u) == pytest.approx(math.exp(-1.0), abs=0.1)
    # transverse: R(tau) = s^2 (1 - tau V / 2L) exp(-tau V / L), which is 0 at tau = 2 L / V
    w = gusts[:, 2] - gusts[:, 2].mean()
    lag = round(2.0 * at.length_w_m / 5.0 / 0.1)
    assert (w[:-lag] @ w[lag:]) / (w @ w) == pytest.approx(0.0, abs=0.08)


def test_spectra_are_drydens(gusts):
    at = dryden_parameters(W20_M_S["moderate"], 30.0)
    f, psd = signal.welch(gusts, fs=10.0, nperseg=4096, axis=0)
    band = (f > 0.02) & (f < 1.0)
    omega = 2.0 * math.pi * f[band]
    for axis, sigma, length in ((0, at.sigma_uv_m_s, at.length_uv_m), (2, at.sigma_w_m_s, at.length_w_m)):
        x = length / 5.0 * omega
        shape = 2.0 / (1.0 + x**2) if axis == 0 else (1.0 + 3.0 * x**2) / (1.0 + x**2) ** 2
        expected = sigma**2 * length / (math.pi * 5.0) * shape * 2.0 * math.pi  # per rad/s -> per Hz
        assert np.mean(np.log(psd[band, axis] / expected)) == pytest.approx(0.0, abs=0.1)
        assert np.std(np.log(psd[band, axis] / expected)) < 0.3


def test_same_seed_same_gusts_and_the_axis_follows_the_steady_wind():
    def sample(heading_rad):
        field = Dryden(8.0, heading_rad=heading_rad, dt_s=0.01, rng=np.random.default_rng(4))
        return np.array([field.step(2.0, 10.0) for _ in range(10)])

    east, north = sample(0.0), sample(0.5 * math.pi)
    assert (sample(0.0) == east).all()
    assert north == pytest.approx(np.stack([-east[:, 1], east[:, 0], east[:, 2]], axis=1))


def test_a_level_vehicle_drifts_with_the_wind():
    """v' = -k/m (v - W): after 5 s it has 1 - exp(-k t / m) of the wind."""
    with world(Physics(wind=Wind(steady=(4.0, -2.0, 0.0)))) as w:
        for _ in range(120):  # the rotors spin up
            w.step([HOVER])
        before = np.array(w.states[0].v_enu)
        for _ in range(1200):
            w.step([HOVER])
        share = 1.0 - math.exp(-DRAG_PER_S * 5.0)
        expected = before[:2] + share * (np.array([4.0, -2.0]) - before[:2])
        assert w.states[0].v_enu[:2] == pytest.approx(expected, rel=2e-3)


def test_the_terminal_drift_is_the_wind():
    with world(Physics(wind=Wind(steady=(3.0, 0.0, 0.0))), z=60.0) as w:
        controller = Controller(w.vehicles[0], 240)
        for _ in range(240 * 30):
            w.step([controller.rpm(w.states[0], AccelerationSetpoint((0.0, 0.0, 0.0)))])
        assert w.states[0].v_enu[:2] == pytest.approx((3.0, 0.0), abs=0.02)


def test_wind_tilts_a_vehicle_that_holds_its_place():
    """Held against W: the thrust's horizontal part balances k W, so tan(tilt) = k W / (m g)."""
    with world(Physics(wind=Wind(steady=(5.0, 0.0, 0.0)))) as w:
        controller = Controller(w.vehicles[0], 240)
        for _ in range(240 * 8):
            w.step([controller.rpm(w.states[0], PositionSetpoint((0.0, 0.0, 20.0)))])
        _, x, y, _ = w.states[0].q_wxyz
        tilt = math.acos(1.0 - 2.0 * (x * x + y * y))
        assert math.tan(tilt) == pytest.approx(DRAG_PER_S * 5.0 / 9.8, rel=0.02)
        # a law without integral gives way by the disturbance over its stiffness, 6.4 1/s^2
        assert w.states[0].p_enu[0] == pytest.approx(DRAG_PER_S * 5.0 / 6.4, rel=0.03)


def test_a_gust_on_request_begins_and_ends():
    with world(Physics()) as w, world(Physics()) as calm:
        for step in range(480):
            if step == 120:
                w.gust((6.0, 0.0, 0.0), 0.5)
            w.step([HOVER])
            calm.step([HOVER])
            if step == 119:
                assert w.states == calm.states
            if step == 239:
                gained = w.states[0].v_enu[0]
        assert gained == pytest.approx(6.0 * (1.0 - math.exp(-DRAG_PER_S * 0.5)), rel=1e-2)
        assert w.states[0].v_enu[0] == pytest.approx(gained * math.exp(-DRAG_PER_S * 1.0), rel=1e-2)


def test_gusts_shake_the_vehicle_the_same_with_the_same_seed():
    def fly(seed):
        effects = Physics(wind=Wind(steady=(3.0, 0.0, 0.0), gusts="light"))
        with world(effects, rngs=[np.random.default_rng(seed)]) as w:
            controller = Controller(w.vehicles[0], 240)
            for _ in range(480):
                w.step([controller.rpm(w.states[0], PositionSetpoint((0.0, 0.0, 20.0)))])
            return w.states[0]

    assert fly(1) == fly(1)
    assert fly(1) != fly(2)


def test_wind_needs_drag_to_act_through():
    with pytest.raises(ScenarioError, match=r"^physics.wind: expected physics.rotor_drag = true"):
        world(Physics(rotor_drag=False, wind=Wind(steady=(1.0, 0.0, 0.0))))
    with pytest.raises(ScenarioError, match=r"^physics.wind.gusts: expected 1 generators, got 0"):
        world(Physics(wind=Wind(gusts="light")))
