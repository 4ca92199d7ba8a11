"""Settings of Zenoh: the stock file, the short form on top, what neither says, and what is refused with which words."""

from __future__ import annotations

import asyncio
import json
import os
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import zenoh
from certificates import Authority

from companion.config import Config, parse_config
from companion.config_links import ZenohConfig, ZenohTlsConfig
from companion.errors import ConfigError
from companion.link.inbox import MAX_PAYLOAD_BYTES
from companion.link.zenoh_config import MAX_MESSAGE_BYTES, open_session, session_settings
from sim_bridge.testing import free_port

pytestmark = pytest.mark.integration


def file(folder: Path, text: str, name: str = "zenoh.json5", mode: int = 0o644) -> str:
    path = folder / name
    path.touch()
    path.chmod(mode)
    path.write_text(text, encoding="utf-8")
    return str(path)


def value(settings: zenoh.Config, key: str) -> Any:
    return json.loads(settings.get_json(key))


def refusal(**sections: Any) -> str:
    with pytest.raises(ConfigError) as caught:
        open_session(parse_config({"zenoh": sections}).zenoh).close()
    assert "\n" not in str(caught.value)
    assert ".rs" not in str(caught.value)
    return str(caught.value)


def test_what_neither_says_stays_on_this_host(tmp_path: Path) -> None:
    for config in (ZenohConfig(), ZenohConfig(config_file=file(tmp_path, '{ metadata: { name: "uav1" } }'))):
        settings = session_settings(config)
        assert value(settings, "mode") == "peer"
        assert value(settings, "scouting/multicast/enabled") is False
        assert value(settings, "scouting/gossip/enabled") is False
        assert value(settings, "listen/endpoints") == []
        assert value(settings, "connect/endpoints") == []
        assert value(settings, "transport/link/rx/max_message_size") == MAX_MESSAGE_BYTES


def test_the_file_is_used_and_the_short_form_overrides_it(tmp_path: Path) -> None:
    path = file(
        tmp_path,
        """{ // comments, single quotes and trailing commas: JSON5
          mode: 'router', connect: { endpoints: ["tcp/127.0.0.1:1"] }, listen: { endpoints: ["tcp/127.0.0.1:2"] },
          scouting: { multicast: { enabled: true }, gossip: { enabled: true } },
          transport: { link: { rx: { max_message_size: 5000000 } } },
        }""",
    )
    settings = session_settings(ZenohConfig(config_file=path))
    assert value(settings, "mode") == "router"
    assert value(settings, "connect/endpoints") == ["tcp/127.0.0.1:1"]
    assert value(settings, "listen/endpoints") == ["tcp/127.0.0.1:2"]
    assert value(settings, "scouting/multicast/enabled") is True
    assert value(settings, "scouting/gossip/enabled") is True
    assert value(settings, "transport/link/rx/max_message_size") == 5_000_000
    settings = session_settings(
        ZenohConfig(
            config_file=path,
            mode="client",
            connect=("tcp/127.0.0.1:3",),
            listen=("tcp/127.0.0.1:4",),
            multicast_scouting=False,
        )
    )
    assert value(settings, "mode") == "client"
    assert value(settings, "connect/endpoints") == ["tcp/127.0.0.1:3"]
    assert value(settings, "listen/endpoints") == ["tcp/127.0.0.1:4"]
    assert value(settings, "scouting/multicast/enabled") is False
    assert value(settings, "scouting/gossip/enabled") is True


@pytest.mark.parametrize("form", ["short", "file"])
def test_a_client_and_a_peer_meet_at_a_router(tmp_path: Path, form: str) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"

    def config(mode: str, which: str) -> ZenohConfig:
        if form == "short":
            return ZenohConfig(mode=mode, **{which: (endpoint,)})  # type: ignore[arg-type]
        text = f'{{ mode: "{mode}", {which}: {{ endpoints: ["{endpoint}"] }} }}'
        return ZenohConfig(config_file=file(tmp_path, text, f"{mode}.json5"))

    async def scenario() -> None:
        loop, heard = asyncio.get_running_loop(), asyncio.Queue[bytes]()
        sessions = [open_session(config("router", "listen"))]
        try:
            sessions += [open_session(config("client", "connect")), open_session(config("peer", "connect"))]
            listener = sessions[1].declare_subscriber(
                "a/b", lambda sample: loop.call_soon_threadsafe(heard.put_nowait, sample.payload.to_bytes())
            )
            speaker = sessions[2].declare_publisher("a/b")
            async with asyncio.timeout(5.0):
                while not speaker.matching_status.matching:
                    await asyncio.sleep(0)
                speaker.put(b"by the router")
                assert await heard.get() == b"by the router"
            listener.undeclare()
        finally:
            for session in reversed(sessions):
                session.close()

    asyncio.run(scenario())


