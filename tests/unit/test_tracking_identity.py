"""Identity: confirmation, status, one track for two sources, splits, and names that cannot both be right."""

import numpy as np
import pytest
from tracking_scenes import S, beside, frame, give, seen

from companion.config import TrackingConfig
from companion.tracking.merge import CHECKS_MIN
from companion.tracking.tracker import Tracker
from companion.types import DetectionKind

STEP_S = 0.05


def at(k, p=(0.0, 0.0, 2.0), v=(1.0, 0.5, 0.0)):
    return np.array(p) + np.array(v) * STEP_S * k


def two_eyes(tracker, first, last, *, apart=0.0, std=0.05, seed=0, kinds=None, every=1, ids=("a", "x")):
    """Cam and radar watch one obstacle, or two that are ``apart``, at alternating stamps."""
    rng = np.random.default_rng(seed)
    for k in range(first, last):
        for source, name, t_s, place, period in (
            ("cam", ids[0], STEP_S * k, at(k), 1),
            ("radar", ids[1], STEP_S * k + 0.02, beside(at(k + 0.4), apart, 0.0, 0.0), every),
        ):
            if k % period == 0:
                kind = (kinds or {}).get(source, DetectionKind.DETECTION)
                told = seen(name, place + rng.normal(scale=std, size=3), std=std)
                give(tracker, frame(t_s, told, source=source, sequence=k, kind=kind))
    return tracker


def test_an_anonymous_detection_alone_is_tentative_and_keeps_out_of_predictions():
    tracker = Tracker(TrackingConfig())
    give(tracker, frame(0.0, seen(None, [1.0, 0.0, 1.0]), seen("a", [4.0, 0.0, 1.0])))
    assert dict(zip(tracker.table().ids, tracker.table().status, strict=True)) == {
        "cam/#1": "tentative",
        "cam/a": "confirmed",
    }
    assert tracker.predict(0, 3, 0.05).ids == ("cam/a",)
    assert tracker.forecast(0, np.array([0.1]))[0].shape == (1, 1, 3)
    give(tracker, frame(0.05, seen(None, [1.0, 0.0, 1.0])))
    assert tracker.table().status == ("coasting", "confirmed")
    assert set(tracker.predict(0, 3, 0.05).ids) == {"cam/a", "cam/#1"}


@pytest.mark.parametrize(("missed", "stays"), [(2, True), (3, False)])
@pytest.mark.parametrize("step_s", [0.01, 0.2])
def test_confirmation_counts_frames_of_the_source_not_time(missed, stays, step_s):
    tracker = Tracker(TrackingConfig(confirm_hits=2, confirm_frames=3))
    give(tracker, frame(0.0, seen(None, [1.0, 0.0, 1.0])))
    for k in range(1, missed + 1):
        give(tracker, frame(step_s * k, sequence=k), frame(step_s * k, source="other", sequence=k))
        give(tracker, frame(step_s * k, sequence=100 + k))  # the same look again is no chance less
    assert len(tracker) == (1 if stays else 0)
    give(tracker, frame(step_s * (missed + 1), seen(None, [1.0, 0.0, 1.0])))
    assert tracker.table().status == (("confirmed",) if stays else ("tentative",))
    assert tracker.dropped == ({} if stays else {"unconfirmed": 1})


def test_one_hit_may_be_enough():
    tracker = Tracker(TrackingConfig(confirm_hits=1))
    give(tracker, frame(0.0, seen(None, [1.0, 0.0, 1.0])))
    assert tracker.table().status == ("confirmed",)


def test_a_tentative_track_of_a_silent_source_ends_unconfirmed():
    tracker = Tracker(TrackingConfig())
    give(tracker, frame(0.0, seen(None, [1.0, 0.0, 1.0])))
    tracker.update([], 2 * S)
    assert tracker.dropped == {"unconfirmed": 1}
    give(tracker, frame(2.0, source="other"))
    assert tracker.dropped == {"unconfirmed": 1}


