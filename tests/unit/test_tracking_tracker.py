"""Tracks from frames: order, stamps, births and deaths, outliers, anonymous detections, and what is counted."""

import math

import numpy as np
import pytest
from tracking_scenes import S, frame, seen

from companion.config import TrackingConfig
from companion.tracking.reference import ReferenceImm
from companion.tracking.tracker import Tracker
from companion.types import DetectionFrame, DetectionKind


def straight(k, rng, p=(0.0, 0.0, 2.0), v=(1.0, -0.5, 0.1), std=0.05):
    return np.array(p) + np.array(v) * 0.05 * k + rng.normal(scale=std, size=3)


def fly(tracker, steps, identity="a", seed=0, **kwargs):
    rng = np.random.default_rng(seed)
    for k in range(steps):
        tracker.update([frame(0.05 * k, seen(identity, straight(k, rng), **kwargs), sequence=k)], round(0.05 * k * S))
    return tracker


def test_named_track_converges_on_position_and_velocity():
    tracker = fly(Tracker(TrackingConfig()), 60)
    table = tracker.table()
    assert table.ids == ("cam/a",)
    np.testing.assert_allclose(table.p_enu[0], [2.95, -1.475, 2.295], atol=0.08)
    np.testing.assert_allclose(table.v_enu[0], [1.0, -0.5, 0.1], atol=0.15)
    assert table.covariance.shape == (1, 9, 9)
    assert np.linalg.eigvalsh(table.covariance[0, :6, :6]).min() > 0.0
    assert table.mode_probabilities.sum() == pytest.approx(1.0)
    assert table.radius_m[0] == 0.2


def test_tracker_equals_the_reference_with_two_rates_and_dropouts():
    """Two sources with their own instants, losses and a velocity now and then: each track is filterpy's to 1e-9."""
    config = TrackingConfig()
    tracker, rng = Tracker(config), np.random.default_rng(12)
    references, last_ns = {}, {}
    for k in range(120):
        for source, every, std in (("cam", 2, 0.05), ("radar", 5, 0.2)):
            if k % every or rng.random() < 0.3:
                continue
            t_ns = k * 25_000_000
            z = np.array([math.sin(0.04 * k), math.cos(0.04 * k), 1.0]) + rng.normal(scale=std, size=3)
            v = rng.normal(scale=0.1, size=3) if k % 15 == 0 and source == "radar" else None
            detection = seen("x", z, std=std, v=v, v_std=0.3)
            tracker.update([DetectionFrame(t_ns, source, k, DetectionKind.DETECTION, (detection,))], t_ns)
            measured = z if v is None else np.concatenate((z, v))
            noise = np.diag([std**2] * 3 + [0.09] * (0 if v is None else 3))
            key = f"{source}/x"
            if key in references:
                references[key].update(measured, noise, (t_ns - last_ns[key]) / S)
            else:
                references[key] = ReferenceImm(config, measured, noise)
            last_ns[key] = t_ns
    table = tracker.table()
    assert set(table.ids) == set(references)
    for row, key in enumerate(table.ids):
        mean, covariance = references[key].predict((table.stamp_ns - last_ns[key]) / S)
        np.testing.assert_allclose(table.p_enu[row], mean[:3], atol=1e-9)
        np.testing.assert_allclose(table.v_enu[row], mean[3:6], atol=1e-9)
        np.testing.assert_allclose(table.a_enu[row], mean[6:9], atol=1e-9)
        np.testing.assert_allclose(table.covariance[row], covariance[:9, :9], atol=1e-9)
        np.testing.assert_allclose(table.mode_probabilities[row], references[key].probabilities, atol=1e-9)


def test_frames_are_used_in_the_order_of_their_stamps():
    rng = np.random.default_rng(1)
    frames = [frame(0.05 * k, seen("a", straight(k, rng)), sequence=k) for k in range(20)]
    one, other = Tracker(TrackingConfig()), Tracker(TrackingConfig())
    one.update(frames, S)
    other.update(frames[::-1], S)
    assert np.array_equal(one.table().p_enu, other.table().p_enu)
    assert not one.dropped