@pytest.mark.parametrize("mode", ["peer", "client"])
def test_a_link_comes_back_with_its_router(mode: str) -> None:
    """A peer may be first, too; a client needs its router when it starts."""
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"

    async def scenario() -> None:
        router = None if mode == "peer" else open_session(ZenohConfig(mode="router", listen=(endpoint,)))
        daemon = open_session(ZenohConfig(mode=mode, connect=(endpoint,)))  # type: ignore[arg-type]

        async def linked(expected: bool) -> None:
            async with asyncio.timeout(10.0):
                while bool(list(daemon.info.routers_zid())) is not expected:
                    await asyncio.sleep(0)

        try:
            for _ in range(2):
                if router is None:
                    router = open_session(ZenohConfig(mode="router", listen=(endpoint,)))
                await linked(True)
                router.close()
                router = None
                await linked(False)
        finally:
            daemon.close()

    asyncio.run(scenario())


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{ mode: 'bogus' }", "line 1: unknown variant `bogus`, expected one of `router`, `peer`, `client`"),
        ("{\n mode: 'peer',\n nope: 1 }", "line 3: unknown field `nope`, expected one of"),
        ("{ bad", "line 1: expected"),
        ("", "Empty config file"),
        ("{ transport: { link: { tls: { key: 'x' } } } }", "unknown field `key`"),
        ("{ transport: { auth: { usrpwd: { user: 'me' } } } }", "a user and its password go together"),
        ("{ listen: { endpoints: ['nonsense'] } }", "Endpoints must be of the form"),
    ],
)
def test_a_wrong_file_is_one_line_that_names_it(tmp_path: Path, text: str, words: str) -> None:
    path = file(tmp_path, text)
    message = refusal(config_file=path)
    assert message.startswith(f"zenoh.config_file: {path}: ")
    assert words in message


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    missing = str(tmp_path / "no.json5")
    assert refusal(config_file=missing).startswith(f"zenoh.config_file: {missing}: cannot be read (no such file)")
    assert "config_file" in refusal(config_file=str(tmp_path))
    text = file(tmp_path, "mode = 1", "zenoh.conf")
    assert f"{text}: Unsupported file type '.conf'" in refusal(config_file=text)


def test_the_command_line_ends_with_status_2(tmp_path: Path) -> None:
    path = file(tmp_path, "{ mode: 'bogus' }")
    toml = file(
        tmp_path, f'[mavlink]\nurl = "udpin://127.0.0.1:{free_port()}"\n[zenoh]\nconfig_file = "{path}"\n', "c.toml"
    )
    done = subprocess.run(
        [sys.executable, "-m", "companion.cli", "run", "-c", toml], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith(f"companion: zenoh.config_file: {path}: line 1")


def test_a_client_that_would_wait_without_end_is_refused(tmp_path: Path) -> None:
    """`zenoh.open` would not return, nor hear SIGTERM."""
    path = file(tmp_path, '{ mode: "client", connect: { timeout_ms: -1, endpoints: ["tcp/127.0.0.1:1"] } }')
    assert "connect.timeout_ms: expected at least 0" in refusal(config_file=path)
    unreachable = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    assert unreachable in refusal(mode="client", connect=[unreachable])


def test_tls_files_are_read_before_anything_opens(tmp_path: Path) -> None:
    authority = Authority(tmp_path)
    own, other = authority.issue("uav1"), authority.issue("other")
    good = {"ca": str(authority.ca), "certificate": str(own.certificate), "private_key": str(own.private_key)}
    session_settings(ZenohConfig(tls=ZenohTlsConfig(**good, mutual=True)))  # nothing to complain about

    assert refusal(tls={"certificate": good["certificate"]}).startswith("zenoh.tls: expected certificate and private_")
    assert refusal(tls={"mutual": True}) == "zenoh.tls.mutual: expected zenoh.tls.ca, to check the others against"
    missing = str(tmp_path / "missing.pem")
    assert refusal(tls=good | {"ca": missing}).startswith(f"zenoh.tls.ca: {missing}: cannot be read (No such file")
    words = file(tmp_path, "not a certificate")
    assert refusal(tls=good | {"ca": words}).startswith(f"zenoh.tls.ca: {words}: holds no certificate")
    message = refusal(tls=good | {"private_key": str(other.private_key)})
    assert message.startswith(f"zenoh.tls.certificate: {own.certificate}: the certificate is not that of the key")
    own.private_key.chmod(0o640)
    message = refusal(tls=good)
    assert message == (f"zenoh.tls.private_key: {own.private_key}: expected mode 0600 or less (owner only), got 0640")
    path = file(tmp_path, json.dumps({"transport": {"link": {"tls": {"root_ca_certificate": missing}}}}))
    message = refusal(config_file=path)
    assert message.startswith(f"{path}: transport.link.tls.root_ca_certificate: {missing}: cannot be read")


def test_a_key_that_asks_for_a_passphrase_is_refused_without_asking(tmp_path: Path) -> None:
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    authority = Authority(tmp_path)
    own = authority.issue("uav1")
    own.private_key.write_bytes(
        ec.generate_private_key(ec.SECP256R1()).private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.BestAvailableEncryption(b"secret"),
        )
    )
    assert "zenoh.tls.certificate" in refusal(
        tls={"certificate": str(own.certificate), "private_key": str(own.private_key)}
    )


