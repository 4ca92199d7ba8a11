"""Who may do what over Zenoh: the shipped access-control files, real certificates, stock sessions on the other side."""

from __future__ import annotations

import asyncio
import json
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh
from certificates import Authority, Host

from companion.config_links import ZenohConfig, ZenohTlsConfig
from companion.link import wire
from companion.link.zenoh import ZenohHandlers, ZenohLink
from sim_bridge.testing import free_port

pytestmark = pytest.mark.integration
EXAMPLES = Path(__file__).parents[2] / "configs" / "zenoh"
PREFIX = "uav/uav1"
TLS, USER = "transport/link/tls", "transport/auth/usrpwd"
PASSWORDS = {"lidar-host": "laser", "operator": "trust:me", "uav1": "wings"}


SPIED = "spied"


def _suffix(sample: zenoh.Sample) -> str:
    return str(sample.key_expr).removeprefix(f"{PREFIX}/")


class Daemon:
    """A `ZenohLink` that notes what it is told."""

    def __init__(self, config: ZenohConfig) -> None:
        self.heard: list[tuple[str, object]] = []
        self._changed = asyncio.Event()

        def note(what: str, value: object) -> None:
            self.heard.append((what, value))
            self._changed.set()

        def command(what: str) -> Callable[[Any], wire.Reply]:
            def answer(value: object) -> wire.Reply:
                note(what, value)
                return wire.Reply(accepted=True)

            return answer

        handlers = ZenohHandlers(
            on_obstacles=lambda source, payload, encoding: note(f"obstacles/{source}", payload),
            on_target=command("target"),
            on_engage=command("engage"),
            config=lambda: b"{}",
            health=lambda: b"{}",
            on_vehicle=lambda payload, encoding: note("vehicle/state", payload),
        )
        loop = asyncio.get_running_loop()
        self.link = ZenohLink.open(config, PREFIX, loop, handlers)
        # zenoh-python gives each subscriber a thread of its own: only one and the same hears in the order of the link
        self._session = self.link._session
        self._spy = self._session.declare_subscriber(
            f"{PREFIX}/**", lambda sample: loop.call_soon_threadsafe(note, SPIED, _suffix(sample))
        )

    async def until(self, condition: Callable[[], bool]) -> None:
        async with asyncio.timeout(5.0):
            while not condition():
                self._changed.clear()
                await self._changed.wait()

    async def spied(self) -> list[str]:
        """Every key of others up to now: a put of our own marks the place."""
        self._session.put(f"{PREFIX}/mark", b"")
        await self.until(lambda: (SPIED, "mark") in self.heard)
        keys = [str(value) for what, value in self.heard if what == SPIED]
        return keys[: keys.index("mark")]

    def unspy(self) -> None:
        self._spy.undeclare()

    @property
    def told(self) -> list[tuple[str, object]]:
        """What the handlers of the daemon were called with."""
        return [entry for entry in self.heard if entry[0] != SPIED]


def stock(file: str, **values: object) -> zenoh.Config:
    """An example file as a user would edit it: `key/with/slashes=value` by keyword, / written as __."""
    config = zenoh.Config.from_file(EXAMPLES / file)
    for key, value in values.items():
        config.insert_json5(key.replace("__", "/"), json.dumps(value))
    return config


@contextmanager
def connected(config: zenoh.Config) -> Iterator[zenoh.Session]:
    session = zenoh.open(config)
    try:
        yield session
    finally:
        session.close()


def refused(config: zenoh.Config) -> bool:
    """Whether a client is not let in: a client's `open` fails, a peer's goes on trying without a link."""
    try:
        with connected(config):
            return False
    except zenoh.ZError:
        return True


def ask(session: zenoh.Session, key: str, payload: bytes | None = None) -> list[dict[str, Any]]:
    """The replies of a stock query; none where nobody may answer."""
    replies = session.get(f"{PREFIX}/{key}", payload=payload, timeout=5.0)
    return [json.loads(reply.ok.payload.to_bytes()) for reply in replies]


