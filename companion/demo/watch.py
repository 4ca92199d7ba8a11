"""`companion demo --watch`: the daemon's page in a browser, opened as soon as it answers."""

from __future__ import annotations

import asyncio
import contextlib
import os
import webbrowser
from collections.abc import Callable

POLL_S = 0.1
WAIT_S = 30.0


async def show_page(port: int, on_open: Callable[[str, bool], None]) -> None:
    """Wait until the daemon listens on ``port``, open its page, tell the URL and whether a browser took it."""
    url = f"http://127.0.0.1:{port}/"
    with contextlib.suppress(TimeoutError):  # a daemon that does not come up ends the flight, which says why
        async with asyncio.timeout(WAIT_S):
            while not await _listens(port):
                await asyncio.sleep(POLL_S)
        on_open(url, await asyncio.to_thread(_open, url))


async def _listens(port: int) -> bool:
    try:
        _, writer = await asyncio.open_connection("127.0.0.1", port)
    except OSError:
        return False
    writer.close()
    with contextlib.suppress(OSError):
        await writer.wait_closed()
    return True


def _open(url: str) -> bool:
    """False where there is no browser, or one in this terminal alone, which would take it over."""
    try:
        browser = webbrowser.get()
    except webbrowser.Error:
        return False
    in_terminal = type(browser) is webbrowser.GenericBrowser and "BROWSER" not in os.environ
    return not in_terminal and browser.open(url)
