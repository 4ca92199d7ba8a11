"""The bench measures what it says: exact motions, textbook rivals, counts that can fail, figures held to limits."""

import json

import numpy as np
import pytest
from scipy.stats import chi2

from companion.bench import accuracy, crossing, timing, tracking
from companion.bench.accuracy import CHI2_95, Cell, draw_trials, hindsight, track, track_filterpy, track_single
from companion.bench.crossing import draw_crossing, judge
from companion.bench.envelope import Figure, envelope
from companion.bench.gnn import GnnTracker, OneModel
from companion.bench.motions import MOTIONS
from companion.bench.rivals import SingleModel, chain, chain_of_axes
from companion.bench.tables import print_tracking
from companion.bench.timing import Quantiles, Timing, measure_timing, quantiles
from companion.config import TrackingConfig

CELL = Cell(0.05, 20.0)


@pytest.mark.parametrize("motion", MOTIONS, ids=lambda motion: motion.name)
def test_velocity_is_the_derivative_of_position(motion):
    path = motion.draw(np.random.default_rng(3))
    t = np.linspace(0.01, 21.9, 4001)
    h = 1e-6
    slope = (path(t + h)[0] - path(t - h)[0]) / (2.0 * h)
    np.testing.assert_allclose(path(t)[1], slope, atol=2e-5)


def test_figure_eights_reach_their_speed_at_the_centre():
    for name, speed in (("eight 0.5 m/s", 0.5), ("eight 1.5 m/s", 1.5), ("eight 3 m/s", 3.0)):
        motion = next(m for m in MOTIONS if m.name == name)
        _, v = motion.draw(np.random.default_rng(0))(np.linspace(0.0, 60.0, 60_001))
        assert np.linalg.norm(v, axis=1).max() == pytest.approx(speed, rel=1e-5)


def test_trials_are_the_same_for_a_seed_and_others_for_another():
    one, same, other = (draw_trials(CELL, seed=seed, trials=1) for seed in (5, 5, 6))
    assert np.array_equal(one.z, same.z)
    assert not np.array_equal(one.z, other.z)
    assert tracking.REPORT_SEED != tracking.TUNING_SEED
    assert tracking.TUNING_SEED not in tracking.CROSSING_SEEDS


def test_measurements_carry_the_stated_noise_loss_and_lateness():
    late = draw_trials(Cell(0.22, 10.0, dropout=0.3, latency_s=0.2), seed=1, trials=4)
    at_stamp = draw_trials(Cell(1e-9, 10.0), seed=1, trials=4)
    np.testing.assert_allclose(late.now[:-2], at_stamp.z[2:], atol=1e-6)  # 0.2 s are two frames
    assert (late.z - at_stamp.z).std() == pytest.approx(0.22, rel=0.02)
    assert 1.0 - late.seen[1:].mean() == pytest.approx(0.3, abs=0.02)


def test_chains_of_integrators_are_filterpys():
    from filterpy.common import Q_continuous_white_noise

    for order in (2, 3):
        f, q = chain(order, 0.3)
        np.testing.assert_allclose(q, Q_continuous_white_noise(order, 0.3, 1.0), rtol=1e-12)
        state = np.array([1.0, 2.0, 3.0])[:order]
        moved = [np.polyval([*(state / [1.0, 1.0, 2.0][:order])[::-1]], 0.3)]
        assert (f @ state)[0] == pytest.approx(moved[0])
    big_f, big_q = chain_of_axes(3, 0.3, 2.0)
    np.testing.assert_allclose(big_f, np.kron(chain(3, 0.3)[0], np.eye(3)))
    np.testing.assert_allclose(big_q, 2.0 * np.kron(chain(3, 0.3)[1], np.eye(3)))


