"""The batched bank and the plain filter on filterpy behind one interface: equal to 1e-9, block by block."""

import dataclasses

import numpy as np
import pytest

from companion.config import TrackingConfig, parse_config
from companion.errors import ConfigError
from companion.tracking import engine
from companion.tracking.agility import growth_factor
from companion.tracking.bank import birth
from companion.tracking.engine import BatchedEngine, make_engine
from companion.tracking.predict import horizon
from companion.tracking.reference_engine import ReferenceEngine
from companion.tracking.tracker import Tracker
from companion.types import Detection, DetectionFrame, DetectionKind, frozen

PAPER = parse_config({"tracking": {"preset": "paper"}}).tracking
CONFIGS = {
    "default": TrackingConfig(),
    "paper": PAPER,
    "lasting": TrackingConfig(accel_memory_s=0.0, likelihood_window=3),
    "window": TrackingConfig(turn_rate="window", turn_window=4),
}


def jinking(rng, count, steps):
    """Velocities that jump now and then, so that predictions are missed; measurements with noise."""
    jumps = rng.normal(scale=2.0, size=(steps, count, 3)) * (rng.random((steps, count, 1)) < 0.05)
    v = np.cumsum(jumps, axis=0) + rng.normal(size=(count, 3))
    return np.cumsum(v, axis=0) * 0.05, v


@pytest.mark.parametrize("name", CONFIGS)
def test_both_engines_agree_in_everything_they_return(name):
    """Irregular dt, measurements with and without velocity, foreign tracks, look-backs and predictions."""
    config = CONFIGS[name]
    rng = np.random.default_rng(5)
    batched, plain = BatchedEngine(config), ReferenceEngine(config)
    p, v = jinking(rng, 3, 50)
    noise = np.stack([np.diag(rng.uniform(0.001, 0.02, size=6)) for _ in range(3)])
    one = other = birth(p[0], noise[:, :3, :3], batched.constants)
    at = horizon(np.array([0.0, 0.05, 0.4, 1.1]), batched.constants.models)
    for k in range(1, 50):
        dt = rng.uniform(0.0, 0.3, size=3) if k % 4 == 0 else np.full(3, 0.05)
        d = 6 if k % 9 == 3 else 3
        z = np.concatenate((p[k], v[k]), axis=1)[:, :d] + rng.normal(scale=0.05, size=(3, d))
        foreign = k % 11 == 7
        one, nis = batched.step(one, dt, z, noise[:, :d, :d], foreign=foreign)
        other, expected = plain.step(other, dt, z, noise[:, :d, :d], foreign=foreign)
        np.testing.assert_allclose(nis, expected, rtol=1e-8, atol=1e-9)
        for part, whole in zip(one.parts(), other.parts(), strict=True):
            np.testing.assert_allclose(part, whole, rtol=1e-9, atol=1e-9)
        if k % 10 == 0:
            for back in (np.array([0.0, 0.07, -0.05]), np.full(3, 0.05)):
                for part, whole in zip(
                    batched.propagate(one.x, one.covariance, back),
                    plain.propagate(one.x, one.covariance, back),
                    strict=True,
                ):
                    np.testing.assert_allclose(part, whole, atol=1e-9)
            ours = batched.predict(one.x, one.covariance, one.probabilities, at)
            theirs = plain.predict(one.x, one.covariance, one.probabilities, at)
            for part, whole in zip(ours, theirs, strict=True):
                np.testing.assert_allclose(part, whole, rtol=1e-9, atol=1e-9)
    assert one.means[:, 0].max() > 1.0, "the jumps were noticed"


def test_blocks_change_no_bit(monkeypatch):
    """300 tracks in one block, in three, and in blocks that do not divide them."""
    config = TrackingConfig()
    rng = np.random.default_rng(3)
    p, _ = jinking(rng, 300, 12)
    noise = np.broadcast_to(np.eye(3) * 0.0025, (300, 3, 3))
    results = []
    for block in (1000, 100, 77):
        monkeypatch.setattr(engine, "BLOCK", block)
        batched = BatchedEngine(config)
        bank = birth(p[0], noise, batched.constants)
        for k in range(1, 12):
            bank, nis = batched.step(bank, np.full(300, 0.05), p[k], noise)
        x, covariance = batched.propagate(bank.x, bank.covariance, np.full(300, 0.02))
        at = horizon(np.arange(5.0) * 0.05, batched.constants.models)
        results.append((*bank.parts(), nis, x, covariance, *batched.predict(x, covariance, bank.probabilities, at)))
    for other in results[1:]:
        for one, two in zip(results[0], other, strict=True):
            assert np.array_equal(one, two)


