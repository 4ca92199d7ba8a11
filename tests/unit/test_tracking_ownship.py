"""The vehicle among the detections: never an obstacle, and no obstacle ever taken for it."""

import math

import numpy as np
import pytest
from tracking_scenes import S, assert_same_bits, beside, frame, give, seen, vehicle

from companion.config import TrackingConfig
from companion.tracking.ownship import (
    MEMORY_MAX_NS,
    MEMORY_NS,
    PATH_NS,
    PERIODS,
    VARIANCE_MIN_M2,
    Fix,
    OwnPath,
    residuals,
    weigh,
)
from companion.tracking.tracker import Tracker

STEP_S = 0.05
HOVER = np.array([1.0, 2.0, 3.0])


def hovering(k):
    return HOVER, np.zeros(3)


def manoeuvring(k):
    """A figure of eight with up to 5 m/s^2."""
    t = STEP_S * k
    p = HOVER + np.array([2.0 * math.sin(1.5 * t), math.sin(3.0 * t) / 2.0, 0.3 * math.sin(t)])
    v = np.array([3.0 * math.cos(1.5 * t), 1.5 * math.cos(3.0 * t), 0.3 * math.cos(t)])
    return p, v


def fly(tracker, flight, first, last, look, *, source="cam", latency_s=0.0):
    """Ticks ``first`` to ``last``: the frame that ``look`` (k, own position then) makes, then the own state."""
    for k in range(first, last):
        t_s = STEP_S * k
        seen_at = flight((t_s - latency_s) / STEP_S)[0]
        give(tracker, frame(t_s - latency_s, *look(k, seen_at), source=source, sequence=k), now_s=t_s)
        tracker.note_vehicle(vehicle(t_s, *flight(k)))
        yield k


@pytest.mark.parametrize("flight", [hovering, manoeuvring])
@pytest.mark.parametrize("std", [0.05, 0.22])
@pytest.mark.parametrize("name", ["drone", None])
@pytest.mark.parametrize("latency_s", [0.0, 0.12])
def test_the_vehicle_seen_by_its_own_sensor_is_never_an_obstacle(flight, std, name, latency_s):
    for seed in range(3):
        rng = np.random.default_rng(seed)
        tracker = Tracker(TrackingConfig())

        def look(_, own, rng=rng):
            return [seen(name, own + rng.normal(scale=std, size=3), std=std)]

        blind = max(1, math.ceil(latency_s / STEP_S))  # frames consumed before their own state was known
        for k in fly(tracker, flight, 0, 400, look, latency_s=latency_s):
            assert k < blind or len(tracker) == 0
        assert tracker.dropped["own_vehicle"] == 400 - blind


@pytest.mark.parametrize("own_name", ["drone", None])
@pytest.mark.parametrize("ball_name", ["ball", None])
def test_an_obstacle_passing_close_keeps_its_track(own_name, ball_name):
    """0.45 m beside the hovering vehicle at 2 m/s, sigma 0.22 m; the vehicle itself is reported too, with losses."""
    for seed in range(5):
        tracker, rng = Tracker(TrackingConfig()), np.random.default_rng(seed)

        def look(k, own, rng=rng):
            ball = beside(HOVER, 0.1 * (k - 60), 0.45, 0.0)
            told = [seen(ball_name, ball + rng.normal(scale=0.22, size=3), std=0.22)]
            if rng.random() < 0.8:
                told.append(seen(own_name, own + rng.normal(scale=0.22, size=3), std=0.22))
            return told

        names = set()
        for k in fly(tracker, hovering, 0, 110, look):
            if k > 20:
                assert len(tracker) == 1
                names.update(tracker.table().ids)
                error = tracker.table().p_enu[0] - (beside(HOVER, 0.1 * (k - 60), 0.45, 0.0))
                assert np.linalg.norm(error) < 0.6
        assert len(names) == 1, "one track from far to far"


@pytest.mark.parametrize("name", ["ball", None])
def test_an_obstacle_that_pops_up_close_is_a_track_within_half_a_second(name):
    for seed in range(20):
        tracker, rng = Tracker(TrackingConfig()), np.random.default_rng(seed)
        tracker.note_vehicle(vehicle(-STEP_S, HOVER))
        side = rng.normal(size=3)
        ball = HOVER + 0.5 * side / np.linalg.norm(side)

        def look(_, own, rng=rng, ball=ball):
            return [seen(name, ball + rng.normal(scale=0.22, size=3), std=0.22)]

        born = [k for k in fly(tracker, hovering, 0, 40, look) if len(tracker.predict(S, 3, 0.05))]
        assert born[0] <= 10
        assert born == list(range(born[0], 40)), "once an obstacle it stays one"


