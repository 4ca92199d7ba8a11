"""Queueing, order, counting and the lockstep bookkeeping of obstacle frames."""

from __future__ import annotations

import itertools
import json

import pytest

from companion.errors import FrameRejected
from companion.link import wire
from companion.link.inbox import MAX_PAYLOAD_BYTES, MAX_SOURCES, ObstacleInbox

S, MS = 1_000_000_000, 1_000_000


def frame(stamp_ns: int, x: float = 0.0) -> bytes:
    ball = {"id": "ball", "position": [x, 0.0, 1.0], "radius": 0.2}
    return json.dumps({"stamp_ns": stamp_ns, "clock": "vehicle", "obstacles": [ball]}).encode()


def marker(through_ns: int, frames: int) -> bytes:
    return json.dumps({"through_ns": through_ns, "frames": frames}).encode()


@pytest.fixture
def inbox() -> ObstacleInbox:
    return ObstacleInbox(queue=64, max_age_s=0.5)


def test_order_is_stamp_source_sequence(inbox: ObstacleInbox) -> None:
    inbox.push("b", frame(20 * MS, 0.0))
    inbox.push("b", frame(10 * MS, 1.0))
    inbox.push("b", frame(10 * MS, 2.0))
    inbox.push("a", frame(20 * MS, 3.0))
    inbox.push("a", frame(10 * MS, 4.0))
    frames = inbox.drain(30 * MS)
    assert [(f.stamp_ns // MS, f.source, f.sequence) for f in frames] == [
        (10, "a", 1),
        (10, "b", 1),
        (10, "b", 2),
        (20, "a", 0),
        (20, "b", 0),
    ]
    assert [f.detections[0].p_enu[0] for f in frames] == [4.0, 1.0, 2.0, 3.0, 0.0]
    assert inbox.drain(30 * MS) == ()
    assert inbox.counts == {"frames": 5}
    assert inbox.sources == ("a", "b")
    assert inbox.newest_stamp_ns("b") == 20 * MS


def test_order_does_not_depend_on_arrival_across_sources() -> None:
    drained = set()
    for order in itertools.permutations(["a", "b", "c"]):
        inbox = ObstacleInbox(queue=64, max_age_s=0.5)
        for source in order:
            inbox.push(source, frame(10 * MS))
        drained.add(tuple(f.source for f in inbox.drain(10 * MS)))
    assert drained == {("a", "b", "c")}


def test_a_full_queue_loses_its_oldest_and_counts_it() -> None:
    inbox = ObstacleInbox(queue=3, max_age_s=0.5)
    for number in range(5):
        inbox.push("a", frame(number * MS))
    inbox.push("b", frame(0))
    assert [(f.source, f.sequence) for f in inbox.drain(10 * MS)] == [("b", 0), ("a", 2), ("a", 3), ("a", 4)]
    assert inbox.counts["dropped"] == 2


def test_bad_frames_are_counted_by_reason_and_cost_no_good_one(inbox: ObstacleInbox) -> None:
    inbox.push("a", b"nonsense")
    inbox.push("a", frame(2 * S))
    inbox.push("a", frame(0))
    inbox.push("a", frame(1 * S))
    inbox.push("a", bytes(MAX_PAYLOAD_BYTES + 1))
    inbox.push("a", frame(1 * S).replace(b"vehicle", b"unix"))
    (good,) = inbox.drain(1 * S)
    assert good.sequence == 3
    assert inbox.counts == {"malformed": 1, "future": 1, "stale": 1, "too_large": 1, "no_time_base": 1, "frames": 1}


def test_rejections_are_reported_at_most_once_a_second_of_vehicle_time() -> None:
    lines: list[str] = []
    inbox = ObstacleInbox(queue=64, max_age_s=0.5, on_report=lines.append)
    for tick in range(40):  # 2 s at 20 Hz
        inbox.push("lidar", b"nonsense")
        inbox.drain(tick * 50 * MS)
    assert len(lines) == 2
    assert lines[0].startswith("rejected 1 payloads, the last of lidar: malformed: ")
    assert lines[1].startswith("rejected 20 payloads")


def test_strangers_cannot_take_the_place_of_configured_sources() -> None:
    inbox = ObstacleInbox(queue=64, max_age_s=0.5, sources=("lidar",))
    for number in range(MAX_SOURCES + 10):
        inbox.push(f"stranger{number}", frame(0))
    inbox.push("lidar", frame(0))
    assert len(inbox.drain(0)) == MAX_SOURCES
    assert inbox.counts["too_many_sources"] == 11
    assert "lidar" in inbox.sources


def test_unix_stamps_use_the_time_base_of_the_tick(inbox: ObstacleInbox) -> None:
    inbox.push("a", frame(100 * S + 5 * MS).replace(b"vehicle", b"unix"))
    (arrived,) = inbox.drain(10 * MS, unix_minus_vehicle_ns=100 * S)
    assert arrived.stamp_ns == 5 * MS


def test_lockstep_waits_for_marker_and_frames_in_whatever_order() -> None:
    arrivals = {
        "f1": lambda inbox: inbox.push("a", frame(40 * MS)),
        "f2": lambda inbox: inbox.push("a", frame(45 * MS)),
        "mark": lambda inbox: inbox.push_marker("a", marker(50 * MS, 2)),
    }
    for order in itertools.permutations(arrivals):
        inbox = ObstacleInbox(queue=64, max_age_s=0.5)
        for step in order:
            assert not inbox.ready(50 * MS, ["a"])
            assert inbox.missing(50 * MS, ["a"]) != ""
            arrivals[step](inbox)
        assert inbox.ready(50 * MS, ["a"])
        assert inbox.missing(50 * MS, ["a"]) == ""
        assert len(inbox.drain(50 * MS)) == 2


def test_missing_names_source_and_what(inbox: ObstacleInbox) -> None:
    inbox.push_marker("a", marker(50, 3))
    inbox.push("a", frame(10))
    assert inbox.missing(50, ["a", "b"]) == "2 of the frames of a for 50; marker of b for 50"
    assert not inbox.ready(50, ["a"])
    assert inbox.ready(50, [])


def test_lockstep_ticks_without_frames_and_the_next_marker(inbox: ObstacleInbox) -> None:
    inbox.push_marker("a", marker(50 * MS, 0))
    assert inbox.ready(50 * MS, ["a"])
    assert inbox.drain(50 * MS) == ()
    assert not inbox.ready(100 * MS, ["a"])  # the old marker does not stand for the next tick
    inbox.push_marker("a", marker(100 * MS, 1))
    assert not inbox.ready(100 * MS, ["a"])
    inbox.push("a", frame(60 * MS))
    assert inbox.ready(100 * MS, ["a"])
    assert len(inbox.drain(100 * MS)) == 1


def test_a_source_that_runs_ahead_does_not_leak_frames_into_an_earlier_tick(inbox: ObstacleInbox) -> None:
    inbox.push("a", frame(40 * MS))
    inbox.push_marker("a", marker(50 * MS, 1))
    inbox.push("a", frame(60 * MS))
    inbox.push_marker("a", marker(100 * MS, 1))
    assert inbox.ready(50 * MS, ["a"])
    assert [f.stamp_ns for f in inbox.drain(50 * MS)] == [40 * MS]
    assert [f.stamp_ns for f in inbox.drain(100 * MS)] == [60 * MS]


def test_rejected_and_dropped_frames_still_count_as_arrived() -> None:
    inbox = ObstacleInbox(queue=1, max_age_s=0.5)
    inbox.push("a", b"nonsense")
    inbox.push("a", bytes(MAX_PAYLOAD_BYTES + 1))
    inbox.push("a", frame(0))
    inbox.push_marker("a", marker(50 * MS, 3))
    assert inbox.ready(50 * MS, ["a"])
    assert len(inbox.drain(50 * MS)) == 1


def test_markers_that_do_not_advance_or_decode_are_rejected(inbox: ObstacleInbox) -> None:
    inbox.push_marker("a", marker(50, 0))
    inbox.push_marker("a", marker(50, 7))
    inbox.push_marker("a", marker(49, 7))
    inbox.push_marker("a", b'{"through_ns": 60}')
    assert inbox.counts == {"marker_order": 2, "malformed": 1}
    assert inbox.ready(50, ["a"])


def test_reset_forgets_the_old_clock(inbox: ObstacleInbox) -> None:
    inbox.push_marker("a", marker(50, 1))
    inbox.push("a", frame(0))
    inbox.reset()
    assert inbox.drain(50) == ()
    inbox.push_marker("a", marker(10, 0))
    assert inbox.ready(10, ["a"])


def test_markers_in_messagepack(inbox: ObstacleInbox) -> None:
    inbox.push_marker("a", wire.encode(wire.SyncMarker(through_ns=5, frames=0), wire.MSGPACK), wire.MSGPACK)
    assert inbox.ready(5, ["a"])


def test_the_newest_complete_tick_needs_every_source(inbox: ObstacleInbox) -> None:
    assert inbox.complete_through_ns(()) is None
    assert inbox.complete_through_ns(("a", "b")) is None
    inbox.push_marker("a", marker(100 * MS, 0))
    assert inbox.complete_through_ns(("a", "b")) is None
    inbox.push_marker("b", marker(50 * MS, 1))
    assert inbox.complete_through_ns(("a", "b")) is None  # a frame of b is still on its way
    inbox.push("b", frame(20 * MS))
    assert inbox.complete_through_ns(("a", "b")) == 50 * MS
    assert inbox.complete_through_ns(("a",)) == 100 * MS


def test_frames_of_other_doors_queue_with_the_rest_and_are_decoded_when_drained() -> None:
    inbox = ObstacleInbox(queue=2, max_age_s=0.5)
    calls: list[int] = []

    def decoded(stamp_ns: int) -> wire.ObstacleFrame:
        return wire.ObstacleFrame(stamp_ns=stamp_ns, clock="vehicle", kind="track", obstacles=[])

    def later(stamp_ns: int) -> wire.ObstacleFrame:
        calls.append(stamp_ns)
        return decoded(stamp_ns)

    def broken() -> wire.ObstacleFrame:
        raise FrameRejected("frame_id", "expected map")

    inbox.push("a", frame(10 * MS))
    inbox.push_decoded("a", decoded(20 * MS))
    inbox.push_decoded("a", lambda: later(30 * MS))
    inbox.push_decoded("b", broken)
    for number in range(MAX_SOURCES):
        inbox.push_decoded(f"stranger{number}", decoded(0))
    assert calls == []
    frames = [f for f in inbox.drain(40 * MS) if f.source in "ab"]
    assert [(f.sequence, f.stamp_ns) for f in frames] == [(1, 20 * MS), (2, 30 * MS)]
    assert calls == [30 * MS]
    expected = {"dropped": 1, "frame_id": 1, "too_many_sources": 2, "frames": 2 + MAX_SOURCES - 2}
    assert inbox.counts == expected


def test_a_source_faster_than_the_ticks_is_thinned_evenly_and_keeps_its_newest() -> None:
    inbox = ObstacleInbox(queue=64, max_age_s=10.0, per_tick=4)
    for n in range(10):
        inbox.push("fast", frame(stamp_ns=n))
    inbox.push("slow", frame(stamp_ns=5))
    taken = inbox.drain(30 * MS)
    assert [(f.source, f.stamp_ns) for f in taken if f.source == "fast"] == [("fast", n) for n in (0, 3, 6, 9)]
    assert [f.stamp_ns for f in taken if f.source == "slow"] == [5]
    assert (inbox.counts["thinned"], inbox.counts["frames"]) == (6, 5)
    for n in range(4):
        inbox.push("fast", frame(stamp_ns=20 + n))
    assert len(inbox.drain(30 * MS)) == 4
    assert inbox.counts["thinned"] == 6
