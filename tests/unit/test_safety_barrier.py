"""Rows (24) against the definition written out term by term, finite differences and numbers worked by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.config import SafetyConfig
from companion.safety.barrier import Balls, Barrier, monomials
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
    now = math.hypot(prediction.sigma_m[j, min(2, round(config.sigma_growth_s / dt))], p_std_m)
    sigma += min(config.kappa_now * now, config.sigma_cap_m)
    delay = config.sigma_delay_s * float(np.linalg.norm(prediction.v_enu[j] - V))
    d = config.drone_radius_m + prediction.radius_m[j] + config.cushion_m + sigma + delay
    keep = d * d if config.form == "paper" else 0.5 * d * d
    h = [0.5 * float(np.sum((positions[k] - prediction.p_enu[j, k]) ** 2)) - keep for k in (i, i + 1, i + 2)]
    psi = [h[1] - h[0] + config.alpha1 * h[0], h[2] - h[1] + config.alpha1 * h[1]]
    return psi[1] - psi[0] + config.alpha2 * epsilon * psi[0]


@pytest.mark.parametrize("config", [SafetyConfig(), SafetyConfig(form="paper", horizon=5, kappa=0.0, kappa_now=0.0)])
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
    config = SafetyConfig(kappa=0.0, kappa_now=0.0, sigma_delay_s=0.0)
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
    config = SafetyConfig(kappa=2.0, kappa_now=0.0, sigma_delay_s=0.1)
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


def test_the_grid_by_hand() -> None:
    """c_k = p + k dt v - o_k and s_k = dt^2 k (k - 1) / 2; r_k = c_k + s_k a for one acceleration and for several."""
    config = SafetyConfig(horizon=2, dt_s=0.1)
    prediction = make_prediction(config, count=2)
    rows = Barrier(config).rows(P, V, prediction, 0.0)
    assert rows.reach == pytest.approx([0.0, 0.0, 0.01, 0.03, 0.06])
    assert rows.drift.shape == (3, 2, 5)
    for j in range(2):
        for k in range(5):
            assert rows.drift[:, j, k] == pytest.approx(P + 0.1 * k * V - prediction.p_enu[j, k])
    points = np.array([[1.0, -2.0, 3.0], [0.5, 0.0, -1.0], [0.0, 0.0, 0.0], [2.0, 2.0, 2.0]])
    many = rows.positions(points)
    assert many.shape == (3, 4, 2, 3)
    for c, a in enumerate(points):
        one = rows.positions(a)
        assert many[:, c] == pytest.approx(one)
        for i in range(3):
            assert one[:, 1, i] == pytest.approx(rows.drift[:, 1, i + 2] + rows.reach[i + 2] * a)


def test_what_a_row_is_made_of() -> None:
    config = SafetyConfig()
    prediction = make_prediction(config)
    rows = Barrier(config).rows(P, V, prediction, 0.0)
    assert (len(rows), rows.ids) == (3, ("s/0", "s/1", "s/2"))
    assert rows.radii_m == pytest.approx(prediction.radius_m + 0.2)
    assert rows.cushion_m == 0.1
    a = np.array([0.3, -0.7, 1.1])
    basis = np.array([1.0, *a, 0.5 * float(a @ a)])
    rise, psi = rows.evaluate(a)
    assert np.tensordot(basis, rows.rise, 1) == pytest.approx(rise)
    assert np.tensordot(basis, rows.psi, 1) == pytest.approx(psi)
    assert rows.evaluate_many(a[None]).shape == (2, 1, 3, 21)
    assert rows.evaluate_many(np.zeros((4, 3))).shape == (2, 4, 3, 21)


@pytest.mark.parametrize("growth_s", [0.0, 0.05, 0.1, 0.5, 9.0])
def test_sigma_counts_up_to_the_end_of_its_growth(growth_s: float) -> None:
    """Instants 2, 3, ... up to the growth's end, which may lie before the first and behind the last of them."""
    config = SafetyConfig(horizon=12, sigma_growth_s=growth_s, kappa=2.0, kappa_now=0.0)
    prediction = make_prediction(config)
    rows = Barrier(config).rows(P, V, prediction, 0.2)
    for i in range(13):
        instant = min(i + 2, round(growth_s / 0.05))
        assert rows.sigma_m[1, i] == pytest.approx(2.0 * math.hypot(prediction.sigma_m[1, instant], 0.2))


