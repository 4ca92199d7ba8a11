"""The examples of the README, as printed there, run."""

from __future__ import annotations

import contextlib
import json
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sim_bridge.testing import FlyingPair, free_port

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def example(name: str, text: str = README) -> str:
    match = re.search(rf"<!-- example: {name} -->\n```python\n(.*?)```", text, re.DOTALL)
    assert match is not None, f"no example {name}"
    return match[1]


@pytest.mark.parametrize(("name", "most"), [("publish", 15), ("fixture", 15), ("library", 10)])
def test_examples_are_short(name: str, most: int) -> None:
    assert len([line for line in example(name).splitlines() if line.strip()]) <= most


def test_library_example() -> None:
    done = subprocess.run([sys.executable, "-c", example("library")], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("adjusted")


def test_a_network_of_your_own_flies_as_the_page_says(tmp_path: Path) -> None:
    """docs/how-to/bring-your-own-policy.md: an ONNX file from elsewhere (here the shipped one's) becomes an artefact that evaluates."""
    shutil.copy(ROOT / "policies" / "artifacts" / "default" / "policy.onnx", tmp_path / "my_policy.onnx")
    code = example("foreign", (ROOT / "docs" / "policies.md").read_text(encoding="utf-8"))
    made = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    command = [sys.executable, "-m", "policies.cli", "evaluate", "mine", "--starts", "3", "--json"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["starts"] == 3


@pytest.mark.integration
def test_publish_example_is_tracked(flying_pair: Callable[..., FlyingPair]) -> None:
    pair = flying_pair()
    code = example("publish")
    assert "tcp/127.0.0.1:7447" in code
    namespace: dict[str, object] = {}
    thread = threading.Thread(target=exec, args=(code.replace("tcp/127.0.0.1:7447", pair.daemon_endpoint), namespace))
    thread.start()
    try:
        assert pair.wait_status(lambda status: status["tracks"] == 1)
    finally:
        thread.join()


@pytest.mark.integration
def test_fixture_example(flying_pair: Callable[..., FlyingPair]) -> None:
    namespace: dict[str, Callable[..., None]] = {}
    exec(example("fixture"), namespace)
    (test,) = [value for name, value in namespace.items() if name.startswith("test_")]
    test(flying_pair)


COMMANDS = re.findall(r"^    (companion .*?)(?:\s+#.*)?$", README, re.MULTILINE)


def test_the_readme_has_commands() -> None:
    assert len(COMMANDS) >= 3


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_parse(command: str) -> None:
    """Every command line of the README is one that the parser accepts."""
    from companion.cli import build_parser

    assert build_parser().parse_args(shlex.split(command)[1:]).handler is not None


def test_the_schema_command_describes_the_frame_of_the_example() -> None:
    (command,) = re.findall(r"`companion (schema [^`]+)`", README)
    done = subprocess.run(
        [sys.executable, "-m", "companion.cli", *shlex.split(command)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    definitions = json.loads(done.stdout)["$defs"]
    code = example("publish")
    for name, start in (("ObstacleFrame", "frame = {"), ("Obstacle", "ball = {")):
        written = set(re.findall(r'"(\w+)":', code[code.index(start) :].splitlines()[0]))
        assert set(definitions[name]["required"]) <= written <= set(definitions[name]["properties"]), name


@pytest.mark.integration
def test_the_run_command_runs_until_it_is_told_to_end() -> None:
    """As printed but for the ports: it heartbeats as component 196 of system 1, and SIGTERM ends it with status 0."""
    (command,) = [line for line in COMMANDS if line.startswith("companion run")]
    assert "udpin://0.0.0.0:14540" in command
    url = f"127.0.0.1:{free_port()}"
    words = shlex.split(command.replace("0.0.0.0:14540", url))[1:]
    words += ["--set", f'zenoh.listen=["tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"]']
    process = subprocess.Popen([sys.executable, "-m", "companion.cli", *words], cwd=ROOT, stderr=subprocess.PIPE)
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot:
            autopilot.settimeout(0.2)
            autopilot.connect(("127.0.0.1", int(url.rpartition(":")[2])))
            mav = dialect.MAVLink(None, 1, 1)
            assert (1, 196) in heartbeats(autopilot, mav)
        process.send_signal(signal.SIGTERM)
        _, err = process.communicate(timeout=10)
        assert process.returncode == 0, err
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate()


def heartbeats(autopilot: socket.socket, mav: dialect.MAVLink) -> set[tuple[int, int]]:
    """Senders (system, component) of the first heartbeats that answer ours."""
    deadline = time.monotonic() + 20.0
    while time.monotonic() < deadline:
        with contextlib.suppress(TimeoutError, ConnectionRefusedError):
            autopilot.send(mav.heartbeat_encode(2, 12, 81, 4 << 16 | 3 << 24, 4).pack(mav))
            heard = mav.parse_buffer(autopilot.recv(4096)) or []
            senders = {(m.get_srcSystem(), m.get_srcComponent()) for m in heard if m.get_type() == "HEARTBEAT"}
            if senders:
                return senders
    raise AssertionError("no heartbeat")


def test_named_files_exist() -> None:
    for path in re.findall(r"(?:configs|docs)/[\w/.-]+\.\w+", README):
        assert (ROOT / path).is_file(), path
