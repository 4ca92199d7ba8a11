"""A pytest fixture for integration tests: a flying pair, simulator and daemon, on free ports of the loopback.

The entry point makes ``flying_pair`` known to pytest wherever this package is installed::

    def test_my_sensor(flying_pair):
        pair = flying_pair(target=(3.0, 0.0, 2.0))   # hovering, daemon READY
        pair.publish("mine", [{"id": "ball", "position": [1.5, 0.0, 2.0], "radius": 0.2}])
        pair.engage()
        assert pair.wait_status(lambda status: status["state"] == "ACTIVE")

Both sides are separate processes over real UDP sockets and a private Zenoh endpoint; nothing leaves the machine.
"""

from __future__ import annotations

import contextlib
import json
import queue
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

COMPANION = 196  # MAV_COMP_ID_OBSTACLE_AVOIDANCE
_ARM, _TAKEOFF, _GUIDED_ENABLE = 400, 22, 92


def free_port(kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    """A port on 127.0.0.1 that nobody holds now."""
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class GroundStation:
    """A plain MAVLink ground station on the simulator's second link: commands out, acknowledgements in."""

    def __init__(self, port: int) -> None:
        from pymavlink.dialects.v20 import ardupilotmega as dialect

        self._dialect = dialect
        self._codec = dialect.MAVLink(None, 245, 190)
        self._codec.robust_parsing = True
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", port))
        self._peer: tuple[str, int] | None = None
        self._unread: list[Any] = []  # one datagram carries several messages

    def close(self) -> None:
        self._socket.close()

    def wait(self, accept: Callable[[Any], bool], what: str, timeout_s: float = 15.0) -> Any:
        """The first message that ``accept`` takes. Raises TimeoutError naming ``what``."""
        deadline = time.monotonic() + timeout_s
        while (left := deadline - time.monotonic()) > 0.0:
            while self._unread:
                message = self._unread.pop(0)
                if accept(message):
                    return message
            self._socket.settimeout(left)
            try:
                data, self._peer = self._socket.recvfrom(4096)
            except TimeoutError:
                break
            self._unread.extend(self._codec.parse_buffer(data) or [])
        raise TimeoutError(f"ground station: no {what} within {timeout_s} s")

    def command(self, command: int, *params: float, component: int = 1) -> None:
        """Send COMMAND_LONG to system 1 and wait until it is accepted."""
        if self._peer is None:
            self.wait(lambda message: message.get_type() == "HEARTBEAT", "heartbeat")
        assert self._peer is not None
        seven = [*params, *[0.0] * (7 - len(params))]
        message = self._dialect.MAVLink_command_long_message(1, component, command, 0, *seven)
        self._socket.sendto(message.pack(self._codec), self._peer)
        ack = self.wait(
            lambda m: m.get_type() == "COMMAND_ACK" and m.command == command and m.get_srcComponent() == component,
            f"COMMAND_ACK of {command}",
        )
        if ack.result != 0:
            raise RuntimeError(f"ground station: command {command} answered with MAV_RESULT {ack.result}")

    def set_parameter(self, name: str, value: float, component: int = COMPANION) -> None:
        """PARAM_SET to a component of system 1, until it has answered with the new value."""
        if self._peer is None:
            self.wait(lambda message: message.get_type() == "HEARTBEAT", "heartbeat")
        assert self._peer is not None
        real32 = self._dialect.MAV_PARAM_TYPE_REAL32
        message = self._dialect.MAVLink_param_set_message(1, component, name.encode(), value, real32)
        self._socket.sendto(message.pack(self._codec), self._peer)
        self.wait(
            lambda m: m.get_type() == "PARAM_VALUE" and m.param_id == name and abs(m.param_value - value) < 1e-6,
            f"PARAM_VALUE of {name}",
        )


class FlyingPair:
    """A simulator and a daemon that talk to each other; made by the ``flying_pair`` fixture."""

    def __init__(
        self, folder: Path, target: Sequence[float], scenario: str, seed: int, overrides: Sequence[str]
    ) -> None:
        import zenoh

        onboard, gcs = free_port(), free_port()
        self.endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
        self.daemon_endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
        self.prefix = "uav/uav1"
        self.ground_station = GroundStation(gcs)
        config = folder / "companion.toml"
        config.write_text(
            f'[mavlink]\nurl = "udpin://127.0.0.1:{onboard}"\nsystem_id = 1\n'
            f'[zenoh]\nconnect = ["{self.endpoint}"]\nlisten = ["{self.daemon_endpoint}"]\n'
            f"[target]\nposition = {[float(x) for x in target]}\n",
            encoding="utf-8",
        )
        self._logs = [(folder / name).open("wb") for name in ("sim-bridge.log", "companion.log")]
        sim = ["sim_bridge.cli", "run", "--scenario", scenario, "--seed", str(seed)]
        sim += ["--onboard-port", str(onboard), "--gcs-port", str(gcs), "--zenoh-listen", self.endpoint]
        sets = [word for item in overrides for word in ("--set", item)]
        self.simulator = self._start(sim, self._logs[0])
        self.daemon = self._start(["companion.cli", "run", "-c", str(config), *sets], self._logs[1])
        self._status: queue.Queue[dict[str, Any]] = queue.Queue()
        self.zenoh = zenoh.open(_zenoh_config(zenoh, [self.endpoint, self.daemon_endpoint]))
        self._subscriber = self.zenoh.declare_subscriber(
            f"{self.prefix}/companion/status", lambda sample: self._status.put(json.loads(sample.payload.to_bytes()))
        )

    def takeoff(self) -> None:
        """Arm, take off, and wait until the daemon reports READY in the air."""
        self.wait_status(lambda status: status["state"] == "READY")
        self.ground_station.command(_ARM, 1.0)
        self.ground_station.command(_TAKEOFF, *[float("nan")] * 7)
        self.ground_station.wait(
            lambda m: m.get_type() == "EXTENDED_SYS_STATE" and m.landed_state == 2, "landed_state IN_AIR"
        )
        self.wait_status(lambda status: status["airborne"])

    def engage(self) -> None:
        """MAV_CMD_NAV_GUIDED_ENABLE to component 196, as an operator would."""
        self.ground_station.command(_GUIDED_ENABLE, 1.0, component=COMPANION)

    def publish(self, source: str, obstacles: Sequence[dict[str, Any]]) -> None:
        """One obstacle frame, stamped now."""
        frame = {"stamp_ns": time.time_ns(), "clock": "unix", "obstacles": list(obstacles)}
        self.zenoh.put(f"{self.prefix}/obstacles/{source}", json.dumps(frame))

    def wait_status(self, accept: Callable[[dict[str, Any]], bool], timeout_s: float = 20.0) -> dict[str, Any]:
        """The first status (from now on) that ``accept`` takes. Raises TimeoutError with the last one seen."""
        deadline = time.monotonic() + timeout_s
        last: dict[str, Any] = {}
        while (left := deadline - time.monotonic()) > 0.0:
            with contextlib.suppress(queue.Empty):
                last = self._status.get(timeout=left)
                if accept(last):
                    return last
        raise TimeoutError(f"daemon: expected status did not come within {timeout_s} s, last was {last}")

    def close(self) -> None:
        """Stop both processes and release every socket."""
        self._subscriber.undeclare()
        self.zenoh.close()
        for process in (self.daemon, self.simulator):
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
        for process in (self.daemon, self.simulator):
            try:
                process.wait(timeout=5.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self.ground_station.close()
        for log in self._logs:
            log.close()

    @staticmethod
    def _start(words: Sequence[str], log: Any) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-m", *words], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=log
        )


def _zenoh_config(zenoh: Any, connect: Sequence[str]) -> Any:
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("connect/endpoints", json.dumps(list(connect)))
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("scouting/gossip/enabled", "false")
    return config


@pytest.fixture
def flying_pair(tmp_path: Path) -> Iterator[Callable[..., FlyingPair]]:
    """Factory of hovering pairs; ``overrides`` go to the daemon, such as ``["safety.horizon=5"]``."""
    pairs: list[FlyingPair] = []

    def make(
        target: Sequence[float] = (3.0, 0.0, 2.0),
        *,
        scenario: str = "empty",
        seed: int = 0,
        overrides: Sequence[str] = (),
    ) -> FlyingPair:
        folder = tmp_path / f"pair{len(pairs)}"
        folder.mkdir()
        pair = FlyingPair(folder, target, scenario, seed, overrides)
        pairs.append(pair)
        pair.takeoff()
        return pair

    yield make
    for pair in pairs:
        pair.close()