def test_sigma_counts_no_further_than_its_cap_and_the_letter_of_22_takes_the_square_root_of_two() -> None:
    for form, factor in (("sphere", 1.0), ("paper", math.sqrt(2.0))):
        config = SafetyConfig(kappa=2.0, kappa_now=0.0, sigma_cap_m=0.25, form=form)
        prediction = make_prediction(config, sigma=0.11)
        rows = Barrier(config).rows(P, V, prediction, 0.0)
        assert rows.sigma_m[:, 0] == pytest.approx([0.242] * 3)  # 2 * 0.11 * 1.1
        assert rows.sigma_m[:, 5] == pytest.approx([0.25] * 3)
        for step in (0, 5):
            total = np.array([margin.total for margin in rows.margins(np.full(3, step))])
            assert rows.keep_out_m[:, step] == pytest.approx(factor * total)


def test_margins_are_those_of_each_obstacle_at_its_own_step() -> None:
    config = SafetyConfig()
    rows = Barrier(config).rows(P, V, make_prediction(config), 0.0)
    for j, (margin, step) in enumerate(zip(rows.margins(np.array([0, 3, 6])), (0, 3, 6), strict=True)):
        assert margin.radii == rows.radii_m[j]
        assert margin.sigma == rows.sigma_m[j, step]
        assert margin.delay == rows.delay_m[j]
        assert margin.cushion == 0.1


def test_inside_the_keep_out_distance_there_is_a_least_decay() -> None:
    config = SafetyConfig(kappa=0.0, kappa_now=0.0, sigma_delay_s=0.0, recovery=0.07)
    start = np.array([[0.45, 0.0, 0.0], [0.55, 0.0, 0.0], [0.3, 0.0, 0.0]])
    v = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [3.2, 0.0, 0.0]])  # the last is out of it after two steps
    prediction = Prediction(
        0,
        0.05,
        ("in", "out", "leaving"),
        frozen(start[:, None] + 0.05 * np.arange(23)[:, None] * v[:, None]),
        frozen(np.zeros((3, 23))),
        frozen(v),
        frozen(np.zeros((3, 3))),
        frozen([0.2, 0.2, 0.2]),
    )
    rows = Barrier(config).rows(np.zeros(3), np.zeros(3), prediction, 0.0)
    assert rows.least_decay.tolist() == [0.07, 0.0, 0.07]
    assert rows.psi[0, 2, 1] > 0.0
    assert rows.psi[0, 0, 0] == pytest.approx(0.8 * 0.5 * (0.45**2 - 0.5**2))  # alpha1 h


def same(one: object, other: object, names: tuple[str, ...]) -> None:
    for name in names:
        assert np.array_equal(getattr(one, name), getattr(other, name)), name


def test_a_selection_is_what_those_obstacles_alone_would_have() -> None:
    config = SafetyConfig()
    whole = make_prediction(config, count=4)
    kept = [3, 1]
    part = Prediction(
        0,
        config.dt_s,
        tuple(whole.ids[index] for index in kept),
        *(frozen(array[kept]) for array in (whole.p_enu, whole.sigma_m, whole.v_enu, whole.a_enu, whole.radius_m)),
    )
    barrier, decay = Barrier(config), np.array([0.2, 0.4, 0.6, 0.8])
    rows, alone = barrier.rows(P, V, whole, 0.1), barrier.rows(P, V, part, 0.1)
    selected = rows.select(np.array(kept))
    assert (selected.ids, selected.cushion_m) == (("s/3", "s/1"), 0.1)
    same(selected, alone, ("coefficients", "drift", "reach", "radii_m", "sigma_m", "delay_m", "least_decay"))
    same(selected, alone, ("keep_out_m",))
    balls = rows.balls(decay).select(np.array(kept))
    same(balls, alone.balls(decay[kept]), ("decay", "centre", "square", "q"))


