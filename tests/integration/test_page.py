"""The live page in a real browser, beside a flying pair: seen, steered, left alone, found again."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from browser import Browser, browsing, chromium

from companion.clock import SystemClock
from companion.config import Config, HttpConfig
from companion.http import HttpServer
from companion.link import wire
from companion.link.inbox import ObstacleInbox
from companion.link.mavlink import MavlinkCodec
from companion.link.router import Router
from companion.page.access import Access
from companion.page.feed import PageFeed
from companion.page.handlers import Page
from companion.route import Route
from companion.session import VehicleSession
from sim_bridge.testing import FlyingPair, free_port

pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(chromium() is None, reason="no Chromium here (Debian: apt-get install chromium)"),
]

TOKEN = "a-token-of-the-browser-test"
STATE = "document.getElementById('state-name').textContent"
# pixels of the plan that have the obstacles' colour, within what blending leaves of it
PAINTED = """(() => { const plan = document.getElementById('plan'), copy = document.createElement('canvas');
[copy.width, copy.height] = [plan.width, plan.height + 1];
const c = copy.getContext('2d', { willReadFrequently: true }); c.drawImage(plan, 0, 1);
c.fillStyle = getComputedStyle(document.documentElement).getPropertyValue('--obstacle').trim();
c.fillRect(0, 0, 1, 1);
const got = c.getImageData(0, 0, copy.width, copy.height).data; let n = -1;
for (let i = 0; i < got.length; i += 4) n += [0, 1, 2].every((k) => Math.abs(got[i + k] - got[k]) < 12) ? 1 : 0;
return n; })()"""
FITS = "document.documentElement.scrollWidth <= document.documentElement.clientWidth"
LIGHTNESS = "getComputedStyle(document.documentElement).backgroundColor.match(/[0-9]+/g).reduce((a, b) => a + +b, 0)"


def test_the_page_beside_a_flight(flying_pair: Callable[..., FlyingPair], tmp_path: Path) -> None:
    port, token = free_port(socket.SOCK_STREAM), tmp_path / "token"
    token.write_text(TOKEN, encoding="utf-8")
    token.chmod(0o600)
    keys = [f"http.port={port}", "http.commands=true", f'http.token_file="{token}"']
    pair = flying_pair((6.5, 0.0, 1.5), scenario="demo", overrides=keys)

    async def watch() -> None:
        async with browsing(tmp_path / "profile") as browser:
            await browser.look(1440, 900, scheme="light")
            await browser.open(f"http://127.0.0.1:{port}/")
            await engage(browser)
            await looks(browser, tmp_path)
            await numbers_move(browser)
            await set_target(browser)
            assert browser.console == []
            pair.daemon.terminate()
            pair.daemon.wait()
            await lost_and_found(browser, port)
            assert {urlsplit(url).netloc for url in browser.requests} == {f"127.0.0.1:{port}"}

    asyncio.run(watch())


async def engage(browser: Browser) -> None:
    """A wrong token does nothing; the right one engages, at the second press."""
    await browser.until(f"{STATE} === 'READY' && !document.getElementById('controls').hidden")
    for token, outcome in (("not-the-token-at-all", "refused"), (TOKEN, "accepted")):
        await browser.run(f"document.getElementById('token').value = '{token}'")
        await browser.run("document.getElementById('engage').click()")
        await browser.until("document.getElementById('engage').textContent === 'Press again to engage'")
        await browser.run("document.getElementById('engage').click()")
        await browser.until(f"document.getElementById('answer').textContent.includes('{outcome}')")
        if outcome == "refused":
            assert "401" in browser.console.pop()  # how Chromium tells of the answer
            assert await browser.run(STATE) == "READY"
    await browser.until(f"{STATE} === 'ACTIVE'")
    assert "State ACTIVE" in await browser.run("document.getElementById('announce').textContent")


async def looks(browser: Browser, folder: Path) -> None:
    """Obstacles are drawn and nothing is cut off, at either width, by day and by night; everything has a name."""
    lightness = {}
    for width, height, scheme in ((1440, 900, "light"), (1440, 900, "dark"), (360, 740, "light"), (360, 740, "dark")):
        await browser.look(width, height, scheme=scheme, mobile=width < 500)
        await browser.until(f"{PAINTED} >= 20")
        assert await browser.run(FITS), f"{width} px: wider than the screen"
        lightness[scheme] = await browser.run(LIGHTNESS)
        await browser.picture(folder / f"page-{width}-{scheme}.png")
        assert (folder / f"page-{width}-{scheme}.png").stat().st_size > 15_000
    assert lightness["dark"] < 150 < 600 < lightness["light"]
    assert await browser.run("document.querySelectorAll('#obstacles > li').length") == 3
    tree = (await browser.call("Accessibility.getFullAXTree"))["nodes"]
    roles = ("button", "textbox", "spinbutton", "combobox", "image", "heading")
    named = [
        (node["role"]["value"], node["name"]["value"]) for node in tree if node.get("role", {}).get("value") in roles
    ]
    assert {role for role, _ in named} == set(roles)
    assert all(name for _, name in named), named
    assert any(name.startswith("plan view: vehicle at") and "3 obstacles" in name for _, name in named)


async def numbers_move(browser: Browser) -> None:
    flight = "document.getElementById('flight').innerText"
    before = await browser.run(flight)
    await browser.until(f"{flight} !== {before!r} && document.getElementById('latency').innerText.includes(' ms')")
    assert "source sim" in await browser.run("document.getElementById('links').innerText")


async def set_target(browser: Browser) -> None:
    """A click on the plan and an altitude become the target that the daemon flies to."""
    await browser.look(1440, 900, scheme="light")
    await browser.run("document.getElementById('pick').click()")
    where = "const box = document.getElementById('plan').getBoundingClientRect()"
    x, y = await browser.run(f"(() => {{ {where}; return [box.x + box.width / 2, box.y + box.height / 2]; }})()")
    for kind in ("mousePressed", "mouseReleased"):
        await browser.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)
    await browser.until("document.getElementById('pick').getAttribute('aria-pressed') === 'false'")
    await browser.run("document.getElementById('target-z').value = '1.75'")
    await browser.run("document.getElementById('target-form').requestSubmit()")
    await browser.until("document.getElementById('answer').textContent === 'target: accepted'")
    await browser.until("document.getElementById('flight').innerText.includes('1.75')")


async def lost_and_found(browser: Browser, port: int) -> None:
    """Without the daemon the page says so; with another one, which takes no commands, it goes on by itself."""
    await browser.until("/no data since [1-9]/.test(document.getElementById('stale').innerText)")
    server = silent_daemon(HttpConfig(port=port))
    await server.start()
    try:
        await browser.until("document.getElementById('stale').hidden && document.getElementById('controls').hidden")
        await browser.until("document.getElementById('connection').textContent === 'live'")
    finally:
        await server.stop()


class NoCommands:
    def engage(self, command: wire.EngageCommand) -> wire.Reply:
        raise AssertionError("not with http.commands = false")

    def target(self, command: wire.TargetCommand) -> wire.Reply:
        raise AssertionError("not with http.commands = false")


def silent_daemon(http: HttpConfig) -> HttpServer:
    """The page of a daemon that has heard no vehicle yet."""
    config, clock, codec = Config(http=http), SystemClock(), MavlinkCodec(system=1)
    route = Route(config.target, config.limits)
    session = VehicleSession(config, codec, route.set_position)
    router = Router(config.mavlink, codec, session, clock, ignore)
    server, inbox = HttpServer(http), ObstacleInbox(queue=8, max_age_s=0.5)
    Page(server, PageFeed(session, route, inbox, router, clock), Access(http, NoCommands()), clock)
    return server


def ignore(events: Any) -> None:
    """Nothing comes: the links are not open."""