class World:
    """Certificates, users and the endpoint of one test, for one way of telling who is who."""

    def __init__(self, by: str, folder: Path) -> None:
        self.by = by
        self.authority = Authority(folder)
        self.hosts = {name: self.authority.issue(name) for name in PASSWORDS}
        (folder / "other").mkdir()
        self.strangers = Authority(folder / "other", "strangers")
        self.endpoint = f"tls/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
        self.users = folder / "users"
        self.users.touch(mode=0o600)
        self.users.write_text("".join(f"{name}:{password}\n" for name, password in PASSWORDS.items()))

    def daemon(self, *, access: str = "shipped") -> ZenohConfig:
        by_certificate = self.by == "certificates"
        file = EXAMPLES / f"access-{self.by}.json5"
        if access == "talkative":
            told = '"declare_subscriber"],\n        key_exprs: ['
            text = file.read_text(encoding="utf-8")
            assert told in text
            file = self.users.with_name("talkative.json5")
            file.write_text(text.replace(told, told + '"uav/**", '), encoding="utf-8")
        own = self.hosts["uav1"]
        return ZenohConfig(
            config_file=None if access == "none" else str(file),
            listen=(self.endpoint,),
            users_file=None if by_certificate else str(self.users),
            tls=ZenohTlsConfig(
                ca=str(self.authority.ca),
                certificate=str(own.certificate),
                private_key=str(own.private_key),
                mutual=by_certificate,
            ),
        )

    def caller(self, name: str, *, mode: str = "client", host: Host | None = None, **values: object) -> zenoh.Config:
        """The stock configuration of the host ``name``."""
        common = {"mode": mode, "connect__endpoints": [self.endpoint], "listen__endpoints": []}
        common[f"{TLS}/root_ca_certificate"] = str(self.authority.ca)
        if self.by == "certificates":
            host = host or self.hosts[name]
            common[f"{TLS}/connect_certificate"] = str(host.certificate)
            common[f"{TLS}/connect_private_key"] = str(host.private_key)
            return stock("sensor-certificate.json5", **(common | values))
        common[USER] = {"user": name, "password": PASSWORDS[name]}
        return stock("sensor-user.json5", **(common | values))


@pytest.fixture(params=["certificates", "users"])
def world(request: pytest.FixtureRequest, tmp_path: Path) -> World:
    return World(request.param, tmp_path)


def run(world: World, scenario: Callable[[Daemon], Any], **options: Any) -> None:
    async def both() -> None:
        daemon = Daemon(world.daemon(**options))
        try:
            await scenario(daemon)
        finally:
            daemon.link.close()

    asyncio.run(both())


async def wait_matching(session: zenoh.Session, key: str) -> zenoh.Publisher:
    publisher = session.declare_publisher(f"{PREFIX}/{key}", congestion_control=zenoh.CongestionControl.BLOCK)
    async with asyncio.timeout(5.0):
        while not publisher.matching_status.matching:
            await asyncio.sleep(0)
    return publisher


@pytest.mark.parametrize("mode", ["client", "peer"])
@pytest.mark.parametrize("access", ["shipped", "talkative", "none"])
def test_a_sensor_publishes_its_own_obstacles_and_nothing_else(world: World, mode: str, access: str) -> None:
    """Without access control each attempt succeeds. "talkative" tells the sensor of every subscription, so that it does
    send what it may not: refused on arrival, not for want of a listener."""
    forbidden = ("obstacles/radar", "vehicle/state", "engage", "target")
    block = zenoh.CongestionControl.BLOCK

    async def scenario(daemon: Daemon) -> None:
        with connected(world.caller("lidar-host", mode=mode)) as sensor:
            frames = await wait_matching(sensor, "obstacles/lidar")
            if access != "shipped":
                for key in forbidden:
                    await wait_matching(sensor, key)
            eavesdropper = sensor.declare_subscriber(f"{PREFIX}/companion/**", lambda sample: None)
            for key in forbidden:
                body = b'{"engaged": true}' if key == "engage" else b'{"position": [1, 2, 3]}'
                sensor.put(f"{PREFIX}/{key}", body, congestion_control=block)
            frames.put(b"a frame")  # one link, one priority: it arrives after all that was sent before
            await daemon.until(lambda: (SPIED, "obstacles/lidar") in daemon.heard)
            arrived = set(await daemon.spied()) - {"obstacles/lidar"}
            assert arrived == (set(forbidden) if access == "none" else set())
            await daemon.until(lambda: ("obstacles/lidar", b"a frame") in daemon.heard)
            daemon.unspy()
            assert daemon.link.wanted("companion/setpoint") is (access == "none")
            for key in ("target", "engage"):
                answers = await asyncio.to_thread(ask, sensor, key, b'{"engaged": true}')
                assert bool(answers) is (access == "none")
            eavesdropper.undeclare()

    run(world, scenario, access=access)


