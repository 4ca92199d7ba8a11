"""`companion monitor` as processes, beside a Zenoh session that publishes what a daemon does."""

from __future__ import annotations

import contextlib
import json
import os
import pty
import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
import zenoh
from monitor_scene import payloads

from companion.config_links import ZenohConfig
from companion.link.zenoh import open_session
from sim_bridge.testing import free_port

pytestmark = pytest.mark.integration


class Publisher:
    """Two vehicles that publish at 20 Hz from a thread, each with its token; ``b`` can be silenced."""

    def __init__(self) -> None:
        self.endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
        self.session = open_session(ZenohConfig(listen=(self.endpoint,)))
        self.tokens = {name: self._token(name) for name in ("a", "b")}
        self.queried: list[str] = []
        self._config = self.session.declare_queryable("uav/a/companion/config", self._answer)
        self._recorded = payloads()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._publish)
        self._thread.start()

    def _token(self, name: str) -> Any:
        return self.session.liveliness().declare_token(f"uav/{name}/companion/alive")

    def _answer(self, query: zenoh.Query) -> None:
        self.queried.append(str(query.key_expr))
        with query:
            query.reply(str(query.key_expr), b'{"config": {"safety": {"drone_radius_m": 1.2}}}')

    def _publish(self) -> None:
        while not self._stop.wait(0.05):
            for name in self.tokens:
                for kind, payload in self._recorded.items():
                    self.session.put(f"uav/{name}/companion/{kind}", payload)

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self.session.close()  # type: ignore[no-untyped-call]


@pytest.fixture(scope="module")
def network() -> Iterator[Publisher]:
    with contextlib.closing(Publisher()) as publisher:
        yield publisher


def monitor(*words: str) -> list[str]:
    return [sys.executable, "-m", "companion.cli", "monitor", *words]


def test_objects_into_a_pipe_and_a_token_that_drops(network: Publisher) -> None:
    words = monitor("--connect", network.endpoint, "--json")
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        seen: list[dict[str, dict[str, Any]]] = []
        try:
            for text in process.stdout:
                seen.append({each["name"]: each for each in json.loads(text)["vehicles"]})
                both = {name: each["presence"] for name, each in seen[-1].items()}
                if both == {"a": "alive", "b": "alive"} and "b" in network.tokens and network.queried:
                    network.tokens.pop("b").undeclare()
                if both.get("b") == "gone" or len(seen) > 20:
                    break
        finally:
            process.terminate()
    last = seen[-1]
    assert (last["a"]["presence"], last["b"]["presence"]) == ("alive", "gone")
    a = last["a"]
    assert (a["state"], a["mode"], a["nearest"]["id"]) == ("ACTIVE", "OFFBOARD", "cam/ball")
    assert a["nearest"]["clearance_m"] == pytest.approx(2.11 - 0.2 - 1.2, abs=0.05)  # with the radius it was told
    assert 10.0 < a["rate_hz"] < 30.0
    assert a["sources"]["cam"] == {"age_s": 0.05, "frames": 40}


def test_lines_of_one_vehicle_and_a_reader_that_leaves(network: Publisher) -> None:
    words = monitor("--connect", network.endpoint, "--name", "a", "--count", "5")
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        process.stdout.close()
        assert process.wait(timeout=20.0) == 0
        assert process.stderr is not None
        assert process.stderr.read() == ""
    assert line.startswith("a ACTIVE (external mode entered), OFFBOARD armed in the air engaged, ")
    assert "to cam/ball closing" in line


def test_a_terminal_until_q(network: Publisher) -> None:
    ours, theirs = pty.openpty()
    environment = {**os.environ, "TERM": "xterm-256color", "COLUMNS": "120", "LINES": "40"}
    words = monitor("--connect", network.endpoint, "--name", "a")
    with subprocess.Popen(words, stdin=theirs, stdout=theirs, stderr=subprocess.PIPE, env=environment) as process:
        os.close(theirs)
        drawn, deadline, asked = b"", time.monotonic() + 20.0, False
        while process.poll() is None and time.monotonic() < deadline:
            if select.select([ours], [], [], 0.1)[0]:
                with contextlib.suppress(OSError):  # the other end was closed
                    drawn += os.read(ours, 65536)
            if b"cam/ball" in drawn and not asked:
                asked = True
                os.write(ours, b"q")
        assert process.wait(timeout=5.0) == 0
        assert process.stderr is not None
        assert process.stderr.read() == b""
    os.close(ours)
    assert b"\x1b[?1049h" in drawn  # the other screen, and back
    assert drawn.rstrip().endswith((b"\x1b[?1049l", b"\x1b[?25h"))
    assert b"companion monitor: a" in drawn


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--name", "a/b"), "companion: --name a/b: expected the name of a vehicle, or all"),
        (("--count", "0"), "companion: --count 0: expected a number above 0"),
        (("--connect", "nonsense"), "companion: zenoh"),
    ],
)
def test_wrong_usage(words: tuple[str, ...], expected: str, capsys: pytest.CaptureFixture[str]) -> None:
    from companion.cli import main

    assert main(["monitor", *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(expected)
