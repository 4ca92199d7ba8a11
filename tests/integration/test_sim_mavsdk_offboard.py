"""MAVSDK's documentation against the simulator: the Offboard and ManualControl plugins."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("mavsdk.asyncio")

from mavsdk_cases import harness, offboarding, peers, pilot

pytestmark = pytest.mark.integration


@pytest.mark.parametrize("case", harness.cases_of(offboarding, pilot), ids=lambda case: case.name)
def test_case(case: harness.Case, tmp_path: Path) -> None:
    peers.fly(case, tmp_path)
