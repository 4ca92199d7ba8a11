"""The disturbance observer against a simulated lag with a known push."""

from __future__ import annotations

import math

import numpy as np

from companion.config import DisturbanceConfig
from companion.disturbance import DisturbanceObserver
from companion.types import Vec3, frozen

DT_S, LAG_S = 0.05, 0.08


def closed_loop(push: list[float], seconds: float, *, adapt: bool = True, saturated: bool = False) -> Vec3:
    """Fly a hover command on a vehicle with the modelled lag and a constant push; the estimate at the end."""
    observer = DisturbanceObserver(DisturbanceConfig(bound_m_s2=1.0), lag_s=LAG_S)
    v, actual, estimate = np.zeros(3), np.zeros(3), np.zeros(3)
    elapsed = None
    for k in range(round(seconds / DT_S)):
        estimate = observer.update(frozen(v), elapsed, adapt=adapt)
        wire = frozen(np.array([math.sin(0.7 * k), 0.0, 0.0]) - estimate)
        observer.command(wire, saturated=saturated)
        fine = DT_S / 200
        for _ in range(200):
            actual += (wire - actual) * fine / LAG_S
            v = v + (actual + np.array(push)) * fine
        elapsed = DT_S
    return estimate


def test_finds_a_constant_push() -> None:
    np.testing.assert_allclose(closed_loop([0.4, -0.2, 0.1], 10.0), [0.4, -0.2, 0.1], atol=0.02)


def test_is_slow() -> None:
    after = closed_loop([0.4, 0.0, 0.0], 0.25)[0]
    assert 0.0 < after < 0.25  # 0.3 Hz: a quarter of a second moves it by less than 40 %


def test_stays_within_its_bound() -> None:
    observer = DisturbanceObserver(DisturbanceConfig(bound_m_s2=0.3), lag_s=LAG_S)
    estimate = np.zeros(3)
    for k in range(200):
        estimate = observer.update(frozen([k * DT_S * 5.0, 0.0, -k * DT_S * 5.0]), DT_S, adapt=True)
        observer.command(frozen([0.0, 0.0, 0.0]), saturated=False)
    np.testing.assert_allclose(estimate, [0.3, 0.0, -0.3])


def test_is_frozen_on_the_ground_and_at_the_limit() -> None:
    assert not closed_loop([0.4, 0.0, 0.0], 5.0, adapt=False).any()
    assert not closed_loop([0.4, 0.0, 0.0], 5.0, saturated=True).any()


def test_disabled_stays_zero() -> None:
    observer = DisturbanceObserver(DisturbanceConfig(enabled=False), lag_s=LAG_S)
    for k in range(50):
        estimate = observer.update(frozen([k * 0.1, 0.0, 0.0]), DT_S, adapt=True)
        observer.command(frozen([0.0, 0.0, 0.0]), saturated=False)
    assert not estimate.any()


def test_without_lag_the_command_counts_at_once() -> None:
    observer = DisturbanceObserver(DisturbanceConfig(), lag_s=0.0)
    observer.update(frozen([0.0, 0.0, 0.0]), None, adapt=True)
    observer.command(frozen([2.0, 0.0, 0.0]), saturated=False)
    assert not observer.update(frozen([2.0 * DT_S, 0.0, 0.0]), DT_S, adapt=True).any()
