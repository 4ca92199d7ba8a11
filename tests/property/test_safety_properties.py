"""Properties of the filter over random scenes: identity, true rows, monotony in D, box, determinism."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.config import LimitsConfig, SafetyConfig
from companion.safety.adapt import decay_interval
from companion.safety.barrier import Barrier
from companion.safety.filter import FilterInput, SafetyFilter
from companion.safety.limits import VehicleLimits, capability, vehicle_limits
from companion.types import Prediction, Verdict, frozen

SAFETY, LIMITS = SafetyConfig(), LimitsConfig()
SETTINGS = settings(max_examples=150, deadline=None, derandomize=True)


@st.composite
def scenes(draw: st.DrawFn) -> FilterInput:
    """A vehicle in mid-air and up to four obstacles on curved paths towards it."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count = draw(st.integers(0, 4))
    t = SAFETY.dt_s * np.arange(SAFETY.horizon + 3)
    p = np.array([0.0, 0.0, 5.0]) + rng.uniform(-3.0, 3.0, 3)
    away = rng.standard_normal((count, 1, 3))
    away /= np.linalg.norm(away, axis=-1, keepdims=True)
    start = p + away * rng.uniform(0.3, 5.0, (count, 1, 1))
    v = -away * rng.uniform(-1.0, 3.0, (count, 1, 1)) + rng.normal(0.0, 0.4, (count, 1, 3))
    path = start + v * t[:, None] + 0.5 * rng.normal(0.0, 1.0, (count, 1, 3)) * t[:, None] ** 2
    prediction = Prediction(
        start_ns=0,
        dt_s=SAFETY.dt_s,
        ids=tuple(f"s/{index}" for index in range(count)),
        p_enu=frozen(path),
        sigma_m=frozen(rng.uniform(0.0, 0.2, (count, 1)) * np.ones(len(t))),
        v_enu=frozen(v[:, 0]),
        a_enu=frozen(np.zeros((count, 3))),
        radius_m=frozen(rng.uniform(0.1, 0.4, count)),
    )
    return FilterInput(p, rng.normal(0.0, 1.5, 3), rng.uniform(-3.0, 3.0, 3), prediction, elapsed_s=0.05)


def limits_of(inputs: FilterInput) -> VehicleLimits:
    return vehicle_limits(inputs.p_enu, inputs.v_enu, LIMITS, capability(LIMITS, shrink_m_s2=0.0, dt_s=0.05))


def admissible_by_grid(inputs: FilterInput) -> bool:
    """Whether some epsilon of a fine grid makes the reference hold every row: cruder than the filter, independent."""
    rows = Barrier(SAFETY).rows(inputs.p_enu, inputs.v_enu, inputs.prediction, 0.0)
    rise, psi = rows.evaluate(inputs.a_ref)
    grid = np.linspace(0.0, 1.0, 401)
    holds = (rise[:, None] + grid[:, None] * psi[:, None]).min(axis=-1, initial=1.0) >= 0.0
    return bool((holds & (grid >= rows.least_decay[:, None])).any(axis=-1).all())


@given(scenes())
@SETTINGS
def test_an_admissible_reference_is_unchanged_to_the_bit(inputs: FilterInput) -> None:
    limits = limits_of(inputs)
    result = SafetyFilter(SAFETY, LIMITS).step(inputs)
    if admissible_by_grid(inputs) and limits.admits(inputs.a_ref):
        assert result.verdict is Verdict.NOMINAL
    if result.verdict is Verdict.NOMINAL:
        assert result.a_safe.tobytes() == inputs.a_ref.tobytes()


@given(scenes())
@SETTINGS
def test_nominal_and_adjusted_answers_satisfy_every_true_row(inputs: FilterInput) -> None:
    result = SafetyFilter(SAFETY, LIMITS).step(inputs)
    assert np.abs(result.a_safe).max() <= LIMITS.acceleration_m_s2 + 1e-12
    assert np.isfinite(result.a_safe).all()
    if result.verdict in (Verdict.NOMINAL, Verdict.ADJUSTED):
        rows = Barrier(SAFETY).rows(inputs.p_enu, inputs.v_enu, inputs.prediction, 0.0)
        epsilon = np.array([record.epsilon for record in result.rows[: len(rows)]])
        assert ((epsilon >= 0.0) & (epsilon <= 1.0 / SAFETY.alpha2 + 1e-12)).all()
        rise, psi = rows.evaluate(result.a_safe)
        _, norm = rows.gradient(result.a_safe, SAFETY.alpha2 * epsilon)
        slack = (rise + SAFETY.alpha2 * epsilon[:, None] * psi) / norm
        assert slack.min(initial=0.0) >= -1e-6
    else:
        assert result.worst is not None
        assert result.worst.slack < 0.0


@given(scenes(), st.floats(0.0, 1.0), st.floats(0.001, 0.5))
@SETTINGS
def test_a_larger_distance_never_enlarges_the_admissible_set(inputs: FilterInput, decay: float, more_m: float) -> None:
    config = SafetyConfig(cushion_m=SAFETY.cushion_m + more_m)
    small = Barrier(SAFETY).rows(inputs.p_enu, inputs.v_enu, inputs.prediction, 0.0)
    large = Barrier(config).rows(inputs.p_enu, inputs.v_enu, inputs.prediction, 0.0)
    points = np.random.default_rng(0).uniform(-3.0, 3.0, (50, 3))
    for_small, for_large = (rows.evaluate_many(points) for rows in (small, large))
    holds_small = for_small[0] + decay * for_small[1] >= 0.0
    holds_large = for_large[0] + decay * for_large[1] >= 0.0
    assert (holds_small | ~holds_large).all()


@given(scenes())
@SETTINGS
def test_tangents_bound_their_rows_from_below(inputs: FilterInput) -> None:
    rows = Barrier(SAFETY).rows(inputs.p_enu, inputs.v_enu, inputs.prediction, 0.0)
    rng = np.random.default_rng(0)
    decay = rng.uniform(0.0, 1.0, len(rows))
    at, elsewhere = rng.uniform(-3.0, 3.0, (2, 3))
    gradient, _ = rows.gradient(at, decay)
    values = [rise + decay[:, None] * psi for rise, psi in (rows.evaluate(at), rows.evaluate(elsewhere))]
    assert (values[1] - values[0] - np.tensordot(elsewhere - at, gradient, 1) >= -1e-12).all()


@given(scenes())
@SETTINGS
def test_obstacles_out_of_reach_never_bind(inputs: FilterInput) -> None:
    rows = Barrier(SAFETY).rows(inputs.p_enu, inputs.v_enu, inputs.prediction, 0.0)
    limits = limits_of(inputs)
    near = rows.balls(np.ones(len(rows))).reachable(limits.hard_low, limits.hard_high)
    far = rows.select(np.flatnonzero(~near))
    points = np.random.default_rng(0).uniform(-3.0, 3.0, (100, 3))
    lower, _ = decay_interval(far.evaluate_many(points), far.least_decay)
    assert (lower <= 1.0).all()


@given(st.lists(scenes(), min_size=2, max_size=4))
@settings(max_examples=30, deadline=None, derandomize=True)
def test_the_same_ticks_give_the_same_answers(ticks: list[FilterInput]) -> None:
    one, other = SafetyFilter(SAFETY, LIMITS), SafetyFilter(SAFETY, LIMITS)
    for inputs in ticks:
        first, second = one.step(inputs), other.step(inputs)
        assert first.a_safe.tobytes() == second.a_safe.tobytes()
        assert first.rows == second.rows
