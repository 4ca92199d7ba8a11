"""sd_notify against sockets of our own, as systemd holds them: a path, and a name in the abstract namespace."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from companion.sdnotify import Notifier

MS = 1_000_000


@pytest.fixture(params=["path", "abstract"])
def manager(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[socket.socket, str]]:
    path = str(tmp_path / "notify")
    name = path if request.param == "path" else "@" + path
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind("\0" + path if request.param == "abstract" else path)
        listening.setblocking(False)
        yield listening, name


def said(listening: socket.socket) -> list[str]:
    words = []
    while True:
        try:
            words += listening.recv(4096).decode().split("\n")
        except BlockingIOError:
            return words


def test_the_life_of_a_daemon(manager: tuple[socket.socket, str]) -> None:
    listening, name = manager
    notifier = Notifier.from_environment({"NOTIFY_SOCKET": name, "WATCHDOG_USEC": "1000000", "WATCHDOG_PID": "7"}, 7)
    assert notifier.watches
    notifier.ready()
    notifier.alive(0, "WAITING: no heartbeat")
    notifier.alive(200 * MS, "WAITING: no heartbeat")
    assert said(listening) == ["READY=1", "WATCHDOG=1", "STATUS=WAITING: no heartbeat"]
    notifier.alive(400 * MS, "READY: vehicle fresh\nMAINPID=1")  # a line of its own would be an order to systemd
    assert said(listening) == ["STATUS=READY: vehicle fresh MAINPID=1"]
    notifier.alive(500 * MS, "READY: vehicle fresh MAINPID=1")
    assert said(listening) == ["WATCHDOG=1"]  # half of what systemd bears
    notifier.stopping()
    notifier.close()
    notifier.alive(9000 * MS, "gone")
    assert said(listening) == ["STOPPING=1"]


def test_what_systemd_did_not_take_is_said_again(tmp_path: Path) -> None:
    path = tmp_path / "notify"
    notifier = Notifier(str(path), watchdog_ns=1000 * MS)
    notifier.alive(0, "READY")
    assert notifier.counts == {"failed": 1}
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(path))
        listening.setblocking(False)
        notifier.alive(1 * MS, "READY")
        assert said(listening) == ["WATCHDOG=1", "STATUS=READY"]
    notifier.close()


@pytest.mark.parametrize(
    ("environment", "watches"),
    [
        ({"WATCHDOG_USEC": "5000000"}, True),
        ({"WATCHDOG_USEC": "5000000", "WATCHDOG_PID": "8"}, False),  # meant for another process
        ({"WATCHDOG_USEC": "0"}, False),
        ({"WATCHDOG_USEC": "-5"}, False),
        ({"WATCHDOG_USEC": "soon"}, False),
        ({}, False),
    ],
)
def test_when_systemd_watches(environment: dict[str, str], watches: bool, tmp_path: Path) -> None:
    notifier = Notifier.from_environment({"NOTIFY_SOCKET": str(tmp_path / "n"), **environment}, 7)
    assert notifier.watches is watches
    notifier.close()


@pytest.mark.parametrize("address", ["", "relative", "@", "vsock:2:1"])
def test_without_a_socket_nothing_is_sent(address: str) -> None:
    notifier = Notifier.from_environment({"NOTIFY_SOCKET": address, "WATCHDOG_USEC": "1000000"})
    notifier.ready()
    notifier.alive(0, "READY")
    assert not notifier.watches
    assert notifier.counts == {}
