"""The `[[faults]]` and `[expect]` tables: what goes wrong, when, and what must be seen then.

What hits what (``on``), and what ``value`` means:

    drop, duplicate, reorder, corrupt   messages of a link or a source, a ``share`` of them, drawn
    delay                               the same, by value [s]
    cut                                 every message of a link or a source, both ways
    freeze                              the daemon (SIGSTOP, after ``for_s`` SIGCONT), or a source that repeats itself
    kill                                the daemon (SIGKILL), or the autopilot (motors off)
    clock_jump                          the clock of the autopilot, or of a source's stamps, by value [s]
    gust                                the world: an added wind, value [east, north, up] m/s
    battery                             the autopilot: value is the state of charge from now on, 0..1
    rc                                  the autopilot: the pilot takes over, value is the mode (default POSITION)

A link is ``onboard`` (the daemon's) or ``ground``; a source is its name, or ``obstacles`` for all of them.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Annotated, Literal, TypeAlias

from msgspec import Meta

from sim_bridge.scenario_types import Name, Point, Positive, Probability, Table, Tick

What: TypeAlias = Literal[
    "drop",
    "delay",
    "duplicate",
    "reorder",
    "corrupt",
    "cut",
    "freeze",
    "kill",
    "clock_jump",
    "gust",
    "battery",
    "rc",
]
DaemonState: TypeAlias = Literal["WAITING", "READY", "ACTIVE", "HOLD", "OVERRIDDEN", "FAULT"]
Verdict: TypeAlias = Literal["nominal", "adjusted", "relaxed", "braking", "silent"]
ModeName = Annotated[str, Meta(pattern=r"^[A-Z][A-Z0-9_]{0,31}$")]  # of the autopilot's personality
Words = Annotated[str, Meta(min_length=1, max_length=200)]  # part of a STATUSTEXT

LINKS = ("onboard", "ground")
_JUMP_MAX_S = 1e6  # time_boot_ms, 32 bits, ends at 4.3e6 s
MESSAGES = frozenset({"drop", "delay", "duplicate", "reorder", "corrupt", "cut"})
_SHARED = MESSAGES - {"cut"}
_PLACES: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(MESSAGES, (*LINKS, "obstacles")),
    "freeze": ("daemon", "obstacles"),
    "kill": ("daemon", "autopilot"),
    "clock_jump": ("autopilot", "obstacles"),
    "gust": ("world",),
    "battery": ("autopilot",),
    "rc": ("autopilot",),
}
_VALUES: dict[str, str] = {
    "delay": "a delay above 0 s",
    "clock_jump": "a jump in s other than 0, at most 1e6 either way",
    "gust": "a wind [east, north, up] in m/s",
    "battery": "a state of charge, 0 to 1",
    "rc": "a mode's name, or none",
}


class FaultExpectation(Table, frozen=True, kw_only=True):
    """What is seen within ``within_s`` of the fault; several keys must all be seen, each at some instant."""

    state: DaemonState | None = None  # of the daemon
    verdict: Verdict | None = None  # of the filter
    mode: ModeName | None = None  # of the autopilot
    text: Words | None = None  # part of a STATUSTEXT
    within_s: Positive = 2.0  # of the fault


class Fault(Table, frozen=True, kw_only=True):
    """One thing that goes wrong; see the module's head."""

    what: What  # goes wrong
    on: Name  # link, source, daemon, autopilot or world
    at_s: Annotated[float, Meta(ge=0.0, le=1e4)] | None = None  # after the entry into external control
    at_tick: Tick | None = None  # or by the count of control periods
    for_s: Positive | None = None  # None: to the end
    vehicle: Name | None = None  # None: every vehicle
    share: Probability = 1.0  # of the messages
    value: float | Point | str | None = None  # of the fault, see below
    expect: FaultExpectation | None = None


class Expectation(Table, frozen=True, kw_only=True):
    """What must hold for the whole flight, of every vehicle; None and () demand nothing."""

    reached: bool | None = None  # the target
    collided: bool | None = None  # with anything
    min_clearance_m: Annotated[float, Meta(ge=-10.0, le=1e3)] | None = None  # surface to surface, at least
    max_time_s: Positive | None = None  # to the target, at most
    state_seen: tuple[DaemonState, ...] = ()  # of the daemon, each at some instant
    verdict_seen: tuple[Verdict, ...] = ()  # of the filter
    mode_seen: tuple[ModeName, ...] = ()  # of the autopilot
    text_seen: tuple[Words, ...] = ()  # parts of STATUSTEXTs
    never_state: tuple[DaemonState, ...] = ()  # of the daemon
    final_state: DaemonState | None = None  # of the daemon, at the end
    final_mode: ModeName | None = None  # of the autopilot, at the end
    landed: bool | None = None  # at the end
    disarmed: bool | None = None  # at the end


def fault_error(fault: Fault, *, sources: Collection[str], vehicles: Collection[str]) -> str | None:
    """What is wrong with one fault in a scenario of these sources and vehicles, or None."""
    if (fault.at_s is None) == (fault.at_tick is None):
        return "expected exactly one of at_s and at_tick"
    places = _PLACES[fault.what]
    known = [*places, *sorted(sources)] if "obstacles" in places else [*places]
    if fault.on not in known:
        return f"on: expected one of {', '.join(known)} for {fault.what}, got {fault.on}"
    if fault.vehicle is not None and fault.vehicle not in vehicles:
        return f"vehicle: expected one of {', '.join(vehicles)}, got {fault.vehicle}"
    if fault.what == "kill" and fault.for_s is not None:
        return "for_s: expected none for kill"
    if fault.share != 1.0 and fault.what not in _SHARED:
        return f"share: expected only with {', '.join(sorted(_SHARED))}"
    if fault.expect is not None and fault.expect == FaultExpectation(within_s=fault.expect.within_s):
        return "expect: expected state, verdict, mode or text"
    if not _value_fits(fault):
        return f"value: expected {_VALUES.get(fault.what, 'none')} for {fault.what}, got {fault.value}"
    return None


def _value_fits(fault: Fault) -> bool:
    value = fault.value
    if fault.what == "delay":
        return isinstance(value, float) and 0.0 < value <= 10.0
    if fault.what == "clock_jump":
        return isinstance(value, float) and 0.0 < abs(value) <= _JUMP_MAX_S
    if fault.what == "gust":
        return isinstance(value, tuple)
    if fault.what == "battery":
        return isinstance(value, float) and 0.0 <= value <= 1.0
    if fault.what == "rc":
        return value is None or isinstance(value, str)
    return value is None