def test_a_row_is_its_ball() -> None:
    """g = q (|a - c|^2 - rho^2) / 2 at any acceleration and decay."""
    config, rng = SafetyConfig(), np.random.default_rng(5)
    rows = Barrier(config).rows(P, V, make_prediction(config), 0.0)
    decay = np.array([0.0, 0.35, 1.0])
    balls = rows.balls(decay)
    assert balls.decay.tolist() == decay.tolist()
    for a in rng.uniform(-3.0, 3.0, (5, 3)):
        rise, psi = rows.evaluate(a)
        away = a[:, None, None] - balls.centre
        assert balls.q * ((away * away).sum(axis=0) - balls.square) / 2.0 == pytest.approx(
            rise + decay[:, None] * psi, abs=1e-9
        )


def test_at_a_balls_centre_the_gradient_is_that_of_an_arm_of_a_millimetre() -> None:
    config = SafetyConfig()
    rows = Barrier(config).rows(P, V, make_prediction(config), 0.0)
    decay = np.array([0.5, 0.5, 0.5])
    centre = rows.balls(decay).centre[:, 1, 7]
    gradient, norm = rows.gradient(centre, decay)
    assert gradient[:, 1, 7] == pytest.approx(np.zeros(3), abs=1e-12)
    assert norm[1, 7] == 1e-3 * rows.reach[9]


@pytest.mark.parametrize(
    ("centre", "square", "reached"),
    [
        ((4.0, 0.0, 0.0), (0.99,), False),  # 1 m/s^2 from the box of +-3
        ((4.0, 0.0, 0.0), (1.01,), True),
        ((4.0, 0.0, 0.0), (1.0,), True),  # in doubt it is reached
        ((0.0, -5.0, 0.0), (3.99,), False),
        ((0.0, -5.0, 0.0), (4.01,), True),
        ((4.0, -5.0, 3.5), (5.24,), False),  # 1 + 4 + 0.25
        ((4.0, -5.0, 3.5), (5.26,), True),
        ((4.0, 0.0, 0.0), (0.5, 1.01), True),  # one row is enough
        ((1.0, 1.0, 1.0), (-0.01,), False),  # holds for every acceleration
        ((1.0, 1.0, 1.0), (0.01,), True),
        ((1e6, 0.0, 0.0), ((1e6 - 3.0) ** 2 - 990.0,), True),  # 1e-9 of |c|^2 is the rounding
        ((1e6, 0.0, 0.0), ((1e6 - 3.0) ** 2 - 1010.0,), False),
    ],
)
def test_a_ball_is_within_reach_if_it_meets_the_box(
    centre: tuple[float, ...], square: tuple[float, ...], reached: bool
) -> None:
    count, box = len(square), np.full(3, 3.0)
    balls = Balls(
        np.ones(1), np.tile(np.reshape(centre, (3, 1, 1)), (1, 1, count)), np.array([square]), np.ones((1, count))
    )
    assert balls.reachable(-box, box).tolist() == [reached]


def test_the_present_sigma_counts_on_top_of_every_row() -> None:
    """1.5 sigma_k + 2.5 sigma_2, the vehicle's own position in both; the cap is for each alone."""
    prediction = make_prediction(SafetyConfig(), sigma=0.1)
    rows = Barrier(SafetyConfig(kappa=1.5, kappa_now=2.5, sigma_growth_s=0.3)).rows(P, V, prediction, 0.05)
    now = 2.5 * math.hypot(0.11, 0.05)
    assert rows.sigma_m[0, 0] == pytest.approx(1.5 * math.hypot(0.11, 0.05) + now)
    assert rows.sigma_m[0, 3] == pytest.approx(1.5 * math.hypot(0.125, 0.05) + now)
    assert rows.sigma_m[0, 20] == pytest.approx(1.5 * math.hypot(0.13, 0.05) + now)
    capped = Barrier(SafetyConfig(kappa=0.5, kappa_now=9.0, sigma_cap_m=0.2)).rows(P, V, prediction, 0.0)
    assert capped.sigma_m[0, 0] == pytest.approx(0.5 * 0.11 + 0.2)
