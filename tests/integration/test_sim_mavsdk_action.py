"""MAVSDK's documentation against the simulator: the Action plugin."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("mavsdk.asyncio")

from mavsdk_cases import actions, harness, peers

pytestmark = pytest.mark.integration


@pytest.mark.parametrize("case", harness.cases_of(actions), ids=lambda case: case.name)
def test_case(case: harness.Case, tmp_path: Path) -> None:
    peers.fly(case, tmp_path)
