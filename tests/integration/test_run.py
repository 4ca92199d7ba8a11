"""`companion run` as a process: bad input is one line and status 2, signals end it, noise does not."""

from __future__ import annotations

import contextlib
import json
import queue
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sim_bridge.testing import free_port

pytestmark = pytest.mark.integration


def start(*words: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "companion.cli", *words]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def refused(*words: str) -> str:
    """The one line on standard error of a run that ends with status 2."""
    process = start(*words)
    out, err = process.communicate(timeout=30)
    assert process.returncode == 2, err
    assert out == ""
    lines = err.strip().splitlines()
    assert len(lines) == 1, err
    return lines[0]


def settings(tmp_path: Path, port: int, endpoint: str, *extra: str) -> list[str]:
    path = tmp_path / "vehicle.toml"
    path.write_text(
        f'[mavlink]\nurl = "udpin://127.0.0.1:{port}"\nsystem_id = 1\n[zenoh]\nlisten = ["{endpoint}"]\n',
        encoding="utf-8",
    )
    return ["run", "-c", str(path), "--json", *(word for item in extra for word in ("--set", item))]


@pytest.fixture
def endpoint() -> str:
    return f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"


def test_unknown_key(tmp_path: Path, endpoint: str) -> None:
    line = refused(*settings(tmp_path, free_port(), endpoint, "safety.alpha9=1"))
    assert "vehicle.toml" in line
    assert "alpha9" in line


def test_missing_file() -> None:
    assert "absent.toml: cannot be read" in refused("run", "-c", "absent.toml")


def test_missing_artifact(tmp_path: Path, endpoint: str) -> None:
    line = refused(*settings(tmp_path, free_port(), endpoint, 'policy.artifact="/nowhere/policy"'))
    assert "policy.artifact" in line
    assert "/nowhere/policy" in line


def test_port_in_use(tmp_path: Path, endpoint: str) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        line = refused(*settings(tmp_path, port, endpoint))
    assert str(port) in line
    assert "mavlink.url" in line


