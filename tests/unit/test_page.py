"""The page's feed says what the brain says, costs nothing unwatched, and no browser can slow the daemon."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import aiohttp
import numpy as np
import pytest
from tracking_scenes import frame, seen, vehicle

from companion.clock import ManualClock
from companion.config import Config, HttpConfig, ObstaclesConfig
from companion.errors import ConfigError
from companion.http import HttpServer
from companion.link import wire
from companion.link.inbox import ObstacleInbox
from companion.link.mavlink import MavlinkCodec
from companion.link.router import Router
from companion.page import handlers
from companion.page.access import Access
from companion.page.feed import PageFeed
from companion.page.handlers import MAX_CLIENTS, Page
from companion.page.view import MAX_TRACKS
from companion.pilot import Pilot, PilotInput
from companion.report import setpoint_record
from companion.route import Route
from companion.session import VehicleSession
from companion.state import State
from companion.types import DetectionFrame, Margin, frozen


class Rig:
    """A feed beside a real brain, on a clock that stands still."""

    def __init__(self, config: Config | None = None) -> None:
        config = Config() if config is None else config
        self.clock = ManualClock()
        codec = MavlinkCodec(system=1)
        self.route = Route(config.target, config.limits)
        session = VehicleSession(config, codec, self.route.set_position)
        self.inbox = ObstacleInbox(queue=64, max_age_s=0.5, sources=config.obstacles.required)
        router = Router(config.mavlink, codec, session, self.clock, lambda events: None)
        self.feed = PageFeed(session, self.route, self.inbox, router, self.clock)
        self.brain = Pilot(config)

    def tick(self, t_s: float, *frames: DetectionFrame, p_enu: list[float] | None = None) -> None:
        state = vehicle(t_s, [0.0, 0.0, 2.0] if p_enu is None else p_enu)
        self.output = self.brain.step(PilotInput(state, frames, target_enu=frozen([6.0, 0.0, 2.0])))
        record = setpoint_record(state.stamp_ns, State.ACTIVE, self.output, sent=True, messages=1, timings_ms={})
        self.feed.tick(record, state, self.output, self.brain.tracks())

    def told(self, *, first: bool = False) -> dict[str, Any]:
        self.clock.advance(0.1)
        message: dict[str, Any] = json.loads(self.feed.message(first=first))
        return message


def test_the_page_shows_the_tracks_the_margin_and_the_prediction_of_the_brain() -> None:
    rig = Rig()
    for k in range(20):
        rig.tick(0.05 * k, frame(0.05 * k, seen("ball", [3.0 - 0.05 * k, 0.2, 2.0]), sequence=k))
    tick = rig.told()["tick"]
    (track,) = tick["tracks"]
    table, row = rig.brain.tracks(), next(r for r in rig.output.result.rows if r.track == "cam/ball")
    assert track["id"] == "cam/ball"
    assert track["p"] == pytest.approx(table.p_enu[0], abs=1e-3)
    distance = float(np.linalg.norm(table.p_enu[0] - [0.0, 0.0, 2.0]))
    assert track["clearance"] == tick["clearance"] == pytest.approx(distance - table.radius_m[0] - 0.2, abs=1e-3)
    assert track["covariance"] == pytest.approx(table.covariance[0][np.triu_indices(9)][[0, 1, 2, 9, 10, 17]], abs=1e-5)
    keep = track["keep_out"]
    assert isinstance(row.margin, Margin)
    assert sum(keep[part] for part in ("radii", "cushion", "sigma", "delay")) == pytest.approx(
        row.margin.total, abs=2e-3
    )
    last = 0 if keep["step"] < 0 else keep["step"] + 2
    assert keep["centre"] == pytest.approx(rig.output.prediction.p_enu[0, last], abs=1e-3)
    assert track["path"][1] == pytest.approx(rig.output.prediction.p_enu[0, 2], abs=1e-2)
    assert tick["u_safe"] == pytest.approx(rig.output.result.a_safe, abs=1e-3)
    assert tick["verdict"] == rig.output.result.verdict.value
    assert (tick["epsilon"], tick["epsilon_star"]) == pytest.approx((row.epsilon, row.epsilon_star), abs=1e-3)


def test_at_most_the_nearest_tracks_are_sent_and_the_rest_is_counted() -> None:
    rig = Rig()
    crowd = [seen(f"n{i}", [2.0 + 0.1 * i, 5.0, 2.0]) for i in range(MAX_TRACKS + 7)]
    for k in range(3):
        rig.tick(0.05 * k, frame(0.05 * k, *crowd, sequence=k))
    tick = rig.told()["tick"]
    assert len(tick["tracks"]) == MAX_TRACKS
    assert tick["hidden"] == 7
    assert {track["id"] for track in tick["tracks"]} == {f"cam/n{i}" for i in range(MAX_TRACKS)}


def test_charts_begin_with_the_last_minute_and_start_anew_with_the_vehicles_clock() -> None:
    rig = Rig()
    rig.tick(0.0)
    record, table = setpoint_record(0, State.READY, None, sent=False, messages=0, timings_ms={}), rig.brain.tracks()
    for k in range(1, 1300):
        rig.feed.tick(record, vehicle(0.05 * k, [0.01 * k, 0.0, 2.0]), None, table)
    history = rig.told(first=True)["history"]
    assert len(history) == 600
    assert history[-1][0] - history[0][0] == pytest.approx(59.9)
    assert history[0][1:4] == [None, None, None]  # no obstacle
    assert history[-1][5:] == pytest.approx([0.01 * 1299, 0.0, 2.0], abs=0.02)
    assert rig.told()["history"] is None
    rig.feed.tick(record, vehicle(0.05, [0.0, 0.0, 2.0]), None, table)
    assert [row[0] for row in rig.told(first=True)["history"]] == [0.05]


def test_ages_go_on_while_the_vehicle_is_silent() -> None:
    rig = Rig(Config(obstacles=ObstaclesConfig(required=("cam", "lidar"))))
    payload = {"stamp_ns": 950_000_000, "clock": "vehicle", "obstacles": []}
    rig.inbox.push("cam", json.dumps(payload).encode())
    rig.inbox.drain(1_000_000_000)
    rig.tick(1.0)
    rig.clock.advance(2.0)
    told = rig.told()
    assert told["tick_age"] == pytest.approx(2.1)
    assert [(source["name"], source["age"]) for source in told["sources"]] == [
        ("cam", pytest.approx(2.15)),
        ("lidar", None),
    ]
    assert told["links"] == [{"name": "udpin://127.0.0.1:14540", "age": None, "note": ""}]


def test_one_message_serves_all_that_ask_within_a_period() -> None:
    rig = Rig()
    rig.tick(0.05)
    first = rig.told()["tick"]["t"]
    rig.tick(0.10)
    assert json.loads(rig.feed.message())["tick"]["t"] == first
    assert rig.told()["tick"]["t"] == 0.1


def test_a_sample_that_fails_is_logged_once_and_ends_no_tick(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise ValueError("a bug")

    monkeypatch.setattr("companion.page.feed.sample", broken)
    rig = Rig()
    rig.tick(0.05)
    rig.tick(0.15)
    assert caplog.text.count("page: no charts from here on") == 1


class Commands:
    """Stands for the doors: keeps what it is told."""

    def __init__(self) -> None:
        self.told: list[wire.EngageCommand | wire.TargetCommand] = []

    def engage(self, command: wire.EngageCommand) -> wire.Reply:
        self.told.append(command)
        return wire.Reply(accepted=False, reason="not airborne") if command.engaged else wire.Reply(accepted=True)

    def target(self, command: wire.TargetCommand) -> wire.Reply:
        self.told.append(command)
        return wire.Reply(accepted=True)


@asynccontextmanager
async def serving(
    rig: Rig, http: HttpConfig, commands: Commands
) -> AsyncIterator[tuple[Page, str, aiohttp.ClientSession]]:
    server = HttpServer(http)
    page = Page(server, rig.feed, Access(http, commands), rig.clock)
    await server.start()
    try:
        async with aiohttp.ClientSession() as client:
            yield page, server.url, client
    finally:
        await server.stop()


TOKEN = "0123456789abcdef-token"


@pytest.fixture
def with_token(tmp_path: Any) -> HttpConfig:
    file = tmp_path / "token"
    file.write_text(f"{TOKEN}\n", encoding="utf-8")
    file.chmod(0o600)
    return HttpConfig(port=0, commands=True, token_file=str(file))


def post(http: HttpConfig, path: str, body: bytes, **headers: str) -> tuple[int, dict[str, Any], Commands]:
    commands = Commands()

    async def ask() -> tuple[int, dict[str, Any]]:
        async with serving(Rig(), http, commands) as (_, url, client):
            named = {name.replace("_", "-"): value.replace("SELF", url.rstrip("/")) for name, value in headers.items()}
            async with client.post(url + path, data=body, headers=named) as answer:
                return answer.status, await answer.json()

    return *asyncio.run(ask()), commands


def test_commands_do_what_the_doors_do(with_token: HttpConfig) -> None:
    allowed = {"Authorization": f"Bearer {TOKEN}"}
    status, reply, commands = post(with_token, "api/target", b'{"position": [1, 2, 3]}', **allowed, Origin="SELF")
    assert (status, reply["accepted"]) == (200, True)
    assert commands.told == [wire.TargetCommand(position=(1.0, 2.0, 3.0))]
    status, reply, _ = post(with_token, "api/engage", b'{"engaged": true}', **allowed)
    assert (status, reply) == (409, {"accepted": False, "reason": "not airborne"})
    assert post(with_token, "api/engage", b'{"engaged": false}', **allowed)[0] == 200
    status, reply, commands = post(with_token, "api/engage", b'{"engaged": "yes"}', **allowed)
    assert (status, commands.told) == (400, [])
    assert "engaged" in reply["reason"]


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 401),
        ({"Authorization": "Bearer "}, 401),
        ({"Authorization": f"Bearer {TOKEN}x"}, 401),
        ({"Authorization": f"Bearer {TOKEN[:-1]}"}, 401),
        ({"Authorization": f"Basic {TOKEN}"}, 401),
        ({"Authorization": f"Bearer {TOKEN}", "Origin": "http://evil.test"}, 403),
        ({"Authorization": f"Bearer {TOKEN}", "Origin": "null"}, 403),
        ({"Authorization": f"Bearer {TOKEN}", "Host": "evil.test"}, None),
    ],
)
def test_without_the_token_or_from_elsewhere_nothing_happens(
    with_token: HttpConfig, headers: dict[str, str], status: int | None
) -> None:
    if status is None:
        with pytest.raises(aiohttp.ContentTypeError, match="421"):
            post(with_token, "api/engage", b'{"engaged": true}', **headers)
        return
    answered, reply, commands = post(with_token, "api/engage", b'{"engaged": true}', **headers)
    assert (answered, reply["accepted"], commands.told) == (status, False, [])


def test_a_daemon_without_commands_takes_none() -> None:
    headers = {"Authorization": f"Bearer {TOKEN}"}
    status, reply, commands = post(HttpConfig(port=0), "api/engage", b'{"engaged": true}', **headers)
    assert (status, commands.told) == (403, [])
    assert "http.commands" in reply["reason"]


@pytest.mark.parametrize(
    "content", ["short", "x" * 15, "with a blank in the midst", "two\nlines of sixteen..", "ümläut" * 4]
)
def test_a_weak_token_is_refused_without_being_shown(with_token: HttpConfig, content: str, tmp_path: Any) -> None:
    (tmp_path / "token").write_text(content, encoding="utf-8")
    with pytest.raises(ConfigError, match=r"^http\.token_file: .*at least 16") as caught:
        Access(with_token, Commands())
    assert content not in str(caught.value)


def test_a_stranger_who_guesses_does_not_fill_the_log(with_token: HttpConfig, caplog: pytest.LogCaptureFixture) -> None:
    async def guess() -> None:
        async with serving(Rig(), with_token, Commands()) as (_, url, client):
            for _ in range(20):
                async with client.post(f"{url}api/engage", data=b"{}"):
                    pass

    with caplog.at_level(logging.WARNING):
        asyncio.run(guess())
    assert caplog.text.count("without the token") == 5  # the 1st, 2nd, 4th, 8th and 16th


def test_every_file_is_served_and_names_no_other_host() -> None:
    async def read() -> dict[str, str]:
        texts = {}
        async with serving(Rig(), HttpConfig(port=0), Commands()) as (_, url, client):
            for name in ("", "app.js", "style.css", "scene.js", "views.js", "charts.js", "panels.js", "controls.js"):
                async with client.get(url + name) as answer:
                    assert answer.status == 200, name
                    texts[name] = await answer.text()
        return texts

    texts = asyncio.run(read())
    for name, text in texts.items():
        assert "http://" not in text, name
        assert "https://" not in text, name
    assert "style=" not in texts[""]  # the policy forbids it
    assert "<script>" not in texts[""]


def test_a_page_of_another_site_cannot_listen() -> None:
    async def listen(origin: str | None) -> int:
        async with serving(Rig(), HttpConfig(port=0), Commands()) as (_, url, client):
            try:
                async with client.ws_connect(f"{url}feed", origin=origin and origin.replace("SELF", url.rstrip("/"))):
                    return 101
            except aiohttp.WSServerHandshakeError as error:
                return error.status

    assert asyncio.run(listen("http://evil.test")) == 403
    assert asyncio.run(listen("SELF")) == 101
    assert asyncio.run(listen(None)) == 101


def test_a_stuck_browser_holds_up_nobody_and_is_cut_off(monkeypatch: pytest.MonkeyPatch) -> None:
    """It never reads: what waits for it stays bounded, another browser gets every message, then it is gone."""
    rig = Rig()
    rig.tick(0.05)
    large = b"x" * 200_000
    made: list[int] = []
    monkeypatch.setattr(rig.feed, "message", lambda *, first=False: made.append(1) or large)
    monkeypatch.setattr(handlers, "SEND_S", 0.2)
    waiting: list[int] = []

    async def watch() -> None:
        async with serving(rig, HttpConfig(port=0), Commands()) as (page, url, client), asyncio.timeout(20.0):
            host, port = url.split("/")[2].split(":")
            reader, writer = await asyncio.open_connection(host, int(port), limit=1024)
            reader._transport.pause_reading()  # type: ignore[attr-defined]
            upgrade = f"GET /feed HTTP/1.1\r\nHost: {host}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            key = "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
            writer.write((upgrade + key).encode())
            async with client.ws_connect(f"{url}feed", max_msg_size=1 << 20) as quick:
                received = 0
                while page.clients != 2:
                    await asyncio.sleep(0)
                while page.clients > 1:
                    rig.clock.advance(0.1)
                    received += len(await quick.receive_str()) == len(large)
                    transports = [request.transport for request in page._watching]
                    waiting.extend(one.get_write_buffer_size() for one in transports if one is not None)
                assert received > 5
            writer.close()

    asyncio.run(watch())
    assert max(waiting) < 1_000_000


def test_only_so_many_may_watch_and_nothing_is_made_for_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig()
    rig.tick(0.05)
    made: list[int] = []
    message = rig.feed.message
    monkeypatch.setattr(rig.feed, "message", lambda *, first=False: made.append(1) or message(first=first))

    async def crowd() -> None:
        async with serving(rig, HttpConfig(port=0), Commands()) as (page, url, client), asyncio.timeout(20.0):
            rig.clock.advance(5.0)
            assert made == []
            sockets = [await client.ws_connect(f"{url}feed") for _ in range(MAX_CLIENTS)]
            for socket in sockets:
                assert json.loads(await socket.receive_str())["history"]
            with pytest.raises(aiohttp.WSServerHandshakeError, match="503"):
                await client.ws_connect(f"{url}feed")
            await sockets[0].close()
            await sockets[1].send_str("a browser has nothing to say")
            while page.clients != MAX_CLIENTS - 2:
                await asyncio.sleep(0)
            async with client.ws_connect(f"{url}feed") as late:
                assert json.loads(await late.receive_str())["history"]

    asyncio.run(crowd())
