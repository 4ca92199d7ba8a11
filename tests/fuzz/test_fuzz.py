"""A million coverage-guided inputs at the doors: no crash, no growth of memory (slow; needs the fuzz extra)."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("atheris")

RUN = Path(__file__).with_name("run.py")
GROWTH_KIB = 40 * 1024  # libFuzzer's own corpus grows with what it finds; a leak of 100 bytes an input would show
RUNS = {
    "mavlink": 200_000,
    "mavlink_payload": 250_000,
    "obstacles": 250_000,
    "commands": 150_000,
    "cdr": 100_000,
    "configuration": 50_000,
}


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(("target", "runs"), RUNS.items())
def test_no_input_crashes_and_memory_stays(target: str, runs: int, tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(RUN.parents[2]), os.environ.get("PYTHONPATH", "")])}
    done = subprocess.run(
        [sys.executable, str(RUN), target, str(runs)],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    told = [tuple(map(int, found)) for found in re.findall(rf"memory {target} (\d+) (\d+)", done.stdout)]
    (early, before), (late, after) = told
    assert late > 8 * early
    assert after - before < GROWTH_KIB
