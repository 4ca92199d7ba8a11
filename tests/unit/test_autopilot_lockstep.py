"""Lockstep's bookkeeping and the judge, without sockets."""

from __future__ import annotations

import math

import pytest

from sim_bridge.judge import Judge, distance_to_segment
from sim_bridge.lockstep import Answer, Desk, Offer
from sim_bridge.mavlink import Packet
from sim_bridge.messages import Command, Sender
from sim_bridge.scenario import End, OperatorStep

T = 1_250_000_000
KEY = "uav/uav1/companion/setpoint"
GCS = Sender(245, 190)
S = 1_000_000_000


def test_an_answer_needs_its_record_and_what_the_record_promises() -> None:
    answer = Answer(T, KEY)
    assert KEY in answer.missing()
    assert str(T) in answer.missing()
    answer.record(T - 50_000_000, sent=True, messages=0)  # of another tick
    assert not answer.complete
    answer.record(T, sent=True, messages=2)
    assert "time_boot_ms 1250" in answer.missing()
    assert "0 of 2" in answer.missing()
    answer.packet(84, 196, 1200)  # another tick's setpoint
    answer.packet(84, 190, 1250)  # another component's
    answer.packet(0, 196, None)  # heartbeats do not count
    answer.packet(76, 196, None)
    assert not answer.complete
    answer.packet(84, 196, 1250)
    assert "1 of 2" in answer.missing()
    answer.packet(77, 196, None)
    assert answer.complete


def test_the_messages_may_come_before_the_record() -> None:
    answer = Answer(T, KEY)
    answer.packet(84, 196, 1250)
    answer.packet(76, 196, None)
    assert not answer.complete
    answer.record(T, sent=True, messages=1)
    assert answer.complete


def test_a_tick_that_sends_nothing_is_answered_by_its_record_alone() -> None:
    answer = Answer(T, KEY)
    answer.record(T, sent=False, messages=0)
    assert answer.complete


def offer(number: int, *params: float, component: int = 1, sender: Sender = GCS) -> Offer:
    command = Command(number, (*params, *[math.nan] * (7 - len(params))), sender, 1, component)
    return Offer(command, Packet(b"", 76, sender, Sender(1, component), command))


STEPS = (
    OperatorStep(do="arm", at_tick=0),
    OperatorStep(do="takeoff", at_tick=1),
    OperatorStep(do="engage", after="airborne_hover"),
    OperatorStep(do="hold", at_tick=900),
    OperatorStep(do="arm", at_tick=1000),
)


def test_commands_before_their_tick_are_kept_and_applied_in_the_order_of_the_steps() -> None:
    desk = Desk(STEPS)
    engage = offer(92, 1.0, component=196)
    assert desk.take(engage) == b""
    assert desk.ready() is None  # arm comes first
    arm = offer(400, 1.0)
    assert desk.take(arm) == b""
    assert desk.ready() is arm
    desk.done(b"armed")
    assert desk.next_step == STEPS[1]
    assert desk.ready() is None
    assert desk.take(offer(22)) == b""
    desk.done(b"up")
    assert desk.ready() is engage


def test_repetitions_are_answered_again_and_not_kept_twice() -> None:
    desk = Desk(STEPS)
    desk.take(offer(400, 1.0))
    assert desk.take(offer(400, 1.0)) == b""  # while its tick has not come: silence, NaN parameters and all
    desk.done(b"armed")
    assert desk.take(offer(400, 1.0)) == b"armed"
    for number, component in ((22, 1), (92, 196)):
        desk.take(offer(number, 1.0, component=component))
        desk.done(b"done")
    desk.take(offer(176, 1.0, 4.0, 3.0))
    desk.done(b"held")
    assert desk.take(offer(400, 1.0)) == b""  # now it is the last step's
    assert desk.ready() is not None


@pytest.mark.parametrize(
    "other",
    [
        offer(400, 0.0),
        offer(511, 30.0),
        offer(92, 0.0, component=196),
        offer(92, 1.0, component=1),
        offer(176, 1.0, 6.0),
    ],
)
def test_what_is_no_step_is_not_kept(other: Offer) -> None:
    assert Desk(STEPS).take(other) is None


