"""MAVSDK's documentation against the simulator: parameters, plain MAVLink, missions and fences."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("mavsdk.asyncio")

from mavsdk_cases import direct, harness, parameters, peers, plans

pytestmark = pytest.mark.integration


@pytest.mark.parametrize("case", harness.cases_of(parameters, direct, plans), ids=lambda case: case.name)
def test_case(case: harness.Case, tmp_path: Path) -> None:
    peers.fly(case, tmp_path)
