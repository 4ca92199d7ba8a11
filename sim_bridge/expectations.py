"""A scenario's expectations against what was seen: one finding each, met or failed, with what was seen instead."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from sim_bridge.craft import Craft
from sim_bridge.faults import Hit
from sim_bridge.messages import NS_PER_S, Landed
from sim_bridge.scenario import Expectation
from sim_bridge.scenario_faults import Fault, FaultExpectation
from sim_bridge.watch import Run, Seen

DEFAULT = Expectation(collided=False, never_state=("FAULT",))  # of a scenario that states none
_TEXTS_SHOWN = 4


@dataclass(frozen=True, slots=True)
class Finding:
    """One expectation. Times count from the vehicle's entry into external control, from boot where it never did."""

    vehicle: str
    about: str  # the fault and its time, or "flight"
    expected: str
    met: bool
    seen: str
    at_s: float | None = None  # when it was seen

    def line(self) -> str:
        """For people."""
        verdict = "met   " if self.met else "FAILED"
        return f"{verdict}  {self.vehicle}  {self.about}: expected {self.expected}: {self.seen}"


def of_fault(hit: Hit, craft: Craft, seen: Seen, end_ns: int) -> list[Finding]:
    """The findings of one fault on one vehicle; ``end_ns``: the flight's last instant."""
    expect = hit.fault.expect
    if expect is None:
        return []
    epoch_ns = _epoch_ns(craft)
    about = f"faults[{hit.index}] {_named(hit.fault)}"
    wanted = _wanted(expect, seen)
    if hit.started_ns is None:
        return [
            Finding(craft.name, about, f"{key} {value}", False, "the flight ended before the fault")
            for key, value, _, _ in wanted
        ]
    about += f" at {(hit.started_ns - epoch_ns) / NS_PER_S:.2f} s"
    until_ns = hit.started_ns + round(expect.within_s * NS_PER_S)
    findings = []
    for key, value, runs, matches in wanted:
        after = [r for r in runs if r.last_ns >= hit.started_ns and r.first_ns <= until_ns]
        run = next((r for r in after if matches(r.value)), None)
        expected = f"{key} {value} within {expect.within_s:g} s"
        if run is not None:
            at_s = (max(run.first_ns, hit.started_ns) - epoch_ns) / NS_PER_S
            said = f" ({run.value})" if key == "text" else ""
            findings.append(Finding(craft.name, about, expected, True, f"seen at {at_s:.2f} s{said}", at_s))
        else:
            short = f", the flight ended at {(end_ns - epoch_ns) / NS_PER_S:.2f} s" if end_ns < until_ns else ""
            findings.append(Finding(craft.name, about, expected, False, f"saw {_told(after, epoch_ns)}{short}"))
    return findings


def of_flight(expect: Expectation, craft: Craft, seen: Seen) -> list[Finding]:
    """The findings of the whole flight for one vehicle."""
    summary = craft.summary()
    epoch_ns = _epoch_ns(craft)

    def finding(expected: str, met: bool, saw: str, at_s: float | None = None) -> Finding:
        return Finding(craft.name, "flight", expected, met, saw, at_s)

    findings = [finding(*each) for each in _outcomes(expect, summary)]
    for key, values, runs in (
        ("state", expect.state_seen, seen.states),
        ("verdict", expect.verdict_seen, seen.verdicts),
        ("mode", expect.mode_seen, seen.modes),
        ("text", expect.text_seen, seen.texts),
    ):
        for value in values:
            matches = _matcher(key, value)
            run = next((r for r in runs if matches(r.value)), None)
            at_s = None if run is None else (run.first_ns - epoch_ns) / NS_PER_S
            saw = f"saw {_told(runs, epoch_ns)}" if run is None else f"seen at {at_s:.2f} s"
            findings.append(finding(f"{key} {value}", run is not None, saw, at_s))
    for value in expect.never_state:
        run = next((r for r in seen.states if r.value == value), None)
        at_s = None if run is None else (run.first_ns - epoch_ns) / NS_PER_S
        saw = "never seen" if run is None else f"seen at {at_s:.2f} s"
        findings.append(finding(f"never state {value}", run is None, saw, at_s))
    findings += [finding(*each) for each in _endings(expect, craft, seen)]
    return findings


def _outcomes(expect: Expectation, summary: dict[str, Any]) -> Iterable[tuple[str, bool, str]]:
    """(expected, met, seen) of what the judge found."""
    for key, wanted in (("reached", expect.reached), ("collided", expect.collided)):
        if wanted is not None:
            yield f"{key} {_yes(wanted)}", summary[key] is wanted, _yes(summary[key])
    if expect.min_clearance_m is not None:
        clearance_m = summary["min_clearance_m"]
        got_m = math.inf if clearance_m is None else clearance_m
        yield f"clearance of at least {expect.min_clearance_m:g} m", got_m >= expect.min_clearance_m, f"{got_m:.3f} m"
    if expect.max_time_s is not None:
        time_s = summary["flight_time_s"]
        saw = "target not reached" if time_s is None else f"{time_s:.2f} s"
        yield f"target within {expect.max_time_s:g} s", time_s is not None and time_s <= expect.max_time_s, saw


def _endings(expect: Expectation, craft: Craft, seen: Seen) -> Iterable[tuple[str, bool, str]]:
    """(expected, met, seen) of how things stood at the end."""
    for key, wanted, runs in (
        ("state", expect.final_state, seen.states),
        ("mode", expect.final_mode, seen.modes),
    ):
        if wanted is not None:
            last = runs[-1].value if runs else "none"
            yield f"{key} {wanted} at the end", last == wanted, last
    landed = craft.autopilot.landed is Landed.ON_GROUND
    if expect.landed is not None:
        yield f"landed {_yes(expect.landed)}", landed is expect.landed, _yes(landed)
    if expect.disarmed is not None:
        disarmed = not craft.autopilot.armed
        yield f"disarmed {_yes(expect.disarmed)}", disarmed is expect.disarmed, _yes(disarmed)


def _wanted(expect: FaultExpectation, seen: Seen) -> list[tuple[str, str, Sequence[Run], Callable[[str], bool]]]:
    """(key, value, what was seen of its kind, whether a seen value is it)."""
    return [
        (key, value, runs, _matcher(key, value))
        for key, value, runs in (
            ("state", expect.state, seen.states),
            ("verdict", expect.verdict, seen.verdicts),
            ("mode", expect.mode, seen.modes),
            ("text", expect.text, seen.texts),
        )
        if value is not None
    ]


def _matcher(key: str, value: str) -> Callable[[str], bool]:
    return (lambda said: value in said) if key == "text" else (lambda said: said == value)


def _epoch_ns(craft: Craft) -> int:
    return 0 if craft.judge is None else craft.judge.start_ns


def _named(fault: Fault) -> str:
    share = f" of {fault.share:.0%}" if fault.share != 1.0 else ""
    return f"{fault.what} on {fault.on}{share}"


def _told(runs: Sequence[Run], epoch_ns: int) -> str:
    """``ACTIVE from 0.00 s, HOLD from 2.05 s``; the last few only."""
    if not runs:
        return "nothing"
    told = [f"{run.value} from {(run.first_ns - epoch_ns) / NS_PER_S:.2f} s" for run in runs[-_TEXTS_SHOWN:]]
    return ("... " if len(runs) > _TEXTS_SHOWN else "") + ", ".join(told)


def _yes(value: bool) -> str:
    return "yes" if value else "no"
