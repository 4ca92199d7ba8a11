"""Headless Chromium, driven through its DevTools protocol: one page, its console, its requests, its pictures."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import os
import shutil
import signal
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import aiohttp

START_S = 20.0
_FLAGS = (
    "--headless=new",
    "--remote-debugging-port=0",
    "--no-first-run",
    "--no-default-browser-check",
    "--disable-gpu",
    "--disable-extensions",
    "--disable-sync",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-default-apps",
    "--disable-dev-shm-usage",
    "--password-store=basic",
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
)


def chromium() -> str | None:
    """Where it is installed, None where it is not."""
    names = ("chromium", "chromium-browser", "google-chrome")
    return next((path for name in names if (path := shutil.which(name)) is not None), None)


class Browser:
    """One page. ``console`` has errors and warnings, ``requests`` every URL that was asked for."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self.console: list[str] = []
        self.requests: list[str] = []
        self._socket = socket
        self._answers: dict[int, asyncio.Future[dict[str, Any]]] = {}
        self._session: str | None = None
        self._loaded = asyncio.Event()
        self._reading = asyncio.create_task(self._read())

    async def attach(self) -> None:
        """Take the first page of the browser."""
        targets = (await self.call("Target.getTargets"))["targetInfos"]
        page = next(target["targetId"] for target in targets if target["type"] == "page")
        self._session = (await self.call("Target.attachToTarget", targetId=page, flatten=True))["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            await self.call(f"{domain}.enable")

    async def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """One command of the protocol; RuntimeError where it fails."""
        number = len(self._answers) + 1
        self._answers[number] = asyncio.get_running_loop().create_future()
        message = {"id": number, "method": method, "params": parameters}
        await self._socket.send_json(message if self._session is None else message | {"sessionId": self._session})
        answer = await asyncio.wait_for(self._answers[number], START_S)
        if "error" in answer:
            raise RuntimeError(f"{method}: {answer['error']}")
        return dict(answer["result"])

    async def open(self, url: str) -> None:
        """Go there; back once everything of it is loaded."""
        self._loaded.clear()
        await self.call("Page.navigate", url=url)
        await asyncio.wait_for(self._loaded.wait(), START_S)

    async def look(self, width: int, height: int, *, scheme: str, scale: float = 1.0, mobile: bool = False) -> None:
        """Window size and colour scheme."""
        metrics = {"width": width, "height": height, "deviceScaleFactor": scale, "mobile": mobile}
        await self.call("Emulation.setDeviceMetricsOverride", **metrics)
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        await self.call("Emulation.setEmulatedMedia", features=features)

    async def run(self, expression: str) -> Any:
        """The value of an expression, awaited; RuntimeError where it throws."""
        answer = await self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in answer:
            raise RuntimeError(f"{expression}: {answer['exceptionDetails']}")
        return answer["result"].get("value")

    async def until(self, condition: str, timeout_s: float = 15.0) -> None:
        """Wait in the page until ``condition`` is true there, looked at with every drawn frame."""
        promise = (
            f"new Promise((done, fail) => {{ const end = performance.now() + {1e3 * timeout_s}; const look = () => "
            f"{{ if ({condition}) done(true); else if (performance.now() > end) fail(document.body.innerText); "
            "else requestAnimationFrame(look); }; look(); })"
        )
        await self.run(promise)

    async def picture(self, path: Path, *, full: bool = False) -> None:
        """A screenshot as PNG; ``full``: the whole page and not the window alone."""
        answer = await self.call("Page.captureScreenshot", format="png", captureBeyondViewport=full)
        path.write_bytes(base64.b64decode(answer["data"]))

    async def _read(self) -> None:
        async for message in self._socket:
            told = message.json()
            if "id" in told:
                self._answers[told["id"]].set_result(told)
                continue
            parameters = told.get("params", {})
            match told["method"]:
                case "Page.loadEventFired":
                    self._loaded.set()
                case "Network.requestWillBeSent":
                    self.requests.append(parameters["request"]["url"])
                case "Network.webSocketCreated":
                    self.requests.append(parameters["url"])
                case "Runtime.consoleAPICalled" if parameters["type"] in ("error", "warning", "assert"):
                    self.console.append(str(parameters["args"]))
                case "Runtime.exceptionThrown":
                    self.console.append(str(parameters["exceptionDetails"]))
                case "Log.entryAdded" if parameters["entry"]["level"] in ("error", "warning"):
                    self.console.append(str(parameters["entry"]))


@asynccontextmanager
async def browsing(folder: Path) -> AsyncIterator[Browser]:
    """A browser with its profile in ``folder``; all its processes are gone afterwards."""
    program = chromium()
    assert program is not None
    flags = [*_FLAGS, f"--user-data-dir={folder}", *(["--no-sandbox"] if os.geteuid() == 0 else [])]
    devnull = asyncio.subprocess.DEVNULL
    environment = {**os.environ, "HOME": str(folder)}
    child = await asyncio.create_subprocess_exec(
        program, *flags, "about:blank", stdin=devnull, stdout=devnull, stderr=asyncio.subprocess.PIPE,
        start_new_session=True, env=environment,
    )  # fmt: skip
    try:
        async with aiohttp.ClientSession() as client:
            url = await asyncio.wait_for(_endpoint(child), START_S)
            async with client.ws_connect(url, max_msg_size=1 << 26) as socket:
                browser = Browser(socket)
                await browser.attach()
                yield browser
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)  # its own session: the helpers it started end with it
        await child.communicate()


async def _endpoint(child: asyncio.subprocess.Process) -> str:
    """The WebSocket URL, which Chromium prints; what it says afterwards must not fill the pipe."""
    assert child.stderr is not None
    said = []
    async for line in child.stderr:
        said.append(line.decode(errors="replace"))
        if "DevTools listening on " in said[-1]:
            return said[-1].rpartition(" on ")[2].strip()
    raise RuntimeError(f"chromium ended: {''.join(said)}")
