"""MAVSDK's documentation against the simulator: discovery, the Info plugin, the link."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("mavsdk.asyncio")

from mavsdk_cases import harness, information, peers

pytestmark = pytest.mark.integration


@pytest.mark.parametrize("case", harness.cases_of(information), ids=lambda case: case.name)
def test_case(case: harness.Case, tmp_path: Path) -> None:
    peers.fly(case, tmp_path)