def test_one_far_detection_of_the_vehicle_is_skipped_a_second_ends_it():
    for wild, tracks in ((1, 0), (2, 1)):
        tracker, rng = Tracker(TrackingConfig()), np.random.default_rng(0)

        def look(k, own, rng=rng, wild=wild):
            offset = [3.0, 0.0, 0.0] if 30 <= k < 30 + wild else [0.0, 0.0, 0.0]
            return [seen("drone", own + offset + rng.normal(scale=0.05, size=3))]

        list(fly(tracker, hovering, 0, 32, look))
        assert len(tracker) == tracks


def test_what_left_the_vehicle_is_an_obstacle_for_good():
    """A drone that starts from our own pad: first it is us, then it flies off, then it comes back."""
    tracker = Tracker(TrackingConfig())

    def look(k, own):
        away = 0.0 if k < 20 else 1.5 if k < 60 else 0.0
        return [seen("other", beside(own, away, 0.0, 0.0))]

    shown = [len(tracker) for _ in fly(tracker, hovering, 0, 100, look)]
    assert shown[1:20] == [0] * 19
    assert shown[22:] == [1] * 78


def test_a_repeated_stamp_is_no_more_evidence():
    tracker = Tracker(TrackingConfig())
    tracker.note_vehicle(vehicle(-STEP_S, HOVER))
    for sequence in range(3):
        give(tracker, frame(0.0, seen("drone", HOVER), sequence=sequence))
    assert tracker.dropped == {"own_vehicle": 1, "duplicate": 2}


def test_a_candidate_stays_one_while_the_path_is_unknown_for_a_moment():
    tracker = Tracker(TrackingConfig())
    list(fly(tracker, hovering, 0, 10, lambda _, own: [seen("drone", own)]))
    give(tracker, frame(0.45 + 0.4, seen("drone", HOVER), sequence=50))
    assert len(tracker) == 0
    give(tracker, frame(0.45 + 1.7, seen("drone", HOVER), sequence=51))
    assert len(tracker) == 1, "nobody knows any more"
    tracker.note_vehicle(vehicle(0.45 + 1.75, HOVER))
    give(tracker, frame(0.45 + 1.75, seen("drone", HOVER), sequence=52))
    assert len(tracker) == 0, "now it is known again"


def test_a_track_born_in_the_dark_is_judged_once_when_the_path_is_known():
    tracker = Tracker(TrackingConfig())
    told = [seen("drone", HOVER), seen("ball", beside(HOVER, 2.0, 0.0, 0.0)), seen(None, beside(HOVER, 0.0, 3.0, 0.0))]
    give(tracker, frame(0.0, *told))
    assert len(tracker) == 3
    tracker.note_vehicle(vehicle(0.0, HOVER))
    for k in range(1, 60):
        ball = beside(HOVER, max(2.0 - 0.1 * k, 0.0), 0.0, 0.0)
        give(tracker, frame(STEP_S * k, seen("drone", HOVER), seen("ball", ball), *told[2:], sequence=k))
        tracker.note_vehicle(vehicle(STEP_S * k, HOVER))
        assert set(tracker.table().ids) == {"cam/ball", "cam/#1"}
    assert tracker.dropped == {"own_vehicle": 59}


def test_of_several_anonymous_births_the_nearest_may_be_us():
    tracker = Tracker(TrackingConfig())
    tracker.note_vehicle(vehicle(-STEP_S, HOVER))
    near, far = seen(None, beside(HOVER, 0.1, 0.0, 0.0)), seen(None, beside(HOVER, 0.25, 0.0, 0.0))
    give(tracker, frame(0.0, near, far))
    np.testing.assert_allclose(tracker.table().p_enu, [far.p_enu])


def test_the_vehicle_cannot_pull_the_track_of_an_obstacle_beside_it():
    """The obstacle is lost for some frames while the sensor goes on to report the vehicle, anonymously."""
    tracker, rng = Tracker(TrackingConfig()), np.random.default_rng(7)

    def look(k, own):
        told = [seen(None, own + rng.normal(scale=0.2, size=3), std=0.2)]
        if k < 40:
            told.append(seen(None, beside(HOVER, 0.6, 0.0, 0.0) + rng.normal(scale=0.2, size=3), std=0.2))
        return told

    coasting = 0
    for k in fly(tracker, hovering, 0, 50, look):
        if k >= 40:
            coasting += tracker.table().status == ("coasting",)
            assert np.linalg.norm(tracker.table().p_enu[0] - beside(HOVER, 0.6)) < 0.3
    assert coasting >= 8, "at three sigma now and then one of ours lies nearer to it"


