"""The state table, every cell."""

from __future__ import annotations

from dataclasses import replace

import pytest

from companion.state import TABLE, Event, Situation, State, advance, refusal


def at(state: State, **facts: bool) -> Situation:
    return replace(Situation(state, "", fresh=True), **facts)


def run(situation: Situation, event: Event, by: str = "command") -> State:
    return advance(situation, event, engage_by=by).state


def test_the_table_has_every_cell() -> None:
    assert set(TABLE) == set(State)
    for row in TABLE.values():
        assert set(row) == set(Event)


ENGAGED = {"engaged": True, "external": True, "airborne": True}

# (state, facts before, event, state after), written from the design's prose: one row for every cell
CELLS = [
    (State.WAITING, {"fresh": False}, Event.VEHICLE_FRESH, State.READY),
    (State.WAITING, {"fresh": False}, Event.VEHICLE_LOST, State.WAITING),
    (State.WAITING, {"fresh": False}, Event.ENGAGE, State.WAITING),
    (State.WAITING, {"fresh": False}, Event.RELEASE, State.WAITING),
    (State.WAITING, {"fresh": False}, Event.ENGAGE_TIMEOUT, State.WAITING),
    (State.WAITING, {"fresh": False}, Event.EXTERNAL_ON, State.WAITING),
    (State.WAITING, {"fresh": False}, Event.EXTERNAL_OFF, State.WAITING),
    (State.WAITING, {"fresh": False}, Event.AIRBORNE, State.WAITING),
    (State.WAITING, {"fresh": False}, Event.LANDED, State.WAITING),
    (State.WAITING, {"fresh": False}, Event.DISARMED, State.WAITING),
    (State.WAITING, {"fresh": False}, Event.DEGRADED, State.WAITING),
    (State.WAITING, {"fresh": False}, Event.RECOVERED, State.WAITING),
    (State.WAITING, {"fresh": False}, Event.BRAIN_FAILED, State.FAULT),
    (State.READY, {}, Event.VEHICLE_FRESH, State.READY),
    (State.READY, ENGAGED, Event.VEHICLE_LOST, State.WAITING),
    (State.READY, {"external": True, "airborne": True}, Event.ENGAGE, State.ACTIVE),
    (State.READY, {"engaged": True}, Event.RELEASE, State.READY),
    (State.READY, {"engaged": True}, Event.ENGAGE_TIMEOUT, State.READY),
    (State.READY, {"engaged": True, "airborne": True}, Event.EXTERNAL_ON, State.ACTIVE),
    (State.READY, {"external": True}, Event.EXTERNAL_OFF, State.READY),
    (State.READY, {"engaged": True, "external": True}, Event.AIRBORNE, State.ACTIVE),
    (State.READY, {"airborne": True}, Event.LANDED, State.READY),
    (State.READY, {"engaged": True}, Event.DISARMED, State.READY),
    (State.READY, {}, Event.DEGRADED, State.READY),
    (State.READY, {"degraded": True}, Event.RECOVERED, State.READY),
    (State.READY, {}, Event.BRAIN_FAILED, State.FAULT),
    (State.ACTIVE, ENGAGED, Event.VEHICLE_FRESH, State.ACTIVE),
    (State.ACTIVE, ENGAGED, Event.VEHICLE_LOST, State.WAITING),
    (State.ACTIVE, ENGAGED, Event.ENGAGE, State.ACTIVE),
    (State.ACTIVE, ENGAGED, Event.RELEASE, State.ACTIVE),
    (State.ACTIVE, ENGAGED, Event.ENGAGE_TIMEOUT, State.ACTIVE),
    (State.ACTIVE, ENGAGED, Event.EXTERNAL_ON, State.ACTIVE),
    (State.ACTIVE, ENGAGED, Event.EXTERNAL_OFF, State.OVERRIDDEN),
    (State.ACTIVE, ENGAGED, Event.AIRBORNE, State.ACTIVE),
    (State.ACTIVE, ENGAGED, Event.LANDED, State.READY),
    (State.ACTIVE, ENGAGED, Event.DISARMED, State.READY),
    (State.ACTIVE, ENGAGED, Event.DEGRADED, State.HOLD),
    (State.ACTIVE, ENGAGED, Event.RECOVERED, State.ACTIVE),
    (State.ACTIVE, ENGAGED, Event.BRAIN_FAILED, State.FAULT),
    (State.HOLD, ENGAGED, Event.VEHICLE_FRESH, State.HOLD),
    (State.HOLD, ENGAGED, Event.VEHICLE_LOST, State.WAITING),
    (State.HOLD, ENGAGED, Event.ENGAGE, State.HOLD),
    (State.HOLD, ENGAGED, Event.RELEASE, State.HOLD),
    (State.HOLD, ENGAGED, Event.ENGAGE_TIMEOUT, State.HOLD),
    (State.HOLD, ENGAGED, Event.EXTERNAL_ON, State.HOLD),
    (State.HOLD, ENGAGED, Event.EXTERNAL_OFF, State.OVERRIDDEN),
    (State.HOLD, ENGAGED, Event.AIRBORNE, State.HOLD),
    (State.HOLD, ENGAGED, Event.LANDED, State.READY),
    (State.HOLD, ENGAGED, Event.DISARMED, State.READY),
    (State.HOLD, ENGAGED, Event.DEGRADED, State.HOLD),
    (State.HOLD, {**ENGAGED, "degraded": True}, Event.RECOVERED, State.ACTIVE),
    (State.HOLD, ENGAGED, Event.BRAIN_FAILED, State.FAULT),
    (State.OVERRIDDEN, {}, Event.VEHICLE_FRESH, State.OVERRIDDEN),
    (State.OVERRIDDEN, {}, Event.VEHICLE_LOST, State.OVERRIDDEN),
    (State.OVERRIDDEN, {"airborne": True}, Event.ENGAGE, State.READY),
    (State.OVERRIDDEN, {}, Event.RELEASE, State.OVERRIDDEN),
    (State.OVERRIDDEN, {}, Event.ENGAGE_TIMEOUT, State.OVERRIDDEN),
    (State.OVERRIDDEN, {"airborne": True}, Event.EXTERNAL_ON, State.OVERRIDDEN),
    (State.OVERRIDDEN, {"external": True}, Event.EXTERNAL_OFF, State.OVERRIDDEN),
    (State.OVERRIDDEN, {}, Event.AIRBORNE, State.OVERRIDDEN),
    (State.OVERRIDDEN, {"airborne": True}, Event.LANDED, State.OVERRIDDEN),
    (State.OVERRIDDEN, {}, Event.DISARMED, State.READY),
    (State.OVERRIDDEN, {}, Event.DEGRADED, State.OVERRIDDEN),
    (State.OVERRIDDEN, {"degraded": True}, Event.RECOVERED, State.OVERRIDDEN),
    (State.OVERRIDDEN, {}, Event.BRAIN_FAILED, State.FAULT),
    (State.FAULT, {}, Event.VEHICLE_FRESH, State.FAULT),
    (State.FAULT, {}, Event.VEHICLE_LOST, State.FAULT),
    (State.FAULT, {}, Event.ENGAGE, State.FAULT),
    (State.FAULT, {}, Event.RELEASE, State.FAULT),
    (State.FAULT, {}, Event.ENGAGE_TIMEOUT, State.FAULT),
    (State.FAULT, {"airborne": True}, Event.EXTERNAL_ON, State.FAULT),
    (State.FAULT, {"external": True}, Event.EXTERNAL_OFF, State.FAULT),
    (State.FAULT, {}, Event.AIRBORNE, State.FAULT),
    (State.FAULT, {}, Event.LANDED, State.FAULT),
    (State.FAULT, {}, Event.DISARMED, State.READY),
    (State.FAULT, {}, Event.DEGRADED, State.FAULT),
    (State.FAULT, {}, Event.RECOVERED, State.FAULT),
    (State.FAULT, {}, Event.BRAIN_FAILED, State.FAULT),
]


