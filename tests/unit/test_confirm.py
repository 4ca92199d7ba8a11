"""Echoes against setpoints, notices, stream requests and origins: their edges, without a vehicle."""

from __future__ import annotations

import numpy as np
import pytest

from companion.confirm import Confirmation
from companion.link.events import SetpointEcho
from companion.notices import Notices
from companion.origin import OriginWatch
from companion.profiles import PROFILES
from companion.requests import StreamRequests
from companion.types import VehicleState, frozen

S, MS = 10**9, 10**6


def echo(mask: int, a: tuple[float, float, float] = (1.0, 2.0, 3.0)) -> SetpointEcho:
    return SetpointEcho(1, 1, 0, mask, 1, frozen(a), frozen([0, 0, 0]))


def confirmation(profile: str, mask: int, a: tuple[float, float, float] = (1.0, 2.0, 3.0)) -> Confirmation:
    """After two seconds of the same setpoint at 50 Hz."""
    made = Confirmation(PROFILES[profile], mask)
    for k in range(101):
        made.sent(frozen(a), k * 20 * MS)
    return made


@pytest.mark.parametrize(
    ("profile", "sent", "heard", "wrong"),
    [
        ("ardupilot", 0x043F, 0x0C3F, False),  # it never echoes a yaw
        ("ardupilot", 0x043F, 0x043F, False),
        ("ardupilot", 0x043F, 0x0C07, True),
        ("ardupilot", 0x043F, 0x0DF8, True),
        ("ardupilot", 0x0407, 0x0C07, False),
        ("ardupilot", 0x0407, 0x0C3F, True),
        ("px4", 0x0C3F, 0x003F, False),
        ("px4", 0x0C3F, 0x0007, False),  # its velocity controller may have filled the velocities
        ("px4", 0x0C3F, 0x0000, True),  # it flies to a position
        ("px4", 0x0C3F, 0x0DFF, True),
        ("crazyflie-sim", 0x0C3F, 0x0C3F, False),
        ("crazyflie-sim", 0x0C3F, 0x003F, False),  # as PX4, the mask tells what is free and says nothing of the yaw
        ("crazyflie-sim", 0x0C3F, 0x0DFF, True),
    ],
)
def test_masks_are_compared_where_the_autopilot_repeats_them(profile: str, sent: int, heard: int, wrong: bool) -> None:
    made = confirmation(profile, sent)
    made.echo(echo(heard), 2 * S)
    expected = f"autopilot does not follow: type_mask 0x{heard:04X}, sent 0x{sent:04X}" if wrong else None
    assert made.complaint(2 * S) == expected
    assert made.counts["mask_mismatch"] == wrong


def test_the_first_second_is_not_judged() -> None:
    made = Confirmation(PROFILES["ardupilot"], 0x043F)
    made.sent(frozen([0, 0, 0]), 0)
    made.echo(echo(0x0DF8), 999 * MS)
    assert made.complaint(1 * S) is None
    made.sent(frozen([0, 0, 0]), 1 * S)
    made.echo(echo(0x0DF8), 1 * S)
    assert made.complaint(1 * S + 1) is not None


def test_silence_counts_from_the_last_echo() -> None:
    made = confirmation("px4", 0x0C3F)
    assert "confirms no setpoint" in str(made.complaint(2 * S))
    made.echo(echo(0x003F), 2 * S)
    assert made.complaint(3 * S) is None
    assert "confirms no setpoint" in str(made.complaint(3 * S + 1))


def test_any_setpoint_of_the_last_second_is_ours() -> None:
    made = Confirmation(PROFILES["ardupilot"], 0x043F)
    for k in range(101):
        made.sent(frozen([0.1 * k, 0, 0]), k * 20 * MS)
    for k, ours in ((100, True), (51, True), (49, False)):
        before = made.counts["foreign_acceleration"]
        made.echo(echo(0x0C3F, (0.1 * k, 0, 0)), 2 * S)
        assert made.counts["foreign_acceleration"] - before == (not ours)
    made.echo(echo(0x0C3F, (10.0, 0.049, 0)), 2 * S)
    assert made.counts["foreign_acceleration"] == 1
    made.echo(echo(0x0C3F, (10.0, 0.051, 0)), 2 * S)
    assert made.counts["foreign_acceleration"] == 2


def test_three_foreign_accelerations_in_a_row_are_a_second_sender() -> None:
    made = confirmation("px4", 0x0C3F)
    for foreign in (True, True, False, True, True):
        made.echo(echo(0x003F, (9.0, 0, 0) if foreign else (1.0, 2.0, 3.0)), 2 * S)
        assert made.complaint(2 * S) is None
    made.echo(echo(0x003F, (9.0, 0, 0)), 2 * S)
    assert "a second sender?" in str(made.complaint(2 * S))
    made.echo(echo(0x003F), 2 * S)
    assert made.complaint(2 * S) is None


def test_beside_a_velocity_only_an_exact_echo_is_compared() -> None:
    for profile, counted in (("px4", 0), ("ardupilot", 1)):
        made = confirmation(profile, 0x0C07)
        made.echo(echo(0x0C07, (9.0, 0, 0)), 2 * S)
        assert made.counts["foreign_acceleration"] == counted


