"""`sim-bridge run --check` with the ardupilot personality and the daemon that it starts: processes and sockets."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.integration

SCENARIO = """
physics_hz = 300
control_hz = 50
[vehicle]
start = [0.0, 0.0, {z}]
personality = "ardupilot"
takeoff_altitude_m = 1.5
parameters = {{ PSC_JERK_XY = 20.0, PSC_JERK_Z = 20.0 }}
daemon = {{ "vehicle.profile" = "auto", "limits.slew_m_s3" = 14.0 }}
[target]
position = [2.0, 0.0, 1.5]
[[obstacles]]
id = "ball"
motion = "linear"
origin = [1.0, 2.0, 1.5]
velocity = [0.0, -0.8, 0.0]
{operator}
[end]
hold_s = 1.0
timeout_s = 20.0
[expect]
reached = true
collided = false
state_seen = ["ACTIVE"]
never_state = ["FAULT"]
mode_seen = ["GUIDED"]
"""
FROM_THE_GROUND = """
[[operator]]
do = "arm"
at_tick = 0
[[operator]]
do = "takeoff"
at_tick = 1
[[operator]]
do = "engage"
after = "airborne_hover"
"""
IN_THE_AIR = """
[[operator]]
do = "engage"
after = "airborne_hover"
"""


@pytest.mark.parametrize(
    ("z", "operator", "pace"),
    [
        (0.2, FROM_THE_GROUND, ()),
        pytest.param(1.5, IN_THE_AIR, ("--real-time",), marks=pytest.mark.slow),
    ],
    ids=["lockstep", "real-time"],
)
def test_the_daemon_flies_it(tmp_path: Path, z: float, operator: str, pace: tuple[str, ...]) -> None:
    file = tmp_path / "copter.toml"
    file.write_text(SCENARIO.format(z=z, operator=operator), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-m", "sim_bridge.cli", "run", "--scenario", str(file), "--check", "--json", *pace],
        capture_output=True,
        timeout=60.0,
        check=False,
    )
    assert done.returncode == 0, done.stdout.decode() + done.stderr.decode()
    report: dict[str, Any] = json.loads(done.stdout)
    assert report["flight"]["ended"] == "reached"
