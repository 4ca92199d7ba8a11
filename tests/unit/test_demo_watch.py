"""`companion demo --watch` opens the page once the daemon answers, and never takes over the terminal."""

from __future__ import annotations

import asyncio
import socket
import webbrowser

import pytest

from companion.demo.watch import show_page
from sim_bridge.testing import free_port


class Browser(webbrowser.BaseBrowser):
    def __init__(self) -> None:
        super().__init__("somebody's")
        self.opened: list[str] = []

    def open(self, url: str, new: int = 0, autoraise: bool = True) -> bool:
        self.opened.append(url)
        return True


def shown(monkeypatch: pytest.MonkeyPatch, browser: webbrowser.BaseBrowser | None) -> list[tuple[str, bool]]:
    """What is told; the daemon comes up after the page was wanted."""

    def get() -> webbrowser.BaseBrowser:
        if browser is None:
            raise webbrowser.Error("could not locate runnable browser")
        return browser

    monkeypatch.setattr(webbrowser, "get", get)
    monkeypatch.delenv("BROWSER", raising=False)
    monkeypatch.setattr("companion.demo.watch.POLL_S", 0.001)
    told: list[tuple[str, bool]] = []
    port = free_port(socket.SOCK_STREAM)

    async def go() -> None:
        showing = asyncio.create_task(show_page(port, lambda url, opened: told.append((url, opened))))
        await asyncio.sleep(0)
        assert told == []
        server = await asyncio.start_server(lambda reader, writer: writer.close(), "127.0.0.1", port)
        async with server, asyncio.timeout(10.0):
            await showing

    asyncio.run(go())
    return [(url.replace(str(port), "PORT"), opened) for url, opened in told]


def test_it_opens_when_the_daemon_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    browser = Browser()
    assert shown(monkeypatch, browser) == [("http://127.0.0.1:PORT/", True)]
    assert len(browser.opened) == 1


@pytest.mark.parametrize("browser", [None, webbrowser.GenericBrowser("w3m")])
def test_without_a_window_only_the_address_is_told(
    monkeypatch: pytest.MonkeyPatch, browser: webbrowser.BaseBrowser | None
) -> None:
    assert shown(monkeypatch, browser) == [("http://127.0.0.1:PORT/", False)]
