"""Every case of MAVSDK's promises fails against a peer that acknowledges everything and does nothing."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("mavsdk.asyncio")

from mavsdk_cases import harness, peers
from mavsdk_cases.every import CASES

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, peers.Outcome]:
    """All at once, with the time limits of the simulator's runs."""
    return peers.fly_dumb(CASES, tmp_path_factory.mktemp("dumb"))


@pytest.mark.parametrize("name", [case.name for case in CASES])
def test_case_fails(name: str, outcomes: dict[str, peers.Outcome]) -> None:
    """By a promise that is not kept, not because the peer could not be reached or the case is broken."""
    outcome = outcomes[name]
    assert outcome.unkept, outcome.error


async def is_believed(drone: harness.Drone) -> None:
    """MAVSDK finds it healthy, and each thing that it asks for is granted."""
    await drone.healthy()
    await drone.action.arm()
    await drone.action.takeoff()
    await drone.param.set_param_float("MPC_LAND_SPEED", 0.8)
    assert await drone.param.get_param_float("MPC_LAND_SPEED") == pytest.approx(0.8)
    await drone.telemetry.set_rate_attitude_quaternion(40.0)
    await drone.action.land()
    await drone.action.return_to_launch()


@pytest.mark.parametrize("vehicle", [harness.GROUND, harness.AIR], ids=["on the ground", "in the air"])
def test_dumb_autopilot_is_believed(vehicle: str, tmp_path: Path) -> None:
    case = harness.Case("believed", is_believed, vehicle, 1.0, "", blocking=False, alters=True)
    assert peers.fly_dumb([case], tmp_path) == {"believed": peers.Outcome("None", unkept=False)}
