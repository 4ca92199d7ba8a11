"""Arming checks, their reasons and the health that SYS_STATUS tells."""

from __future__ import annotations

import math

import pytest

from sim_bridge.autopilot import Autopilot
from sim_bridge.messages import Ack, Command, Result, Sender, Text
from sim_bridge.physics import BodyState
from sim_bridge.rotation import from_euler
from tests.unit.test_autopilot_failsafe import Reading

GCS = Sender(245, 190)
PREARM, GPS, BATTERY, FENCE, STICKS = 1 << 28, 1 << 5, 1 << 25, 1 << 20, 1 << 16


def standing(roll_deg: float = 0.0, pitch_deg: float = 0.0, x: float = 0.0) -> BodyState:
    q = from_euler(math.radians(roll_deg), math.radians(pitch_deg), 0.3)
    return BodyState((x, 0.0, 0.2), (0.0, 0.0, 0.0), q, (0.0, 0.0, 0.0))


@pytest.fixture
def autopilot() -> Autopilot:
    return Autopilot(start_enu=(0.0, 0.0, 0.2), rest_height_m=0.2, yaw_rad=0.0, system_id=7)


def order(autopilot: Autopilot, state: BodyState, number: int, *params: float) -> tuple[Result, list[str]]:
    command = Command(number, (*params, *[0.0] * (7 - len(params))), GCS)  # type: ignore[arg-type]
    replies = autopilot.command(command, state, 0)
    (ack,) = [r for r in replies if isinstance(r, Ack)]
    return ack.result, [r.text for r in replies if isinstance(r, Text)]


DENIED = "Arming denied: Resolve system health failures first"


@pytest.mark.parametrize(
    ("state", "reason", "unhealthy"),
    [
        (standing(roll_deg=70.0), "Attitude failure (roll)", PREARM),
        (standing(roll_deg=180.0), "Attitude failure (roll)", PREARM),  # on its back
        (standing(pitch_deg=-70.0), "Attitude failure (pitch)", PREARM),
        (standing(x=math.nan), "No valid local position estimate", PREARM | GPS | 1 << 21),
    ],
)
def test_what_the_state_forbids(autopilot: Autopilot, state: BodyState, reason: str, unhealthy: int) -> None:
    assert order(autopilot, state, 400, 1.0) == (
        Result.TEMPORARILY_REJECTED,
        [f"Preflight Fail: {reason}", DENIED],
    )
    assert not autopilot.armed
    assert order(autopilot, state, 401) == (Result.ACCEPTED, [f"Preflight Fail: {reason}"])
    autopilot.step(state, 0)
    present, enabled, healthy = autopilot.health
    assert present == enabled
    assert present & ~healthy == unhealthy
    assert order(autopilot, state, 400, 1.0, 21196.0) == (Result.ACCEPTED, [])  # by force
    assert autopilot.armed


def test_what_parameters_and_battery_forbid(autopilot: Autopilot) -> None:
    state = standing(x=3.0)
    assert autopilot.parameters.write("NAV_DLL_ACT", 2, is_int=True)
    assert autopilot.parameters.write("GF_MAX_HOR_DIST", 2.0, is_int=False)
    autopilot.battery(Reading(0.06))
    autopilot.step(state, 0)
    _, texts = order(autopilot, state, 400, 1.0)
    assert texts == [
        "Preflight Fail: Low battery",
        "Preflight Fail: No connection to the GCS",
        "Preflight Fail: Geofence violation",
        DENIED,
    ]
    present, _, healthy = autopilot.health
    assert present & ~healthy == PREARM | BATTERY | FENCE
    autopilot.battery(Reading(0.1))  # low is a warning only
    autopilot.heard_station(0)
    assert autopilot.parameters.write("GF_MAX_HOR_DIST", 0.0, is_int=False)
    assert order(autopilot, state, 400, 1.0) == (Result.ACCEPTED, [])


@pytest.mark.parametrize("sub", [5.0, 6.0])
def test_nobody_arms_to_land_or_to_return(autopilot: Autopilot, sub: float) -> None:
    assert order(autopilot, standing(), 176, 1.0, 4.0, sub)[0] is Result.ACCEPTED
    result, texts = order(autopilot, standing(), 400, 1.0)
    assert result is Result.TEMPORARILY_REJECTED
    assert texts[0] == "Preflight Fail: Mode not suitable for takeoff"


def test_a_healthy_vehicle(autopilot: Autopilot) -> None:
    autopilot.step(standing(), 0)
    present, enabled, healthy = autopilot.health
    assert present == enabled == healthy
    assert present & PREARM
    assert not present & (STICKS | FENCE)
    assert order(autopilot, standing(), 401) == (Result.ACCEPTED, [])
    assert order(autopilot, standing(), 400, 1.0) == (Result.ACCEPTED, [])
    assert order(autopilot, standing(), 400, 1.0) == (Result.ACCEPTED, [])  # it is already
    assert order(autopilot, standing(), 401)[0] is Result.TEMPORARILY_REJECTED
    assert order(autopilot, standing(), 400, 0.5)[0] is Result.UNSUPPORTED
    assert order(autopilot, standing(), 400, 0.0) == (Result.ACCEPTED, [])


def test_home_is_where_it_is_armed(autopilot: Autopilot) -> None:
    order(autopilot, standing(x=4.0), 400, 1.0)
    assert autopilot.home_enu == (4.0, 0.0, 0.0)


def test_the_system_id_is_a_parameter_that_cannot_be_changed(autopilot: Autopilot) -> None:
    assert autopilot.parameters["MAV_SYS_ID"] == 7
    assert not autopilot.parameters.write("MAV_SYS_ID", 8, is_int=True)
