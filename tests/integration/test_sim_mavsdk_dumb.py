"""Every case of MAVSDK's promises fails against a peer that acknowledges everything and does nothing."""

from __future__ import annotations

import pytest

pytest.importorskip("mavsdk.asyncio")

from mavsdk_cases import (
    actions,
    blocking,
    direct,
    harness,
    information,
    offboarding,
    parameters,
    peers,
    pilot,
    plans,
    rates,
    telemetry,
)

pytestmark = pytest.mark.integration

CASES = harness.cases_of(
    actions, blocking, direct, information, offboarding, parameters, pilot, plans, rates, telemetry
)


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, peers.Outcome]:
    """All at once, with the time limits of the simulator's runs."""
    return peers.fly_dumb(CASES, tmp_path_factory.mktemp("dumb"))


@pytest.mark.parametrize("name", [case.name for case in CASES])
def test_case_fails(name: str, outcomes: dict[str, peers.Outcome]) -> None:
    """By a promise that is not kept, not because the peer could not be reached or the case is broken."""
    outcome = outcomes[name]
    assert outcome.unkept, outcome.error
