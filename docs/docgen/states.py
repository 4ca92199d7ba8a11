"""docs/reference/states.md: the state machine, the verdicts and the vehicle profiles, from their tables."""

from __future__ import annotations

import inspect
import re

from companion.profiles import PROFILES
from companion.state import TABLE, Event, Rule, State
from companion.types import Verdict
from docgen.pages import table

_RULES = {Rule.STAY: ".", Rule.SETTLE: "settle"}


def transitions() -> str:
    """The table of `companion/state.py`: a row an event, a column a state."""
    rows = []
    for event in Event:
        cells = [TABLE[state][event] for state in State]
        shown = [_RULES[cell] if isinstance(cell, Rule) else f"**{cell}**" for cell in cells]
        rows.append((event.value, *shown))
    return table(("event", *(state.value for state in State)), rows)


def events() -> str:
    """What each event is, where the source says more than its name."""
    return table(("event", "is"), [(e.value, said) for e in Event if (said := _said(Event, e.name))])


def verdicts() -> str:
    """Every verdict with its meaning."""
    rows = [(f"`{verdict}`", _said(Verdict, verdict.name)) for verdict in Verdict]
    return table(("verdict", "what the filter did with the reference"), rows)


def profiles() -> str:
    """Every number of a vehicle profile."""
    rows = [
        ("MAV_AUTOPILOT", *(str(p.autopilot) for p in PROFILES.values())),
        ("ticks and setpoints [Hz]", *(str(p.tick_hz) for p in PROFILES.values())),
        ("type_mask", *(f"0x{p.type_mask:04X}" for p in PROFILES.values())),
        (
            'type_mask, `setpoint = "velocity+acceleration"`',
            *(f"0x{p.mask('velocity+acceleration'):04X}" for p in PROFILES.values()),
        ),
        ("custom_mode that obeys setpoints", *(f"0x{p.external.custom_mode:X}" for p in PROFILES.values())),
        ("custom_mode asked for on release and FAULT", *(f"0x{p.hold.custom_mode:X}" for p in PROFILES.values())),
        ("dead time from setpoint to effect [s]", *(f"{p.actuation_lag_s:g}" for p in PROFILES.values())),
        ("lag of the acceleration loop [s]", *(f"{p.response_lag_s:g}" for p in PROFILES.values())),
        (
            "default of `limits.slew_m_s3`",
            *("unlimited" if p.slew_m_s3 is None else f"{p.slew_m_s3:g}" for p in PROFILES.values()),
        ),
        ("streams in READY", *("yes" if p.streams_when_ready else "no" for p in PROFILES.values())),
        ("default of `engage.by`", *(f"`{p.engage_by}`" for p in PROFILES.values())),
    ]
    return table(("", *(f"`{name}`" for name in PROFILES)), rows)


def _said(kind: type, name: str) -> str:
    """The comment behind a member of an enumeration."""
    match = re.search(rf"^\s+{name} = \"[^\"]*\"  # (.*)$", inspect.getsource(kind), re.MULTILINE)
    return match[1] if match else ""
