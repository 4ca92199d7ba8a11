"""Ground stations that we did not write, connected to a flying pair: MAVSDK, and MAVProxy where it is installed."""

from __future__ import annotations

import asyncio
import contextlib
import os
import queue
import shutil
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from companion.tunables import BY_NAME
from sim_bridge.testing import COMPANION, FlyingPair

pytestmark = pytest.mark.integration

# MAVProxy pulls more than these tests are worth; point MAVPROXY at one of your own
MAVPROXY = os.environ.get("MAVPROXY") or shutil.which("mavproxy.py")


def ground_link(pair: FlyingPair) -> tuple[str, int]:
    """Where the simulator's second link can be spoken to."""
    peer = pair.ground_station._peer
    assert peer is not None
    return peer


def configuration(pair: FlyingPair) -> dict[str, Any]:
    """What the daemon answers on its configuration query."""
    import json

    (reply,) = list(pair.zenoh.get(f"{pair.prefix}/companion/config"))
    return dict(json.loads(reply.ok.payload.to_bytes())["config"])


def test_mavsdk_reads_and_sets_parameters_of_component_196(flying_pair: Callable[..., FlyingPair]) -> None:
    mavsdk = pytest.importorskip("mavsdk.asyncio")
    from concurrent.futures import ThreadPoolExecutor

    from mavsdk.asyncio.plugins.param import ParamAsync
    from mavsdk.plugins.param import ParamError, ProtocolVersion

    pair = flying_pair()
    host, port = ground_link(pair)

    async def tune() -> None:
        asyncio.get_running_loop().set_default_executor(ThreadPoolExecutor(max_workers=12))
        settings = mavsdk.Configuration.create_with_component_type(mavsdk.ComponentType.GROUND_STATION)
        async with mavsdk.Mavsdk(settings) as library:
            await library.add_any_connection(f"udpout://{host}:{port}")
            system = await library.first_autopilot(timeout_s=15.0)
            assert system is not None
            async with asyncio.timeout(15.0):
                while COMPANION not in await system.component_ids():
                    await asyncio.sleep(0.1)  # its heartbeat comes once a second
            param = ParamAsync(system)
            with contextlib.suppress(ParamError):  # 4.1.0 returns UNKNOWN though it has selected the component
                await param.select_component(COMPANION, ProtocolVersion.V1)
            assert await param.get_param_float("CA_CUSHION") == pytest.approx(0.1)
            await param.set_param_float("CA_CUSHION", 0.35)
            assert await param.get_param_float("CA_CUSHION") == pytest.approx(0.35)
            everything = await param.get_all_params()
            found = {each.name: each.value for each in everything.float_params}
            assert set(BY_NAME) <= set(found)
            assert found["CA_CUSHION"] == pytest.approx(0.35)

    asyncio.run(tune())
    assert configuration(pair)["safety"]["cushion_m"] == 0.35


class MavProxy:
    """The process, its prompt fed by us and its output line by line."""

    def __init__(self, command: list[str], folder: Path) -> None:
        self._process = subprocess.Popen(
            command, cwd=folder, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        self.lines: list[str] = []
        self._queue: queue.Queue[str] = queue.Queue()
        threading.Thread(target=self._pump, daemon=True).start()

    def _pump(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._queue.put(line.rstrip())

    def type(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()

    def wait(self, text: str, timeout_s: float = 40.0) -> str:
        """The next line with ``text`` in it."""
        while True:
            try:
                line = self._queue.get(timeout=timeout_s)
            except queue.Empty:
                raise AssertionError(f"MAVProxy: no {text!r} in {self.lines}") from None
            self.lines.append(line)
            if text in line:
                return line

    def close(self) -> None:
        self._process.terminate()
        try:
            self._process.wait(timeout=5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        for stream in (self._process.stdin, self._process.stdout):
            assert stream is not None
            stream.close()


@contextmanager
def mavproxy(pair: FlyingPair, folder: Path) -> Iterator[MavProxy]:
    assert MAVPROXY is not None
    host, port = ground_link(pair)
    master = f"--master=udpout:{host}:{port}"
    target = ["--target-system=1", f"--target-component={COMPANION}"]
    options = ["--no-state", "--default-modules=param,cmdlong", "--nowait"]
    running = MavProxy([MAVPROXY, master, *target, *options], folder)
    try:
        yield running
    finally:
        running.close()


@pytest.mark.slow
@pytest.mark.skipif(MAVPROXY is None, reason="no mavproxy.py on the path")
def test_mavproxy_lists_and_sets_parameters(flying_pair: Callable[..., FlyingPair], tmp_path: Path) -> None:
    pair = flying_pair()
    with mavproxy(pair, tmp_path) as station:
        station.wait(f"Received {len(BY_NAME)} parameters")
        station.type("param show CA_*")
        shown = [station.wait(name) for name in BY_NAME]
        assert len(shown) == len(BY_NAME)
        station.type("param set CA_CUSHION 0.3")
        pair.wait_status(lambda _: configuration(pair)["safety"]["cushion_m"] == 0.3)
        station.type("param set CA_CUSHION -1")
        station.wait("refused: PARAM_SET: CA_CUSHION")
        station.type("param fetch CA_CUSHION")
        assert "CA_CUSHION = 0.3" in station.wait("CA_CUSHION = ")
    assert configuration(pair)["safety"]["cushion_m"] == 0.3