def test_zenoh_endpoint_in_use(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        line = refused(*settings(tmp_path, free_port(), f"tcp/127.0.0.1:{taken.getsockname()[1]}"))
    assert "zenoh" in line


def test_unwritable_log(tmp_path: Path, endpoint: str) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    line = refused(*settings(tmp_path, free_port(), endpoint, f'log.directory="{tmp_path}/file/logs"'))
    assert "log.directory" in line


def test_usage_is_status_2() -> None:
    process = start("fly")
    _, err = process.communicate(timeout=30)
    assert process.returncode == 2
    assert "usage" in err


class Daemon:
    """A daemon that runs, the autopilot's side of its UDP link, and its Zenoh neighbour."""

    def __init__(self, tmp_path: Path, endpoint: str, *extra: str) -> None:
        port = free_port()
        self.address = ("127.0.0.1", port)
        self.process = start(*settings(tmp_path, port, endpoint, *extra))
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.mav = dialect.MAVLink(None, 1, 1)
        self.received: list[Any] = []
        self.statuses: queue.Queue[dict[str, Any]] = queue.Queue()
        self.k = 0
        config = zenoh.Config()
        config.insert_json5("connect/endpoints", json.dumps([endpoint]))
        config.insert_json5("scouting/multicast/enabled", "false")
        self.session = zenoh.open(config)
        self.subscriber = self.session.declare_subscriber(
            "uav/uav1/companion/status", lambda sample: self.statuses.put(json.loads(sample.payload.to_bytes()))
        )

    def fly(self, k: int) -> None:
        """One 20 Hz tick of an autopilot that stands on the ground."""
        if k % 10 == 0:
            self._send(self.mav.heartbeat_encode(2, 12, 81, 4 << 16 | 3 << 24, 4))
        self._send(self.mav.attitude_quaternion_encode(50 * k, 1.0, 0, 0, 0, 0, 0, 0))
        self._send(self.mav.local_position_ned_encode(50 * k, 0.0, 0.0, -2.0, 0.0, 0.0, 0.0))
        self.socket.settimeout(0.05)
        with contextlib.suppress(TimeoutError):
            while True:
                self.received.extend(self.mav.parse_buffer(self.socket.recv(4096)) or [])

    def _send(self, message: Any) -> None:
        self.socket.sendto(message.pack(self.mav), self.address)

    def wait_status(self, accept: Any, before_tick: Callable[[int], None] = lambda k: None) -> dict[str, Any]:
        """Keep the telemetry coming until a status is accepted; ``before_tick`` is called with each tick's number."""
        deadline = time.monotonic() + 20.0
        last: dict[str, Any] = {}
        while time.monotonic() < deadline:
            self.k += 1
            before_tick(self.k)
            self.fly(self.k)
            while not self.statuses.empty():
                last = self.statuses.get()
                if accept(last):
                    return last
        raise AssertionError(f"status never came, last {last}")

    def setpoints(self) -> list[Any]:
        return [m for m in self.received if m.get_type() == "SET_POSITION_TARGET_LOCAL_NED"]

    def close(self) -> None:
        self.subscriber.undeclare()
        self.session.close()
        self.socket.close()
        if self.process.poll() is None:
            self.process.kill()
        self.process.communicate()


@pytest.fixture
def daemon(tmp_path: Path, endpoint: str) -> Iterator[Daemon]:
    running = Daemon(tmp_path, endpoint)
    yield running
    running.close()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_it_within_a_second(daemon: Daemon, number: signal.Signals) -> None:
    daemon.wait_status(lambda status: status["state"] == "READY")
    began = time.monotonic()
    daemon.process.send_signal(number)
    out, err = daemon.process.communicate(timeout=10)
    assert time.monotonic() - began < 1.0, err
    assert daemon.process.returncode == 0, err
    summary = json.loads(out)
    assert summary["final_state"] == "READY"
    assert summary["ticks"] > 0


def test_one_setpoint_a_state_with_its_stamp(daemon: Daemon) -> None:
    daemon.wait_status(lambda status: status["state"] == "READY")
    for k in range(1000, 1020):
        daemon.fly(k)
    stamps = [m.time_boot_ms for m in daemon.setpoints() if m.time_boot_ms >= 50_000]
    assert stamps == [50 * k for k in range(1000, 1020)]
    assert {m.type_mask for m in daemon.setpoints()} == {0x0C3F}
    assert {m.coordinate_frame for m in daemon.setpoints()} == {1}


def test_noise_on_every_door_is_counted_and_survived(daemon: Daemon) -> None:
    daemon.wait_status(lambda status: status["state"] == "READY")
    for size in (1, 7, 280, 1400):
        daemon.socket.sendto(bytes((i * 37 + size) % 256 for i in range(size)), daemon.address)
    put = daemon.session.put
    put("uav/uav1/obstacles/bad", b"\xff\xfe not json")
    put("uav/uav1/obstacles/bad", json.dumps({"stamp_ns": 1, "clock": "vehicle"}))
    far = {"id": "x", "position": [1e9, 0, 0], "radius": 0.2}
    nan = '{"stamp_ns": 1, "clock": "vehicle", "obstacles": [{"position": [NaN, 0, 0], "radius": 1}]}'
    put("uav/uav1/obstacles/bad", nan)
    put("uav/uav1/obstacles/bad", json.dumps({"stamp_ns": 10**12, "clock": "vehicle", "obstacles": []}))
    put("uav/uav1/target", b"[]")
    put("uav/uav1/engage", b"{}")

    def counted(status: dict[str, Any]) -> bool:
        counts = status["counts"]
        return (
            counts.get("obstacles.malformed", 0) >= 3
            and counts.get("obstacles.future", 0) >= 1
            and counts.get("mavlink.garbage_bytes", 0) > 0
        )

    status = daemon.wait_status(counted)
    assert status["state"] == "READY"

    def put_far(k: int) -> None:  # with a stamp that this tick accepts, so that the range is what it is refused for
        put("uav/uav1/obstacles/bad", json.dumps({"stamp_ns": 50_000_000 * k, "clock": "vehicle", "obstacles": [far]}))

    status = daemon.wait_status(lambda status: status["counts"].get("obstacles.out_of_range", 0) > 0, put_far)
    assert status["state"] == "READY"
    assert status["tracks"] == 0
    assert daemon.process.poll() is None


def test_queries_are_answered(daemon: Daemon) -> None:
    daemon.wait_status(lambda status: status["state"] == "READY")

    def ask(key: str, payload: object | None = None) -> dict[str, Any]:
        replies = daemon.session.get(f"uav/uav1/{key}", payload=None if payload is None else json.dumps(payload))
        return next(json.loads(reply.ok.payload.to_bytes()) for reply in replies)

    assert ask("target", {"position": [1, 1, 2]}) == {"accepted": True, "reason": ""}
    refusal = ask("target", {"position": [99, 0, 2]})
    assert not refusal["accepted"]
    assert "arena" in refusal["reason"]
    assert not ask("target", {})["accepted"]
    assert not ask("target", {"position": [1, 1, 2], "yaw": 1.0})["accepted"]
    assert ask("engage", {"engaged": False})["accepted"]
    assert ask("companion/config")["config"]["safety"]["horizon"] == 20
    assert ask("companion/health")["state"] in {"READY", "WAITING"}