def test_coasting_is_what_no_source_shows_in_its_newest_frame():
    tracker = Tracker(TrackingConfig())
    give(tracker, frame(0.0, seen("a", [0.0] * 3)), frame(0.0, seen("x", [0.0] * 3), source="radar"))
    give(tracker, frame(0.1, sequence=1))
    assert tracker.table().status == ("coasting", "confirmed")
    give(tracker, frame(0.2, source="radar", sequence=1))
    assert tracker.table().status == ("coasting", "coasting")
    give(tracker, frame(0.3, seen("a", [0.0] * 3), sequence=2))
    assert tracker.table().status == ("confirmed", "coasting")


def test_two_sources_of_one_obstacle_become_one_track():
    tracker = two_eyes(Tracker(TrackingConfig()), 0, 16)
    assert tracker.table().ids == ("cam/a", "radar/x"), "not proven yet"
    two_eyes(tracker, 16, 30)
    table = tracker.table()
    assert table.ids == ("cam/a",)
    assert table.sources == (("cam", "radar"),)
    assert table.status == ("confirmed",)
    np.testing.assert_allclose(table.p_enu[0], at(29.4), atol=0.1)
    give(tracker, frame(1.6, seen("x", at(32), radius=0.7), source="radar"))
    assert tracker.table().ids == ("cam/a",), "the radar's detections now go to the one track"
    assert tracker.table().radius_m[0] == 0.7, "the larger of what the sources state"
    give(tracker, frame(1.62, seen("a", at(32.4), radius=0.1)))
    assert tracker.table().radius_m[0] == 0.7


def test_the_first_of_the_two_gives_the_name_and_the_surer_the_state():
    tracker, tables = Tracker(TrackingConfig(merge_s=0.5)), []
    for k in range(20):
        give(tracker, frame(STEP_S * k, seen("old", at(k), std=0.5), source="zz", sequence=k))
        if k:
            give(tracker, frame(STEP_S * k, seen("sure", at(k), std=0.02), source="aa", sequence=k))
        tables.append(tracker.table())
    assert tables[-1].ids == ("zz/old",)
    before = next(table for table in reversed(tables) if len(table) == 2)
    after = tables[tables.index(before) + 1]
    assert before.ids == ("zz/old", "aa/sure")
    sigma_before, sigma_after = (np.sqrt(np.trace(t.covariance[0, :3, :3])) for t in (before, after))
    assert sigma_after < 0.2 * sigma_before


def test_tracks_born_together_are_named_by_the_smaller_id():
    tracker = Tracker(TrackingConfig(merge_s=0.3))
    for k in range(20):
        give(tracker, *(frame(STEP_S * k, seen("o", at(k)), source=source, sequence=k) for source in ("zz", "aa")))
    assert tracker.table().ids == ("aa/o",)


@pytest.mark.parametrize(
    "config", [TrackingConfig(merge_s=0.0), TrackingConfig(untrusted=("radar",)), TrackingConfig(merge_s=3.0)]
)
def test_what_is_never_merged(config):
    assert len(two_eyes(Tracker(config), 0, 40)) == 2


def test_obstacles_that_do_not_touch_are_never_one():
    assert len(two_eyes(Tracker(TrackingConfig()), 0, 80, apart=0.7, std=0.22)) == 2


def test_a_bias_beyond_the_covariances_keeps_two_tracks():
    assert len(two_eyes(Tracker(TrackingConfig()), 0, 80, apart=0.3, std=0.02)) == 2


def test_at_least_five_checks_whatever_merge_s():
    tracker = Tracker(TrackingConfig(merge_s=0.01))
    for k in range(CHECKS_MIN):
        two_eyes(tracker, 2 * k, 2 * k + 2, std=0.01)
        assert len(tracker) == (2 if k < CHECKS_MIN - 1 else 1)


def test_a_slow_source_merges_too():
    """At 2 Hz most checks say nothing about the pair; they neither count nor break the streak."""
    tracker = two_eyes(Tracker(TrackingConfig()), 0, 60, every=10)
    assert tracker.table().ids == ("cam/a",)


