"""The parameter protocol through the codec's bytes, with pymavlink as a plain ground station."""

from __future__ import annotations

import math
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.link.mavlink import MavlinkCodec
from companion.link.params import BURST, EVERY_NS, ParameterServer

S = 1_000_000_000
NAMES = tuple(f"P{number:02d}" for number in range(19))


class Rig:
    """A server with nineteen values behind a codec of system 1, and a ground station 255/190."""

    def __init__(self) -> None:
        self.held = {name: float(index) for index, name in enumerate(NAMES)}
        self.refused: list[str] = []
        self.codec = MavlinkCodec(system=1)
        self.server = ParameterServer(NAMES, read=self.held.__getitem__, write=self._write, refused=self.refused.append)
        self.station = dialect.MAVLink(None, 255, 190)
        self.now_ns = 0

    def _write(self, name: str, value: float) -> str | None:
        if not 0.0 <= value <= 100.0:
            return f"{name}: out of range"
        self.held[name] = value
        return None

    def send(self, message: Any) -> None:
        for event in self.codec.receive(message.pack(self.station)):
            self.server.handle(event)  # type: ignore[arg-type]

    def answers(self, seconds: float = 5.0, *, every_s: float = 0.05) -> list[Any]:
        found: list[Any] = []
        for _ in range(round(seconds / every_s)):
            self.now_ns += round(every_s * S)
            for message in self.server.take(self.now_ns):
                found += self.station.parse_buffer(self.codec.encode(message)) or []
        return found

    def request_list(self, system: int = 1, component: int = 196) -> None:
        self.send(self.station.param_request_list_encode(system, component))

    def read(self, name: str, index: int = -1) -> None:
        self.send(self.station.param_request_read_encode(1, 196, name.encode(), index))

    def set(self, name: str, value: float, kind: int = 9, *, system: int = 1, component: int = 196) -> None:
        self.send(self.station.param_set_encode(system, component, name.encode(), value, kind))


@pytest.fixture
def rig() -> Rig:
    return Rig()


def test_the_list_is_complete_and_in_order(rig: Rig) -> None:
    rig.request_list()
    values = rig.answers()
    assert [m.param_index for m in values] == list(range(19))
    assert {m.param_count for m in values} == {19}
    assert {m.param_type for m in values} == {dialect.MAV_PARAM_TYPE_REAL32}
    assert {m.param_id: m.param_value for m in values} == rig.held
    assert {(m.get_srcSystem(), m.get_srcComponent()) for m in values} == {(1, 196)}
    assert rig.answers() == []


def test_the_list_is_paced_whoever_polls(rig: Rig) -> None:
    rig.request_list()
    assert len(rig.answers(0.001, every_s=0.001)) == BURST  # the first wake
    assert len(rig.answers(0.2, every_s=0.001)) == pytest.approx(0.2 * S / EVERY_NS, abs=1)
    rig.answers()
    rig.request_list()
    rig.now_ns += 60 * S
    assert len(rig.server.take(rig.now_ns)) == BURST  # a long sleep saves nothing up


def test_a_clock_that_goes_back_gives_nothing_away(rig: Rig) -> None:
    rig.request_list()
    rig.answers(0.05)
    assert rig.server.take(rig.now_ns - 10 * S) == []
    assert len(rig.answers(5.0)) == 19 - BURST


def test_a_list_asked_for_again_and_again_is_sent_once(rig: Rig) -> None:
    for _ in range(1000):
        rig.request_list()
    assert len(rig.answers()) == 19


def test_reads_by_name_and_by_index(rig: Rig) -> None:
    rig.read("P07")
    rig.read("ignored", 3)
    rig.read("P01", 0)  # an index counts before a name
    assert [(m.param_id, m.param_value, m.param_index) for m in rig.answers()] == [
        ("P07", 7.0, 7),
        ("P03", 3.0, 3),
        ("P00", 0.0, 0),
    ]


def test_a_reader_does_not_wait_for_the_list(rig: Rig) -> None:
    rig.request_list()
    rig.read("P18")
    names = [m.param_id for m in rig.answers()]
    assert names == ["P18", *NAMES[:18]]


@pytest.mark.parametrize(("name", "index"), [("P19", -1), ("", -1), ("p07", -1), ("P00", 19), ("P00", 32767)])
def test_what_does_not_exist_gets_no_answer(rig: Rig, name: str, index: int) -> None:
    rig.read(name, index)
    if index < 0:
        rig.set(name, 1.0)
    assert rig.answers() == []
    assert rig.refused == []


def test_a_name_of_sixteen_characters_needs_no_terminator() -> None:
    rig = Rig()
    name = "ABCDEFGHIJKLMNOP"
    server = ParameterServer([name], read=lambda _: 2.5, write=lambda n, v: None, refused=rig.refused.append)
    rig.server = server
    rig.read(name)
    assert [(m.param_id, m.param_value) for m in rig.answers()] == [(name, 2.5)]


def test_set_answers_with_the_new_value(rig: Rig) -> None:
    rig.set("P05", 50.5)
    assert [(m.param_id, m.param_value) for m in rig.answers()] == [("P05", 50.5)]
    assert rig.held["P05"] == 50.5


@pytest.mark.parametrize("value", [-1.0, 101.0, math.nan, math.inf])
def test_a_refused_set_answers_with_the_old_value_and_a_reason(rig: Rig, value: float) -> None:
    rig.set("P05", value)
    assert [(m.param_id, m.param_value) for m in rig.answers()] == [("P05", 5.0)]
    assert rig.refused == ["P05: out of range"]


def test_another_type_is_refused_because_its_bytes_mean_something_else(rig: Rig) -> None:
    rig.set("P05", 1.4e-45, dialect.MAV_PARAM_TYPE_INT32)  # the integer 1, bytewise
    assert [m.param_value for m in rig.answers()] == [5.0]
    assert rig.refused == ["P05: expected MAV_PARAM_TYPE_REAL32 (9), got type 6"]


@pytest.mark.parametrize(
    ("system", "component", "answered"),
    [(0, 0, True), (1, 0, True), (1, 196, True), (0, 196, True), (1, 1, False), (2, 196, False), (2, 0, False)],
)
def test_targets(rig: Rig, system: int, component: int, answered: bool) -> None:
    rig.request_list(system, component)
    rig.set("P05", 9.0, system=system, component=component)
    rig.send(rig.station.param_request_read_encode(system, component, b"P06", -1))
    assert bool(rig.answers()) is answered
    assert rig.held["P05"] == (9.0 if answered else 5.0)


def test_a_name_that_is_no_text_is_no_name(rig: Rig) -> None:
    packet = bytearray(rig.station.param_request_read_encode(1, 196, b"P07", -1).pack(rig.station))
    message = dialect.MAVLink_param_request_read_message(1, 196, bytes(range(0xF0, 0x100)), -1)
    rig.send(message)
    assert rig.answers() == []
    assert packet  # the codec took both