def test_repeated_stamps_are_counted_and_change_nothing():
    tracker = fly(Tracker(TrackingConfig()), 10)
    before = tracker.table()
    for sequence, t_s in ((97, 0.3), (98, 0.45), (99, 0.45)):
        tracker.update([frame(t_s, seen("a", [9.0, 9.0, 9.0]), sequence=sequence)], round(0.45 * S))
    assert tracker.dropped == {"duplicate": 3}
    assert np.array_equal(tracker.table().p_enu, before.p_enu)
    tracker.update([frame(0.5, seen("a", straight(10, np.random.default_rng(5))), seen("a", [9.0] * 3))], S // 2)
    assert tracker.dropped["duplicate"] == 4
    assert len(tracker) == 1


def test_without_a_replay_what_is_older_than_its_track_is_late():
    tracker = fly(Tracker(TrackingConfig(replay_s=0.0)), 10)
    before = tracker.table()
    tracker.update([frame(0.3, seen("a", [9.0, 9.0, 9.0]))], round(0.45 * S))
    tracker.update([frame(0.45, seen("a", [9.0, 9.0, 9.0]), sequence=99)], round(0.45 * S))
    assert tracker.dropped == {"late": 1, "duplicate": 1}
    assert np.array_equal(tracker.table().p_enu, before.p_enu)
    tracker.update([frame(0.4, seen("b", [3.0, 3.0, 3.0]), source="slow")], round(0.45 * S))
    assert tracker.table().ids == ("cam/a", "slow/b"), "a slower source is not late for its own tracks"


def test_a_track_coasts_with_growing_covariance_and_then_ends():
    tracker = fly(Tracker(TrackingConfig(coast_s=0.5)), 20)
    traces = []
    for t_s in (1.0, 1.2, 1.4):
        tracker.update([], round(t_s * S))
        table = tracker.table()
        traces.append(np.trace(table.covariance[0, :3, :3]))
        assert table.age_s[0] == pytest.approx(t_s - 0.95)
    assert traces[0] < traces[1] < traces[2]
    tracker.update([], round(1.5 * S))
    assert len(tracker) == 0
    assert tracker.dropped["lost"] == 1
    assert tracker.predict(2 * S, 23, 0.05).p_enu.shape == (0, 23, 3)
    assert len(tracker.table()) == 0


def test_one_far_off_detection_is_skipped_the_next_restarts_the_track():
    tracker = fly(Tracker(TrackingConfig()), 20)
    before = tracker.table().p_enu[0]
    tracker.update([frame(1.0, seen("a", [500.0, -500.0, 100.0]))], S)
    assert tracker.dropped["outlier"] == 1
    np.testing.assert_allclose(tracker.table().p_enu[0], before, atol=0.2)
    tracker.update([frame(1.05, seen("a", [500.0, -500.0, 100.0]))], round(1.05 * S))
    np.testing.assert_allclose(tracker.table().p_enu[0], [500.0, -500.0, 100.0], atol=1e-9)
    np.testing.assert_allclose(tracker.table().v_enu[0], 0.0, atol=1e-9)


def test_a_detection_after_an_outlier_is_used_as_if_it_had_not_been():
    clean, disturbed = fly(Tracker(TrackingConfig()), 20), fly(Tracker(TrackingConfig()), 20)
    disturbed.update([frame(0.97, seen("a", [50.0, 0.0, 0.0]))], round(0.97 * S))
    for tracker in (clean, disturbed):
        tracker.update([frame(1.0, seen("a", [1.0, -0.5, 2.1]))], S)
    assert np.array_equal(clean.table().p_enu, disturbed.table().p_enu)


def test_the_latest_stated_radius_counts():
    tracker = fly(Tracker(TrackingConfig()), 3)
    tracker.update([frame(0.2, seen("a", [0.2, -0.1, 2.0], radius=0.7))], S // 5)
    assert tracker.table().radius_m[0] == 0.7
    assert tracker.predict(S // 5, 3, 0.05).radius_m[0] == 0.7


def test_no_more_than_max_tracks_are_kept_and_the_rest_is_counted():
    tracker = Tracker(TrackingConfig(max_tracks=3))
    tracker.update([frame(0.0, *(seen(f"o{k}", [k, 0.0, 1.0]) for k in range(5)))], 0)
    assert tracker.table().ids == ("cam/o0", "cam/o1", "cam/o2")
    assert tracker.dropped["over_max_tracks"] == 2


def test_values_that_are_not_finite_are_counted_and_never_enter():
    tracker = fly(Tracker(TrackingConfig()), 5)
    bad = [
        seen("b", [math.nan, 0.0, 0.0]),
        seen("c", [0.0, 0.0, 0.0], v=[0.0, math.inf, 0.0]),
        seen("d", [0.0, 0.0, 0.0], std=math.nan),
        seen(None, [0.0, math.nan, 0.0]),
        seen("e", [0.0, 0.0, 0.0], covariance=np.full((6, 6), math.nan)),
    ]
    tracker.update([frame(0.25, *bad)], S // 4)
    assert tracker.dropped["not_finite"] == 5
    assert tracker.table().ids == ("cam/a",)


def test_stated_velocity_and_covariance_speed_up_a_new_track():
    """After two frames a track that was told its velocity predicts half a second ahead far better."""
    told, untold = Tracker(TrackingConfig()), Tracker(TrackingConfig())
    for k in range(2):
        p = np.array([0.1 * k, 0.0, 1.0])
        told.update([frame(0.05 * k, seen("a", p, v=[2.0, 0.0, 0.0], v_std=0.05))], round(0.05 * k * S))
        untold.update([frame(0.05 * k, seen("a", p))], round(0.05 * k * S))
    assert told.predict(S // 20, 11, 0.05).sigma_m[0, 10] < 0.3 * untold.predict(S // 20, 11, 0.05).sigma_m[0, 10]
    full = Tracker(TrackingConfig())
    covariance = np.diag([0.04, 0.01, 0.01, 0.09, 0.01, 0.01])
    covariance[0, 3] = covariance[3, 0] = 0.05
    full.update([frame(0.0, seen("a", [0.0, 0.0, 1.0], v=[2.0, 0.0, 0.0], covariance=covariance))], 0)
    np.testing.assert_allclose(full.table().covariance[0, :6, :6], covariance, atol=1e-12)


@pytest.mark.parametrize("covariance", [np.zeros((6, 6)), -np.eye(6), np.full((6, 6), 1e12), np.eye(6) * 1e-30])
def test_absurd_covariances_are_bounded(covariance):
    tracker = Tracker(TrackingConfig())
    for k in range(20):
        detection = seen("a", [0.05 * k, 0.0, 1.0], v=[1.0, 0.0, 0.0], covariance=covariance)
        tracker.update([frame(0.05 * k, detection, sequence=k)], round(0.05 * k * S))
    table, prediction = tracker.table(), tracker.predict(S, 23, 0.05)
    assert np.isfinite(table.covariance).all()
    assert np.isfinite(prediction.sigma_m).all()
    assert np.linalg.eigvalsh(table.covariance[0, :6, :6]).min() > 0.0


def test_foreign_tracks_stay_as_unsure_as_they_say():
    tracker = Tracker(TrackingConfig())
    for k in range(100):
        detection = seen("t", [0.05 * k, 0.0, 1.0], std=0.1, v=[1.0, 0.0, 0.0], v_std=0.2)
        tracker.update([frame(0.05 * k, detection, sequence=k, kind=DetectionKind.TRACK)], round(0.05 * k * S))
    spread = np.diagonal(tracker.table().covariance[0])
    assert spread[:3].min() > 0.0075
    np.testing.assert_allclose(tracker.table().v_enu[0], [1.0, 0.0, 0.0], atol=0.05)


def crossing(k, rng, std=0.05):
    """Two obstacles that pass each other 0.6 m apart, and one that stands."""
    places = np.array([[-1.5 + 0.05 * k, 0.3, 1.0], [1.5 - 0.05 * k, -0.3, 1.0], [4.0, 4.0, 1.0]])
    return places + rng.normal(scale=std, size=places.shape)


def test_anonymous_detections_keep_to_their_tracks():
    tracker, rng = Tracker(TrackingConfig()), np.random.default_rng(3)
    for k in range(60):
        order = rng.permutation(3)
        z = crossing(k, rng)
        tracker.update([frame(0.05 * k, *(seen(None, z[m]) for m in order), sequence=k)], round(0.05 * k * S))
        if k == 0:
            first = dict(zip(tracker.table().ids, np.argsort(z[:, 0], kind="stable"), strict=True))
    table = tracker.table()
    assert set(table.ids) == {"cam/#1", "cam/#2", "cam/#3"}
    for track_id, p in zip(table.ids, table.p_enu, strict=True):
        np.testing.assert_allclose(p, crossing(59, rng, std=1e-9)[first[track_id]], atol=0.15)


def test_anonymous_detection_outside_every_gate_begins_a_track():
    tracker = fly(Tracker(TrackingConfig()), 20)
    tracker.update([frame(1.0, seen(None, [1.0, -0.5, 2.1]), source="lidar")], S)
    assert len(tracker) == 1, "inside the gate of cam/a it updates that track"
    tracker.update([frame(1.05, seen(None, [3.0, 3.0, 2.1]), source="lidar")], round(1.05 * S))
    assert tracker.table().ids == ("cam/a", "lidar/#1")


def test_reset_is_a_new_tracker_bit_for_bit():
    used = fly(Tracker(TrackingConfig()), 30, seed=3)
    used.update([frame(1.45, seen("a", [0.0, 0.0, 0.0]), seen(None, [5.0, 5.0, 5.0]))], round(1.45 * S))
    used.reset()
    new = Tracker(TrackingConfig())
    assert used.dropped == {}
    for tracker in (used, new):
        fly(tracker, 25, seed=4)
    for name in ("p_enu", "v_enu", "a_enu", "covariance", "mode_probabilities", "age_s"):
        assert np.array_equal(getattr(used.table(), name), getattr(new.table(), name)), name
    assert np.array_equal(used.predict(2 * S, 23, 0.05).sigma_m, new.predict(2 * S, 23, 0.05).sigma_m)


def test_predicting_does_not_disturb_the_tracks():
    quiet, asked = Tracker(TrackingConfig()), Tracker(TrackingConfig())
    rng = np.random.default_rng(6)
    for k in range(30):
        one = frame(0.05 * k, seen("a", straight(k, rng)), sequence=k)
        quiet.update([one], one.stamp_ns)
        asked.update([one], one.stamp_ns)
        asked.predict(one.stamp_ns + 70_000_000, 23, 0.05)
        asked.table()
    assert np.array_equal(quiet.table().covariance, asked.table().covariance)


def test_prediction_starts_where_it_is_asked_and_follows_the_velocity():
    tracker = fly(Tracker(TrackingConfig()), 60)
    now, later = tracker.predict(round(2.95 * S), 24, 0.05), tracker.predict(round(3.0 * S), 23, 0.05)
    np.testing.assert_allclose(now.p_enu[0, 1:], later.p_enu[0], atol=2e-3)
    np.testing.assert_allclose(now.p_enu[0, 0], tracker.table().p_enu[0], atol=1e-12)
    np.testing.assert_allclose(now.p_enu[0, 20] - now.p_enu[0, 0], now.v_enu[0] * 1.0, atol=0.2)
    assert (np.diff(now.sigma_m[0]) > 0.0).all()


def test_returned_values_cannot_be_written():
    tracker = fly(Tracker(TrackingConfig()), 5)
    table, prediction = tracker.table(), tracker.predict(S, 3, 0.05)
    for array in (table.p_enu, table.covariance, table.radius_m, prediction.p_enu, prediction.sigma_m):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0.0


def test_a_stamp_ahead_of_the_prediction_widens_nothing_and_no_variance_is_negative():
    """Of a jinker, whose predictions grow up to tenfold: going back in time to the start there is nothing to grow."""
    tracker, rng = Tracker(TrackingConfig()), np.random.default_rng(2)
    p, v = np.zeros(3), np.array([2.0, 0.0, 0.0])
    for k in range(200):
        if k % 20 == 19:
            v = rng.normal(size=3) * 2.0
        p = p + 0.05 * v
        one = frame(0.05 * k + 0.1, seen("j", p + rng.normal(scale=0.05, size=3)), sequence=k)
        tracker.update([one], round(0.05 * k * S))
    assert tracker.table().growth[0] > 1.5
    start_ns = round(0.05 * 199 * S)
    _, spread = tracker.forecast(start_ns, np.array([0.0, 0.05, 0.08, 0.1, 0.3]))
    assert (spread[0, :3] > 0.0).all()
    assert (tracker.predict(start_ns, 5, 0.05).sigma_m > 0.01).all()


def test_a_crowd_of_anonymous_detections_is_associated_with_the_nearest():
    """1024 of them around one track: it keeps to one of the nearest, and the crowd begins tracks up to the bound."""
    tracker, rng = Tracker(TrackingConfig(max_tracks=16)), np.random.default_rng(5)
    for k in range(5):
        crowd = [seen(None, rng.normal(scale=0.1, size=3), std=0.22) for _ in range(1024)]
        tracker.update([frame(0.05 * k, *crowd, sequence=k)], round(0.05 * k * S))
    assert len(tracker) == 16
    assert np.linalg.norm(tracker.table().p_enu, axis=1).max() < 1.0