def test_a_pause_of_the_setpoints_starts_anew() -> None:
    made = confirmation("px4", 0x0C3F)
    made.sent(frozen([0, 0, 0]), 4 * S)
    assert made.complaint(4 * S + 500 * MS) is None
    assert "confirms no setpoint" in str(made.complaint(5 * S + 1))
    made.reset()
    assert made.complaint(9 * S) is None


def test_notices_are_told_once_and_again_after_ten_seconds() -> None:
    told: list[str] = []
    notices = Notices(told.append)
    for second in range(25):
        notices.stand("x", "late" if second % 2 else None, second * S)
        notices.stand("y", "early", second * S)
    assert told == ["early", "late", "late", "late"]  # at 1, 11 and 21 s
    assert notices.counts == {"x": 12, "y": 1}
    notices.stand("x", "late", 25 * S)
    notices.stand("x", "very late", 26 * S)
    assert notices.standing == ("early", "very late")
    assert notices.counts["x"] == 13
    for second in range(30, 35):
        notices.happened("z", "jump", second * S)
    assert told.count("jump") == 1
    assert notices.counts["z"] == 5


def test_streams_are_asked_for_until_they_come_and_when_they_stop() -> None:
    asked: list[tuple[int, int, float]] = []
    now_ns = 0
    streams = StreamRequests(lambda message, hz: asked.append((now_ns // MS, message, hz)))
    wanted = {32: 50.0, 245: 2.0}
    stopped: set[tuple[int, int]] = set()
    for step in range(121):
        now_ns = step * 100 * MS
        if 4.5 * S < now_ns < 8 * S:
            streams.heard(32, now_ns)
        if step % 5 == 0 and now_ns < 8 * S:
            streams.heard(245, now_ns)
        stopped |= {(message, now_ns // MS) for message in streams.poll(wanted, now_ns, now_ns - 50 * MS)}
    assert [(at, hz) for at, message, hz in asked if message == 32] == [
        (0, 50.0),
        (2000, 50.0),
        (4000, 50.0),
        (9000, 50.0),  # a second after the last at 7.9 s
        (11000, 50.0),
    ]
    assert [at for at, message, _ in asked if message == 245] == [0, 9100, 11100]  # three periods after 7.5 s
    assert min(at for message, at in stopped if message == 32) == 9000
    assert min(at for message, at in stopped if message == 245) == 9100


def test_a_link_that_is_gone_is_not_a_stream_that_stopped() -> None:
    streams = StreamRequests(lambda message, hz: None)
    streams.heard(32, 10 * S)
    wanted = {32: 50.0}
    assert streams.poll(wanted, 12 * S, 10 * S + 30 * MS) == set()
    assert streams.poll(wanted, 12 * S, None) == set()
    assert streams.poll(wanted, 12 * S, 10 * S + 50 * MS) == {32}


def at(t_ns: int, p: list[float], v: list[float], counter: int | None = None, std: float = 0.0) -> VehicleState:
    return VehicleState(t_ns, frozen(p), frozen(v), p_std_m=std, reset_counter=counter)


def test_origins_move_by_what_was_not_flown() -> None:
    watch = OriginWatch()
    assert watch.moved_m(at(0, [0, 0, 2], [10, 0, 0])) is None
    assert watch.moved_m(at(100 * MS, [1, 0, 2], [10, 0, 0])) is None
    assert watch.moved_m(at(400 * MS, [4, 0.99, 2], [10, 0, 0])) is None
    assert watch.moved_m(at(500 * MS, [5, 2.0, 2], [10, 0, 0])) == pytest.approx(1.01)
    assert watch.moved_m(at(900 * MS, [9, 2.0, 2], [10, 0, 0])) is None  # the new origin is the origin
    assert watch.moved_m(at(1500 * MS, [19, 2.0, 2], [10, 0, 0])) is None  # too long ago to tell
    watch.reset()
    assert watch.moved_m(at(1600 * MS, [-50, 0, 2], [0, 0, 0])) is None


def test_braking_hard_is_flying() -> None:
    watch = OriginWatch()
    for k in range(11):  # 8 m/s to rest in a second, at 8 m/s^2
        t = 0.1 * k
        moved = watch.moved_m(at(round(t * S), [8 * t - 4 * t * t, 0, 0], [8 - 8 * t, 0, 0]))
        assert moved is None


def test_noise_of_the_estimate_is_no_jump() -> None:
    rng = np.random.default_rng(3)
    watch = OriginWatch()
    for k in range(2000):
        state = at(k * 50 * MS, list(rng.normal(0.0, 0.5, 3)), [0, 0, 0], std=0.5)
        assert watch.moved_m(state) is None


def test_the_counter_tells_whatever_the_distance() -> None:
    watch = OriginWatch()
    counters = [None, 3, None, 3, 4, None, 4, 0]
    moved = [watch.moved_m(at(k * 50 * MS, [0, 0, 0], [0, 0, 0], n)) for k, n in enumerate(counters)]
    assert moved == [None, None, None, None, 0.0, None, None, 0.0]