def test_one_disagreement_begins_the_second_anew():
    tracker = two_eyes(Tracker(TrackingConfig()), 0, 18)
    for k in range(18, 21):
        give(tracker, frame(STEP_S * k, seen("x", beside(at(k), 0.0, 2.0, 0.0)), source="radar", sequence=k))
        give(tracker, frame(STEP_S * k, seen("a", at(k)), sequence=k))
    two_eyes(tracker, 21, 34, seed=1)
    assert len(tracker) == 2


def test_whom_one_source_sees_at_one_stamp_it_tells_apart():
    """Two obstacles fly 0.3 m apart; a third source that sees both keeps their tracks two for ever."""
    tracker, rng = Tracker(TrackingConfig()), np.random.default_rng(2)
    for k in range(60):
        noise = rng.normal(scale=0.1, size=(4, 3))
        places = at(k), beside(at(k), 0.3, 0.0, 0.0)
        give(tracker, frame(STEP_S * k, seen("a", places[0] + noise[0], std=0.1), sequence=k))
        give(tracker, frame(STEP_S * k, seen("b", places[1] + noise[1], std=0.1), source="radar", sequence=k))
        if k == 3:
            both = [seen(None, place, std=0.1) for place in places]
            give(tracker, frame(STEP_S * k, *both, source="wide", sequence=k))
    assert tracker.table().ids == ("cam/a", "radar/b")


def test_a_third_source_joins_the_pair():
    tracker, rng = Tracker(TrackingConfig(merge_s=0.3)), np.random.default_rng(4)
    for k in range(40):
        for source in ("cam", "lidar", "radar"):
            named = None if source == "lidar" else "o"
            told = seen(named, at(k) + rng.normal(scale=0.05, size=3))
            give(tracker, frame(STEP_S * k, told, source=source, sequence=k))
    assert tracker.table().ids == ("cam/o",)
    assert tracker.table().sources == (("cam", "lidar", "radar"),)


def test_anonymous_keys_of_one_source_are_one_after_a_merge():
    """The lidar has updated both tracks in turn; the union knows it once."""
    tracker, keys = Tracker(TrackingConfig(merge_s=0.4)), []
    for k in range(20):
        give(tracker, frame(STEP_S * k, seen("a", at(k), std=0.2), sequence=k))
        give(tracker, frame(STEP_S * k, seen("x", beside(at(k), 0.1, 0.0, 0.0), std=0.2), source="radar", sequence=k))
        side = [-0.1, 0.0, 0.0] if k % 2 else [0.2, 0.0, 0.0]
        give(tracker, frame(STEP_S * k + 0.01, seen(None, at(k + 0.2) + side, std=0.2), source="lidar", sequence=k))
        keys.append(sorted(tracker._picture.tracks.keys.names, key=str))
    assert [("cam", "a"), ("lidar", None), ("lidar", None), ("radar", "x")] in keys
    assert len(tracker) == 1
    assert keys[-1] == [("cam", "a"), ("lidar", None), ("radar", "x")]


@pytest.mark.parametrize("nearer", ["x", "y"])
def test_of_two_that_are_told_apart_only_the_nearer_is_the_third(nearer):
    """The radar sees two obstacles that touch, the camera one of them: never three in one."""
    tracker = Tracker(TrackingConfig(merge_s=0.4))
    gap = 0.13 if nearer == "x" else 0.17
    for k in range(40):
        both = seen("x", at(k), std=0.1), seen("y", beside(at(k), 0.3), std=0.1)
        give(tracker, frame(STEP_S * k, *both, source="radar", sequence=k))
        give(tracker, frame(STEP_S * k + 0.01, seen("a", beside(at(k + 0.2), gap), std=0.1), sequence=k))
    table = tracker.table()
    assert dict(zip(table.ids, table.sources, strict=True)) == {
        f"radar/{name}": ("cam", "radar") if name == nearer else ("radar",) for name in ("x", "y")
    }


def test_three_sources_that_agree_at_one_check_are_one():
    tracker, counts = Tracker(TrackingConfig(merge_s=0.3)), set()
    give(tracker, *(frame(0.0, source=name) for name in ("a", "b", "c")))  # the first check finds nothing
    for k in range(1, 20):
        give(tracker, *(frame(STEP_S * k, seen("o", at(k)), source=name, sequence=k) for name in ("a", "b", "c")))
        counts.add(len(tracker))
    assert tracker.table().sources == (("a", "b", "c"),)
    assert counts == {3, 1}


