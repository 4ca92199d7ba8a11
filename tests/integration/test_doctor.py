"""`companion doctor` on real sockets: beside the simulator, and beside an ArduPilot of pymavlink."""

from __future__ import annotations

import contextlib
import json
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from doctor_peer import ARDUPILOT, Peer

from companion.cli import main
from companion.doctor import machine
from sim_bridge.testing import free_port

pytestmark = pytest.mark.integration

ARDU_VALUES = {"GUID_TIMEOUT": 3.0, "GUID_OPTIONS": 0, "PSC_JERK_XY": 5.0, "FS_GCS_ENABLE": 1, "WPNAV_SPEED": 500.0}


def config_file(folder: Path, port: int, *, profile: str = "crazyflie-sim", more: str = "") -> Path:
    """System 1 on ``port``; ``more`` is TOML."""
    path = folder / "doctor.toml"
    text = f'[vehicle]\nprofile = "{profile}"\n[mavlink]\nurl = "udpin://127.0.0.1:{port}"\nsystem_id = 1\n{more}'
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture(autouse=True)
def few_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "STEPS", 100)


def doctor(config: Path, *words: str) -> int:
    return main(["doctor", "-c", str(config), "--duration", "1", *words])


def told(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    """The one object on stdout, its checks by name."""
    answer: dict[str, Any] = json.loads(capsys.readouterr().out)
    return {**answer, "checks": {check["name"]: check for check in answer["checks"]}}


@pytest.fixture
def simulator(tmp_path: Path) -> Iterator[Callable[[str], tuple[int, str]]]:
    """Start a simulator; its onboard port and Zenoh endpoint."""
    started: list[subprocess.Popen[bytes]] = []

    def run(scenario: str) -> tuple[int, str]:
        port, endpoint = free_port(), f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
        ports = ["--onboard-port", str(port), "--gcs-port", str(free_port()), "--zenoh-listen", endpoint]
        with (tmp_path / "simulator.log").open("wb") as log:
            words = [sys.executable, "-m", "sim_bridge.cli", "run", "--scenario", scenario, *ports]
            started.append(subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=log))
        return port, endpoint

    yield run
    for process in started:
        process.kill()
        process.wait()


@pytest.fixture
def ardupilot() -> Iterator[Callable[..., tuple[Peer, int]]]:
    """Start an ArduPilot on a thread of its own; it sends to a port on which the doctor will listen."""
    threads: list[tuple[threading.Thread, threading.Event]] = []

    def run(**options: Any) -> tuple[Peer, int]:
        peer, port, over = Peer(ARDUPILOT, ARDU_VALUES, **options), free_port(), threading.Event()

        def fly() -> None:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
                sock.bind(("127.0.0.1", 0))
                sock.settimeout(0.002)
                while not over.is_set():
                    data = b""
                    with contextlib.suppress(TimeoutError, ConnectionError):
                        data = sock.recv(4096)
                    now_s = time.monotonic()
                    for packet in (peer.take(data, now_s) if data else b"", peer.stream(now_s)):
                        if packet:
                            with contextlib.suppress(ConnectionError):
                                sock.sendto(packet, ("127.0.0.1", port))

        thread = threading.Thread(target=fly)
        thread.start()
        threads.append((thread, over))
        return peer, port

    yield run
    for thread, over in threads:
        over.set()
        thread.join()


