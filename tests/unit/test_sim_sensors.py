"""The external sensor: rate, noise, latency, dropout, and that its chance comes from the generator alone."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import kstest, poisson

from sim_bridge.errors import ScenarioError
from sim_bridge.obstacles import AWAY_ENU
from sim_bridge.scenario import parse_scenario
from sim_bridge.sensors import Clutter, Sensor, View, sensor_of

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


@dataclass
class Carrier:
    """Who carries the sensor, with a heading, pitch and roll in degrees (intrinsic z, y, x)."""

    p_enu: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ypr_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def rotation(self):
        return Rotation.from_euler("ZYX", self.ypr_deg, degrees=True)

    @property
    def q_wxyz(self):
        x, y, z, w = self.rotation.as_quat().tolist()
        return (w, x, y, z)


EXACT = {"sigma_m": 0.0, "latency_s": 0.0, "dropout": 0.0}


def seen_by(view, carrier, *points):
    """Which of ``points`` are seen, by index."""
    names = [str(i) for i in range(len(points))]
    rng = np.random.default_rng(0)
    instance = Sensor(names, [0.2] * len(points), rate_hz=20.0, rng=rng, view=view, **EXACT)
    instance.sample(0, points, carrier)
    ((_, seen),) = instance.due(0)
    return [int(name) for name, _, _ in seen]


def test_range_counts_from_the_vehicle():
    view = View(range_m=5.0)
    points = [(4.9, 0.0, 0.0), (5.1, 0.0, 0.0), (0.0, 0.0, 4.9), (3.0, 3.0, 3.0)]
    assert seen_by(view, Carrier(), *points) == [0, 2]
    assert seen_by(view, Carrier(p_enu=(1.0, 0.0, 0.0)), *points) == [0, 1, 3]


def test_field_of_view_turns_with_the_vehicle():
    view = View(fov_rad=math.radians(90.0), fov_up_rad=math.radians(40.0))
    east, north, west = (1.0, 0.1, 0.0), (0.1, 1.0, 0.0), (-1.0, 0.0, 0.0)
    high = (1.0, 0.0, math.tan(math.radians(25.0)))
    points = (east, north, west, high)
    assert seen_by(view, Carrier(), *points) == [0]
    assert seen_by(view, Carrier(ypr_deg=(90.0, 0.0, 0.0)), *points) == [1]
    assert seen_by(view, Carrier(ypr_deg=(180.0, 0.0, 0.0)), *points) == [2]
    assert seen_by(view, Carrier(ypr_deg=(0.0, -10.0, 0.0)), *points) == [0, 3]  # nose up (FLU: negative pitch)


def test_what_is_not_there_is_not_seen_even_without_limits():
    assert seen_by(View(), Carrier(), AWAY_ENU, (1.0, 0.0, 0.0)) == [1]


def test_a_limited_sensor_needs_to_know_its_carrier():
    instance = Sensor(["a"], [0.2], rate_hz=20.0, rng=np.random.default_rng(0), view=View(range_m=1.0), **EXACT)
    with pytest.raises(ValueError, match="who carries it"):
        instance.sample(0, [(0.0, 0.0, 0.0)])


def test_neither_limits_nor_clutter_change_the_noise_of_what_is_seen():
    everything = dict(collect(sensor(), 20.0))
    limited = sensor(view=View(range_m=5.0), clutter=Clutter(mean=2.0))
    for t_ms in range(0, 20_000, 50):
        limited.sample(t_ms * MS, TRUTH, Carrier())
    frames = limited.due(19_950 * MS)
    assert any(name == "a" for _, seen in frames for name, _, _ in seen)
    for stamp, seen in frames:
        for name, p, radius in seen:
            assert name != "c"  # 9 m off
            if not name.startswith("clutter-"):
                assert (name, p, radius) in everything[stamp]


def false_detections(view, clutter, carrier, *, seconds=200, **changed):
    instance = Sensor([], [], rate_hz=20.0, rng=np.random.default_rng(3), view=view, clutter=clutter, **EXACT | changed)
    frames = []
    for t_ms in range(0, seconds * 1000, 50):
        instance.sample(t_ms * MS, [], carrier)
        frames += instance.due(t_ms * MS)
    return frames


def test_clutter_is_poisson_and_uniform_in_the_view():
    carrier = Carrier(p_enu=(3.0, -1.0, 2.0), ypr_deg=(70.0, 15.0, -10.0))
    view = View(range_m=6.0, fov_rad=math.radians(100.0), fov_up_rad=math.radians(60.0))
    frames = false_detections(view, Clutter(mean=1.5), carrier)
    counts = np.bincount([len(seen) for _, seen in frames], minlength=12)
    assert counts.sum() == 4000
    assert counts[:5] / 4000 == pytest.approx(poisson.pmf(np.arange(5), 1.5), abs=0.03)
    points = np.array([p for _, seen in frames for _, p, _ in seen])
    body = carrier.rotation.inv().apply(points - carrier.p_enu)
    r = np.linalg.norm(body, axis=1)
    azimuth, elevation = np.arctan2(body[:, 1], body[:, 0]), np.arcsin(body[:, 2] / r)
    # uniform in the volume: r^3, azimuth and sin(elevation) are uniform
    half = math.sin(math.radians(30.0))
    for uniform in ((r / 6.0) ** 3, azimuth / math.radians(100.0) + 0.5, 0.5 * np.sin(elevation) / half + 0.5):
        assert kstest(uniform, "uniform").pvalue > 1e-3
    assert all(view.sees(tuple(p), carrier) for p in points.tolist())


def test_clutter_in_a_box_has_names_of_its_own_and_survives_no_lost_frame():
    box = ((1.0, -2.0, 0.0), (3.0, 2.0, 1.0))
    frames = false_detections(View(), Clutter(mean=1.0, box=box, radius_m=0.4), None, frame_dropout=0.5)
    names = [name for _, seen in frames for name, _, _ in seen]
    assert len(set(names)) == len(names)
    assert 1700 < len(frames) < 2300
    points = np.array([p for _, seen in frames for _, p, _ in seen])
    share = (points - box[0]) / np.subtract(box[1], box[0])
    assert all(kstest(share[:, axis], "uniform").pvalue > 1e-3 for axis in range(3))
    assert {radius for _, seen in frames for _, _, radius in seen} == {0.4}


def test_anonymous_detections_carry_no_id():
    frames = collect(sensor(anonymous=True, clutter=Clutter(mean=1.0, box=((0.0,) * 3, (1.0,) * 3))), 5.0)
    assert {name for _, seen in frames for name, _, _ in seen} == {None}


def test_clutter_needs_bounds():
    with pytest.raises(ScenarioError, match="clutter: expected a range or a box"):
        sensor(clutter=Clutter(mean=1.0))


def test_a_table_makes_the_sensor_it_describes():
    table = {"range_m": 4.0, "fov_deg": 60.0, "fov_up_deg": 30.0, "anonymous": True, "sigma_m": 0.0, "dropout": 0.0}
    (spec,) = parse_scenario({"sensors": [table]}, source="x").sensors
    instance = sensor_of(spec, ["a", "b", "c"], [0.2] * 3, np.random.default_rng(0))
    r = 3.0
    left, up = math.radians(29.0), math.radians(14.0)
    points = [
        (r * math.cos(left), r * math.sin(left), 0.0),
        (r * math.cos(up), 0.0, r * math.sin(up)),
        (0.0, r, 0.0),
    ]
    instance.sample(0, points, Carrier())
    assert instance.due(49 * MS) == []
    assert instance.due(50 * MS) == [(0, [(None, points[0], 0.2), (None, points[1], 0.2)])]
