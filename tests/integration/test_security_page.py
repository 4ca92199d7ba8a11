"""docs/how-to/security.md: its commands run as printed, and what they make lets the right ones in."""

from __future__ import annotations

import asyncio
import json
import re
import shutil
import socket
import subprocess
import tomllib
from pathlib import Path

import pytest
import zenoh

from companion.config import parse_config
from companion.link.zenoh_config import open_session, session_settings
from sim_bridge.testing import free_port

pytestmark = pytest.mark.integration
ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "how-to" / "security.md").read_text(encoding="utf-8")
needs_openssl = pytest.mark.skipif(shutil.which("openssl") is None, reason="no openssl command")


def example(name: str) -> str:
    match = re.search(rf"<!-- example: {name} -->\n```\w+\n(.*?)```", PAGE, re.DOTALL)
    assert match is not None, f"no example {name}"
    return match[1]


def shell(name: str, folder: Path) -> None:
    script = "set -e\n" + example(name).replace("192.0.2.10", "127.0.0.1")
    done = subprocess.run(["sh", "-c", script], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def here(text: str, folder: Path, endpoint: str) -> str:
    """An example with its paths and endpoints moved to this test's."""
    text = text.replace("/etc/companion/zenoh/", f"{folder}/").replace("configs/zenoh/", f"{folder}/")
    return text.replace("tls/0.0.0.0:7447", endpoint).replace("tls/192.0.2.10:7447", endpoint)


@needs_openssl
@pytest.mark.parametrize("form", ["short-form", "access"])
def test_certificates_as_made_on_the_page(tmp_path: Path, form: str) -> None:
    shell("certificates", tmp_path)
    assert (tmp_path / "uav1.key").stat().st_mode & 0o777 == 0o600
    endpoint = f"tls/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    for name in ("access-certificates.json5", "sensor-certificate.json5"):
        text = (ROOT / "configs" / "zenoh" / name).read_text(encoding="utf-8")
        (tmp_path / name).write_text(here(text, tmp_path, endpoint), encoding="utf-8")
    daemon = open_session(parse_config(tomllib.loads(here(example(form), tmp_path, endpoint))).zenoh)
    try:
        sensor = zenoh.open(zenoh.Config.from_file(tmp_path / "sensor-certificate.json5"))

        async def meet() -> None:
            loop, heard = asyncio.get_running_loop(), asyncio.Queue[str]()
            subscriber = daemon.declare_subscriber(
                "uav/uav1/**", lambda sample: loop.call_soon_threadsafe(heard.put_nowait, str(sample.key_expr))
            )
            narrow = daemon.declare_subscriber("uav/uav1/obstacles/*", lambda sample: None)
            block = zenoh.CongestionControl.BLOCK
            publisher = sensor.declare_publisher("uav/uav1/obstacles/lidar", congestion_control=block)
            async with asyncio.timeout(5.0):
                while not publisher.matching_status.matching:
                    await asyncio.sleep(0)
                sensor.put("uav/uav1/engage", b'{"engaged":true}', congestion_control=block)
                publisher.put(b"{}")
                first = await heard.get()
            assert first.endswith("obstacles/lidar" if form == "access" else "engage")
            subscriber.undeclare()
            narrow.undeclare()

        try:
            asyncio.run(meet())
        finally:
            sensor.close()
    finally:
        daemon.close()


@needs_openssl
def test_users_as_made_on_the_page(tmp_path: Path) -> None:
    shell("users", tmp_path)
    settings = session_settings(parse_config({"zenoh": {"users_file": str(tmp_path / "users")}}).zenoh)
    assert json.loads(settings.get_json("transport/auth/usrpwd/dictionary_file")) == str(tmp_path / "users")
    names = [line.split(":")[0] for line in (tmp_path / "users").read_text().splitlines()]
    text = (ROOT / "configs" / "zenoh" / "access-users.json5").read_text(encoding="utf-8")
    assert sorted(names) == sorted(re.findall(r'usernames: \["([\w-]+)"\]', text))


@needs_openssl
def test_the_key_of_mavlink_as_made_on_the_page(tmp_path: Path) -> None:
    shell("mavlink-key", tmp_path)
    path = tmp_path / "mavlink.key"
    assert path.stat().st_mode & 0o777 == 0o600
    assert len(bytes.fromhex(path.read_text().strip())) == 32


def test_every_file_that_the_page_names_exists() -> None:
    for path in re.findall(r"`(configs/[\w/.-]+)`", PAGE):
        assert (ROOT / path).exists(), path


def test_the_defaults_are_as_the_page_says() -> None:
    config = parse_config({})
    assert f'`mavlink.url = "{config.mavlink.url}"`' in PAGE
    settings = session_settings(config.zenoh)
    for key, expected in {
        "listen/endpoints": [],
        "connect/endpoints": [],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "adminspace/enabled": False,
    }.items():
        assert json.loads(settings.get_json(key)) == expected, key
