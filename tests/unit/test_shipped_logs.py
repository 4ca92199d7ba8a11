"""Flights of before, again: this version answers as the one did that flew them.

To the bit that holds on a machine of the same vector instructions, numpy and ONNX Runtime only: BLAS and numpy choose
their kernels by the processor, and those round differently. So numbers may differ by 1e-6 max(1, |x|) here; equality
to the bit is asked of flights that are made in the same run (test_replay.py, test_demo.py). After a change that is
meant to answer otherwise: `make logs`.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from companion.cli import main
from companion.logbook.reader import open_log

LOGS = sorted((Path(__file__).parents[1] / "logs").glob("*.mcap"))
TOLERANCE = "1e-6"
# what each log is there for
HOLDS = {
    "ardupilot": {"profile": "ardupilot", "state": {"ACTIVE"}, "verdicts": {"adjusted"}},
    "demo": {"profile": "crazyflie-sim", "state": {"READY", "ACTIVE"}, "verdicts": {"nominal", "adjusted", "relaxed"}},
    "hold": {"profile": "crazyflie-sim", "state": {"ACTIVE", "HOLD"}, "verdicts": {"nominal"}},
    "noisy": {"profile": "crazyflie-sim", "state": {"ACTIVE"}, "verdicts": {"adjusted"}},
    "retune": {"profile": "crazyflie-sim", "state": {"ACTIVE"}, "verdicts": {"adjusted"}},
}


@pytest.mark.parametrize("path", LOGS, ids=lambda path: path.stem)
def test_a_shipped_flight_is_answered_as_it_was(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status = main(["replay", str(path), "--tolerance", TOLERANCE, "--json"])
    report = json.loads(capsys.readouterr().out)
    assert status == 0, (
        f"{path.name}: {report['differing']} of {report['compared']} ticks are not within {TOLERANCE} of what was "
        f"recorded, the first: {report['first_difference']}. If the brain was meant to change: make logs. "
        f"Same numerics as where it was made: {report['same_numerics']}."
    )
    assert report["compared"] == report["ticks"] > 60
    assert report["notes"] == []
    assert len(report["configurations"]) == (path.stem == "retune")


@pytest.mark.parametrize("path", LOGS, ids=lambda path: path.stem)
def test_a_shipped_log_holds_what_it_is_there_for(path: Path) -> None:
    assert path.stat().st_size < 1_000_000
    log, wanted = open_log(path), HOLDS[path.stem]
    records = [message.json for message in log.messages("/companion/setpoint")]
    assert log.config.vehicle.profile == wanted["profile"]
    assert {record["state"] for record in records} >= wanted["state"]
    assert {record["verdict"] for record in records} >= wanted["verdicts"]
    assert log.config.log.directory is None
    if path.stem == "noisy":
        seen = [one for message in log.messages("/companion/input/obstacles") for one in message.json["obstacles"]]
        assert {one["id"] is None for one in seen} == {True, False}


def test_every_log_is_there() -> None:
    assert [path.stem for path in LOGS] == sorted(HOLDS)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="OPENBLAS_CORETYPE")
def test_other_kernels_of_blas_stay_within_the_tolerance() -> None:
    words = [sys.executable, "-m", "companion.cli", "replay", str(LOGS[0]), "--tolerance", TOLERANCE]
    other = {**os.environ, "OPENBLAS_CORETYPE": "Prescott", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(words, capture_output=True, text=True, env=other, check=False, timeout=60)
    assert done.returncode == 0, done.stdout + done.stderr
