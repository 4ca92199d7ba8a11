"""STATUSTEXT: not twice in a row, no flood, nothing lost without a word. Time is counted."""

from __future__ import annotations

from companion.texts import BURST, WAITING, TextGate

S = 1_000_000_000


def texts(gate: TextGate, now_s: float) -> list[str]:
    return [text for _, text in gate.take(round(now_s * S))]


def test_the_same_text_again_is_counted_and_told_when_another_comes() -> None:
    gate = TextGate()
    gate.push(6, "a")
    assert texts(gate, 0.0) == ["a"]
    for number in range(1, 4):
        gate.push(6, "a")
        assert texts(gate, number) == []
    gate.push(6, "b")
    assert texts(gate, 5.0) == ["(repeated 3 times: a)", "b"]
    assert gate.counts == {"repeated": 3}


def test_after_ten_seconds_it_may_come_again() -> None:
    gate = TextGate()
    gate.push(6, "a")
    assert texts(gate, 0.0) == ["a"]
    gate.push(6, "a")
    assert texts(gate, 9.9) == []
    assert texts(gate, 10.0) == ["(repeated 1 times: a)"]  # told though nothing else came
    gate.push(6, "a")
    assert texts(gate, 10.5) == ["a"]


def test_with_another_between_it_is_sent_again() -> None:
    gate = TextGate()
    for text in ("a", "b", "a"):
        gate.push(6, text)
    assert texts(gate, 0.0) == ["a", "b", "a"]
    assert gate.counts == {}


def test_repeats_while_it_waits_are_counted_for_the_right_text() -> None:
    gate = TextGate()
    for text in ("a", "a", "b", "b", "b", "c"):
        gate.push(6, text)
    assert texts(gate, 0.0) == ["a", "(repeated 1 times: a)", "b", "(repeated 2 times: b)", "c"]


def test_a_flood_is_two_a_second_and_what_is_dropped_is_told() -> None:
    gate = TextGate()
    sent: list[str] = []
    pushed = 0
    for tick in range(200):  # 20 a second for ten seconds
        gate.push(6, f"text {tick}")
        pushed += 1
        sent += texts(gate, 0.05 * tick)
    assert len(sent) <= BURST + 20
    while more := texts(gate, 10.0 + len(sent)):
        sent += more
    told = [text for text in sent if "dropped" in text]
    assert len(told) == 1
    assert len(sent) - 1 + gate.counts["dropped"] == pushed
    assert told == [f"companion: {gate.counts['dropped']} texts dropped"]


def test_the_severe_ones_stay() -> None:
    gate = TextGate()
    gate.push(2, "the daemon failed")
    for number in range(3 * WAITING):
        gate.push(6, f"noise {number}")
    gate.push(7, "less than noise")
    kept = [text for second in range(60) for text in texts(gate, float(second))]
    assert kept[0] == "the daemon failed"
    assert "less than noise" not in kept
    assert f"noise {3 * WAITING - 1}" in kept  # of equals the newest stay
    assert "noise 0" not in kept