def test_the_cells_below_are_all_the_cells() -> None:
    assert {(state, event) for state, _, event, _ in CELLS} == {(s, e) for s in State for e in Event}


@pytest.mark.parametrize(("state", "facts", "event", "after"), CELLS, ids=lambda x: str(x)[:24])
def test_cell(state: State, facts: dict[str, bool], event: Event, after: State) -> None:
    assert run(at(state, **facts), event) is after


@pytest.mark.parametrize(
    ("facts", "event"),
    [
        ({"external": True, "airborne": False}, Event.ENGAGE),
        ({"external": False, "airborne": True}, Event.ENGAGE),
        ({"external": True, "engaged": False}, Event.AIRBORNE),
        ({"engaged": True, "airborne": False}, Event.EXTERNAL_ON),
    ],
)
def test_active_needs_latch_and_mode_and_flight(facts: dict[str, bool], event: Event) -> None:
    assert run(at(State.READY, **facts), event) is State.READY


def test_degraded_inputs_engage_into_hold() -> None:
    assert run(at(State.READY, external=True, airborne=True, degraded=True), Event.ENGAGE) is State.HOLD


def test_release_is_not_an_override() -> None:
    releasing = advance(at(State.ACTIVE, **ENGAGED), Event.RELEASE, engage_by="command")
    assert releasing.state is State.ACTIVE  # the stream goes on until the mode is seen to change
    after = advance(releasing, Event.EXTERNAL_OFF, engage_by="command")
    assert after.state is State.READY
    assert not after.engaged
    assert not after.releasing


def test_a_takeover_drops_the_latch() -> None:
    taken = advance(at(State.ACTIVE, **ENGAGED), Event.EXTERNAL_OFF, engage_by="command")
    assert not taken.engaged
    again = advance(taken, Event.EXTERNAL_ON, engage_by="command")
    assert again.state is State.OVERRIDDEN  # the mode alone does not give it back
    assert advance(again, Event.ENGAGE, engage_by="command").state is State.ACTIVE


def test_mode_switch_engages_and_gives_back() -> None:
    assert run(at(State.READY, airborne=True), Event.EXTERNAL_ON, by="mode_switch") is State.ACTIVE
    assert run(at(State.OVERRIDDEN, airborne=True), Event.EXTERNAL_ON, by="mode_switch") is State.ACTIVE
    assert run(at(State.FAULT, airborne=True), Event.EXTERNAL_ON, by="mode_switch") is State.FAULT


def test_leaving_the_mode_unseen_drops_the_latch() -> None:
    lost = advance(at(State.ACTIVE, **ENGAGED), Event.VEHICLE_LOST, engage_by="command")
    left = advance(lost, Event.EXTERNAL_OFF, engage_by="command")
    assert advance(left, Event.VEHICLE_FRESH, engage_by="command").state is State.READY
    assert advance(lost, Event.VEHICLE_FRESH, engage_by="command").state is State.ACTIVE


def test_refusal_names_state_and_reason() -> None:
    assert refusal(Situation()) == "WAITING: no vehicle"
    assert refusal(at(State.READY)) is None
    assert refusal(replace(at(State.FAULT), reason="brain failed")) == "FAULT: brain failed"


def test_reason_tells_why() -> None:
    assert advance(
        at(State.ACTIVE, **ENGAGED), Event.DEGRADED, engage_by="command", detail="source radar silent"
    ).reason == ("source radar silent")
