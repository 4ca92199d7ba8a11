"""The HTTP server: who may ask, what a taken port says, and that no handler reaches the daemon."""

from __future__ import annotations

import asyncio
import doctest
import logging
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import aiohttp
import pytest
from aiohttp import web

import companion.http
from companion.config import HttpConfig, config_hash, parse_config
from companion.errors import ConfigError
from companion.http import HttpServer


@asynccontextmanager
async def serving(config: HttpConfig) -> AsyncIterator[HttpServer]:
    async def hello(request: web.Request) -> web.Response:
        return web.Response(text="hello")

    async def broken(request: web.Request) -> web.Response:
        raise RuntimeError("a bug")

    server = HttpServer(config)
    server.add("GET", "/hello", hello)
    server.add("GET", "/broken", broken)
    await server.start()
    try:
        yield server
    finally:
        await server.stop()


def run(config: HttpConfig, path: str, host: str | None = None, method: str = "GET") -> tuple[int, str, dict[str, str]]:
    async def ask() -> tuple[int, str, dict[str, str]]:
        async with serving(config) as server, aiohttp.ClientSession() as client:
            headers = {} if host is None else {"Host": host}
            async with client.request(method, server.url + path, headers=headers) as answer:
                return answer.status, await answer.text(), dict(answer.headers)

    return asyncio.run(ask())


ANY = HttpConfig(port=0)


def test_answers_carry_a_policy_that_forbids_every_other_host() -> None:
    status, text, headers = run(ANY, "hello")
    assert (status, text) == (200, "hello")
    policy = headers["Content-Security-Policy"]
    assert policy.startswith("default-src 'none';")
    assert "unsafe" not in policy
    assert "http" not in policy
    assert headers["X-Frame-Options"] == "DENY"
    assert not [name for name in headers if name.startswith("Access-Control")]


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("localhost:8080", 200),
        ("127.0.0.1", 200),
        ("[::1]:8080", 200),
        ("drone1.local:8080", 200),
        ("DRONE1.LOCAL", 200),
        ("evil.test:8080", 421),
        ("localhost.evil.test", 421),
        ("[::1", 421),
    ],
)
def test_a_name_that_was_pointed_here_by_others_is_refused(host: str, status: int) -> None:
    assert run(HttpConfig(port=0, names=("drone1.local",)), "hello", host)[0] == status


def test_unknown_paths_and_methods_are_named_in_plain_text() -> None:
    assert run(ANY, "nowhere")[:2] == (404, "Not Found\n")
    status, _, headers = run(ANY, "hello", method="DELETE")
    assert status == 405
    assert "GET" in headers["Allow"]


def test_a_handler_that_fails_is_logged_and_nothing_else(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.ERROR):
        assert run(ANY, "broken")[0] == 500
    assert "GET /broken failed" in caplog.text


def test_a_taken_port_is_an_error_only_where_it_was_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", 0))
        holder.listen()
        taken = holder.getsockname()[1]
        with pytest.raises(
            ConfigError, match=rf"^http\.port {taken}: .*address already in use.*http\.enabled = false$"
        ):
            run(HttpConfig(port=taken), "hello")
        monkeypatch.setattr("companion.http.DEFAULT_PORT", taken)
        assert run(HttpConfig(), "hello")[0] == 200


def test_a_foreign_address_is_named() -> None:
    with pytest.raises(ConfigError, match=r"^http\.host 192\.0\.2\.1: "):
        run(HttpConfig(host="192.0.2.1", port=0), "hello")


def test_commands_need_a_token_and_change_no_hash() -> None:
    with pytest.raises(ConfigError, match=r"http\.token_file: expected a file"):
        parse_config({"http": {"commands": True}})
    assert config_hash(parse_config({"http": {"enabled": False}})) == config_hash(parse_config({}))


def test_the_example_of_the_docstring_holds() -> None:
    assert doctest.testmod(companion.http) == (0, 1)
