"""The arithmetic of `companion bench wire` on instants written by hand."""

from __future__ import annotations

import pytest

from companion.bench.parsing import traffic
from companion.bench.wire import evaluate, figures
from companion.bench.wire_daemon import Notes
from companion.bench.wire_peer import Seen
from companion.errors import CompanionError
from companion.link.mavlink import MavlinkCodec

MS = 1_000_000


def test_the_wait_for_a_state_message_is_left_out_and_a_missed_one_is_part_of_it() -> None:
    """States go out at 100, 120, 140 and 160 ms; each is answered 1 ms later but for the last."""
    seen = Seen(
        # a: well before 120; b: 0.2 ms before 140, which overtakes it; c: lost on the way; d: never answered
        published=[(1, 105 * MS), (2, 139 * MS + 800_000), (3, 150 * MS), (4, 155 * MS)],
        states={100: 100 * MS, 120: 120 * MS, 140: 140 * MS, 160: 160 * MS, 180: 180 * MS},
        setpoints={100: 101 * MS, 120: 121 * MS, 140: 141 * MS, 160: 161 * MS},
    )
    notes = Notes(
        arrivals_ns=[105 * MS + 300_000, 140 * MS + 100_000, 155 * MS + 300_000],
        stamps_ns=[1, 2, 4],
        taken={0: 120 * MS, 1: 160 * MS, 2: 180 * MS},
    )
    told = evaluate(seen, notes)
    assert (told.frames, told.lost, told.overtaken) == (2, 2, 1)
    # a: 16 ms whole, of which 14.7 waited; b: 21.2 ms whole, of which 19.9 waited
    assert told.whole.max == pytest.approx(21.2)
    assert told.beyond.p50 == pytest.approx(1.3)
    assert told.beyond.max == pytest.approx(1.3)
    assert told.delivery.max == pytest.approx(0.3)
    assert told.answer.max == pytest.approx(1.0)
    assert told.after_next_state.max == pytest.approx(21.0)  # b, from the 140 that overtook it


def test_a_frame_that_comes_during_a_tick_has_not_waited() -> None:
    seen = Seen(published=[(1, 99 * MS)], states={100: 100 * MS}, setpoints={100: 103 * MS})
    notes = Notes(arrivals_ns=[101 * MS], stamps_ns=[1], taken={0: 100 * MS})
    assert evaluate(seen, notes).beyond.max == pytest.approx(4.0)


def test_few_samples_give_no_p99_and_none_is_an_error() -> None:
    seen = Seen(published=[(1, 99 * MS)], states={100: 100 * MS}, setpoints={100: 101 * MS})
    notes = Notes(arrivals_ns=[99 * MS], stamps_ns=[1], taken={0: 100 * MS})
    (figure,) = figures(evaluate(seen, notes))
    assert (figure.limit, figure.met) == (2.0, True)
    with pytest.raises(CompanionError, match="no setpoint knew any frame"):
        evaluate(seen, Notes())


def test_every_message_of_the_traffic_is_parsed_to_one_event() -> None:
    codec = MavlinkCodec()
    assert [len(codec.receive(packet)) for packet in traffic()] == [1] * 200
