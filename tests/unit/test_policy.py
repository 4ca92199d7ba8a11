"""The reference in the brain: hold laws, capture, far targets, invalid output."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from companion.config import LimitsConfig, PolicyConfig
from companion.errors import PolicyOutputInvalid
from companion.policy import Float32, Network, Policy, brake, capture_weight, hold, load_policy, read_manifest

CONFIG = PolicyConfig(hold_kp=2.0, hold_kd=3.0, capture_radius_m=0.6)
BUILTIN = Path(__file__).resolve().parents[2] / "policies" / "artifacts" / "default"


def policy_of(network: Network, config: PolicyConfig = CONFIG) -> Policy:
    manifest, digest = read_manifest(BUILTIN)
    return Policy(manifest, digest, network, config, LimitsConfig())


def constant(*action: float) -> Network:
    return lambda observation: np.array([action], dtype=np.float32)


def test_hold_laws_by_hand() -> None:
    v, e = np.array([1.0, -2.0, 0.1]), np.array([0.5, 0.0, -0.2])
    np.testing.assert_allclose(brake(v, CONFIG, 2.5), [-2.5, 2.5, -0.3])
    np.testing.assert_allclose(hold(e, v, CONFIG, 2.5), [-2.0, 2.5, -0.7])


@pytest.mark.parametrize(
    ("v", "e", "expected"),
    [
        ([0.0, 0.0, 0.0], [0.2, 0.0, 0.0], 1.0),
        ([0.0, 0.0, 0.0], [0.0, 0.45, 0.0], 0.5),  # 2 - 2 x 0.45 / 0.6
        ([0.0, 0.0, 0.0], [0.0, 0.0, 0.7], 0.0),
        ([3.0, 0.0, 0.0], [0.1, 0.0, 0.0], 0.0),  # would stop 9 / 4.8 m on: flies through
        ([1.2, 0.0, 0.0], [0.45, 0.0, 0.0], 0.5),  # would stop 0.3 m on, inside: where it is decides
        ([-1.2, 0.0, 0.0], [0.15, 0.0, 0.0], 0.5),  # moving away: would stop 0.45 m off
    ],
)
def test_capture_weight_by_hand(v: list[float], e: list[float], expected: float) -> None:
    assert capture_weight(np.array(v), np.array(e), 0.6, 2.4) == pytest.approx(expected)


def test_capture_weight_is_continuous() -> None:
    rng = np.random.default_rng(0)
    for _ in range(500):
        v, e = rng.normal(size=3), rng.normal(size=3) * 0.4
        dv, de = rng.normal(size=(2, 3)) * 1e-6
        jump = capture_weight(v + dv, e + de, 0.6, 2.4) - capture_weight(v, e, 0.6, 2.4)
        assert abs(jump) < 1e-3


def test_no_capture_without_a_radius() -> None:
    assert capture_weight(np.zeros(3), np.zeros(3), 0.0, 2.4) == 0.0


def test_far_out_the_action_is_scaled_by_k_ma() -> None:
    policy = policy_of(constant(0.5, -1.0, 7.0))
    np.testing.assert_allclose(policy.act(np.zeros(3), np.array([5.0, 0.0, 0.0])), [1.5, -3.0, 3.0])  # 7 is clipped


def test_between_the_two_radii_the_laws_are_mixed() -> None:
    policy = policy_of(constant(1.0, 0.0, 0.0))
    a = policy.act(np.zeros(3), np.array([0.45, 0.0, 0.0]))  # weight 0.5; hold: 2 x 0.45
    np.testing.assert_allclose(a, [0.5 * 3.0 + 0.5 * 0.9, 0.0, 0.0])


def test_captured_it_is_the_hold_law_and_the_network_is_not_asked() -> None:
    def never(observation: Float32) -> Float32:
        raise AssertionError

    v, e = np.array([0.1, 0.0, 0.0]), np.array([0.1, 0.0, -0.1])
    np.testing.assert_allclose(policy_of(never).act(v, e), hold(e, v, CONFIG, 3.0))


def test_an_error_beyond_training_is_shortened_along_its_direction() -> None:
    seen: list[Float32] = []

    def spy(observation: Float32) -> Float32:
        seen.append(observation.copy())
        return np.zeros((1, 3), dtype=np.float32)

    policy_of(spy).act(np.array([1.0, 2.0, 3.0]), np.array([80.0, -40.0, 10.0]))
    np.testing.assert_allclose(seen[0], [[1.0, 2.0, 3.0, 20.0, -10.0, 2.5]])


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_output_that_is_not_finite_is_named(bad: float) -> None:
    with pytest.raises(PolicyOutputInvalid, match=r"policy default: action .* expected finite numbers"):
        policy_of(constant(0.0, bad, 0.0)).act(np.zeros(3), np.array([5.0, 0.0, 0.0]))


@pytest.mark.parametrize("place", range(6))
def test_input_that_is_not_finite_never_becomes_an_acceleration(place: int) -> None:
    policy = load_policy(PolicyConfig(), LimitsConfig())
    values = np.array([0.1, 0.0, 0.0, 5.0, 0.0, 0.0])
    values[place] = np.nan
    with pytest.raises(PolicyOutputInvalid):
        policy.act(values[:3], values[3:])


def test_the_shipped_policy_has_the_symmetries_of_the_cube() -> None:
    policy = load_policy(PolicyConfig(), LimitsConfig())
    rng = np.random.default_rng(1)
    for _ in range(100):
        v, e = rng.uniform(-5.0, 5.0, 3), rng.uniform(-20.0, 20.0, 3)
        order, signs = rng.permutation(3), rng.choice([-1.0, 1.0], 3)
        turned = policy.action(signs * v[order], signs * e[order])
        np.testing.assert_allclose(turned, signs * policy.action(v, e)[order], atol=1e-6)


def test_at_rest_the_shipped_policy_pulls_towards_the_target() -> None:
    """So a mean of it and the hold law has no rest but the target: nothing to be trapped in."""
    policy = load_policy(PolicyConfig(), LimitsConfig())
    rng = np.random.default_rng(2)
    for _ in range(500):
        direction = rng.normal(size=3)
        e = direction / np.linalg.norm(direction) * rng.uniform(0.3, 20.0)
        assert policy.action(np.zeros(3), e) @ e > 0.0


def test_same_input_same_output_whatever_was_asked_before() -> None:
    policy = load_policy(PolicyConfig(), LimitsConfig())
    v, e = np.array([1.0, 0.0, 0.0]), np.array([4.0, 2.0, 0.0])
    first = policy.act(v, e)
    policy.act(-v, e[::-1].copy())
    np.testing.assert_array_equal(policy.act(v, e), first)
