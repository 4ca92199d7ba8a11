"""`companion demo` over real processes and sockets, in lockstep."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from companion.cli import main

pytestmark = pytest.mark.integration


def demo(folder: Path, *words: str) -> tuple[int, dict[str, Any]]:
    """Exit status and JSON of a lockstep demo."""
    command = [sys.executable, "-m", "companion.cli", "demo", "--lockstep", "--json", "--out", str(folder), *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stdout.count("\n") == 1, done.stderr  # one JSON object and nothing else
    return done.returncode, json.loads(done.stdout)


def test_same_seed_same_flight_to_the_bit(tmp_path: Path) -> None:
    status, first = demo(tmp_path / "a", "--seed", "100")
    assert status == 0
    assert first["reached"]
    assert not first["collided"]
    assert first["min_clearance_m"] > 0.0
    assert first["flight_time_s"] >= first["unobstructed_time_s"] > 0.0
    assert sum(first["verdicts"].values()) > 100
    status, second = demo(tmp_path / "b", "--seed", "100")
    assert status == 0
    assert second["log_hash"] == first["log_hash"]
    assert second["verdicts"] == first["verdicts"]
    status, other = demo(tmp_path / "c", "--seed", "101")
    assert status == 0
    assert other["log_hash"] != first["log_hash"]
    _check_log(Path(first["log"]), first)
    assert main(["replay", first["log"]]) == 0  # this process answers as the daemon did, to the bit
    assert (tmp_path / "a" / "flight.png").read_bytes()[:4] == b"\x89PNG"


def _check_log(path: Path, report: dict[str, Any]) -> None:
    """The log opens with the stock reader and tells the same story."""
    with path.open("rb") as file:
        reader = make_reader(file)
        channels = {channel.topic for channel in reader.get_summary().channels.values()}
        verdicts: dict[str, int] = {}
        for _, _, message in reader.iter_messages(topics=["/companion/setpoint"]):
            record = json.loads(message.data)
            verdicts[record["verdict"]] = verdicts.get(record["verdict"], 0) + 1
    assert {"/companion/config", "/companion/input/obstacles", "/companion/vehicle", "/companion/tracks"} <= channels
    assert verdicts == report["verdicts"]


def test_the_control_without_the_filter_collides(tmp_path: Path) -> None:
    status, report = demo(tmp_path, "--seed", "100", "--filter", "none")
    assert status == 1
    assert report["collided"]
    assert report["min_clearance_m"] <= 0.0


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--scenario", "nowhere"], "nowhere"),
        (["--set", "safety.alpha9=1"], "alpha9"),
        (["--set", 'policy.artifact="/nowhere"'], "/nowhere"),
        (["--scenario", "empty"], "target"),
    ],
)
def test_mistakes_are_one_line_and_status_2(tmp_path: Path, words: list[str], expected: str) -> None:
    command = [sys.executable, "-m", "companion.cli", "demo", "--lockstep", "--json", "--out", str(tmp_path), *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2, done.stderr
    assert done.stdout == ""
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 1, done.stderr
    assert expected in lines[0]


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    folder = tmp_path / "file" / "out"
    (tmp_path / "file").write_bytes(b"")
    status, line = mistake("--out", str(folder))
    assert status == 2
    assert line == f"companion: --out {folder}: cannot be made (Not a directory), expected a folder to write to"


def test_a_missing_configuration_is_named_once_and_nothing_starts(tmp_path: Path) -> None:
    missing = tmp_path / "missing.toml"
    status, line = mistake("--out", str(tmp_path / "out"), "-c", str(missing))
    assert status == 2
    assert line == f"companion: {missing}: cannot be read (No such file or directory), expected a TOML file"
    assert not (tmp_path / "out").exists()


def mistake(*words: str) -> tuple[int, str]:
    """Exit status and the one line on standard error."""
    command = [sys.executable, "-m", "companion.cli", "demo", "--lockstep", "--json", *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1, done.stderr
    return done.returncode, done.stderr.rstrip()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_simulator_and_the_daemon_too(tmp_path: Path, number: signal.Signals) -> None:
    """Sent as soon as all three processes run, long before the first flight can be over."""
    command = [sys.executable, "-m", "companion.cli", "demo", "--json", "--out", str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as demo:
        wanted = ("sim_bridge.cli run", "companion.cli run", "companion.demo.operator")
        while len(found := [pid for words in wanted if (pid := _child(demo.pid, words))]) < len(wanted):
            assert demo.poll() is None, demo.communicate()
            os.sched_yield()
        demo.send_signal(number)
        said, complained = demo.communicate(timeout=20)
    alive = [pid for pid in found if Path(f"/proc/{pid}").exists()]
    for pid in alive:
        os.kill(pid, signal.SIGKILL)
    assert alive == []
    assert (demo.returncode, said) == (1, "")
    assert complained == f"companion: demo: stopped by {number.name}\n"


def _child(parent: int, words: str) -> int | None:
    """The child of ``parent`` with ``words`` in its command line, once it exists."""
    for pid in Path(f"/proc/{parent}/task/{parent}/children").read_text().split():
        with suppress(FileNotFoundError, ProcessLookupError):
            if words in Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode():
                return int(pid)
    return None


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_ten_seeds_reach_and_ten_controls_collide(tmp_path: Path) -> None:
    reports = [demo(tmp_path / str(seed), "--seed", str(seed)) for seed in range(10)]
    assert [status for status, _ in reports] == [0] * 10
    controls = [demo(tmp_path / f"none{seed}", "--seed", str(seed), "--filter", "none")[1] for seed in range(10)]
    assert sum(report["collided"] for report in controls) >= 8


def test_nobody_can_watch_a_lockstep_flight(tmp_path: Path) -> None:
    words = ["demo", "--lockstep", "--watch", "--out", str(tmp_path / "x")]
    command = [sys.executable, "-m", "companion.cli", *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "--watch: expected without --lockstep" in done.stderr
