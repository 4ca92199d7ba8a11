"""`companion publish` against a plain Zenoh subscriber on loopback."""

from __future__ import annotations

import argparse
import io
import json
import math
import queue
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from companion.config_links import ZenohConfig
from companion.errors import ConfigError
from companion.link.zenoh import open_session
from companion.publish import add_parser, parse_motion, run

pytestmark = pytest.mark.integration


class Listener:
    def __init__(self) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
        self.session = open_session(ZenohConfig(listen=(self.endpoint,)))
        self._samples: queue.Queue[tuple[str, dict]] = queue.Queue()
        self.session.declare_subscriber(
            "uav/**", lambda s: self._samples.put((str(s.key_expr), json.loads(s.payload.to_bytes())))
        )

    def take(self, count: int) -> list[tuple[str, dict]]:
        return [self._samples.get(timeout=5.0) for _ in range(count)]


@pytest.fixture
def listener() -> Iterator[Listener]:
    heard = Listener()
    yield heard
    heard.session.close()


def publish(*arguments: str) -> int:
    parser = argparse.ArgumentParser()
    add_parser(parser.add_subparsers())
    args = parser.parse_args(["publish", *arguments])
    return args.handler(args)


def frame(stamp_ns: int, **changes: object) -> str:
    obstacle = {"id": "ball", "position": [1.0, 2.0, 1.5], "radius": 0.2} | changes
    return json.dumps({"stamp_ns": stamp_ns, "clock": "vehicle", "obstacles": [obstacle]})


def test_file_is_sent_with_fresh_unix_stamps(listener: Listener, tmp_path: Path) -> None:
    file = tmp_path / "frames.jsonl"
    file.write_text(f"{frame(0)}\n\n{frame(20_000_000)}\n")
    before = time.time_ns()
    arguments = ("--key-source", "lidar", "--name", "uav7", "--from", str(file), "--connect", listener.endpoint)
    assert publish(*arguments) == 0
    (key, first), (_, second) = listener.take(2)
    assert key == "uav/uav7/obstacles/lidar"
    assert first["clock"] == second["clock"] == "unix"
    assert before <= first["stamp_ns"] < second["stamp_ns"] <= time.time_ns()
    assert second["stamp_ns"] - first["stamp_ns"] >= 15_000_000  # paced by the file's own stamps
    assert first["obstacles"][0]["position"] == [1.0, 2.0, 1.5]


def test_kept_stamps_from_standard_input(listener: Listener, monkeypatch: pytest.MonkeyPatch) -> None:
    text = io.TextIOWrapper(io.BytesIO(f"{frame(0)}\n{frame(10**12)}\n".encode()))
    monkeypatch.setattr("sys.stdin", text)
    assert publish("--from", "-", "--keep-stamps", "--connect", listener.endpoint) == 0
    assert [(key, sent["stamp_ns"], sent["clock"]) for key, sent in listener.take(2)] == [
        ("uav/uav1/obstacles/cli", 0, "vehicle"),
        ("uav/uav1/obstacles/cli", 10**12, "vehicle"),
    ]


def test_bad_lines_are_named_counted_and_fail(
    listener: Listener, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "frames.jsonl"
    lines = [frame(0), "{", frame(0, radius=-1.0), frame(0, position=[1.0, 2.0]), '{"stamp_ns": 1}', frame(1)]
    file.write_bytes("\n".join(lines).encode() + b'\n{"stamp_ns": "\xff"}\n')
    assert publish("--from", str(file), "--rate", "1000", "--connect", listener.endpoint) == 1
    listener.take(2)
    errors = capsys.readouterr().err.splitlines()
    for number, expectation in ((2, "malformed"), (3, "radius: expected"), (4, "position"), (5, "clock"), (7, "")):
        assert any(f"{file}:{number}: " in line and expectation in line for line in errors)
    assert errors[-1] == "companion publish: 2 frames on uav/uav1/obstacles/cli, 5 bad lines skipped"


def test_made_up_orbit(listener: Listener) -> None:
    spec = "center=1,2,1.5 radius=2 speed=1.5"
    assert publish("--orbit", spec, "--rate", "200", "--duration", "0.05", "--connect", listener.endpoint) == 0
    for number, (_, sent) in enumerate(listener.take(10)):
        (ball,) = sent["obstacles"]
        angle = 1.5 / 2.0 * number / 200
        assert ball["position"] == pytest.approx([1 + 2 * math.cos(angle), 2 + 2 * math.sin(angle), 1.5])
        assert ball["radius"] == 0.2


def test_nobody_listening_is_told_and_fails(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("companion.publish.MATCH_S", 0.1)
    file = tmp_path / "frames.jsonl"
    file.write_text(frame(0))
    assert publish("--from", str(file)) == 1
    assert "no subscriber on uav/uav1/obstacles/cli" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("--from", "/no/such/file"), "--from /no/such/file: cannot be read"),
        (("--orbit", "center=1,2 radius=2 speed=1"), "--orbit .*expected .*got center=1,2"),
        (("--orbit", "center=1,2,3 radius=0 speed=1"), "radius above 0"),
        (("--line", "start=0,0,1 end=1,1,1"), "speed is missing"),
        (("--eight", "center=0,0,nan size=1 speed=1"), "got center=0,0,nan"),
        (("--orbit", "center=1,2,3 radius=2 speed=1", "--rate", "0"), "--rate 0.0: expected a number above 0"),
        (("--orbit", "center=1,2,3 radius=2 speed=1", "--key-source", "a/b"), "--key-source a/b: expected one chunk"),
        (("--orbit", "center=1,2,3 radius=2 speed=1", "--connect", "here"), "zenoh.connect: expected endpoints"),
    ],
)
def test_wrong_options_name_the_option(arguments: tuple[str, ...], named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        publish(*arguments)


def test_motions_have_the_speed_they_state() -> None:
    h = 1e-6
    for kind, spec, at in (
        ("orbit", "center=0,0,1 radius=2 speed=1.5", 0.7),
        ("line", "start=0,-3,1.5 end=0,3,1.5 speed=1.5", 0.7),
        ("eight", "center=0,0,1 size=2 speed=1.5", 0.0),
    ):
        motion = parse_motion(kind, spec)
        assert math.dist(motion(at + h), motion(at)) / h == pytest.approx(1.5, rel=1e-4)
    there_and_back = parse_motion("line", "start=0,-3,1.5 end=0,3,1.5 speed=1.5")
    assert there_and_back(4.0) == (0.0, 3.0, 1.5)
    assert there_and_back(8.0) == (0.0, -3.0, 1.5)


def test_handler_is_run() -> None:
    parser = argparse.ArgumentParser()
    add_parser(parser.add_subparsers())
    assert parser.parse_args(["publish", "--from", "-"]).handler is run