@pytest.mark.parametrize("order", [2, 3])
def test_single_models_are_filterpys_kalman_filters(order):
    from filterpy.kalman import KalmanFilter

    rng = np.random.default_rng(2)
    z = rng.normal(size=(30, 2, 3))
    seen = rng.random((30, 2)) < 0.7
    model = SingleModel(order, np.array([0.3, 7.0]), z[0], 0.2)
    f, q = chain_of_axes(order, 0.05, 7.0)
    kalman = KalmanFilter(dim_x=3 * order, dim_z=3)
    kalman.x[:3, 0] = z[0, 1]
    kalman.P = np.diag(np.repeat([0.04, 9.0, 9.0][:order], 3))
    kalman.F, kalman.Q = f[: 3 * order, : 3 * order], q[: 3 * order, : 3 * order]
    kalman.H, kalman.R = np.eye(3, 3 * order), np.eye(3) * 0.04
    for k in range(1, 30):
        model.predict(0.05)
        model.update(z[k], seen[k])
        kalman.predict()
        if seen[k, 1]:
            kalman.update(z[k, 1])
        np.testing.assert_allclose(model.x[1, 1].ravel(), kalman.x[:, 0], atol=1e-10)
    ahead, _ = chain_of_axes(order, 0.25, 0.0)
    expected = ahead[: 3 * order, : 3 * order] @ kalman.x[:, 0]
    np.testing.assert_allclose(model.ahead(0.25)[0][1, 1], expected[:3], atol=1e-10)


