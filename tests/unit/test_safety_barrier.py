"""Rows (24) against the definition written out term by term, finite differences and numbers worked by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.config import SafetyConfig
from companion.safety.barrier import Barrier, monomials
from companion.types import Prediction, frozen

P, V = np.array([0.2, -0.1, 2.0]), np.array([1.5, 0.3, -0.2])


def make_prediction(config: SafetyConfig, count: int = 3, seed: int = 0, sigma: float = 0.1) -> Prediction:
    """Obstacles on random smooth paths: the rows must hold for any prediction, not only straight ones."""
    rng = np.random.default_rng(seed)
    instants = config.horizon + 3
    t = config.dt_s * np.arange(instants)
    start, v, a = (rng.uniform(-scale, scale, (count, 1, 3)) for scale in (3.0, 2.0, 1.0))
    path = start + v * t[:, None] + 0.5 * a * t[:, None] ** 2 + (0.0, 0.0, 2.0)
    return Prediction(
        start_ns=0,
        dt_s=config.dt_s,
        ids=tuple(f"s/{index}" for index in range(count)),
        p_enu=frozen(path),
        sigma_m=frozen(sigma * (1.0 + 0.05 * np.arange(instants)) * np.ones((count, 1))),
        v_enu=frozen(v[:, 0]),
        a_enu=frozen(a[:, 0]),
        radius_m=frozen(rng.uniform(0.1, 0.5, count)),
    )


def row_by_definition(
    config: SafetyConfig, prediction: Prediction, j: int, i: int, a: np.ndarray, epsilon: float, p_std_m: float
) -> float:
    """(21)-(24) with loops: Euler positions, h, psi_1, and the row, nothing collected or cancelled."""
    p, v, dt = P.copy(), V.copy(), config.dt_s
    positions = []
    for _ in range(config.horizon + 3):
        positions.append(p)
        p, v = p + dt * v, v + dt * a
    sigma = min(
        config.kappa * math.hypot(prediction.sigma_m[j, min(i + 2, round(config.sigma_growth_s / dt))], p_std_m),
        config.sigma_cap_m,
    )
    delay = config.sigma_delay_s * float(np.linalg.norm(prediction.v_enu[j] - V))
    d = config.drone_radius_m + prediction.radius_m[j] + config.cushion_m + sigma + delay
    keep = d * d if config.form == "paper" else 0.5 * d * d
    h = [0.5 * float(np.sum((positions[k] - prediction.p_enu[j, k]) ** 2)) - keep for k in (i, i + 1, i + 2)]
    psi = [h[1] - h[0] + config.alpha1 * h[0], h[2] - h[1] + config.alpha1 * h[1]]
    return psi[1] - psi[0] + config.alpha2 * epsilon * psi[0]


@pytest.mark.parametrize("config", [SafetyConfig(), SafetyConfig(form="paper", horizon=5, kappa=0.0)])
@pytest.mark.parametrize("epsilon", [0.0, 0.7, 2.0])
def test_rows_equal_their_definition(config: SafetyConfig, epsilon: float) -> None:
    prediction = make_prediction(config)
    rows = Barrier(config).rows(P, V, prediction, 0.05)
    a = np.array([1.0, -2.0, 0.5])
    rise, psi = rows.evaluate(a)
    values = rise + config.alpha2 * epsilon * psi
    for j in range(3):
        for i in range(config.horizon + 1):
            assert values[j, i] == pytest.approx(
                row_by_definition(config, prediction, j, i, a, epsilon, 0.05), abs=1e-12
            )


@pytest.mark.parametrize("seed", range(4))
def test_gradients_agree_with_finite_differences(seed: int) -> None:
    config = SafetyConfig()
    rows = Barrier(config).rows(P, V, make_prediction(config, seed=seed), 0.0)
    rng = np.random.default_rng(seed)
    a, decay, step = rng.uniform(-3, 3, 3), rng.uniform(0, 1, 3), 1e-4
    gradient, norm = rows.gradient(a, decay)
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        (rise1, psi1), (rise0, psi0) = rows.evaluate(a + shift), rows.evaluate(a - shift)
        difference = (rise1 - rise0 + decay[:, None] * (psi1 - psi0)) / (2 * step)
        assert np.allclose(gradient[axis], difference, atol=1e-9)
    assert np.allclose(norm, np.linalg.norm(gradient, axis=0))


def test_slope_in_epsilon_is_alpha2_psi() -> None:
    config = SafetyConfig()
    prediction = make_prediction(config)
    rows = Barrier(config).rows(P, V, prediction, 0.0)
    a = np.array([0.5, 0.5, -1.0])
    _, psi = rows.evaluate(a)
    for i in (0, 7, config.horizon):
        ahead = row_by_definition(config, prediction, 1, i, a, 1.0 + 1e-3, 0.0)
        behind = row_by_definition(config, prediction, 1, i, a, 1.0 - 1e-3, 0.0)
        assert config.alpha2 * psi[1, i] == pytest.approx((ahead - behind) / 2e-3, abs=1e-10)


def test_many_equals_one_by_one() -> None:
    config = SafetyConfig()
    rows = Barrier(config).rows(P, V, make_prediction(config), 0.0)
    points = np.random.default_rng(1).uniform(-3, 3, (7, 3))
    rise, psi = rows.evaluate_many(points)
    for index, a in enumerate(points):
        one_rise, one_psi = rows.evaluate(a)
        assert np.allclose(rise[index], one_rise, atol=1e-13)
        assert np.allclose(psi[index], one_psi, atol=1e-13)


def test_first_row_of_a_head_on_obstacle_by_hand() -> None:
    """Vehicle at rest, obstacle 2 m ahead at rest: r = -2, h = (4 - 0.25) / 2 = 1.875, psi_0 = 0.8 h = 1.5.

    r_2 = -2 + 0.0025 a, so rise_0 = h_2 - h_1 = 0.5 ((2 - 0.0025 a)^2 - 4) = -0.005 a + 3.125e-6 a^2.
    """
    config = SafetyConfig(kappa=0.0, sigma_delay_s=0.0)
    prediction = Prediction(
        0,
        0.05,
        ("a",),
        frozen(np.full((1, 23, 3), (2.0, 0.0, 0.0))),
        frozen(np.zeros((1, 23))),
        frozen(np.zeros((1, 3))),
        frozen(np.zeros((1, 3))),
        frozen([0.2]),
    )
    rows = Barrier(config).rows(np.zeros(3), np.zeros(3), prediction, 0.0)
    assert rows.margins(np.array([0]))[0].total == pytest.approx(0.5)
    rise, psi = rows.evaluate(np.array([2.0, 0.0, 0.0]))
    assert psi[0, 0] == pytest.approx(1.5)
    assert rise[0, 0] == pytest.approx(-0.01 + 4 * 3.125e-6)


def test_margin_parts_are_kept_apart() -> None:
    config = SafetyConfig(kappa=2.0, sigma_delay_s=0.1)
    prediction = make_prediction(config, count=1)
    rows = Barrier(config).rows(P, V, prediction, 0.3)
    margin = rows.margins(np.array([4]))[0]
    assert margin.radii == pytest.approx(0.2 + prediction.radius_m[0])
    assert margin.cushion == 0.1
    assert margin.sigma == pytest.approx(2.0 * math.hypot(prediction.sigma_m[0, 6], 0.3))
    assert margin.delay == pytest.approx(0.1 * np.linalg.norm(prediction.v_enu[0] - V))
    assert rows.keep_out_m[0, 4] == pytest.approx(margin.total)


def test_a_short_prediction_is_refused() -> None:
    config = SafetyConfig(horizon=10)
    prediction = make_prediction(SafetyConfig(horizon=9))
    with pytest.raises(ValueError, match=r"expected 13 instants \(horizon \+ 3\), got 12"):
        Barrier(config).rows(P, V, prediction, 0.0)


def test_rows_are_convex_in_the_acceleration_for_every_decay() -> None:
    config = SafetyConfig()
    rows = Barrier(config).rows(P, V, make_prediction(config), 0.0)
    for decay in np.linspace(0.0, 1.0, 11):
        assert ((rows.rise + decay * rows.psi)[4] > 0.0).all()


def test_monomials_are_one_a_and_half_its_square() -> None:
    assert monomials(np.array([[1.0, 2.0, -2.0]])).tolist() == [[1.0], [1.0], [2.0], [-2.0], [4.5]]
