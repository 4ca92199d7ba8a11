"""Trust and room: untrusted sources add and never take away, the nearest obstacles are kept."""

import numpy as np
import pytest
from tracking_scenes import S, assert_same_bits, beside, frame, give, seen, vehicle

from companion.config import TrackingConfig
from companion.tracking.tracker import Tracker

STEP_S = 0.05


def test_untrusted_detections_change_no_bit_of_a_trusted_track():
    """Whatever an untrusted source says, near, on top of, or ahead of its time."""
    rng = np.random.default_rng(1)
    config = TrackingConfig(untrusted=("net",), max_tracks=3, confirm_hits=1)
    quiet, disturbed = Tracker(config), Tracker(config)
    for k in range(60):
        z = np.array([0.1 * k, 0.0, 1.0]) + rng.normal(scale=0.05, size=3)
        own = frame(STEP_S * k, seen("a", z), seen(None, beside(z, 0.0, 3.0, 0.0)), sequence=k)
        give(quiet, own)
        give(disturbed, own)
        lies = [seen("a", z), seen(None, z), seen(None, beside(z, 0.0, 3.0, 0.0)), seen("b", z + rng.normal(size=3))]
        give(disturbed, frame(STEP_S * k + 0.01, *lies, source="net", sequence=k), now_s=STEP_S * k)
    give(disturbed, frame(60.0, source="net", sequence=99), now_s=STEP_S * 59)
    table = disturbed.table()
    trusted = [row for row, sources in enumerate(table.sources) if sources == ("cam",)]
    assert [table.ids[row] for row in trusted] == list(quiet.table().ids)
    assert np.array_equal(table.p_enu[trusted], quiet.table().p_enu)
    assert np.array_equal(table.covariance[trusted], quiet.table().covariance)


def test_an_untrusted_source_adds_obstacles():
    tracker = Tracker(TrackingConfig(untrusted=("net",)))
    give(tracker, frame(0.0, seen("a", [0.0, 0.0, 1.0])), frame(0.0, seen("a", [0.0, 0.0, 1.0]), source="net"))
    assert tracker.predict(0, 3, 0.05).ids == ("cam/a", "net/a")
    tracker.update([frame(0.5, source="net", sequence=1)], S // 2)
    assert len(tracker) == 2


def test_untrusted_tracks_end_by_the_time_of_any_source_trusted_ones_by_their_own():
    tracker = Tracker(TrackingConfig(untrusted=("net",), replay_s=0.0))
    give(tracker, frame(0.0, seen("a", [0.0, 0.0, 1.0])), frame(0.0, seen("n", [5.0, 0.0, 1.0]), source="net"))
    tracker.update([frame(3.0, source="net", sequence=1)], 0)
    assert tracker.table().ids == ("cam/a",)
    tracker.update([frame(3.0, source="other", sequence=1)], 0)
    assert tracker.table().ids == ()
    assert tracker.dropped == {"lost": 2}


@pytest.mark.parametrize("known", [True, False])
def test_the_nearest_to_the_vehicle_are_kept(known):
    tracker = Tracker(TrackingConfig(max_tracks=2))
    if known:
        tracker.note_vehicle(vehicle(0.0, [10.0, 0.0, 1.0]))
    give(tracker, frame(0.0, *(seen(f"o{k}", [k, 0.0, 1.0]) for k in range(4))))
    assert tracker.table().ids == (("cam/o2", "cam/o3") if known else ("cam/o0", "cam/o1"))
    assert tracker.dropped == {"over_max_tracks": 2}
    give(tracker, frame(0.05, seen("new", [9.0, 0.0, 1.0]), sequence=1))
    assert tracker.table().ids == (("cam/o3", "cam/new") if known else ("cam/o0", "cam/o1"))
    assert tracker.dropped == {"over_max_tracks": 3}
    give(tracker, frame(0.1, seen("far", [-9.0, 0.0, 1.0]), sequence=2))
    assert "cam/far" not in tracker.table().ids


def test_a_stale_position_of_the_vehicle_still_ranks():
    tracker = Tracker(TrackingConfig(max_tracks=1))
    tracker.note_vehicle(vehicle(0.0, [10.0, 0.0, 1.0]))
    give(tracker, frame(5.0, seen("a", [0.0, 0.0, 1.0]), seen("b", [9.0, 0.0, 1.0])))
    assert tracker.table().ids == ("cam/b",)


def test_trusted_tracks_have_room_before_untrusted_ones():
    tracker = Tracker(TrackingConfig(max_tracks=2, untrusted=("net",)))
    tracker.note_vehicle(vehicle(0.0, [0.0, 0.0, 1.0]))
    give(tracker, frame(0.0, seen("n", [1.0, 0.0, 1.0]), seen("m", [2.0, 0.0, 1.0]), source="net"))
    give(tracker, frame(0.01, seen("a", [9.0, 0.0, 1.0])))
    assert tracker.table().ids == ("net/n", "cam/a")
    give(tracker, frame(0.02, seen("b", [8.0, 0.0, 1.0]), sequence=1))
    assert tracker.table().ids == ("cam/a", "cam/b")
    give(tracker, frame(0.03, seen("n", [0.7, 0.0, 1.0]), source="net", sequence=2))
    assert tracker.table().ids == ("cam/a", "cam/b")


def test_the_bound_holds_with_late_frames_to_the_bit():
    frames = [
        frame(STEP_S * k, *(seen(f"o{m}", [m - k, m, 1.0]) for m in range(k, k + 3)), sequence=k) for k in range(8)
    ]
    one, other = Tracker(TrackingConfig(max_tracks=4)), Tracker(TrackingConfig(max_tracks=4))
    for tracker, order in ((one, frames), (other, [frames[k] for k in (1, 0, 4, 3, 2, 7, 5, 6)])):
        tracker.note_vehicle(vehicle(0.0, [0.0, 0.0, 1.0]))
        for each in order:
            give(tracker, each, now_s=0.4)
    assert_same_bits(one, other, S)
    assert one.dropped == other.dropped


def test_the_time_of_an_untrusted_frame_ends_no_name_of_a_trusted_track():
    tracker = Tracker(TrackingConfig(untrusted=("net",), merge_s=0.3, replay_s=0.0))
    for k in range(20):
        for source in ("cam", "radar"):
            give(tracker, frame(STEP_S * k, seen("a", [0.0, 0.0, 1.0]), source=source, sequence=k))
    for k in range(20, 30):
        give(tracker, frame(STEP_S * k, seen("a", [0.0, 0.0, 1.0]), sequence=k))
    give(tracker, frame(2.2, source="net"), now_s=1.45)
    assert tracker.table().sources == (("cam", "radar"),)
    give(tracker, frame(2.2, source="cam", sequence=99), now_s=1.45)
    assert tracker.table().sources == (("cam",),)


def test_a_full_table_still_updates_what_it_has_while_births_push_others_out():
    """In one frame: a tentative track is confirmed, one is pushed out, a near one gets in."""
    tracker = Tracker(TrackingConfig(max_tracks=2))
    tracker.note_vehicle(vehicle(0.0, [0.0, 0.0, 1.0]))
    give(tracker, frame(0.0, seen("far", [9.0, 0.0, 1.0]), seen(None, [3.0, 0.0, 1.0])))
    give(tracker, frame(0.05, seen("far", [9.0, 0.0, 1.0]), seen(None, [3.0, 0.0, 1.0]), seen("near", [2.0] * 3)))
    assert tracker.table().ids == ("cam/#1", "cam/near")
    assert tracker.table().status == ("confirmed", "confirmed")