def test_hindsight_is_no_worse_than_any_filter_of_its_grids():
    trials = draw_trials(CELL, seed=1, trials=1)
    best = hindsight(trials)
    for order, grid in ((2, accuracy.CV_GRID), (3, accuracy.CA_GRID)):
        for index in (0, len(grid) // 2):
            one = track_single(trials, order, grid[index : index + 1])
            assert (best.ahead_m <= one.ahead_m[..., 0] + 1e-12).all()
    assert best.ahead_m[0][0] == track_single(trials, 2, accuracy.CV_GRID[:1]).ahead_m[0][0, 0], (
        "quiet CV flies straight"
    )


def test_ours_and_filterpy_see_a_still_world_as_it_is():
    """Without noise and manoeuvre every filter ends up at the truth: the bench aligns instants and latencies."""
    trials = draw_trials(Cell(1e-4, 20.0, latency_s=0.1), seed=1, trials=1)
    ours = track(trials, TrackingConfig())
    theirs = track_filterpy(trials, accel_psd=1e-3, jerk_psd=1e-2, stay=0.97)
    assert ours.ahead_m[0][0] < 2e-3
    assert theirs.ahead_m[0][0] < 4e-3
    assert abs(CHI2_95 - chi2(3).ppf(0.95)) < 1e-12


def test_coverage_falls_where_the_stated_noise_is_a_lie():
    trials = draw_trials(CELL, seed=1, trials=1)
    honest = track(trials, TrackingConfig())
    small = TrackingConfig(force_measurement_variance=True, measurement_variance_m2=1e-5, inflation_max=1.0)
    lying = track(trials, small)
    assert honest.coverage is not None
    assert lying.coverage is not None
    assert lying.coverage[0] < 0.8 < honest.coverage[0]


class Oracle:
    """A tracker that knows the truth; from ``exchange_at`` on it calls the first two by each other's name."""

    def __init__(self, scene, exchange_at=None, blind=0):
        self.scene, self.exchange_at, self.blind = scene, exchange_at, blind

    def __call__(self, frame, k):
        names = [f"o{m}" for m in range(crossing.OBSTACLES)]
        if self.exchange_at is not None and k >= self.exchange_at:
            names[0], names[1] = names[1], names[0]
        return names[self.blind :], self.scene.truth[k][self.blind :]


def test_swaps_and_losses_are_counted():
    scene = draw_crossing(1)
    assert scene.nearest_m >= 2.0 * crossing.RADIUS_M
    assert scene.passes > 20
    perfect = judge(scene, Oracle(scene))
    assert (perfect.swaps, perfect.lost_share, perfect.false_share) == (0, 0.0, 0.0)
    assert judge(scene, Oracle(scene, exchange_at=600)).swaps == 2
    assert judge(scene, Oracle(scene, blind=2)).lost_share == pytest.approx(0.2)


def test_the_plain_tracker_keeps_two_far_obstacles_apart():
    plain = GnnTracker(lambda z: OneModel(2, 1.0, z, 0.05), rate_hz=20.0, std_m=0.05)
    rng = np.random.default_rng(1)
    for k in range(40):
        truth = np.array([[0.05 * k, 0.0, 1.0], [-0.05 * k, 5.0, 1.0]])
        ids, p = plain.frame(rng.permutation(truth + rng.normal(scale=0.05, size=(2, 3))), k)
    assert len(ids) == 2
    np.testing.assert_allclose(p[np.argsort(p[:, 1])], truth, atol=0.15)
    for k in range(40, 70):
        ids, _ = plain.frame(np.zeros((0, 3)), k)
    assert ids == []


def test_confirmed_tracks_of_the_plain_tracker_choose_first():
    """A tentative track nearer to the only detection does not take it from the confirmed one."""
    plain = GnnTracker(lambda z: OneModel(2, 1.0, z, 0.05), rate_hz=20.0, std_m=0.05)
    for k in range(20):
        plain.frame(np.zeros((1, 3)), k)
    ids, _ = plain.frame(np.array([[0.0, 0.0, 0.0], [0.6, 0.0, 0.0]]), 20)
    assert ids == ["#1"]
    ids, _ = plain.frame(np.array([[0.15, 0.0, 0.0]]), 21)
    assert ids == ["#1"]
    assert plain._tracks[0].last == 21


@pytest.mark.parametrize(("frames", "coasted"), [(2, 6), (6, 10), (40, 20)])
def test_the_plain_tracker_coasts_as_ours(frames, coasted):
    """max(0.3 s, twice the time over which it was seen), at most a second."""
    plain = GnnTracker(lambda z: OneModel(2, 1.0, z, 0.05), rate_hz=20.0, std_m=0.05)
    for k in range(frames):
        plain.frame(np.zeros((1, 3)), k)
    shown = [bool(plain.frame(np.zeros((0, 3)), k)[0]) for k in range(frames, frames + 40)]
    assert shown == [True] * coasted + [False] * (40 - coasted)


def test_quantiles_of_too_few_samples_are_not_told(capsys):
    few, some, many = (quantiles([1_000_000] * count) for count in (99, 100, 1000))
    assert (few.p99, few.p999) == (None, None)
    assert (some.p99, some.p999) == (1.0, None)
    assert many == Quantiles(1.0, 1.0, 1.0, 1.0)
    print_tracking([], {}, [Timing(1, few, few, few, few)], [])
    row = next(line for line in capsys.readouterr().out.splitlines() if "1.000" in line)
    assert row.count(" - ") == 3


def test_filterpy_is_timed_on_some_of_the_ticks(monkeypatch):
    pytest.importorskip("filterpy")
    monkeypatch.setattr(timing, "FILTERPY_UPDATES", 20)
    monkeypatch.setattr(timing, "FILTERPY_TICKS", 5)
    looped = []
    monkeypatch.setattr(timing, "_loop_ns", lambda estimators, z: looped.append(len(z)) or 1_000_000)
    assert measure_timing(2, 40, filterpy=True).filterpy.p50 == 1.0
    assert looped == [2] * (5 + 10)


def test_without_git_there_is_no_commit(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert envelope("tracking", {}, [])["commit"] is None


def test_figures_are_met_or_missed():
    assert Figure("a", 1.0, "at most", 1.0).met
    assert not Figure("a", 1.1, "at most", 1.0).met
    assert Figure("a", 1.1, "at least", 1.0).met
    told = envelope("tracking", {"x": 1}, [Figure("a", 1.1, "at most", 1.0)])
    assert told["figures"] == [{"name": "a", "value": 1.1, "relation": "at most", "limit": 1.0, "met": False}]
    assert told["machine"]["cores"] >= 1
    json.dumps(told)


def test_a_whole_small_bench_has_every_filter_and_figure():
    cell = tracking.HEADLINE[1]
    results = [tracking.measure_cell(cell, seed=tracking.TUNING_SEED, trials=1, filterpy=False)]
    crossings = {1: {"ours": crossing.CrossingResult(2, 0.0, 0.0)}}
    times = [measure_timing(count, 3, filterpy=False) for count in (100, 1000)]
    figures = tracking.figures(results, crossings, times)
    names = [figure.name for figure in figures]
    assert sum(name.startswith("sigma 0.05") for name in names) == 10
    assert "1000 obstacles over 100, time" in names
    plain = tracking.as_json(results, crossings, times)
    assert set(plain["accuracy"][0]["filters"]) == {"ours", "paper", "CV only", "CA only", "hindsight"}
    json.dumps(plain)


def test_cells_cover_noise_rate_loss_and_lateness():
    chosen, every = tracking.cells(every=False), tracking.cells(every=True)
    assert len(every) == 81
    assert set(chosen) <= set(every)
    assert chosen[:2] == list(tracking.HEADLINE)
    assert {cell.rate_hz for cell in chosen} == {10.0, 20.0, 50.0}
    assert {cell.dropout for cell in chosen} == {0.0, 0.1, 0.3}
    assert {cell.latency_s for cell in chosen} == {0.0, 0.1, 0.2}
