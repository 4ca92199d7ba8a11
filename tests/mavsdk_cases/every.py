"""All cases, plugin by plugin."""

from __future__ import annotations

from mavsdk_cases import (
    actions,
    blocking,
    direct,
    information,
    offboarding,
    parameters,
    pilot,
    plans,
    rates,
    telemetry,
)
from mavsdk_cases.harness import cases_of

CASES = cases_of(actions, blocking, direct, information, offboarding, parameters, pilot, plans, rates, telemetry)
