"""MAVSDK's documentation against the simulator: every plugin that it offers for what exists here."""

from __future__ import annotations

import pytest

pytest.importorskip("mavsdk.asyncio")

from mavsdk_cases import peers
from mavsdk_cases.every import CASES

pytestmark = [pytest.mark.integration, pytest.mark.timeout(600)]  # the first test waits for all of them


@pytest.fixture(scope="module")
def raised(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> dict[str, BaseException | None]:
    """What each of the selected cases raised, flown a few at a time."""
    names = {item.callspec.params["name"] for item in request.session.items if item.path == request.path}
    return peers.fly([case for case in CASES if case.name in names], tmp_path_factory.mktemp("flights"))


@pytest.mark.parametrize("name", [case.name for case in CASES])
def test_case(name: str, raised: dict[str, BaseException | None]) -> None:
    if (error := raised[name]) is not None:
        raise error
