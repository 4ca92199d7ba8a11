"""docker/health.py: what a container's health check finds, over real sockets."""

from __future__ import annotations

import importlib.util
import socket
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest

_SPEC = importlib.util.spec_from_file_location("docker_health", Path(__file__).parents[2] / "docker" / "health.py")
assert _SPEC is not None
assert _SPEC.loader is not None
health = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(health)


@pytest.fixture
def web() -> Iterator[int]:
    """The port of a server whose /well is answered with 200 and whose other pages with 503."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200 if self.path == "/well" else 503)
            self.end_headers()
            self.wfile.write(b"no vehicle")

        def log_message(self, *words: object) -> None:
            pass

    server = HTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield server.server_port
    server.shutdown()
    server.server_close()
    thread.join()


def test_health_of_a_daemon(web: int, capsys: pytest.CaptureFixture[str]) -> None:
    assert health.main(["http", str(web), "/well"]) == 0
    assert health.main(["http", str(web), "/ill"]) == 1
    assert "status 503: no vehicle" in capsys.readouterr().out


def test_health_of_a_daemon_that_does_not_listen(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))  # bound and not listening: nobody answers, and nobody else can take it
        assert health.main(["http", str(free.getsockname()[1]), "/livez"]) == 1
    assert "no answer" in capsys.readouterr().out


class _Prefed(socket.socket):
    """A socket to which ``data`` is sent as soon as it is bound."""

    data = b""

    def bind(self, address: Any) -> None:
        super().bind(address)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.sendto(self.data, self.getsockname())


@pytest.mark.parametrize(("data", "status"), [(b"\xfd\x09\x00", 0), (b"\xfe\x09\x00", 0), (b"hello", 1)])
def test_health_of_a_simulator(data: bytes, status: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_Prefed, "data", data)
    monkeypatch.setattr(health.socket, "socket", _Prefed)
    assert health.main(["mavlink", "0"]) == status


def test_health_of_a_simulator_that_is_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(health, "TIMEOUT_S", 0.02)
    assert health.main(["mavlink", "0"]) == 1


@pytest.mark.parametrize("words", [[], ["http", "80"], ["radio", "1"]])
def test_health_of_something_else(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert health.main(words) == 1
    assert "expected http PORT PATH, or mavlink PORT" in capsys.readouterr().out
