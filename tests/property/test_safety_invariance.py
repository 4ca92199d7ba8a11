"""Forward invariance without noise: closed loops on the grid's own plant (21) over random obstacles and limits."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safety_scenes import uniform_motion

from companion.config import LimitsConfig, SafetyConfig
from companion.safety.filter import FilterInput, SafetyFilter
from companion.types import Verdict

SAFETY = SafetyConfig(kappa=0.0, sigma_delay_s=0.0)
DT, STEPS = SAFETY.dt_s, 70
D_M = SAFETY.drone_radius_m + 0.2 + SAFETY.cushion_m

LIMITS = {
    "box": LimitsConfig(),
    "norm and tilt": LimitsConfig(norm_m_s2=2.5, tilt_deg=14.0),
    "slew": LimitsConfig(slew_m_s3=15.0),
}


@pytest.mark.parametrize("name", list(LIMITS))
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 3))
@settings(max_examples=12, deadline=None, derandomize=True)
def test_what_starts_safe_stays_safe(name: str, seed: int, count: int) -> None:
    """Obstacles at up to 2 m/s cross the straight flight of a vehicle that starts clear of them.

    As long as the rows could be kept, nobody is nearer than D; and with few obstacles they always could: never is
    anybody touched.
    """
    rng, limits = np.random.default_rng(seed), LIMITS[name]
    guard = SafetyFilter(SAFETY, limits)
    p, v, before = np.array([-4.0, 0.0, 5.0]), np.array([1.0, 0.0, 0.0]), np.zeros(3)
    target = np.array([4.0, 0.0, 5.0])
    meet_s = rng.uniform(1.3, 2.2, (count, 1))
    ov = rng.normal(0.0, 0.8, (count, 3)) * (1.0, 1.0, 0.4)
    o = np.array([-4.0, 0.0, 5.0]) + meet_s * (2.0, 0.0, 0.0) + rng.uniform(-0.2, 0.2, (count, 3)) - meet_s * ov
    kept = True
    for _ in range(STEPS):
        a_ref = np.clip(1.2 * (target - p) - 1.8 * v, -2.5, 2.5)
        result = guard.step(FilterInput(p, v, a_ref, uniform_motion(o, ov), elapsed_s=DT, a_before=before))
        before = result.a_safe
        kept &= result.verdict in (Verdict.NOMINAL, Verdict.ADJUSTED)
        p, v, o = p + DT * v, v + DT * before, o + DT * ov
        nearest = float(np.linalg.norm(p - o, axis=1).min())
        assert nearest > 0.4
        assert nearest >= D_M - 1e-6 or not kept


@pytest.mark.parametrize("name", [*LIMITS, "norm and slew"])
@pytest.mark.parametrize("push", [(3.0, 1.0, 0.0), (3.0, 0.0, 3.0), (3.0, 3.0, 3.0), (2.0, -3.0, -3.0)])
def test_no_push_leads_out_of_the_arena(name: str, push: tuple[float, float, float]) -> None:
    """Against one, two and three walls at once, with norm, tilt and slew; the half step is exact integration's."""
    limits = LIMITS[name] if name in LIMITS else LimitsConfig(norm_m_s2=2.0, slew_m_s3=6.0)
    guard, before = SafetyFilter(SAFETY, limits), np.zeros(3)
    p, v = np.array([2.0, 2.0, 4.0]), np.zeros(3)
    nothing = uniform_motion(np.zeros((0, 3)), np.zeros((0, 3)))
    for _ in range(170):
        result = guard.step(FilterInput(p, v, np.array(push), nothing, elapsed_s=DT, a_before=before))
        before = result.a_safe
        p, v = p + DT * v + 0.5 * DT**2 * before, v + DT * before
        assert (p <= np.array(limits.arena_max) + 0.02).all()
        assert (p >= np.array(limits.arena_min) - 0.02).all()


def test_a_large_obstacle_far_away_and_a_wall_have_an_answer() -> None:
    """Nothing is within reach, but the reference does not pass: the search has rows of no obstacle at all."""
    guard = SafetyFilter(SAFETY, LimitsConfig())
    large = uniform_motion([-9.0, 0.0, 3.0], [0.0, 0.0, 0.0], radius_m=3.0)
    result = guard.step(
        FilterInput(np.array([9.5, 0.0, 3.0]), np.array([2.0, 0.0, 0.0]), np.array([2.0, 0.0, 0.0]), large)
    )
    assert result.a_safe[0] < 0.0