@pytest.mark.parametrize(
    ("point", "distance_m", "share"),
    [
        ((0.0, 2.0, 0.0), 2.0, 0.5),
        ((3.0, 0.0, 0.0), 2.0, 1.0),
        ((-1.0, 0.0, 0.0), 0.0, 0.0),
        ((-2.0, 0.0, 0.0), 1.0, 0.0),
    ],
)
def test_distance_to_segment(point: tuple[float, float, float], distance_m: float, share: float) -> None:
    assert distance_to_segment(point, (-1.0, 0.0, 0.0), (1.0, 0.0, 0.0)) == (distance_m, share)
    assert distance_to_segment(point, point, point) == (0.0, 0.0)


def judge(*, timeout_s: float = 60.0) -> Judge:
    end = End(timeout_s=timeout_s)
    return Judge(
        end, (5.0, 0.0, 1.0), start_ns=S, p_enu=(0.0, 0.0, 1.0), radius_m=0.2, ids=["a", "b"], radii_m=[0.2, 0.3]
    )


def fly(judged: Judge, x_m: float, t_s: float, clearance_m: float = 1.0, *, grounded: bool = False) -> str | None:
    t_ns = round(t_s * S)
    judged.step(t_ns, (x_m, 0.0, 1.0), clearance_m, grounded=grounded)
    return judged.verdict(t_ns)


def test_reached_on_the_segment_then_three_seconds_near() -> None:
    judged = judge()
    fly(judged, 4.0, 2.0)
    # passes the target in the middle of this step, 0.2 m beyond at its end
    assert fly(judged, 5.2, 2.012) is None
    assert fly(judged, 5.2, 5.0) is None
    assert fly(judged, 5.0, 5.011) == "reached"
    assert judged.flight_time_s == pytest.approx(1.0 + 0.012 / 1.2)
    assert judged.collided_ns is None


def test_flying_through_is_not_reaching() -> None:
    judged = judge()
    fly(judged, 4.0, 2.0)
    fly(judged, 5.2, 2.1)
    fly(judged, 5.4, 2.2)  # out of 0.3 m
    fly(judged, 5.2, 2.3)  # back within it, but not within 0.1 m
    assert fly(judged, 5.2, 9.0) is None
    assert judged.flight_time_s is None
    fly(judged, 5.05, 9.5)
    assert fly(judged, 5.05, 12.6) == "reached"
    assert judged.flight_time_s == pytest.approx(8.5, abs=0.5)


def test_collisions_end_the_flight_a_second_later_and_stay_collisions() -> None:
    judged = judge()
    assert fly(judged, 1.0, 1.5, 0.001) is None
    assert judged.collided_ns is None
    assert fly(judged, 1.1, 1.6, 0.0) is None
    assert fly(judged, 1.2, 1.7, 0.5) is None
    assert fly(judged, 1.3, 2.6, 2.0) == "collision"
    assert judged.min_clearance_m == 0.0
    grounded = judge()
    fly(grounded, 1.0, 1.5, grounded=True)
    assert fly(grounded, 1.0, 2.5) == "collision"


def test_timeout_and_closest_approaches() -> None:
    judged = judge(timeout_s=2.0)
    for t_s, x_m in ((1.5, 1.0), (2.0, 2.0), (2.5, 3.0)):
        judged.approach(round(t_s * S), (x_m, 0.0, 1.0), [(2.0, 1.0, 1.0), (9.0, 0.0, 1.0)])
        assert fly(judged, x_m, t_s) is None
    assert fly(judged, 3.5, 3.0) == "timeout"
    near, far = judged.approaches
    assert near is not None
    assert far is not None
    assert (near.id, near.t_s, near.clearance_m) == ("a", 1.0, pytest.approx(0.6))
    assert (far.id, far.t_s, far.clearance_m) == ("b", 1.5, pytest.approx(5.5))
    assert near.p_enu == (2.0, 0.0, 1.0)
    assert near.p_obstacle_enu == (2.0, 1.0, 1.0)