def test_passwords_are_in_files_of_mode_0600(tmp_path: Path) -> None:
    good = file(tmp_path, "secret\n", "password", 0o600)
    users = file(tmp_path, "lidar:a\n\nradar:b:c\n", "users", 0o600)
    settings = session_settings(ZenohConfig(user="me", password_file=good, users_file=users))
    assert value(settings, "transport/auth/usrpwd/user") == "me"
    assert value(settings, "transport/auth/usrpwd/dictionary_file") == users

    assert refusal(user="me").startswith("zenoh.user: expected user and password_file together")
    os.chmod(good, 0o644)
    message = refusal(user="me", password_file=good)
    assert message == f"zenoh.password_file: {good}: expected mode 0600 or less (owner only), got 0644"
    for text in ("", "\n", "two\nlines\n"):
        path = file(tmp_path, text, "wrong", 0o600)
        assert "expected one line, the password" in refusal(user="me", password_file=path)
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo, 0o600)
    assert "expected a regular file" in refusal(user="me", password_file=str(fifo))
    os.chmod(users, 0o604)
    assert refusal(users_file=users).startswith(f"zenoh.users_file: {users}: expected mode 0600")
    wrong = file(tmp_path, "lidar:a\nradar\n", "wrong-users", 0o600)
    assert refusal(users_file=wrong) == f"zenoh.users_file: {wrong}: line 2: expected user:password"
    inside = file(tmp_path, "{ transport: { auth: { usrpwd: { user: 'me', password: 'secret' } } } }")
    message = refusal(config_file=inside)
    assert message.startswith(f"zenoh.config_file: {inside}: transport.auth.usrpwd.password: expected mode 0600")
    assert "secret" not in message


def test_one_who_listens_and_has_a_name_needs_the_list_of_the_others(tmp_path: Path) -> None:
    """Measured: without a dictionary Zenoh refuses every caller, one with the same name and password too."""
    password = file(tmp_path, "secret", "password", 0o600)
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    message = refusal(user="me", password_file=password, listen=[endpoint])
    assert message.startswith("zenoh.users_file: expected where zenoh.listen and zenoh.user are set")


def test_what_the_daemon_publishes_of_its_configuration_holds_no_password(tmp_path: Path) -> None:
    password = file(tmp_path, "open sesame\n", "password", 0o600)
    config = parse_config({"zenoh": {"user": "me", "password_file": password}})
    session_settings(config.zenoh)
    assert "sesame" not in repr(config)
    assert config != Config()


def test_a_message_beyond_the_bound_is_not_put_together() -> None:
    """One of 1 MiB and a byte still is, so that it can be counted; memory is bounded before that."""
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"

    async def scenario() -> None:
        loop, heard = asyncio.get_running_loop(), asyncio.Queue[int]()
        remote = session_settings(ZenohConfig(connect=(endpoint,)))
        remote.insert_json5("transport/shared_memory/enabled", "false")  # as from another host
        listener, speaker = open_session(ZenohConfig(listen=(endpoint,))), zenoh.open(remote)
        try:
            subscriber = listener.declare_subscriber(
                "a", lambda sample: loop.call_soon_threadsafe(heard.put_nowait, len(sample.payload))
            )
            publisher = speaker.declare_publisher("a", congestion_control=zenoh.CongestionControl.BLOCK)
            async with asyncio.timeout(10.0):
                while not publisher.matching_status.matching:
                    await asyncio.sleep(0)
                for size in (1, MAX_PAYLOAD_BYTES + 1, MAX_MESSAGE_BYTES + 1, 2):
                    await asyncio.to_thread(publisher.put, bytes(size))
                assert [await heard.get() for _ in range(3)] == [1, MAX_PAYLOAD_BYTES + 1, 2]
            subscriber.undeclare()
        finally:
            speaker.close()
            listener.close()

    asyncio.run(scenario())
