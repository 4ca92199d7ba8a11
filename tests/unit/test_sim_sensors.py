"""The external sensor: rate, noise, latency, dropout, and that its chance comes from the generator alone."""

import numpy as np
import pytest

from sim_bridge.errors import ScenarioError
from sim_bridge.sensors import Sensor

MS = 1_000_000
IDS = ("a", "b", "c")
TRUTH = [(1.0, 2.0, 3.0), (-4.0, 0.0, 1.0), (0.0, 0.0, 9.0)]


def sensor(seed=0, **changed):
    settings = {"rate_hz": 20.0, "sigma_m": 0.05, "latency_s": 0.05, "dropout": 0.05} | changed
    return Sensor(IDS, (0.2, 0.3, 0.4), rng=np.random.default_rng(seed), **settings)


def collect(instance, seconds, *, call_ms=50):
    frames = []
    for t_ms in range(0, round(seconds * 1000), call_ms):
        instance.sample(t_ms * MS, TRUTH)
        frames += instance.due(t_ms * MS)
    return frames


def test_perfect_sensor_tells_the_truth():
    instance = sensor(sigma_m=0.0, latency_s=0.0, dropout=0.0)
    instance.sample(0, TRUTH)
    assert instance.due(0) == [(0, [("a", TRUTH[0], 0.2), ("b", TRUTH[1], 0.3), ("c", TRUTH[2], 0.4)])]
    assert instance.due(10**12) == []  # handed out once


@pytest.mark.parametrize(("rate_hz", "call_ms"), [(20.0, 50), (20.0, 1), (10.0, 50), (50.0, 1), (7.5, 1)])
def test_rate(rate_hz, call_ms):
    frames = collect(sensor(rate_hz=rate_hz, latency_s=0.0), 20.0, call_ms=call_ms)
    assert len(frames) == 20 * rate_hz
    gaps_ms = np.diff([stamp for stamp, _ in frames]) / MS
    assert gaps_ms == pytest.approx(1000.0 / rate_hz, abs=1.0)


def test_rate_between_the_callers_ticks_keeps_its_mean():
    frames = collect(sensor(rate_hz=15.0, latency_s=0.0), 60.0, call_ms=10)
    assert len(frames) == 900
    assert all(stamp % (10 * MS) == 0 for stamp, _ in frames)  # stamped when measured, not when scheduled


def test_a_faster_sensor_than_its_caller_gives_one_frame_a_call():
    assert len(collect(sensor(rate_hz=200.0, latency_s=0.0), 5.0)) == 100


def test_next_measurement_fits_the_physics_clock():
    """floor(k 1e9 / rate) meets floor(step 1e9 / 240) exactly at 30 Hz."""
    instance = sensor(rate_hz=30.0)
    for k in range(500):
        assert instance.next_ns == (8 * k) * 1_000_000_000 // 240
        instance.sample(instance.next_ns, TRUTH)


def test_latency_is_exact_and_frames_are_never_merged():
    instance = sensor(latency_s=0.12, dropout=0.0)
    arrivals = []
    for t_ms in range(0, 2000, 10):
        instance.sample(t_ms * MS, TRUTH)
        arrivals += [(t_ms * MS, stamp) for stamp, _ in instance.due(t_ms * MS)]
    assert [stamp for _, stamp in arrivals] == [k * 50 * MS for k in range(len(arrivals))]
    assert {arrival - stamp for arrival, stamp in arrivals} == {120 * MS}


def test_frames_that_waited_come_together_but_apart():
    instance = sensor(latency_s=0.0, dropout=0.0)
    for t_ms in (0, 50, 100):
        instance.sample(t_ms * MS, TRUTH)
    assert [stamp for stamp, _ in instance.due(100 * MS)] == [0, 50 * MS, 100 * MS]


def test_noise_is_white_of_the_stated_deviation():
    frames = collect(sensor(dropout=0.0, latency_s=0.0), 500.0)
    errors = np.array(
        [[np.subtract(p, truth) for (_, p, _), truth in zip(seen, TRUTH, strict=True)] for _, seen in frames]
    )
    assert errors.shape == (10_000, 3, 3)
    # 10 000 draws: the mean within 4 sigma / sqrt(n), the deviation within 3 %
    assert np.abs(errors.mean(axis=0)).max() < 4 * 0.05 / 100
    assert errors.std(axis=0) == pytest.approx(0.05, rel=0.03)
    flat = errors.reshape(10_000, 9)
    correlation = np.corrcoef(np.hstack([flat[1:], flat[:-1]]).T)
    assert np.abs(correlation - np.eye(18)).max() < 0.045


def test_dropout_takes_obstacles_and_leaves_frames():
    frames = collect(sensor(dropout=0.2, latency_s=0.0), 500.0)
    assert len(frames) == 10_000
    for name in IDS:
        share = sum(any(sighting[0] == name for sighting in seen) for _, seen in frames) / 10_000
        assert share == pytest.approx(0.8, abs=0.016)  # 4 sigma
    empty = sum(not seen for _, seen in frames) / 10_000
    assert empty == pytest.approx(0.2**3, abs=0.004)  # independent of each other


def test_frame_dropout_takes_whole_frames():
    frames = collect(sensor(dropout=0.0, frame_dropout=0.3, latency_s=0.0), 500.0)
    assert len(frames) / 10_000 == pytest.approx(0.7, abs=0.02)
    assert all(len(seen) == 3 for _, seen in frames)


def test_chance_is_that_of_the_generator():
    assert collect(sensor(seed=4), 10.0) == collect(sensor(seed=4), 10.0)
    assert collect(sensor(seed=4), 10.0) != collect(sensor(seed=5), 10.0)


def test_dropout_does_not_change_the_noise_of_what_is_seen():
    everything = dict(collect(sensor(dropout=0.0), 10.0))
    for stamp, seen in collect(sensor(dropout=0.5, frame_dropout=0.2), 10.0):
        for sighting in seen:
            assert sighting in everything[stamp]


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"rate_hz": 0.0}, r"^sensor: rate_hz: expected above 0, got 0.0$"),
        ({"sigma_m": -0.1}, r"^sensor: sigma_m: expected 0 or above"),
        ({"latency_s": -1.0}, r"^sensor: latency_s: expected 0 or above"),
        ({"dropout": 1.2}, r"^sensor: dropout: expected a probability"),
        ({"frame_dropout": float("nan")}, r"^sensor: frame_dropout: expected a probability"),
    ],
)
def test_bad_settings_are_named(changed, message):
    with pytest.raises(ScenarioError, match=message):
        sensor(**changed)


def test_ids_and_radii_must_match():
    with pytest.raises(ScenarioError, match="radii_m: expected 3 values"):
        Sensor(IDS, (0.2,), rate_hz=20.0, sigma_m=0.0, latency_s=0.0, dropout=0.0, rng=np.random.default_rng(0))