def test_late_frames_and_the_own_vehicle():
    """Evidence belongs to what is rolled back."""
    frames = [frame(STEP_S * k, seen("drone", HOVER), seen(None, HOVER), sequence=k) for k in range(9)]
    one, other = Tracker(TrackingConfig()), Tracker(TrackingConfig())
    for tracker, order in ((one, frames), (other, [frames[k] for k in (1, 0, 4, 3, 2, 8, 6, 5, 7)])):
        for k in range(9):
            tracker.note_vehicle(vehicle(STEP_S * k, HOVER))
        for each in order:
            give(tracker, each, now_s=0.4)
    assert_same_bits(one, other, S)
    assert one.dropped == other.dropped == {"own_vehicle": 18}


def test_reset_forgets_the_path():
    tracker = Tracker(TrackingConfig())
    tracker.note_vehicle(vehicle(0.0, HOVER))
    tracker.reset()
    give(tracker, frame(0.0, seen("drone", HOVER)))
    assert len(tracker) == 1


def test_the_path_is_interpolated_carried_on_and_bounded():
    path = OwnPath()
    assert path.at(0) is None
    assert path.newest is None
    path.note(vehicle(0.0, [0.0, 0.0, 1.0], [2.0, 0.0, 0.0], 0.3))
    path.note(vehicle(0.4, [1.0, 0.0, 1.0], [2.0, 0.0, 0.0]))
    path.note(vehicle(0.4, [9.0, 0.0, 1.0]))  # not newer
    path.note(vehicle(1.4, [3.0, 0.0, 1.0], [2.0, 0.0, 0.0]))
    assert path.at(-1) is None
    between, beyond = path.at(S // 10), path.at(round(1.7 * S))
    np.testing.assert_allclose(between.p_enu, [0.25, 0.0, 1.0])
    assert between.variance_m2 == pytest.approx(0.09)
    np.testing.assert_allclose(beyond.p_enu, [3.6, 0.0, 1.0])
    assert beyond.variance_m2 == pytest.approx(0.05**2)
    assert path.at(round(0.9 * S)) is None, "in a hole of a second nobody knows"
    assert path.at(round(1.71 * S)) is None
    path.note(vehicle(3.0, [4.0, 0.0, 1.0]))
    assert path.at(S // 10) is None
    path.note(vehicle(3.1, [4.0, 0.0, 1.0], p_std_m=0.31))
    assert path.at(31 * S // 10) is None, "too vague to tell anything"
    path.reset()
    path.note(vehicle(1.4, [3.0, 0.0, 1.0]))
    path.note(vehicle(3.0, [4.0, 0.0, 1.0]))
    assert len(path._states) == 2
    assert PATH_NS == 2 * S


def vague(t_s, k, offset, *, std, p_std_m=0.0, name="ball", rng):
    """A frame with something ``offset`` m from the hovering vehicle, and the vehicle's state then."""
    z = beside(HOVER, offset) + rng.normal(scale=std, size=3)
    return frame(t_s, seen(name, z, std=std), sequence=k), vehicle(t_s, HOVER, p_std_m=p_std_m)


def shown_at(offset, *, std, p_std_m=0.0, name="ball", rate_hz=20.0, count=40, seed=0):
    """Number of each detection after which an obstacle is predicted."""
    tracker, rng = Tracker(TrackingConfig()), np.random.default_rng(seed)
    tracker.note_vehicle(vehicle(-STEP_S, HOVER, p_std_m=p_std_m))
    shown = []
    for k in range(count):
        look, state = vague(k / rate_hz, k, offset, std=std, p_std_m=p_std_m, name=name, rng=rng)
        tracker.note_vehicle(vehicle(k / rate_hz - 0.1, HOVER, p_std_m=p_std_m))
        give(tracker, look)
        tracker.note_vehicle(state)
        shown += [k] if len(tracker.predict(look.stamp_ns, 3, STEP_S)) else []
    return shown


@pytest.mark.parametrize("name", ["ball", None])
@pytest.mark.parametrize("far", [0.5, 1.0, 2.0])
def test_an_own_position_too_vague_to_tell_hides_no_obstacle(name, far):
    for seed in range(5):
        first = shown_at(far, std=0.05, p_std_m=far, name=name, seed=seed)[0]
        assert first <= (0 if name else 1), "an anonymous one needs two hits"


@pytest.mark.parametrize("offset", [0.5, 1.5, 4.0])
@pytest.mark.parametrize("std", [2.0, 5.0])
def test_a_sensor_too_coarse_to_tell_hides_no_obstacle(std, offset):
    for seed in range(5):
        assert shown_at(offset, std=std, seed=seed) == list(range(40))


@pytest.mark.parametrize(("std", "offset"), [(0.5, 0.9), (0.9, 1.0)])
def test_a_mean_that_cannot_tell_after_the_grace_hides_no_obstacle(std, offset):
    shown = [shown_at(offset, std=std, seed=seed)[0] for seed in range(20)]
    assert sum(first <= 10 for first in shown) >= 18
    assert max(shown) <= 20


def test_a_slow_source_sums_evidence_and_the_verdict_outlives_its_track():
    """At 0.9 Hz a track ends before the next detection: every one is a birth."""
    for seed in range(20):
        shown = shown_at(0.8, std=0.22, rate_hz=0.9, count=20, seed=seed)
        assert shown[0] <= 2
        assert shown[1:] == list(range(shown[1], 20))


def test_a_constant_error_within_our_hull_is_still_us():
    for seed in range(3):
        assert shown_at(0.15, std=0.22, count=600, seed=seed) == []
        assert shown_at(0.19, std=0.05, count=600, seed=seed) == []


def test_what_leaves_us_after_a_long_time_is_soon_told_apart():
    tracker, rng = Tracker(TrackingConfig()), np.random.default_rng(0)

    def look(k, own):
        away = 0.0 if k < 600 else min(0.05 * (k - 600), 0.8)
        return [seen("other", beside(own, away) + rng.normal(scale=0.22, size=3), std=0.22)]

    shown = [k for k in fly(tracker, hovering, 0, 680, look) if len(tracker) and k > 1]
    assert 600 < shown[0] < 630
    assert shown == list(range(shown[0], 680))


def test_the_vehicle_born_while_its_position_was_vague_is_recognised_later():
    tracker = Tracker(TrackingConfig())
    for k in range(40):
        tracker.note_vehicle(vehicle(STEP_S * k - 0.01, HOVER, p_std_m=0.5 if k < 20 else 0.1))
        give(tracker, frame(STEP_S * k, seen("drone", HOVER), sequence=k))
        assert len(tracker) == (k < 20)


def test_the_own_position_counts_once_and_is_not_averaged_away():
    own = Fix(np.zeros(3), 0.2**2 + VARIANCE_MIN_M2)
    (one,) = residuals(np.zeros((1, 3)), 0.01 * np.eye(3)[None], own)
    evidence = None
    for k in range(500):
        evidence = weigh(evidence, one, k * S // 20, 0.2)
    _, spread = evidence.whole.moments()
    np.testing.assert_allclose(spread, (0.2**2 + (0.01 + VARIANCE_MIN_M2) / 500) * np.eye(3), atol=1e-12)


def test_evidence_lasts_some_intervals_of_its_key():
    (one,) = residuals(np.zeros((1, 3)), 0.01 * np.eye(3)[None], Fix(np.zeros(3), VARIANCE_MIN_M2))
    for interval_ns, lasts_ns in ((S // 20, S), (2 * S, PERIODS * 2 * S), (4 * S, MEMORY_MAX_NS)):
        first = weigh(None, one, 0, 0.2)
        assert first.sums(MEMORY_MAX_NS)
        assert not first.lives(MEMORY_NS + 1)
        second = weigh(first, one, interval_ns, 0.2)
        assert second.count == 2
        assert weigh(second, one, interval_ns + lasts_ns, 0.2).count == 3
        assert weigh(second, one, interval_ns + lasts_ns + 1, 0.2).count == 1


def test_the_recent_mean_is_bounded_and_the_whole_is_not():
    (one,) = residuals(np.zeros((1, 3)), 0.01 * np.eye(3)[None], Fix(np.zeros(3), VARIANCE_MIN_M2))
    evidence = None
    for k in range(100):
        evidence = weigh(evidence, one, k * S // 20, 0.2)
    assert np.trace(evidence.whole.information) == pytest.approx(100.0 * np.trace(one.inverse))
    assert np.trace(evidence.recent.information) == pytest.approx(20.0 * np.trace(one.inverse), rel=0.02)
    (far,) = residuals(np.full((1, 3), 9.0), 0.01 * np.eye(3)[None], Fix(np.zeros(3), VARIANCE_MIN_M2))
    assert weigh(None, far, 0, 0.2) is None
