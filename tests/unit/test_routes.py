"""The routing table and the addresses in packets, against the MAVLink guide and pymavlink's packer."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.link.routes import MAX_ADDRESSES, Routes, target_of

AUTOPILOT, GIMBAL, GCS, NEIGHBOUR = (1, 1), (1, 154), (255, 190), (2, 1)


@pytest.fixture
def table() -> Routes:
    """The autopilot on link 0, a gimbal of ours on 1, a ground station and a neighbour behind 2."""
    table = Routes(4)
    for link, address in [(0, AUTOPILOT), (1, GIMBAL), (2, GCS), (2, NEIGHBOUR)]:
        table.learn(link, address)
    return table


@pytest.mark.parametrize(
    ("came_on", "target", "goes_to"),
    [
        (0, (0, 0), (1, 2, 3)),  # broadcast: everywhere but back, to link 3 too, where nobody was heard
        (2, (0, 1), (0, 1, 3)),  # no system named: a broadcast, whatever the component
        (2, (1, 0), (0, 1)),  # all of our system
        (2, (1, 1), (0,)),
        (2, (1, 154), (1,)),
        (2, (1, 99), ()),  # a component of our system that was never heard
        (0, (255, 190), (2,)),
        (0, (255, 1), (2,)),  # within other systems components do not count
        (2, (2, 1), ()),  # heard on the link it came from: they reach each other without us
        (0, (2, 77), (2,)),
        (0, (9, 1), ()),  # nobody heard
        (1, (1, 1), (0,)),
    ],
)
def test_rules_of_the_guide(table: Routes, came_on: int, target: tuple[int, int], goes_to: tuple[int, ...]) -> None:
    assert table.onward(came_on, target, vehicle=1) == goes_to


def test_who_is_heard_on_two_links_is_reached_on_both(table: Routes) -> None:
    table.learn(0, GCS)  # by radio through the autopilot, too
    assert table.to(GCS, vehicle=1) == (0, 2)
    assert table.onward(0, GCS, vehicle=1) == (2,)


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(1, 255), st.integers(1, 255))), st.data())
def test_nothing_goes_back_or_where_nobody_is(heard: list[tuple[int, int, int]], data: st.DataObject) -> None:
    table = Routes(4)
    for link, system, component in heard:
        table.learn(link, (system, component))
    target = data.draw(st.tuples(st.integers(0, 255), st.integers(0, 255)))
    came_on = data.draw(st.integers(0, 3))
    goes_to = table.onward(came_on, target, vehicle=1)
    assert came_on not in goes_to
    assert len(set(goes_to)) == len(goes_to)
    if target[0] != 0:
        assert set(goes_to) <= {link for link, system, _ in heard if system == target[0]}


def test_a_flood_of_senders_is_bounded_and_spares_who_speaks(table: Routes) -> None:
    for number in range(10 * MAX_ADDRESSES):
        table.learn(3, (3 + number % 200, 1 + number // 200))
        if number % 100 == 0:
            table.learn(0, AUTOPILOT)
        assert table.to(AUTOPILOT, vehicle=1) == (0,)
    assert len(table._heard) == MAX_ADDRESSES


def _message(kind: Any, **named: int) -> Any:
    """A message of ``kind`` with zeros in every other field."""
    values = []
    for name, type_name in zip(kind.fieldnames, kind.fieldtypes, strict=True):
        length = kind.array_lengths[kind.ordered_fieldnames.index(name)]
        zero: Any = b"" if type_name == "char" else [0] * length if length else 0
        values.append(named.get(name, zero))
    return kind(*values)


@pytest.mark.parametrize("kind", dialect.mavlink_map.values(), ids=lambda kind: kind.msgname)
def test_the_target_is_found_in_every_message_of_the_dialect(kind: Any) -> None:
    mav = dialect.MAVLink(None, 1, 1)
    named = [name for name in ("target_system", "target_component") if name in kind.fieldnames]
    expected = (77 if named else 0, 88 if len(named) == 2 else 0)
    packet = _message(kind, target_system=77, target_component=88).pack(mav)
    assert target_of(packet) == expected
    assert target_of(_message(kind).pack(mav)) == (0, 0)  # zeros at the end are cut off


def test_an_unknown_message_speaks_to_all() -> None:
    assert target_of(b"\xfd\x02\x00\x00\x00\x01\x01\xaa\xaa\xaa\x05\x06\x00\x00") == (0, 0)
