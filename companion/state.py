"""The state machine of the daemon as one table: every state by every event (design 4).

An event first updates the facts (engaged latch, external mode, airborne, ...), then the table's cell names the next
state: a state, ``STAY``, or ``SETTLE``, which derives it from the facts. Pure: no clock, no I/O.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from types import MappingProxyType


class State(StrEnum):
    WAITING = "WAITING"
    READY = "READY"
    ACTIVE = "ACTIVE"
    HOLD = "HOLD"
    OVERRIDDEN = "OVERRIDDEN"
    FAULT = "FAULT"


class Event(StrEnum):
    VEHICLE_FRESH = "vehicle fresh"  # heartbeat and a fresh state are there
    VEHICLE_LOST = "vehicle lost"
    ENGAGE = "engage"  # an operator's command
    RELEASE = "release"
    ENGAGE_TIMEOUT = "engage timeout"  # the autopilot did not enter its external mode
    EXTERNAL_ON = "external mode entered"  # PX4 OFFBOARD, ArduPilot GUIDED, seen in the heartbeat
    EXTERNAL_OFF = "external mode left"
    AIRBORNE = "airborne"
    LANDED = "landed"
    DISARMED = "disarmed"
    DEGRADED = "degraded"  # required source silent, policy output invalid, time base lost
    RECOVERED = "recovered"
    BRAIN_FAILED = "brain failed"


class Rule(StrEnum):
    STAY = "stay"
    SETTLE = "settle"


@dataclass(frozen=True, slots=True)
class Situation:
    """State and the facts it is derived from."""

    state: State = State.WAITING
    reason: str = "no vehicle"
    fresh: bool = False
    engaged: bool = False  # the latch
    external: bool = False
    airborne: bool = False
    degraded: bool = False
    releasing: bool = False  # hold mode asked for, its heartbeat not yet seen


_S, _R = Rule.STAY, Rule.SETTLE

TABLE: Mapping[State, Mapping[Event, State | Rule]] = MappingProxyType(
    {
        State.WAITING: {
            Event.VEHICLE_FRESH: _R,
            Event.VEHICLE_LOST: _S,
            Event.ENGAGE: _S,
            Event.RELEASE: _S,
            Event.ENGAGE_TIMEOUT: _S,
            Event.EXTERNAL_ON: _S,
            Event.EXTERNAL_OFF: _S,
            Event.AIRBORNE: _S,
            Event.LANDED: _S,
            Event.DISARMED: _S,
            Event.DEGRADED: _S,
            Event.RECOVERED: _S,
            Event.BRAIN_FAILED: State.FAULT,
        },
        State.READY: {
            Event.VEHICLE_FRESH: _S,
            Event.VEHICLE_LOST: State.WAITING,
            Event.ENGAGE: _R,
            Event.RELEASE: _R,
            Event.ENGAGE_TIMEOUT: _R,
            Event.EXTERNAL_ON: _R,
            Event.EXTERNAL_OFF: _S,
            Event.AIRBORNE: _R,
            Event.LANDED: _S,
            Event.DISARMED: _R,
            Event.DEGRADED: _S,
            Event.RECOVERED: _S,
            Event.BRAIN_FAILED: State.FAULT,
        },
        State.ACTIVE: {
            Event.VEHICLE_FRESH: _S,
            Event.VEHICLE_LOST: State.WAITING,
            Event.ENGAGE: _S,
            Event.RELEASE: _S,  # the stream goes on until the heartbeat shows the hold mode
            Event.ENGAGE_TIMEOUT: _S,
            Event.EXTERNAL_ON: _S,
            Event.EXTERNAL_OFF: State.OVERRIDDEN,
            Event.AIRBORNE: _S,
            Event.LANDED: _R,
            Event.DISARMED: _R,
            Event.DEGRADED: State.HOLD,
            Event.RECOVERED: _S,
            Event.BRAIN_FAILED: State.FAULT,
        },
        State.HOLD: {
            Event.VEHICLE_FRESH: _S,
            Event.VEHICLE_LOST: State.WAITING,
            Event.ENGAGE: _S,
            Event.RELEASE: _S,
            Event.ENGAGE_TIMEOUT: _S,
            Event.EXTERNAL_ON: _S,
            Event.EXTERNAL_OFF: State.OVERRIDDEN,
            Event.AIRBORNE: _S,
            Event.LANDED: _R,
            Event.DISARMED: _R,
            Event.DEGRADED: _S,
            Event.RECOVERED: State.ACTIVE,
            Event.BRAIN_FAILED: State.FAULT,
        },
        State.OVERRIDDEN: {
            Event.VEHICLE_FRESH: _S,
            Event.VEHICLE_LOST: _S,  # silent already; the takeover is remembered
            Event.ENGAGE: _R,
            Event.RELEASE: _S,
            Event.ENGAGE_TIMEOUT: _S,
            Event.EXTERNAL_ON: _S,  # with engage.by = "mode_switch" this counts as ENGAGE, see `advance`
            Event.EXTERNAL_OFF: _S,
            Event.AIRBORNE: _S,
            Event.LANDED: _S,
            Event.DISARMED: _R,
            Event.DEGRADED: _S,
            Event.RECOVERED: _S,
            Event.BRAIN_FAILED: State.FAULT,
        },
        State.FAULT: {
            Event.VEHICLE_FRESH: _S,
            Event.VEHICLE_LOST: _S,
            Event.ENGAGE: _S,
            Event.RELEASE: _S,
            Event.ENGAGE_TIMEOUT: _S,
            Event.EXTERNAL_ON: _S,
            Event.EXTERNAL_OFF: _S,
            Event.AIRBORNE: _S,
            Event.LANDED: _S,
            Event.DISARMED: _R,  # on the ground the brain is reset and may try again
            Event.DEGRADED: _S,
            Event.RECOVERED: _S,
            Event.BRAIN_FAILED: _S,
        },
    }
)

FLYING = frozenset({State.ACTIVE, State.HOLD})
_DEAF = frozenset({State.WAITING, State.FAULT})  # an engage command is refused here


def refusal(situation: Situation) -> str | None:
    """Why an engage command would be refused now, None where it would be accepted."""
    if situation.state in _DEAF or not situation.fresh:
        return f"{situation.state}: {situation.reason}"
    return None


def advance(situation: Situation, event: Event, *, engage_by: str, detail: str = "") -> Situation:
    """The next situation. ``engage_by``: "command", or "mode_switch" (the external mode itself engages)."""
    old = situation.state
    if event is Event.EXTERNAL_ON and engage_by == "mode_switch" and old not in _DEAF:
        situation = replace(situation, external=True)
        event = Event.ENGAGE
    facts = _facts(situation, event)
    rule = TABLE[old][event]
    if rule is Rule.STAY:
        return replace(facts, state=old)
    if event is Event.EXTERNAL_OFF and situation.releasing:
        rule = Rule.SETTLE  # the release that we asked for, not a takeover
    state = _settle(facts) if rule is Rule.SETTLE else State(rule)
    if state is State.OVERRIDDEN:
        facts = replace(facts, engaged=False)
    if state is old:
        return replace(facts, state=old)
    return replace(facts, state=state, reason=detail or event.value)


def _facts(situation: Situation, event: Event) -> Situation:
    """The facts after ``event``, state untouched."""
    match event:
        case Event.VEHICLE_FRESH:
            return replace(situation, fresh=True)
        case Event.VEHICLE_LOST:
            return replace(situation, fresh=False)
        case Event.ENGAGE:
            accepted = refusal(situation) is None
            return replace(situation, engaged=situation.engaged or accepted, releasing=False)
        case Event.RELEASE:
            flying = situation.state in FLYING
            return replace(situation, engaged=situation.engaged and flying, releasing=flying)
        case Event.ENGAGE_TIMEOUT:
            return replace(situation, engaged=False)
        case Event.EXTERNAL_ON:
            return replace(situation, external=True)
        case Event.EXTERNAL_OFF:
            return replace(situation, external=False, engaged=False, releasing=False)
        case Event.AIRBORNE:
            return replace(situation, airborne=True)
        case Event.LANDED:
            return replace(situation, airborne=False)
        case Event.DISARMED:
            return replace(situation, engaged=False, airborne=False, releasing=False)
        case Event.DEGRADED:
            return replace(situation, degraded=True)
        case Event.RECOVERED:
            return replace(situation, degraded=False)
        case Event.BRAIN_FAILED:
            return replace(situation, engaged=False)


def _settle(facts: Situation) -> State:
    """The state that the facts call for."""
    if not facts.fresh:
        return State.WAITING
    if facts.engaged and facts.external and facts.airborne:
        return State.HOLD if facts.degraded else State.ACTIVE
    return State.READY
