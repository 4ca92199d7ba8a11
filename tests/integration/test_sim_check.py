"""`sim-bridge run --check` with the real daemon: it fails when it should, says why, and does so every time."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.integration

WORLD = """
[vehicle]
start = [-2.0, 0.0, 0.2]
[target]
position = [2.0, 0.0, 1.5]
[[obstacles]]
id = "ball"
motion = "linear"
origin = [0.0, 3.0, 1.5]
velocity = [0.0, -0.5, 0.0]
[end]
timeout_s = 4.0
"""


def sim(*words: str) -> subprocess.CompletedProcess[str]:
    one_thread = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "sim_bridge.cli", "run", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, env=one_thread)


def checked(folder: Path, faults: str, *words: str) -> tuple[subprocess.CompletedProcess[str], bytes]:
    scenario, trace = folder / "s.toml", folder / "trace.jsonl"
    scenario.write_text(WORLD + faults)
    done = sim("--scenario", str(scenario), "--check", "--trace", str(trace), *words)
    return done, trace.read_bytes() if trace.exists() else b""


def test_a_false_expectation_fails_the_check_and_says_what_was_seen(tmp_path: Path) -> None:
    faults = """
    [[faults]]
    what = "kill"
    on = "daemon"
    at_s = 1.0
    expect = { mode = "LAND", within_s = 2.0 }
    [expect]
    reached = true
    state_seen = ["ACTIVE"]
    """
    done, _ = checked(tmp_path, faults)
    assert done.returncode == 1, done.stderr
    lines = done.stdout.splitlines()
    assert "FAILED  uav1  faults[0] kill on daemon at 1.00 s: expected mode LAND within 2 s: saw OFFBOARD" in lines[0]
    assert "HOLD from 2.00 s" in lines[0]  # COM_OF_LOSS_T, then COM_OBL_RC_ACT
    assert lines[1:] == [
        "FAILED  uav1  flight: expected reached yes: no",
        "met     uav1  flight: expected state ACTIVE: seen at 0.05 s",
        "s, seed 0: 1 of 3 expectations met",
    ]


FAULTY = """
[[faults]]
what = "{what}"
on = "onboard"
at_s = 0.3
{more}
[[faults]]
what = "drop"
on = "sim"
at_s = 0.3
share = 0.3
"""


@pytest.mark.parametrize(
    ("what", "more"),
    [
        ("drop", "share = 0.3"),
        pytest.param("reorder", "share = 0.3", marks=pytest.mark.slow),
        pytest.param("freeze", "for_s = 0.4", marks=pytest.mark.slow),
    ],
)
def test_the_same_seed_loses_the_same_messages(tmp_path: Path, what: str, more: str) -> None:
    faults = FAULTY.format(what=what, more=more)
    if what == "freeze":
        faults = faults.replace('"onboard"', '"daemon"')
    traces = []
    for _ in range(2):
        done, trace = checked(tmp_path, faults, "--seed", "3")
        assert done.returncode == 0, done.stdout + done.stderr
        traces.append(trace)
    assert traces[0] == traces[1]


def test_two_vehicles_each_with_its_daemon_and_its_own_fault(tmp_path: Path) -> None:
    scenario = tmp_path / "two.toml"
    scenario.write_text("""
    [[vehicles]]
    start = [-2.0, 0.0, 0.2]
    target = [2.0, 0.0, 1.5]
    [[vehicles]]
    start = [-2.0, 3.0, 0.2]
    target = [2.0, 3.0, 1.5]
    system_id = 7
    [[faults]]
    what = "kill"
    on = "daemon"
    vehicle = "uav2"
    at_s = 0.5
    expect = { mode = "HOLD" }
    [end]
    timeout_s = 4.0
    """)
    done = sim("--scenario", str(scenario), "--check", "--json")
    report = json.loads(done.stdout)
    assert done.returncode == 0, done.stdout
    assert [(f["vehicle"], f["expected"]) for f in report["expectations"]] == [
        ("uav2", "mode HOLD within 2 s"),
        ("uav1", "collided no"),
        ("uav1", "never state FAULT"),
        ("uav2", "collided no"),
        ("uav2", "never state FAULT"),
    ]
    assert report["daemons"]["uav1"]["ticks"] > 0
    assert report["daemons"]["uav2"] is None
    first, second = report["flight"]["vehicles"]
    assert (first["name"], second["name"]) == ("uav1", "uav2")


def test_a_flight_in_real_time_is_checked_too(tmp_path: Path) -> None:
    done, _ = checked(
        tmp_path, '[expect]\nstate_seen = ["ACTIVE"]\nmode_seen = ["OFFBOARD"]\n', "--real-time", "--json"
    )
    assert done.returncode == 0, done.stdout + done.stderr
    report: dict[str, Any] = json.loads(done.stdout)
    assert all(finding["met"] for finding in report["expectations"])


@pytest.mark.parametrize(
    ("words", "faults", "named"),
    [
        (["--real-time"], "", "--real-time"),
        (["--check", "--lockstep"], "", "--lockstep"),
        ([], '[[faults]]\nwhat = "kill"\non = "daemon"\nat_s = 1.0', "faults[0]: expected --check"),
        (["--check"], '[[faults]]\nwhat = "rc"\non = "autopilot"\nat_s = 1.0\nvalue = "SWIM"', "SWIM"),
    ],
)
def test_wrong_usage_is_one_line_and_status_2(tmp_path: Path, words: list[str], faults: str, named: str) -> None:
    scenario = tmp_path / "s.toml"
    scenario.write_text(WORLD + faults)
    done = sim("--scenario", str(scenario), "--zenoh-listen", "none", *words)
    assert done.returncode == 2, done.stderr
    (complaint,) = [line for line in done.stderr.splitlines() if line.startswith("sim-bridge: ")]
    assert named in complaint


def test_a_daemon_that_refuses_its_configuration_is_named(tmp_path: Path) -> None:
    scenario = tmp_path / "s.toml"
    scenario.write_text(WORLD.replace("[vehicle]", '[vehicle]\ndaemon = { "safety.horizont" = 3 }'))
    done = sim("--scenario", str(scenario), "--check")
    assert done.returncode == 2
    assert "daemon of uav1" in done.stderr
    assert "horizont" in done.stderr


def test_a_signal_before_the_flight_leaves_no_daemon_behind(tmp_path: Path) -> None:
    words = [sys.executable, "-m", "sim_bridge.cli", "run", "--scenario", "empty", "--check", "--logs", str(tmp_path)]
    child = subprocess.Popen(words, stdout=subprocess.DEVNULL, start_new_session=True)
    try:
        deadline = time.monotonic() + 30.0
        while not (tmp_path / "uav1.log").exists() and time.monotonic() < deadline:  # its daemon is about to start
            time.sleep(0.005)
        time.sleep(0.05)
        os.kill(child.pid, signal.SIGTERM)
        assert child.wait(30.0) == 1
        with pytest.raises(ProcessLookupError):  # nobody is left of its group
            os.killpg(child.pid, 0)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)
