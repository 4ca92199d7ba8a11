"""Time: every frame at its own stamp, one rollback for late ones, bounded memory, and what is counted."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tracking_scenes import S, assert_same_bits, frame, give, seen

from companion.config import TrackingConfig
from companion.tracking import replay
from companion.tracking.bank import build_constants
from companion.tracking.picture import empty_picture
from companion.tracking.replay import REPLAY_FRAMES, Replay
from companion.tracking.tracker import Tracker

STEP_S = 0.025


def two_sources(seed, steps=18, *, dropout=0.25):
    """Named and anonymous obstacles of two sources, some stamps shared, frames and detections lost."""
    rng = np.random.default_rng(seed)
    p, v = rng.uniform(-3.0, 3.0, (4, 3)), rng.uniform(-2.0, 2.0, (4, 3))
    frames = []
    for k in range(steps):
        for source, every, ids in (("cam", 1, ("a", "b", None, None)), ("radar", 2, ("x", None, None, "y"))):
            if k % every or rng.random() < dropout:
                continue
            z = p + v * STEP_S * k + rng.normal(scale=0.05, size=p.shape)
            told = [
                seen(ids[m], z[m], v=v[m] if m == 3 else None, v_std=0.3) for m in range(4) if rng.random() > dropout
            ]
            frames.append(frame(STEP_S * k, *told, source=source, sequence=k))
    return frames


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), shuffle=st.randoms(use_true_random=False), sizes=st.lists(st.integers(1, 6)))
def test_the_order_of_arrival_changes_no_bit(seed, shuffle, sizes):
    """Frames within `replay_s`, in any order and in any number of updates, give what they give in order."""
    frames = two_sources(seed)
    config = TrackingConfig(coast_s=0.2, merge_s=0.1, confirm_frames=2)
    in_order, shuffled = Tracker(config), Tracker(config)
    for one in frames:
        give(in_order, one)
    arrived = list(frames)
    shuffle.shuffle(arrived)
    for size in sizes:
        part, arrived = arrived[:size], arrived[size:]
        shuffled.update(part, S // 2)
        shuffled.table()
    shuffled.update(arrived, S // 2)
    in_order.update([], S // 2)
    assert_same_bits(in_order, shuffled, S)
    assert in_order.dropped == shuffled.dropped


def test_a_late_frame_counts_at_its_own_stamp():
    late, punctual = Tracker(TrackingConfig()), Tracker(TrackingConfig())
    frames = [frame(0.05 * k, seen("a", [0.1 * k, 0.0, 1.0]), sequence=k) for k in range(10)]
    for one in frames:
        give(punctual, one)
    for one in [*frames[:4], *frames[5:], frames[4]]:
        give(late, one, now_s=0.45)
    assert_same_bits(late, punctual, S)
    assert not late.dropped


def test_all_late_frames_of_an_update_cost_one_rollback(monkeypatch):
    tracker, consumed = Tracker(TrackingConfig()), []
    plain = replay.Replay.run

    def counting(self, frames, picture, consume):
        def one(before, frame):
            consumed.append(frame)
            return consume(before, frame)

        return plain(self, frames, picture, one)

    monkeypatch.setattr(replay.Replay, "run", counting)
    frames = [frame(0.05 * k, seen("a", [0.1 * k, 0.0, 1.0]), sequence=k) for k in range(10)]
    tracker.update([frames[k] for k in (0, 1, 3, 5, 6, 8)], S // 2)
    consumed.clear()
    tracker.update([frames[k] for k in (7, 2, 4, 9)], S // 2)
    assert [one.sequence for one in consumed] == [2, 3, 4, 5, 6, 7, 8, 9]


def test_what_is_older_than_the_buffer_is_used_where_it_is_news():
    """Its track has seen newer: late. Another obstacle, unheard of: a track, whatever other sources are up to."""
    tracker = Tracker(TrackingConfig())
    for k in range(20):
        give(tracker, frame(0.05 * k, seen("a", [0.1 * k, 0.0, 1.0]), sequence=k))
    before = tracker.table()
    give(tracker, frame(0.44, seen("a", [5.0, 0.0, 1.0]), seen("b", [5.0, 0.0, 1.0]), sequence=99), now_s=0.95)
    assert tracker.dropped == {"late": 1}
    assert tracker.table().ids == ("cam/a", "cam/b")
    assert np.array_equal(tracker.table().p_enu[0], before.p_enu[0])
    give(tracker, frame(0.46, seen("b", [5.0, 0.0, 1.0]), sequence=100), now_s=0.95)
    assert tracker.table().ids == ("cam/a", "cam/b")


def test_two_sources_at_one_stamp_are_both_used():
    """dt = 0 between the two, also where a model has no probability left."""
    tracker = Tracker(TrackingConfig(merge_s=0.3))
    rng = np.random.default_rng(0)
    for k in range(40):
        p = np.array([0.1 * k, 0.0, 1.0])
        for source in ("cam", "radar"):
            give(tracker, frame(0.05 * k, seen("a", p + rng.normal(scale=0.05, size=3)), source=source, sequence=k))
    assert tracker.table().ids == ("cam/a",)
    assert tracker.table().sources == (("cam", "radar"),)
    assert not tracker.dropped
    alone = Tracker(TrackingConfig())
    rng = np.random.default_rng(0)
    for k in range(40):
        p = np.array([0.1 * k, 0.0, 1.0])
        give(alone, frame(0.05 * k, seen("a", p + rng.normal(scale=0.05, size=3)), sequence=k))
        rng.normal(size=3)
    ratio = np.trace(tracker.table().covariance[0, :3, :3]) / np.trace(alone.table().covariance[0, :3, :3])
    assert 0.4 < ratio < 0.8, "two measurements know more than one"


def test_tracks_are_hidden_by_the_tick_and_revived_by_what_was_under_way():
    tracker = Tracker(TrackingConfig(coast_s=0.5))
    for k in range(10):
        give(tracker, frame(0.05 * k, seen("a", [0.1 * k, 0.0, 1.0]), sequence=k))
    tracker.update([], round(1.0 * S))
    assert len(tracker) == len(tracker.table()) == len(tracker.predict(S, 3, 0.05)) == 0
    assert len(tracker.forecast(S, np.array([0.0]))[0]) == 0
    assert tracker.dropped == {"lost": 1}
    give(tracker, frame(0.6, seen("a", [1.2, 0.0, 1.0]), sequence=12), now_s=1.0)
    assert tracker.table().ids == ("cam/a",)
    assert np.linalg.norm(tracker.table().v_enu[0]) > 1.0, "the same track, not a new one"
    assert not tracker.dropped
    tracker.update([], round(1.7 * S))
    tracker.update([], round(9.0 * S))
    assert tracker.dropped == {"lost": 1}


def test_memory_is_bounded_at_any_rate():
    buffer, picture = Replay(0.5), empty_picture(build_constants(TrackingConfig()))
    for k in range(2000):
        buffer.run([frame(0.001 * k, sequence=k)], picture, lambda before, _: before)
        assert len(buffer._checkpoints) <= 18
        assert len(buffer._frames) <= REPLAY_FRAMES
    assert buffer._frames[0].sequence <= 2000 - REPLAY_FRAMES + 32
    for k in range(2000):  # all within one spacing
        buffer.run([frame(2.0 + 1e-6 * k, sequence=k)], picture, lambda before, _: before)
        assert len(buffer._frames) <= REPLAY_FRAMES


@pytest.mark.parametrize(
    ("before", "late", "detections", "rolled_back"),
    [(8, 8, 1, True), (20, 20, 1, False), (8, 8, 60, True), (8, 9, 60, False)],
)
def test_a_rollback_beyond_its_budget_is_not_done(before, late, detections, rolled_back):
    """``before`` frames after the checkpoint, ``late`` before them: 32 frames or 512 detections, else as they come."""
    buffer, picture = Replay(0.5), empty_picture(build_constants(TrackingConfig()))
    consumed = []

    def consume(picture, one):
        consumed.append(one)
        return picture

    buffer.run([frame(0.0)], picture, consume)
    buffer.run([frame(0.3 + 0.0001 * k, sequence=k) for k in range(before)], picture, consume)
    consumed.clear()
    crowd = [seen(str(m), [0.0, 0.0, 0.0]) for m in range(detections)]
    old = [frame(0.1 + 0.0001 * k, *crowd, source="slow", sequence=k) for k in range(late)]
    buffer.run(old, picture, consume)
    assert len(consumed) == late + (before if rolled_back else 0)
    assert [one.order_key for one in consumed] == sorted(one.order_key for one in consumed)


def flooded(flood):
    """Ticks of 50 with a trusted track, seen 120 ms late, while ``flood`` sends its frames of each tick."""
    tracker = Tracker(TrackingConfig(untrusted=("net",)))
    shown = 0
    for k in range(150):
        now_s = 1.0 + 0.02 * k
        cam = frame(now_s - 0.12, seen("a", [0.002 * k, 0.0, 1.0]), sequence=k)
        tracker.update([cam, *flood(k, now_s)], round(now_s * S))
        shown += "cam/a" in tracker.predict(round(now_s * S), 3, 0.05).ids
    return shown


def test_no_flood_of_another_source_makes_a_slow_one_useless():
    def ahead(k, now_s):
        return [frame(now_s + 0.0999 + 1e-6 * j, source="net", sequence=64 * k + j) for j in range(64)]

    def behind(k, now_s):
        return [frame(now_s - 0.45, source="net", sequence=k)]

    assert flooded(lambda k, now_s: []) == flooded(ahead) == flooded(behind) == 150


def test_many_fast_sources_leave_room_for_a_slow_one():
    tracker = Tracker(TrackingConfig())
    shown = 0
    for k in range(60):
        now_s = 1.0 + 0.05 * k
        fast = [
            frame(now_s - 0.0001 * m, seen("o", [5.0 + 2.0 * m, 5.0, 1.0]), source=f"s{m:02d}", sequence=k)
            for m in range(60)
        ]
        slow = frame(now_s - 0.35, seen("b", [1.0, 0.0, 1.0]), source="slow", sequence=k)
        tracker.update([*fast, slow], round(now_s * S))
        shown += "slow/b" in tracker.predict(round(now_s * S), 3, 0.05).ids
    assert shown == 60


def test_what_was_counted_is_not_counted_again_by_a_rollback():
    """Counters belong to what is rolled back: an outlier before a late frame is one outlier after it too."""
    tracker = Tracker(TrackingConfig())
    for k in range(12):
        if k != 5:
            p = [50.0, 0.0, 0.0] if k == 8 else [0.1 * k, 0.0, 1.0]
            give(tracker, frame(0.03 * k, seen("a", p), seen("a", p), sequence=k))
    assert tracker.dropped == {"outlier": 1, "duplicate": 11}
    give(tracker, frame(0.15, seen("a", [0.5, 0.0, 1.0]), sequence=5), now_s=0.33)
    assert tracker.dropped == {"outlier": 1, "duplicate": 11}
    tracker.reset()
    assert not tracker.dropped


@pytest.mark.parametrize(("t_s", "reason"), [(0.1, "duplicate"), (0.05, "late")])
def test_an_anonymous_frame_of_a_stamp_already_seen_changes_nothing(t_s, reason):
    tracker = Tracker(TrackingConfig(replay_s=0.0))
    give(tracker, frame(0.1, seen(None, [1.0, 0.0, 1.0]), sequence=1))
    give(tracker, frame(t_s, seen(None, [5.0, 0.0, 1.0]), seen(None, [6.0, 0.0, 1.0]), sequence=2), now_s=0.1)
    assert tracker.dropped == {reason: 2}
    assert len(tracker) == 1
    give(tracker, frame(t_s, seen(None, [5.0, 0.0, 1.0]), source="other"), now_s=0.1)
    assert len(tracker) == 2, "another source of that stamp is used"
