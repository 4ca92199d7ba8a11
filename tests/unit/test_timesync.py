"""TIMESYNC by hand-made cases: the autopilot's clock is `ours - OFFSET`."""

from __future__ import annotations

import pytest

from companion.link.timesync import TimeSync

OFFSET_NS = 1_000_000_000_000  # ours minus vehicle
UNIX_MINUS_OURS_NS = 1_700_000_000_000_000_000
S, MS = 1_000_000_000, 1_000_000


def exchange(sync: TimeSync, now_ns: int, *, there_ns: int = MS, back_ns: int = MS, offset_ns: int = OFFSET_NS) -> bool:
    """One request and its reply; the reply arrives at ``now_ns + there_ns + back_ns``."""
    ts1_ns = sync.request(now_ns)
    arrival_ns = now_ns + there_ns + back_ns
    return sync.reply(
        tc1_ns=now_ns + there_ns - offset_ns,
        ts1_ns=ts1_ns,
        now_ns=arrival_ns,
        unix_ns=arrival_ns + UNIX_MINUS_OURS_NS,
    )


@pytest.fixture
def settled() -> TimeSync:
    sync = TimeSync()
    for second in range(5):
        assert exchange(sync, OFFSET_NS + (10 + second) * S)
    assert sync.settled
    return sync


def test_symmetric_path_gives_the_offset_exactly_after_five_samples() -> None:
    sync = TimeSync()
    for second in range(5):
        assert sync.unix_minus_vehicle_ns is None
        assert sync.ours_minus_vehicle_ns is None
        assert exchange(sync, OFFSET_NS + (10 + second) * S)
    assert sync.ours_minus_vehicle_ns == OFFSET_NS
    assert sync.unix_minus_vehicle_ns == OFFSET_NS + UNIX_MINUS_OURS_NS
    assert sync.round_trip_ns == 2 * MS


def test_error_is_at_most_half_the_shortest_round_trip() -> None:
    sync = TimeSync()
    for second, (there_ms, back_ms) in enumerate([(1, 9), (30, 1), (2, 1), (1, 50), (8, 8), (3, 3)]):
        exchange(sync, OFFSET_NS + (10 + second) * S, there_ns=there_ms * MS, back_ns=back_ms * MS)
    assert sync.round_trip_ns == 3 * MS
    assert sync.ours_minus_vehicle_ns == OFFSET_NS - MS // 2  # of the sample (2, 1): half of the difference
    assert abs(sync.ours_minus_vehicle_ns - OFFSET_NS) <= sync.round_trip_ns // 2


def test_only_open_requests_of_ours_count_and_only_once(settled: TimeSync) -> None:
    now_ns = OFFSET_NS + 20 * S
    ts1_ns = settled.request(now_ns)
    before = settled.ours_minus_vehicle_ns
    forged = {"tc1_ns": 5, "now_ns": now_ns + MS, "unix_ns": now_ns}
    assert not settled.reply(ts1_ns=ts1_ns + 1, **forged)  # somebody else's
    assert not settled.reply(ts1_ns=0, **forged)
    genuine = {"tc1_ns": now_ns + MS - OFFSET_NS, "ts1_ns": ts1_ns, "now_ns": now_ns + 2 * MS, "unix_ns": 0}
    assert settled.reply(**genuine)
    assert not settled.reply(**genuine)
    assert settled.counts["foreign"] == 3
    assert settled.ours_minus_vehicle_ns == before


def test_high_round_trips_and_replies_from_the_past_are_rejected(settled: TimeSync) -> None:
    assert not exchange(settled, OFFSET_NS + 20 * S, there_ns=100 * MS, back_ns=1)
    assert not exchange(settled, OFFSET_NS + 21 * S, there_ns=-2 * MS, back_ns=MS)
    assert settled.counts["slow"] == 2
    assert exchange(settled, OFFSET_NS + 22 * S, there_ns=50 * MS, back_ns=50 * MS)


def test_requests_are_unique_and_old_ones_forgotten() -> None:
    sync = TimeSync()
    assert sync.request(0) == 1  # 0 would read as "no request"
    assert sync.request(0) == 2
    first = sync.request(5)
    for k in range(20):
        sync.request(10 + k)
    assert not sync.reply(tc1_ns=1, ts1_ns=first, now_ns=40, unix_ns=0)
    late = sync.request(1 * S)
    sync.request(3 * S)
    assert not sync.reply(tc1_ns=1, ts1_ns=late, now_ns=3 * S, unix_ns=0)
    assert sync.counts["foreign"] == 2