def merged(config=None):
    tracker = two_eyes(Tracker(config or TrackingConfig()), 0, 30)
    assert tracker.table().ids == ("cam/a",)
    return tracker


def test_a_key_twice_far_off_leaves_the_shared_track():
    tracker = merged()
    give(tracker, frame(1.5, seen("x", [9.0, 9.0, 2.0]), source="radar", sequence=50))
    assert len(tracker) == 1
    assert tracker.dropped == {"outlier": 1}
    give(tracker, frame(1.55, seen("x", [9.0, 9.0, 2.0]), source="radar", sequence=51))
    table = tracker.table()
    assert table.ids == ("cam/a", "radar/x")
    assert table.sources == (("cam",), ("radar",))
    np.testing.assert_allclose(table.p_enu[1], [9.0, 9.0, 2.0])
    assert np.linalg.norm(table.p_enu[0] - at(31)) < 0.2, "the other key's track is where it was"


def test_the_key_that_named_the_track_leaves_under_another_name():
    tracker = merged()
    for k in (31, 32):
        give(tracker, frame(STEP_S * k, seen("a", [9.0, 9.0, 2.0]), sequence=k))
        give(tracker, frame(STEP_S * k, seen("x", at(k)), source="radar", sequence=k))
    assert tracker.table().ids == ("cam/a", "cam/a~2")
    assert tracker.table().sources == (("radar",), ("cam",))


def test_a_key_that_drifts_outside_the_gate_leaves_after_five():
    """The two obstacles were one by chance and part at 3 m/s."""
    tracker = merged()
    for k in range(30, 60):
        give(tracker, frame(STEP_S * k, seen("a", at(k)), sequence=k))
        away = beside(at(k), 0.0, 3.0 * STEP_S * (k - 30), 0.0)
        give(tracker, frame(STEP_S * k + 0.02, seen("x", away), source="radar", sequence=k))
    table = tracker.table()
    assert len(table) == 2
    assert tracker.dropped.keys() <= {"outlier"}
    np.testing.assert_allclose(table.p_enu[table.sources.index(("cam",))], at(59.4), atol=0.15)
    np.testing.assert_allclose(table.p_enu[table.sources.index(("radar",))], away, atol=0.15)


def test_two_names_of_one_source_on_one_track_are_two_obstacles_when_seen_together():
    """The camera renames the obstacle, the new name merges, then it shows both names at once."""
    tracker = two_eyes(Tracker(TrackingConfig(merge_s=0.4, coast_s=3.0)), 0, 20)
    two_eyes(tracker, 20, 40, ids=("b", "x"))
    assert tracker.table().ids == ("cam/a",)
    give(tracker, frame(2.0, seen("a", at(40)), seen("b", beside(at(40), 0.2, 0.0, 0.0)), sequence=99))
    table = tracker.table()
    assert table.ids == ("cam/a", "cam/a~2"), "the name seen last, b, keeps the track; a begins anew"
    assert table.sources == (("cam", "radar"), ("cam",))
    np.testing.assert_allclose(table.p_enu[1], at(40))


def test_a_name_unseen_for_coast_s_is_forgotten_though_its_track_lives():
    tracker = merged()
    for k in range(30, 60):
        give(tracker, frame(STEP_S * k, seen("x", at(k)), source="radar", sequence=k))
    assert tracker.table().sources == (("radar",),)
    give(tracker, frame(3.0, seen("a", at(60)), sequence=99))
    assert tracker.table().ids == ("cam/a", "cam/a~2")


def test_a_name_that_looks_like_a_number_stays_unique():
    tracker = Tracker(TrackingConfig())
    give(tracker, frame(0.0, seen("#1", [5.0, 0.0, 0.0]), seen(None, [0.0, 0.0, 0.0])))
    assert set(tracker.table().ids) == {"cam/#1", "cam/#1~2"}
    assert len(tracker) == 2