def test_the_simulator_is_found_read_and_fit_to_fly(
    simulator: Callable[[str], tuple[int, str]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    port, endpoint = simulator("demo")
    config = config_file(tmp_path, port, more=f'[zenoh]\nconnect = ["{endpoint}"]\n[obstacles]\nrequired = ["sim"]\n')
    assert doctor(config, "--json") == 0
    answer = told(capsys)
    assert answer["status"] == "WARN"  # the simulator has no remote control: COM_RCL_EXCEPT
    assert {n for n, check in answer["checks"].items() if check["level"] == "WARN"} <= {"COM_RCL_EXCEPT", "deadline"}
    for name in ("autopilot", "LOCAL_POSITION_NED", "ATTITUDE_QUATERNION", "EXTENDED_SYS_STATE", "HEARTBEAT",
                 "TIMESYNC", "COM_OF_LOSS_T", "COM_OBL_RC_ACT", "MPC_THR_HOVER", "source sim", "clock of sim",
                 "artifact", "solver daqp", "solver osqp"):  # fmt: skip
        assert answer["checks"][name]["level"] == "PASS", answer["checks"][name]
    vehicle = answer["observation"]["link"]["autopilot"]
    assert vehicle["parameters"] == {
        "COM_OF_LOSS_T": 1.0,
        "COM_OBL_RC_ACT": 5,
        "COM_RCL_EXCEPT": 7,
        "MPC_THR_HOVER": pytest.approx(1.0 / 2.25),  # a Crazyflie lifts 2.25 times its weight
    }
    (source,) = answer["observation"]["zenoh"]["sources"]
    assert source["least_age_s"] == pytest.approx(0.05, abs=0.03)  # the demo's sensor is 50 ms late
    assert answer["if_daemon_dies"].endswith("holds its position (COM_OBL_RC_ACT 5)")

    assert doctor(config, "--fix", "COM_OBL_RC_ACT=4", "--fix", "MPC_THR_HOVER=0.6") == 1
    out = capsys.readouterr().out
    assert "PASS  fix COM_OBL_RC_ACT   was 5, reads 4 now" in out
    assert "FAIL  fix MPC_THR_HOVER    was 0.444444, reads 0.444444 now" in out  # a constant of this vehicle
    assert "If the daemon dies now: after 1 s without setpoints the autopilot lands where it is" in out


def test_an_ardupilot_is_left_as_it_is(
    ardupilot: Callable[..., tuple[Peer, int]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    peer, port = ardupilot()
    assert doctor(config_file(tmp_path, port, profile="ardupilot"), "--json") == 0
    answer = told(capsys)
    assert answer["checks"]["autopilot"]["level"] == "PASS"
    assert answer["checks"]["GUID_TIMEOUT"]["level"] == "WARN"  # 3 s, the default
    assert answer["checks"]["PSC_JERK_XY"]["level"] == "PASS"
    assert answer["checks"]["LOCAL_POSITION_NED"]["level"] == "PASS"
    assert "goes on for 3 s (GUID_TIMEOUT), then it brakes" in answer["if_daemon_dies"]
    assert peer.parameters == ARDU_VALUES
    assert peer.unasked() == []


def test_a_fix_changes_one_parameter_of_an_ardupilot(
    ardupilot: Callable[..., tuple[Peer, int]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    peer, port = ardupilot()
    config = config_file(tmp_path, port, profile="ardupilot")
    assert doctor(config, "--fix", "GUID_TIMEOUT=0.5") == 0
    assert peer.parameters == {**ARDU_VALUES, "GUID_TIMEOUT": 0.5}
    assert set(peer.unasked()) == {"PARAM_SET"}
    assert "PASS  fix GUID_TIMEOUT     was 3, reads 0.5 now" in capsys.readouterr().out


def test_the_wrong_profile_and_an_armed_vehicle_fail(
    ardupilot: Callable[..., tuple[Peer, int]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    peer, port = ardupilot(armed=True)
    assert doctor(config_file(tmp_path, port, profile="px4"), "--json", "--fix", "GUID_TIMEOUT=0.5") == 1
    checks = told(capsys)["checks"]
    assert checks["autopilot"]["level"] == "FAIL"
    assert checks["fix GUID_TIMEOUT"]["found"] == "refused: the vehicle is armed"
    assert peer.unasked() == []


def test_nobody_there_is_a_failure_and_the_machine_is_examined(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    port = free_port()
    assert doctor(config_file(tmp_path, port), "--json") == 1
    answer = told(capsys)
    assert answer["checks"]["autopilot"]["level"] == "FAIL"
    assert answer["checks"]["deadline"]["level"] in {"PASS", "WARN"}
    assert answer["if_daemon_dies"] == "unknown: no autopilot was heard"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as holder:  # such as a daemon that runs already
        holder.bind(("127.0.0.1", port))
        assert doctor(config_file(tmp_path, port), "--json") == 1
    link = told(capsys)["checks"]["link"]
    assert (link["level"], "daemon running" in link["expected"]) == ("FAIL", True)


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--set", "mavlink.url=nonsense"], "mavlink.url nonsense: expected udpin://HOST:PORT"),
        (["--set", "mavlink.urk=1"], "unknown field `urk`"),
        (["--fix", "COM_OBL_RC_ACT"], "--fix COM_OBL_RC_ACT: expected NAME=VALUE"),
        (["--fix", "A=1", "--fix", "A=2"], "--fix: expected each name once"),
        (["--duration", "0"], "--duration 0: expected 0.5 .. 600 s"),
    ],
)
def test_wrong_usage_and_configuration_exit_with_2(
    words: list[str], complaint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert doctor(config_file(tmp_path, free_port()), *words) == 2
    told = capsys.readouterr()
    assert complaint in told.err
    assert told.out == ""


def test_a_file_that_is_not_there_exits_with_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert doctor(tmp_path / "none.toml") == 2
    assert "none.toml" in capsys.readouterr().err
