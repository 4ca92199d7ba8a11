"""Every case of MAVSDK's promises fails against a peer that acknowledges everything and does nothing."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("mavsdk.asyncio")

from mavsdk.exceptions import MavsdkError

from mavsdk_cases import harness, information

pytestmark = pytest.mark.integration

CASES = harness.cases_of(information)


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, BaseException | None]:
    """All at once, with the time limits of the simulator's runs."""
    return harness.fly_dumb(CASES, tmp_path_factory.mktemp("dumb"))


@pytest.mark.parametrize("name", [case.name for case in CASES])
def test_case_fails(name: str, outcomes: dict[str, BaseException | None]) -> None:
    raised = outcomes[name]
    assert isinstance(raised, AssertionError | MavsdkError), repr(raised)