def test_an_anonymous_far_off_the_models_is_skipped_like_a_named_one():
    """A gate wider than `jump_sigma`: the assignment takes it, the filter does not."""
    tracker = Tracker(TrackingConfig(gate_sigma=60.0, jump_sigma=3.0, confirm_hits=1, confirm_frames=100))
    for k in range(20):
        give(tracker, frame(STEP_S * k, seen(None, [0.0, 0.0, 1.0]), sequence=k))
    give(tracker, frame(1.0, seen(None, [1.5, 0.0, 1.0]), sequence=20))
    assert tracker.dropped == {"outlier": 1}
    give(tracker, frame(1.05, seen(None, [1.5, 0.0, 1.0]), sequence=21))
    np.testing.assert_allclose(tracker.table().p_enu, [[1.5, 0.0, 1.0]])


def test_an_anonymous_key_leaves_a_shared_track_too():
    tracker = Tracker(TrackingConfig(gate_sigma=60.0, jump_sigma=3.0, merge_s=0.3))
    for k in range(30):
        give(tracker, frame(STEP_S * k, seen("a", [0.0, 0.0, 1.0]), sequence=k))
        give(tracker, frame(STEP_S * k, seen(None, [0.0, 0.0, 1.0]), source="lidar", sequence=k))
    assert tracker.table().sources == (("cam", "lidar"),)
    for k in (31, 32):
        give(tracker, frame(STEP_S * k, seen(None, [1.5, 0.0, 1.0]), source="lidar", sequence=k))
    assert tracker.table().ids == ("cam/a", "lidar/#1")
    assert tracker.table().status == ("confirmed", "tentative")


def nees(kinds, seed):
    """Mean squared position error over covariance, of a merged track whose two sources share their errors."""
    tracker, rng = Tracker(TrackingConfig()), np.random.default_rng(seed)
    p, values = np.array([0.0, 0.0, 2.0]), []
    v, shared = np.array([1.0, 0.0, 0.0]), np.zeros(3)
    for k in range(120):
        v = v + rng.normal(scale=0.1, size=3)
        p = p + v * STEP_S
        z = p + rng.normal(scale=0.1, size=3)
        shared = 0.8 * shared + 0.6 * (z - p)  # what a filter elsewhere makes of the same measurements: lasting errors
        give(tracker, frame(STEP_S * k, seen("a", z, std=0.1), sequence=k))
        told = seen("x", p + shared, std=0.1)
        give(tracker, frame(STEP_S * k, told, source="radar", sequence=k, kind=kinds))
        if k > 60:
            assert tracker.table().ids == ("cam/a",)
            error, cov = tracker.table().p_enu[0] - p, tracker.table().covariance[0, :3, :3]
            values.append(error @ np.linalg.solve(cov, error))
    return np.mean(values)


def test_a_foreign_track_merges_with_our_own_and_is_never_counted_as_independent():
    foreign = np.mean([nees(DetectionKind.TRACK, seed) for seed in range(8)])
    trusted = np.mean([nees(DetectionKind.DETECTION, seed) for seed in range(8)])
    assert foreign < 3.5, "three degrees of freedom: no surer than its errors allow"
    assert trusted > 1.3 * foreign, "what covariance intersection is there for"


def test_a_foreign_track_cannot_make_the_merged_one_much_surer_than_our_own_detections():
    alone, joined = Tracker(TrackingConfig()), Tracker(TrackingConfig())
    for k in range(60):
        own = frame(STEP_S * k, seen("a", at(k), std=0.1), sequence=k)
        give(alone, own)
        give(joined, own)
        told = seen("x", at(k), std=0.1, v=[1.0, 0.5, 0.0], v_std=0.3)
        give(joined, frame(STEP_S * k, told, source="radar", sequence=k, kind=DetectionKind.TRACK))
    assert joined.table().ids == ("cam/a",)
    mine, both = (np.trace(tracker.table().covariance[0, :3, :3]) for tracker in (alone, joined))
    assert both > 0.6 * mine