def test_an_operator_commands_by_query_and_watches(world: World) -> None:
    async def scenario(daemon: Daemon) -> None:
        with connected(world.caller("operator")) as operator:
            samples: asyncio.Queue[zenoh.Sample] = asyncio.Queue()
            loop = asyncio.get_running_loop()
            watching = operator.declare_subscriber(
                f"{PREFIX}/companion/**", lambda sample: loop.call_soon_threadsafe(samples.put_nowait, sample)
            )
            assert await asyncio.to_thread(ask, operator, "target", b'{"position":[1,2,3]}') == [
                {"accepted": True, "reason": ""}
            ]
            assert await asyncio.to_thread(ask, operator, "engage", b'{"engaged":true}') == [
                {"accepted": True, "reason": ""}
            ]
            assert daemon.told == [
                ("target", wire.TargetCommand(position=(1.0, 2.0, 3.0))),
                ("engage", wire.EngageCommand(engaged=True)),
            ]
            assert await asyncio.to_thread(ask, operator, "companion/config") == [{}]
            alive = await asyncio.to_thread(lambda: list(operator.liveliness().get("uav/*/companion/alive")))
            assert [str(reply.ok.key_expr) for reply in alive] == [f"{PREFIX}/companion/alive"]
            daemon.link.put_encoded("companion/setpoint", b"{}")
            async with asyncio.timeout(5.0):
                assert str((await samples.get()).key_expr) == f"{PREFIX}/companion/setpoint"
            watching.undeclare()

            block = zenoh.CongestionControl.BLOCK
            for key in ("engage", "obstacles/operator", "vehicle/state"):  # commands by query only, no obstacles
                operator.put(f"{PREFIX}/{key}", b'{"engaged": false}', congestion_control=block)
            await asyncio.to_thread(ask, operator, "target", b'{"position":[4,5,6]}')
            assert await daemon.spied() == ["companion/setpoint"]  # our own
            assert [what for what, _ in daemon.told] == ["target", "engage", "target"]

    run(world, scenario)


