"""epsilon*, its CLF budget and the interval that the rows leave, by hand and by brute force."""

from __future__ import annotations

import numpy as np
import pytest

from companion.config import SafetyConfig
from companion.safety.adapt import clf_budget, decay_interval, epsilon_star

CONFIG = SafetyConfig()


@pytest.mark.parametrize(
    ("p_rel", "v_rel", "expected"),
    [
        ((4.0, 0.0, 0.0), (-2.0, 0.0, 0.0), 0.0),  # approaching: 0, near or far
        ((0.6, 0.0, 0.0), (-2.0, 0.0, 0.0), 0.0),
        ((4.0, 0.0, 0.0), (2.0, 0.0, 0.0), 1.0),  # separating: 2 * 2 / 4
        ((3.0, 4.0, 0.0), (0.0, 1.0, 0.0), 2.0 * 0.8 / 5.0),  # cosine 4/5
        ((1.0, 0.0, 0.0), (5.0, 0.0, 0.0), 2.0),  # no more than 1 / alpha2
        ((0.5, 0.0, 0.0), (0.4, 0.0, 0.0), 1.6),  # near: 2 * 0.4 / 0.5
        ((2.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0),
        ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 0.0),  # on top of each other: defined, and strict
    ],
)
def test_epsilon_star_by_hand(p_rel: tuple[float, ...], v_rel: tuple[float, ...], expected: float) -> None:
    assert epsilon_star(np.array([p_rel]), np.array([v_rel]), CONFIG)[0] == pytest.approx(expected)


def test_clf_budget_halves_each_twentieth_of_a_second() -> None:
    budget = clf_budget(np.array([2.0, 2.0, 2.0]), np.zeros(3), np.array([0.05, 0.10, 0.0]), 0.5)
    assert budget == pytest.approx([2.0, 1.0, 4.0])
    assert clf_budget(np.array([2.0]), np.array([0.5]), np.array([0.02]), 0.5)[0] == pytest.approx(0.5**0.4 * 1.5**2)


@pytest.mark.parametrize(
    ("rise", "psi", "expected"),
    [
        ((-0.3, -0.1), (1.0, 1.0), (0.3, 1.0)),  # approach at 0.3 of psi needs that decay
        ((0.2, 0.3), (1.0, 2.0), (0.0, 1.0)),  # nothing asked
        ((0.3,), (-1.0,), (0.0, 0.3)),  # inside, leaving at 0.3: no faster a decay allowed
        ((-0.2, 0.1), (1.0, -1.0), (0.2, 0.1)),  # empty
        ((-1.5,), (1.0,), (1.5, 1.0)),  # beyond 1: empty
        ((0.1,), (0.0,), (0.0, 1.0)),
        ((1.5,), (-1.0,), (0.0, 1.0)),  # leaving faster than any decay asks
    ],
)
def test_decay_interval_by_hand(rise: tuple[float, ...], psi: tuple[float, ...], expected: tuple[float, float]) -> None:
    lower, upper = decay_interval(np.array([[rise], [psi]]), np.zeros(1))
    assert (lower[0], upper[0]) == pytest.approx(expected)


def test_a_row_with_psi_zero_and_falling_has_no_decay() -> None:
    lower, upper = decay_interval(np.array([[[-0.1]], [[0.0]]]), np.zeros(1))
    assert lower[0] > upper[0]


def test_interval_against_brute_force() -> None:
    rng = np.random.default_rng(3)
    rise, psi = rng.normal(0.3, 1.0, (200, 5)), rng.normal(0.5, 1.0, (200, 5))
    lower, upper = decay_interval(np.stack((rise, psi)), np.zeros(200))
    grid = np.linspace(0.0, 1.0, 1001)
    holds = (rise[:, None, :] + grid[:, None] * psi[:, None, :] >= 0.0).all(axis=-1)
    inside = (grid >= lower[:, None]) & (grid <= upper[:, None])
    assert 20 < holds.any(axis=-1).sum() < 180
    assert (holds == inside).all()


def test_inside_the_keep_out_distance_the_decay_has_a_floor() -> None:
    """At rest inside: psi_0 < 0 and nothing changes; without a floor decay 0 would call that admissible."""
    rise, psi = np.array([[0.0, 0.0]]), np.array([[-0.1, -0.1]])
    assert decay_interval(np.stack((rise, psi)), np.zeros(1))[0][0] == 0.0
    lower, upper = decay_interval(np.stack((rise, psi)), np.array([0.02]))
    assert lower[0] > upper[0]
    leaving = decay_interval(np.stack((rise + 0.01, psi)), np.array([0.02]))
    assert (leaving[0][0], leaving[1][0]) == pytest.approx((0.02, 0.1))


def test_rows_that_open_those_that_close_and_a_zero_together() -> None:
    """Two obstacles of three rows: psi 0 asks for rise >= 0 alone, beside psi < 0 and psi > 0."""
    rise = np.array([[0.1, 0.3, -0.2], [0.4, 0.2, 0.5]])
    psi = np.array([[0.0, -1.0, 2.0], [0.0, -0.5, 1.0]])
    lower, upper = decay_interval(np.stack((rise, psi)), np.array([0.0, 0.05]))
    assert lower == pytest.approx([0.1, 0.05])
    assert upper == pytest.approx([0.3, 0.4])


def test_a_floor_applies_where_no_row_closes() -> None:
    lower, upper = decay_interval(np.array([[[0.2], [-0.4]], [[1.0], [1.0]]]), np.array([0.3, 0.1]))
    assert lower == pytest.approx([0.3, 0.4])
    assert upper.tolist() == [1.0, 1.0]