@pytest.mark.parametrize("apart_s", [0.0, 0.002, 0.005, 0.02])
@pytest.mark.parametrize("latency_s", [0.0, 0.05, 0.3])
@pytest.mark.parametrize("rate_hz", [20.0, 2.0])
def test_two_sensors_of_one_instant_see_an_anonymous_obstacle(apart_s, latency_s, rate_hz):
    """Neither confirms it for the other at once; with the second look of the first it is a track and stays one."""
    tracker, names, step_s = Tracker(TrackingConfig()), [], 1.0 / rate_hz
    for k in range(12):
        t_s = 1.0 + step_s * k
        left = frame(t_s, seen(None, [3.0, 0.0, 1.0]), source="left", sequence=k)
        right = frame(t_s + apart_s, seen(None, [3.0, 0.0, 1.0]), source="right", sequence=k)
        now_ns = round((t_s + apart_s + latency_s) * S)
        tracker.update([left, right], now_ns)
        names.append(tracker.predict(now_ns, 3, 0.05).ids)
    assert names[0] == ()
    assert set(names[1:]) == {("left/#1",)}


def test_an_anonymous_obstacle_is_confirmed_by_another_source_when_its_own_falls_silent():
    tracker = Tracker(TrackingConfig())
    give(tracker, frame(0.0, seen(None, [3.0, 0.0, 1.0]), source="left"))
    for k in range(1, 10):
        give(tracker, frame(STEP_S * k, seen(None, [3.0, 0.0, 1.0]), source="right", sequence=k))
    assert tracker.table().status == ("confirmed",)


def test_a_named_track_between_two_frames_is_not_carried_off():
    """The camera names its obstacle twice a second; a lidar sees only another one, two metres away."""
    tracker, rng = Tracker(TrackingConfig()), np.random.default_rng(3)
    for k in range(100):
        t_s, frames = STEP_S * k, []
        if k % 10 == 0:
            frames.append(frame(t_s, seen("a", rng.normal(scale=0.05, size=3)), sequence=k))
        other = np.array([2.0, 0.0, 0.0]) + rng.normal(scale=0.05, size=3)
        frames.append(frame(t_s, seen(None, other), source="lidar", sequence=k))
        give(tracker, *frames)
        if k > 15:
            ahead = tracker.predict(round(t_s * S), 3, 0.05)
            for truth in ([0.0, 0.0, 0.0], [2.0, 0.0, 0.0]):
                assert np.linalg.norm(ahead.p_enu[:, 0] - truth, axis=1).min() < 0.7, k


def test_untrusted_frames_do_not_hurry_the_merging_of_trusted_tracks():
    def merged_at(with_net):
        tracker = Tracker(TrackingConfig(untrusted=("net",)))
        for k in range(60):
            t_s = 1.0 + STEP_S * k
            frames = [frame(t_s - 0.25, seen("a", at(k)), sequence=k)]
            frames.append(frame(t_s - 0.25, seen("x", at(k)), source="radar", sequence=k))
            if with_net:
                frames.append(frame(t_s + 0.09, source="net", sequence=k))
            tracker.update(frames, round(t_s * S))
            if k > 3 and len(tracker) == 1:
                return k
        return None

    assert merged_at(False) == merged_at(True) is not None


@pytest.mark.parametrize("seed", range(4))
def test_two_padded_obstacles_taken_for_one_part_before_they_are_a_metre_apart(seed):
    """Radii of 1 m, centres 0.3 m apart at sigma 0.22 m: one, by the rules. They part at 0.5 m/s: two, soon."""
    tracker, rng = Tracker(TrackingConfig()), np.random.default_rng(seed)
    merged = False
    for k in range(300):
        t_s = STEP_S * k
        gap = 0.3 + max(0.0, t_s - 8.0) * 0.5
        one, other = np.zeros(3), np.array([gap, 0.0, 0.0])
        for source, p in (("cam", one), ("radar", other)):
            noisy = seen("a", p + rng.normal(scale=0.22, size=3), std=0.22, radius=1.0)
            give(tracker, frame(t_s, noisy, source=source, sequence=k))
        merged = merged or len(tracker) == 1
        if gap > 1.0:
            assert len(tracker) == 2, gap
    assert merged, "else this test says nothing"