def test_one_contradicting_sample_is_ignored_three_in_a_row_restart(settled: TimeSync) -> None:
    jumped = OFFSET_NS + 5 * S
    assert not exchange(settled, OFFSET_NS + 20 * S, offset_ns=jumped - 10 * S)
    assert settled.ours_minus_vehicle_ns == OFFSET_NS
    assert exchange(settled, OFFSET_NS + 21 * S)  # the count of contradictions starts again
    offset_ns = OFFSET_NS - 5 * S  # the vehicle's clock leapt forward
    results = [exchange(settled, OFFSET_NS + (22 + k) * S, offset_ns=offset_ns) for k in range(3)]
    assert results == [False, False, True]
    assert settled.counts["jumps"] == 1
    assert not settled.settled
    for k in range(4):
        exchange(settled, OFFSET_NS + (25 + k) * S, offset_ns=offset_ns)
    assert settled.ours_minus_vehicle_ns == offset_ns


def test_reboot_seen_in_telemetry_restarts_at_once(settled: TimeSync) -> None:
    assert not settled.vehicle_time(15 * S)
    assert not settled.vehicle_time(15 * S - 999 * MS)  # reordered, no reboot
    assert settled.settled
    assert settled.vehicle_time(2 * S)
    assert not settled.settled
    assert settled.unix_minus_vehicle_ns is None
    assert settled.counts["reboots"] == 1
    assert not settled.vehicle_time(3 * S)


def test_reboot_seen_in_a_reply_restarts_and_settles_on_the_new_clock(settled: TimeSync) -> None:
    rebooted_ns = OFFSET_NS + 18 * S  # the vehicle's clock began again
    for k in range(5):
        assert exchange(settled, OFFSET_NS + (20 + k) * S, offset_ns=rebooted_ns)
    assert settled.counts["reboots"] == 1
    assert settled.ours_minus_vehicle_ns == rebooted_ns


def test_a_step_of_unix_time_is_followed_with_the_next_reply(settled: TimeSync) -> None:
    now_ns = OFFSET_NS + 20 * S
    ts1_ns = settled.request(now_ns)
    settled.reply(tc1_ns=now_ns + MS - OFFSET_NS, ts1_ns=ts1_ns, now_ns=now_ns + 2 * MS, unix_ns=now_ns + 2 * MS + 7)
    assert settled.unix_minus_vehicle_ns == OFFSET_NS + 7


def test_drift_is_followed_as_the_window_moves_on() -> None:
    sync = TimeSync()
    for second in range(60):
        drift_ns = 50_000 * second  # 50 ppm
        assert exchange(sync, OFFSET_NS + (10 + second) * S, offset_ns=OFFSET_NS + drift_ns)
    assert abs(sync.ours_minus_vehicle_ns - (OFFSET_NS + 50_000 * 59)) <= 16 * 50_000


def test_a_stamp_further_ahead_than_time_has_passed_restarts(settled: TimeSync) -> None:
    """Both clocks count: a pause of the link moves both, a jump only the vehicle's."""
    now_ns = OFFSET_NS + 15 * S
    assert not settled.vehicle_time(15 * S, now_ns)
    assert not settled.vehicle_time(75 * S, now_ns + 60 * S)  # a minute of silence
    assert not settled.vehicle_time(78 * S, now_ns + 60 * S)  # a burst after a stall
    assert settled.settled
    assert settled.vehicle_time(81 * S + 1, now_ns + 60 * S)
    assert not settled.settled
    assert settled.counts["jumps_ahead"] == 1
    assert not settled.vehicle_time(81 * S + 20 * MS, now_ns + 60 * S + 20 * MS)


def test_without_a_clock_beside_it_only_steps_back_are_noticed(settled: TimeSync) -> None:
    assert not settled.vehicle_time(500 * S)
    assert not settled.vehicle_time(5000 * S)
    assert settled.vehicle_time(4998 * S)


def test_a_stray_reply_from_the_future_is_no_stamp(settled: TimeSync) -> None:
    assert not exchange(settled, OFFSET_NS + 20 * S, offset_ns=OFFSET_NS - 60 * S)
    assert not settled.vehicle_time(20 * S, OFFSET_NS + 20 * S)  # neither back from it nor ahead of the last
    assert settled.settled
    assert settled.counts["reboots"] == settled.counts["jumps_ahead"] == 0


def test_replies_that_agree_on_a_jump_of_minutes_tell_it(settled: TimeSync) -> None:
    for k in range(3):
        exchange(settled, OFFSET_NS + (20 + k) * S, offset_ns=OFFSET_NS - 60 * S)
    assert settled.counts["jumps_ahead"] == 1
    assert settled.counts["reboots"] == 0
