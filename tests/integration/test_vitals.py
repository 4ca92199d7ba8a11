"""A daemon under systemd's eyes: one process with a real NOTIFY_SOCKET, its probes by HTTP, and its log as JSON."""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sim_bridge.testing import free_port

pytestmark = pytest.mark.integration

WATCHDOG_S = 0.8

# the daemon as it is, but once the file exists its control task never ends the turn it is in
STUCK = """
import asyncio, os, signal, sys
from companion.cli import main
from companion.service import Service

turn = Service._housekeeping
def housekeeping(self):
    turn(self)
    if os.path.exists(sys.argv[1]):
        signal.pause()
Service._housekeeping = housekeeping
sys.exit(main(sys.argv[2:]))
"""


class Daemon:
    """`companion run` as a child, as systemd would start it."""

    def __init__(self, folder: Path, *, stuck_file: Path | None = None) -> None:
        name = f"@companion-test-{os.getpid()}-{folder.name}"  # in the abstract namespace
        self.manager = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.manager.bind("\0" + name[1:])
        self.port, self.http = free_port(), free_port(socket.SOCK_STREAM)
        config = folder / "companion.toml"
        config.write_text(
            f'[vehicle]\nname = "uav7"\n[mavlink]\nurl = "udpin://127.0.0.1:{self.port}"\nsystem_id = 1\n'
            f'[zenoh]\nlisten = ["tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"]\n'
            f'[http]\nport = {self.http}\n[log]\nformat = "json"\n',
            encoding="utf-8",
        )
        self.errors = folder / "stderr"
        environment = {**os.environ, "NOTIFY_SOCKET": name, "WATCHDOG_USEC": str(int(WATCHDOG_S * 1e6))}
        run = ["run", "-c", str(config)]
        words = ["-m", "companion.cli", *run] if stuck_file is None else ["-c", STUCK, str(stuck_file), *run]
        with self.errors.open("wb") as errors:
            self.process = subprocess.Popen([sys.executable, *words], stderr=errors, env=environment)
        self.heard: list[str] = []

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        self.manager.close()

    def wait_said(self, prefix: str, timeout_s: float = 20.0) -> str:
        """The first assignment from now on that begins with ``prefix``."""
        deadline = time.monotonic() + timeout_s
        while (left := deadline - time.monotonic()) > 0:
            if not select.select([self.manager], [], [], left)[0]:
                break
            words = self.manager.recv(4096).decode().split("\n")
            self.heard += words
            for word in words:
                if word.startswith(prefix):
                    return word
        raise AssertionError(f"no {prefix} within {timeout_s} s, heard {self.heard}: {self.errors.read_text()}")

    def is_silent(self, seconds: float) -> bool:
        """Whether nothing is said for so long, once what was said before is read."""
        while select.select([self.manager], [], [], 0.0)[0]:
            self.manager.recv(4096)
        return not select.select([self.manager], [], [], seconds)[0]

    def get(self, path: str) -> tuple[int, str, bytes]:
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{self.http}{path}", timeout=5.0) as answer:
                return answer.status, answer.headers["Content-Type"], answer.read()
        except urllib.error.HTTPError as error:
            with error:
                return error.code, error.headers["Content-Type"], error.read()

    def log(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.errors.read_text(encoding="utf-8").splitlines()]


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    with contextlib.closing(Daemon(tmp_path_factory.mktemp("vitals"))) as running:
        running.wait_said("READY=1")
        yield running


def test_the_watchdog_is_fed_and_starves_while_the_daemon_is_stopped(daemon: Daemon) -> None:
    for _ in range(3):
        daemon.wait_said("WATCHDOG=1", WATCHDOG_S)
    os.kill(daemon.process.pid, signal.SIGSTOP)
    try:
        assert daemon.is_silent(2 * WATCHDOG_S)
    finally:
        os.kill(daemon.process.pid, signal.SIGCONT)
    daemon.wait_said("WATCHDOG=1")


def test_probes_before_and_with_a_vehicle(daemon: Daemon) -> None:
    status, kind, body = daemon.get("/healthz")
    assert (status, kind) == (503, "application/json; charset=utf-8")
    assert json.loads(body)["reasons"] == ["no fresh vehicle state: no heartbeat"]
    assert daemon.get("/livez")[0] == 200
    mav = dialect.MAVLink(None, 1, 1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot:
        autopilot.connect(("127.0.0.1", daemon.port))
        for tick in range(1, 200):
            for message in (
                mav.heartbeat_encode(2, 12, 0, 4 << 16 | 3 << 24, 4),
                mav.attitude_quaternion_encode(50 * tick, 1.0, 0, 0, 0, 0, 0, 0),
                mav.local_position_ned_encode(50 * tick, 0, 0, -2, 0, 0, 0),
            ):
                autopilot.send(message.pack(mav))
            if daemon.get("/healthz")[0] == 200:
                break
        status, kind, body = daemon.get("/metrics")
        health = json.loads(daemon.get("/healthz")[2])
    assert (status, kind) == (200, "text/plain; version=0.0.4; charset=utf-8")
    assert (health["healthy"], health["state"], health["reasons"]) == (True, "READY", [])
    values = {s.name: s.value for f in text_string_to_metric_families(body.decode()) for s in f.samples if not s.labels}
    assert values["companion_vehicle_fresh"] == 1
    assert values["companion_mavlink_messages_received_total"] >= 3
    assert values["companion_tick_latency_seconds_count"] >= 1
    assert 0 <= values["companion_control_age_seconds"] < 1
    assert values["process_resident_memory_bytes"] > 10e6
    assert daemon.wait_said("STATUS=READY") == "STATUS=READY: vehicle fresh"


def test_a_stop_is_told_and_every_line_was_json(daemon: Daemon) -> None:
    daemon.process.send_signal(signal.SIGTERM)
    daemon.wait_said("STOPPING=1")
    assert daemon.process.wait(timeout=20.0) == 0
    log = daemon.log()
    assert {line["vehicle"] for line in log} == {"uav7"}
    changes = [(line["state"], line["reason"]) for line in log if "state" in line]
    assert ("READY", "vehicle fresh") in changes
    assert log[-1]["message"] == "stopping"


def test_a_stuck_control_task_starves_the_watchdog_and_says_where(tmp_path: Path) -> None:
    with contextlib.closing(Daemon(tmp_path, stuck_file=tmp_path / "stuck")) as daemon:
        daemon.wait_said("READY=1")
        daemon.wait_said("WATCHDOG=1")
        (tmp_path / "stuck").touch()
        while not daemon.is_silent(WATCHDOG_S):
            pass  # a turn under way still ends with its beat
        assert daemon.is_silent(2 * WATCHDOG_S)
        daemon.process.send_signal(signal.SIGABRT)  # as systemd does
        assert daemon.process.wait(timeout=10.0) == -signal.SIGABRT
        assert "in _control" in daemon.errors.read_text(encoding="utf-8")


def test_a_daemon_that_cannot_start_says_so_in_json(tmp_path: Path) -> None:
    config = tmp_path / "companion.toml"
    config.write_text('[mavlink]\nurl = "udpin://203.0.113.1:14540"\n[log]\nformat = "json"\n', encoding="utf-8")
    words = [sys.executable, "-m", "companion.cli", "run", "-c", str(config)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=30.0)
    assert done.returncode == 2
    line = json.loads(done.stderr.splitlines()[-1])
    assert line["level"] == "critical"
    assert line["message"].startswith("mavlink.url udpin://203.0.113.1:14540")
