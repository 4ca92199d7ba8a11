"""Expectations: each is met by what it asks for, and fails by what it does not."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from sim_bridge.expectations import DEFAULT, Finding, of_fault, of_flight
from sim_bridge.faults import Hit
from sim_bridge.messages import Landed
from sim_bridge.scenario import Expectation
from sim_bridge.scenario_faults import Fault, FaultExpectation
from sim_bridge.watch import Seen

S = 1_000_000_000
ENTERED = 10 * S
STARTED = 12 * S


def craft(**outcome: Any) -> Any:
    summary = {"reached": True, "collided": False, "min_clearance_m": 0.4, "flight_time_s": 8.0} | outcome
    autopilot = SimpleNamespace(landed=Landed.IN_AIR, armed=True)
    return SimpleNamespace(
        name="uav1", judge=SimpleNamespace(start_ns=ENTERED), autopilot=autopilot, summary=lambda: summary
    )


def history() -> Seen:
    """ACTIVE until the fault at 12 s, HOLD from 13.5 s on; the mode follows at 14 s, a text is said at 13.5 s."""
    seen = Seen()
    for tick in range(200, 400):
        t_ns = tick * S // 20
        Seen.extend(seen.states, "ACTIVE" if tick < 270 else "HOLD", t_ns)
        Seen.extend(seen.verdicts, "nominal" if tick < 270 else "braking", t_ns)
        Seen.extend(seen.modes, "OFFBOARD" if tick < 280 else "HOLD", t_ns)
    Seen.extend(seen.texts, "companion HOLD: obstacle source sim silent", 270 * S // 20)
    return seen


def judged(expect: FaultExpectation, started_ns: int | None = STARTED) -> list[Finding]:
    fault = Fault(what="cut", on="obstacles", at_s=2.0, expect=expect)
    return of_fault(Hit(0, fault, 0, started_ns), craft(), history(), 20 * S)


@pytest.mark.parametrize(
    ("expect", "met"),
    [
        ({"state": "HOLD"}, True),
        ({"state": "HOLD", "within_s": 1.4}, False),  # it came after 1.5 s
        ({"state": "FAULT"}, False),
        ({"verdict": "braking"}, True),
        ({"verdict": "relaxed"}, False),
        ({"mode": "HOLD", "within_s": 1.9}, False),
        ({"mode": "HOLD", "within_s": 2.0}, True),
        ({"mode": "LAND"}, False),
        ({"text": "sim silent"}, True),
        ({"text": "sim silent", "within_s": 1.0}, False),
        ({"text": "Sim Silent"}, False),
        ({"state": "ACTIVE", "within_s": 0.5}, True),  # in force when the fault began
        ({"state": "READY", "within_s": 100.0}, False),  # was never seen
    ],
)
def test_of_a_fault(expect: dict[str, Any], met: bool) -> None:
    (finding,) = judged(FaultExpectation(**expect))
    assert finding.met is met
    assert finding.line().startswith("met   " if met else "FAILED")
    assert "faults[0] cut on obstacles at 2.00 s" in finding.line()


def test_what_was_over_before_the_fault_is_not_seen_after_it() -> None:
    seen = history()
    fault = Fault(what="cut", on="obstacles", at_s=5.0, expect=FaultExpectation(state="ACTIVE", within_s=5.0))
    (finding,) = of_fault(Hit(0, fault, 0, 15 * S), craft(), seen, 20 * S)
    assert not finding.met
    assert "saw HOLD from 3.50 s" in finding.seen


def test_every_key_is_a_finding_with_its_time() -> None:
    findings = judged(FaultExpectation(state="HOLD", mode="HOLD", text="silent"))
    assert [(f.expected, f.met, f.at_s) for f in findings] == [
        ("state HOLD within 2 s", True, 3.5),
        ("mode HOLD within 2 s", True, 4.0),
        ("text silent within 2 s", True, 3.5),
    ]


def test_a_fault_that_never_came_meets_nothing() -> None:
    (finding,) = judged(FaultExpectation(state="ACTIVE"), started_ns=None)
    assert not finding.met
    assert "before the fault" in finding.seen


def test_a_failure_tells_what_was_seen_instead() -> None:
    (finding,) = judged(FaultExpectation(state="FAULT"))
    assert finding.seen == "saw ACTIVE from 0.00 s, HOLD from 3.50 s"


@pytest.mark.parametrize(
    ("expect", "outcome", "met"),
    [
        ({"reached": True}, {}, True),
        ({"reached": True}, {"reached": False}, False),
        ({"reached": False}, {}, False),
        ({"collided": False}, {"collided": True}, False),
        ({"collided": True}, {"collided": True}, True),
        ({"min_clearance_m": 0.4}, {}, True),
        ({"min_clearance_m": 0.41}, {}, False),
        ({"min_clearance_m": 0.41}, {"min_clearance_m": None}, True),  # nothing there to come close to
        ({"max_time_s": 8.0}, {}, True),
        ({"max_time_s": 7.9}, {}, False),
        ({"max_time_s": 7.9}, {"flight_time_s": None}, False),
        ({"state_seen": ("HOLD",)}, {}, True),
        ({"state_seen": ("FAULT",)}, {}, False),
        ({"verdict_seen": ("relaxed",)}, {}, False),
        ({"mode_seen": ("OFFBOARD",)}, {}, True),
        ({"text_seen": ("silent",)}, {}, True),
        ({"text_seen": ("battery",)}, {}, False),
        ({"never_state": ("FAULT",)}, {}, True),
        ({"never_state": ("HOLD",)}, {}, False),
        ({"final_state": "HOLD"}, {}, True),
        ({"final_state": "ACTIVE"}, {}, False),
        ({"final_mode": "OFFBOARD"}, {}, False),
        ({"landed": True}, {}, False),
        ({"landed": False}, {}, True),
        ({"disarmed": True}, {}, False),
    ],
)
def test_of_the_flight(expect: dict[str, Any], outcome: dict[str, Any], met: bool) -> None:
    (finding,) = of_flight(Expectation(**expect), craft(**outcome), history())
    assert finding.met is met


def test_a_scenario_that_states_nothing_wants_no_collision_and_no_fault() -> None:
    seen = history()
    assert all(f.met for f in of_flight(DEFAULT, craft(), seen))
    assert not all(f.met for f in of_flight(DEFAULT, craft(collided=True), seen))
    Seen.extend(seen.states, "FAULT", 20 * S)
    assert not all(f.met for f in of_flight(DEFAULT, craft(), seen))