def test_the_configuration_chooses_the_engine():
    assert isinstance(make_engine(TrackingConfig()), BatchedEngine)
    assert isinstance(make_engine(TrackingConfig(backend="reference")), ReferenceEngine)


def test_a_reference_without_filterpy_is_a_configuration_error(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "filterpy", None)
    with pytest.raises(ConfigError, match=r"tracking\.backend"):
        make_engine(TrackingConfig(backend="reference"))


def test_a_straight_flyer_keeps_its_tube_and_a_jinker_gets_a_wide_one():
    batched = BatchedEngine(TrackingConfig())
    rng = np.random.default_rng(1)
    jinker, _ = jinking(rng, 1, 200)
    straight = np.arange(200.0)[:, None, None] * np.array([0.05, 0.02, 0.0])
    p = np.concatenate((straight, jinker), axis=1)
    noise = np.broadcast_to(np.eye(3) * 0.0025, (2, 3, 3))
    bank = birth(p[0], noise, batched.constants)
    for k in range(1, 200):
        bank, _ = batched.step(bank, np.full(2, 0.05), p[k] + rng.normal(scale=0.05, size=(2, 3)), noise)
    straight_factor, jinker_factor = growth_factor(bank.means, batched.constants.watch)
    assert straight_factor < 1.3
    assert jinker_factor > 2.0


def test_a_note_that_is_never_looked_at_again_judges_nothing():
    """A gap longer than twice the look discards the note; means stay, a new note is taken."""
    batched = BatchedEngine(TrackingConfig())
    noise = np.eye(3)[None] * 0.0025
    bank = birth(np.zeros((1, 3)), noise, batched.constants)
    bank, _ = batched.step(bank, np.array([0.05]), np.zeros((1, 3)), noise)
    bank = dataclasses.replace(bank, means=np.array([[2.0, 0.3]]))
    after, _ = batched.step(bank, np.array([0.7]), np.full((1, 3), 5.0), noise)
    assert np.array_equal(after.means, bank.means)
    assert after.notes[0, 0] == 0.0


def test_a_tracker_on_the_reference_is_the_same_tracker():
    """Two sources with their own rates, late frames, losses, velocities, anonymous detections, foreign tracks."""
    config = TrackingConfig(merge_s=0.5)
    flying, plain = Tracker(config), Tracker(TrackingConfig(merge_s=0.5, backend="reference"))
    rng = np.random.default_rng(8)
    p, v = jinking(rng, 3, 90)
    p[:, 0], v[:, 0] = 0.05 * np.arange(90.0)[:, None] * (1.0, 0.4, 0.0), (1.0, 0.4, 0.0)
    for k in range(90):
        stamp_ns, frames = k * 50_000_000, []
        seen = [
            Detection("ab"[m], frozen(p[k, m] + rng.normal(scale=0.05, size=3)), 0.2, 0.05)
            for m in range(2)
            if rng.random() < 0.8
        ]
        if k % 10 != 4:
            found = [*seen, Detection(None, frozen(p[k, 2] + 5.0 + rng.normal(scale=0.05, size=3)), 0.2, 0.05)]
            frames.append(DetectionFrame(stamp_ns, "cam", k, DetectionKind.DETECTION, tuple(found)))
        if k % 3 == 2:  # the radar's frames are two ticks old
            old = p[k - 2, 0] + rng.normal(scale=0.1, size=3)
            one = Detection("r", frozen(old), 0.2, 0.1, frozen(v[k - 2, 0]), 0.3)
            kind = DetectionKind.TRACK if k % 2 else DetectionKind.DETECTION
            frames.append(DetectionFrame(stamp_ns - 100_000_000, "radar", k, kind, (one,)))
        for tracker in (flying, plain):
            tracker.update(frames, stamp_ns)
        if k % 6 == 5:
            one, other = flying.table(), plain.table()
            assert (one.ids, one.status, one.sources) == (other.ids, other.status, other.sources)
            for name in ("p_enu", "v_enu", "a_enu", "covariance", "mode_probabilities", "surprise", "growth"):
                np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-9, atol=1e-9, err_msg=name)
            ahead, too = flying.predict(stamp_ns + 70_000_000, 12, 0.05), plain.predict(stamp_ns + 70_000_000, 12, 0.05)
            for name in ("p_enu", "sigma_m", "v_enu", "a_enu"):
                np.testing.assert_allclose(getattr(ahead, name), getattr(too, name), rtol=1e-9, atol=1e-9, err_msg=name)
    table = flying.table()
    assert table.sources[table.ids.index("cam/a")] == ("cam", "radar"), "the tracks of one obstacle became one"