def test_a_router_lets_the_daemon_and_its_sensor_meet(world: World) -> None:
    """The same file at a router between them; the daemon is a client with the identity uav1."""

    async def scenario() -> None:
        router = zenoh.open(
            stock(
                f"access-{world.by}.json5",
                mode="router",
                listen__endpoints=[world.endpoint],
                scouting__multicast__enabled=False,
                **{
                    f"{TLS}/root_ca_certificate": str(world.authority.ca),
                    f"{TLS}/listen_certificate": str(world.hosts["uav1"].certificate),
                    f"{TLS}/listen_private_key": str(world.hosts["uav1"].private_key),
                    **({} if world.by == "certificates" else {f"{USER}/dictionary_file": str(world.users)}),
                },
            )
        )
        with ExitStack() as stack:
            stack.callback(router.close)
            own = world.hosts["uav1"]
            password = world.users.with_name("password")
            password.touch(mode=0o600)
            password.write_text(PASSWORDS["uav1"] + "\n")
            by_user = world.by == "users"
            config = ZenohConfig(
                mode="client",
                connect=(world.endpoint,),
                user="uav1" if by_user else None,
                password_file=str(password) if by_user else None,
                tls=ZenohTlsConfig(
                    ca=str(world.authority.ca),
                    certificate=None if by_user else str(own.certificate),
                    private_key=None if by_user else str(own.private_key),
                    mutual=not by_user,
                ),
            )
            daemon = Daemon(config)
            stack.callback(daemon.link.close)
            sensor = stack.enter_context(connected(world.caller("lidar-host")))
            frames = await wait_matching(sensor, "obstacles/lidar")
            sensor.put(f"{PREFIX}/engage", b'{"engaged":true}', congestion_control=zenoh.CongestionControl.BLOCK)
            frames.put(b"through the router")
            await daemon.until(lambda: ("obstacles/lidar", b"through the router") in daemon.heard)
            operator = stack.enter_context(connected(world.caller("operator")))
            answers = await asyncio.to_thread(ask, operator, "engage", b'{"engaged":true}')
            assert answers == [{"accepted": True, "reason": ""}]
            assert await daemon.spied() == ["obstacles/lidar"]
            assert [what for what, _ in daemon.told] == ["obstacles/lidar", "engage"]

    asyncio.run(scenario())


def test_companion_publish_goes_through_with_a_sensor_s_file(world: World, tmp_path: Path) -> None:
    text = (EXAMPLES / ("sensor-certificate.json5" if world.by == "certificates" else "sensor-user.json5")).read_text()
    for shown, ours in (
        ("/etc/companion/zenoh/ca.pem", str(world.authority.ca)),
        ("/etc/companion/zenoh/", f"{tmp_path}/"),
        ("tls/192.0.2.10:7447", world.endpoint),
        ("change me", PASSWORDS["lidar-host"]),
    ):
        text = text.replace(shown, ours)
    path = tmp_path / "sensor.json5"
    path.touch(mode=0o600)
    path.write_text(text)

    async def scenario(daemon: Daemon) -> None:
        words = ["--zenoh-config", str(path), "--orbit", "center=1,2,1.5 radius=2 speed=1.5", "--duration", "0.1"]
        words = ["publish", "--key-source", "lidar", *words]
        process = await asyncio.create_subprocess_exec(sys.executable, "-m", "companion.cli", *words)
        assert await process.wait() == 0
        await daemon.until(lambda: (SPIED, "obstacles/lidar") in daemon.heard)

    run(world, scenario)


@pytest.mark.parametrize("world", ["certificates"], indirect=True)
def test_only_certificates_of_our_authority_are_let_in(world: World, tmp_path: Path) -> None:
    async def scenario(daemon: Daemon) -> None:
        impostor = world.strangers.issue("lidar-host")
        expired = world.authority.issue("lidar-host-of-last-week", expired=True)
        nothing = {f"{TLS}/connect_certificate": None, f"{TLS}/connect_private_key": None, f"{TLS}/enable_mtls": False}
        assert refused(world.caller("lidar-host", host=impostor))
        assert refused(world.caller("lidar-host", host=expired))
        assert refused(world.caller("lidar-host", **nothing))
        assert refused(world.caller("lidar-host", connect__endpoints=[world.endpoint.replace("tls", "tcp")]))
        # and a sensor does not talk to a daemon that another authority vouches for
        assert refused(world.caller("lidar-host", **{f"{TLS}/root_ca_certificate": str(world.strangers.ca)}))
        assert not refused(world.caller("lidar-host"))

    run(world, scenario)


@pytest.mark.parametrize("world", ["users"], indirect=True)
def test_only_users_with_their_password_are_let_in(world: World) -> None:
    async def scenario(daemon: Daemon) -> None:
        for credentials in (
            {"user": "lidar-host", "password": "wrong"},
            {"user": "operator", "password": PASSWORDS["lidar-host"]},
            {"user": "nobody", "password": "laser"},
            {},
        ):
            assert refused(world.caller("lidar-host", **{USER: credentials}))
        assert not refused(world.caller("operator"))  # whose password has a colon in it

    run(world, scenario)
