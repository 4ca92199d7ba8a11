"""What a channel does to messages, and which state a companion then has to answer."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sim_bridge.delivery import Delivery
from sim_bridge.impairments import Channel, Impairment, Passage, damage_message, message_id, payload, split
from sim_bridge.mavlink import Decoder

MS = 1_000_000
MAV = dialect.MAVLink(None, 1, 1)


class Clock:
    def __init__(self) -> None:
        self.t_ns = 0

    def __call__(self) -> int:
        return self.t_ns


def mark(item: str, rng: np.random.Generator) -> str:
    return f"{item}!{rng.integers(10)}"


def impairment(kind: str, *, share: float = 1.0, delay_ns: int = 0, seed: int = 7) -> Impairment[str]:
    draws = (np.random.default_rng([seed, timed]) for timed in (1, 0))
    return Impairment(kind, share=share, delay_ns=delay_ns, rng=next(draws), wall_rng=next(draws), damage=mark)


def channel(*kinds: Impairment[str]) -> tuple[Channel[str], Clock]:
    clock = Clock()
    return Channel(clock, list(kinds)), clock


def items(passages: list[Passage[str]]) -> str:
    return "".join(passage.item for passage in passages)


def test_without_faults_everything_passes() -> None:
    line, _ = channel()
    assert items(line.pass_on("abc")) == "abc"
    assert line.clear


@pytest.mark.parametrize("kind", ["drop", "duplicate", "delay", "corrupt"])
def test_the_share_is_of_messages_and_the_seed_fixes_which(kind: str) -> None:
    outcomes = []
    for _ in range(2):
        line, clock = channel(impairment(kind, share=0.3, delay_ns=MS))
        out = [len(line.pass_on("x")) for _ in range(2000)]
        clock.t_ns = MS
        outcomes.append((out, len(line.release())))
    assert outcomes[0] == outcomes[1]
    hit = {"drop": Counter(outcomes[0][0])[0], "duplicate": Counter(outcomes[0][0])[2], "delay": outcomes[0][1]}
    assert hit.get(kind, 600) == pytest.approx(600, abs=80)  # four standard deviations
    line, _ = channel(impairment(kind, share=0.3, delay_ns=MS, seed=8))
    assert kind == "corrupt" or [len(line.pass_on("x")) for _ in range(2000)] != outcomes[0][0]


def test_a_late_message_comes_after_its_delay_and_not_before() -> None:
    line, clock = channel(impairment("delay", delay_ns=100 * MS))
    assert line.pass_on("a") == []
    clock.t_ns = 60 * MS
    assert line.pass_on("b") == []
    assert line.release() == []
    clock.t_ns = 100 * MS
    assert items(line.release()) == "a"
    clock.t_ns = 200 * MS
    assert items(line.release()) == "b"
    assert line.release() == []


def test_reordered_messages_change_places_with_the_next_that_is_not() -> None:
    fault = impairment("reorder", share=0.5)
    line, _ = channel(fault)
    sent = "abcdefghijklmnopqrstuvwxyz"
    came = items(line.pass_on(sent))
    line.remove(fault)
    came += items(line.release())
    assert sorted(came) == sorted(sent)
    assert came != sent


def test_a_source_that_is_stuck_repeats_its_first_frame() -> None:
    line, _ = channel(impairment("freeze"))
    assert items(line.pass_on("abc")) == "aaa"


def test_a_cut_link_lets_nothing_through_whatever_it_is() -> None:
    fault = impairment("cut")
    line, _ = channel(fault)
    assert line.pass_on("ab") == []
    assert line.pass_on("ab", timed=False) == []
    line.remove(fault)
    assert items(line.pass_on("ab")) == "ab"


def test_what_the_wall_clock_sends_changes_no_draw_of_the_others() -> None:
    """Otherwise a flight in lockstep would depend on the machine's load."""
    alone, _ = channel(impairment("drop", share=0.5))
    among, _ = channel(impairment("drop", share=0.5))
    expected, came = [], []
    for i in range(200):
        expected.append(len(alone.pass_on("x")))
        if i % 3 == 0:
            among.pass_on("hb", timed=False)
        came.append(len(among.pass_on("x")))
    assert came == expected


def test_faults_act_in_their_order() -> None:
    line, _ = channel(impairment("duplicate"), impairment("drop", share=0.5))
    counts = Counter(len(line.pass_on("x")) for _ in range(1000))
    assert set(counts) == {0, 1, 2}  # each copy is lost by itself


def heartbeat(component: int = 1) -> bytes:
    return bytes(dialect.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3).pack(dialect.MAVLink(None, 1, component)))


def attitude(ms: int) -> bytes:
    return bytes(dialect.MAVLink_attitude_quaternion_message(ms, 1, 0, 0, 0, 0, 0, 0).pack(MAV))


def position(ms: int) -> bytes:
    return bytes(dialect.MAVLink_local_position_ned_message(ms, 1, 2, 3, 0, 0, 0).pack(MAV))


def test_datagrams_are_split_at_messages_signed_ones_too() -> None:
    signed = bytearray(position(50)) + bytes(13)
    signed[2] |= 1
    parts = [heartbeat(), bytes(signed), position(100), b"rubbish"]
    assert split(b"".join(parts)) == parts
    assert [message_id(part) for part in parts] == [0, 32, 32, -1]
    assert payload(position(258))[:2] == b"\x02\x01"


def test_a_damaged_message_is_one_that_fails_its_checksum() -> None:
    rng = np.random.default_rng(1)
    for ms in range(200):
        whole = position(ms)
        hurt = damage_message(whole, rng)
        assert len(hurt) == len(whole)
        assert hurt[:10] == whole[:10]  # the framing holds
        assert sum(a != b for a, b in zip(hurt, whole, strict=True)) == 1
        assert not any(packet.message_id == 32 for packet in Decoder().packets(hurt))


def delivered(delivery: Delivery, *messages: Any) -> int | None:
    return delivery.datagram([m if isinstance(m, Passage) else Passage(m) for m in messages])


def test_a_state_is_owed_once_it_and_what_it_needs_have_arrived() -> None:
    delivery = Delivery()
    assert delivered(delivery, attitude(0), position(0)) is None  # nobody knows the autopilot yet
    assert delivered(delivery, heartbeat(190), attitude(50), position(50)) is None  # a ground station's
    assert delivered(delivery, heartbeat(), position(100)) is None  # no attitude
    assert delivered(delivery, attitude(150)) is None
    assert delivered(delivery, position(150)) == 150 * MS
    assert delivered(delivery, position(150)) is None  # twice
    assert delivered(delivery, position(100)) is None  # late
    assert delivered(delivery, Passage(position(200), intact=False)) is None
    assert delivered(delivery, position(250), position(200)) == 250 * MS
    assert delivered(delivery, position(300), position(350)) == 350 * MS


def test_a_clock_that_falls_back_is_a_reboot_only_beyond_a_second() -> None:
    delivery = Delivery()
    assert delivered(delivery, heartbeat(), attitude(5000), position(5000)) == 5000 * MS
    assert delivered(delivery, attitude(4500), position(4500)) is None
    assert not delivery.rebooted
    assert delivered(delivery, attitude(100), position(100)) == 100 * MS
    assert delivery.rebooted
    assert delivered(delivery, position(150)) is None  # its attitude is of the time before
    assert not delivery.rebooted
    assert delivered(delivery, attitude(200), position(200)) == 200 * MS
