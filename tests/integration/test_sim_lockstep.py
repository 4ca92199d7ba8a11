"""The simulator in lockstep with a scripted companion and operator, over real UDP and Zenoh.

The companion here is no part of the project's daemon: it follows design 3.3 with pymavlink and zenoh directly.
"""

from __future__ import annotations

import json
import math
import queue
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
import zenoh
from pymavlink.dialects.v20 import ardupilotmega as dialect

pytestmark = pytest.mark.integration

TARGET = (2.0, 0.0, 1.5)
SCENARIO = """
[vehicle]
start = [-2.0, 0.0, 0.2]
[target]
position = [2.0, 0.0, 1.5]
[[sensors]]
source = "camera"
[[sensors]]
source = "radar"
rate_hz = 7.0
latency_s = 0.12
frame_dropout = 0.1
[[obstacles]]
id = "ball-1"
motion = "linear"
origin = [0.0, 3.0, 1.5]
velocity = [0.0, 0.5, 0.0]
jitter = { position_m = [0.5, 0.5, 0.0] }
"""


def free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Peer:
    """A MAVLink component on one of the simulator's links."""

    def __init__(self, port: int, system: int, component: int) -> None:
        self.mav = dialect.MAVLink(None, system, component)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", port))
        self.socket.settimeout(0.2)
        self.simulator: Any = None

    def receive(self) -> list[Any]:
        try:
            data, self.simulator = self.socket.recvfrom(4096)
        except TimeoutError:
            return []
        return self.mav.parse_buffer(data) or []

    def send(self, message: Any) -> None:
        self.socket.sendto(message.pack(self.mav), self.simulator)


class Companion(threading.Thread):
    """Answers every tick; flies to TARGET by a PD law once engaged. ``silent_from`` ticks it stops doing so."""

    def __init__(self, port: int, endpoint: str, sources: tuple[str, ...], withhold: str = "") -> None:
        super().__init__()
        self.peer = Peer(port, 1, 196)
        self.withhold = withhold  # "record" or "setpoint": not sent any more once engaged
        self.markers: queue.Queue[tuple[str, dict[str, int]]] = queue.Queue()
        self.frames: dict[str, int] = dict.fromkeys(sources, 0)
        self.promised: dict[str, int] = dict.fromkeys(sources, 0)
        self.tick_order: list[str] = []
        self.stamps: list[int] = []
        self.engaged = False
        self.offboard = False
        self.quit = threading.Event()
        config = zenoh.Config()
        for key, value in (
            ("mode", "peer"),
            ("scouting/multicast/enabled", False),
            ("scouting/gossip/enabled", False),
            ("connect/endpoints", [endpoint]),
        ):
            config.insert_json5(key, json.dumps(value))
        self.session = zenoh.open(config)
        self.session.declare_subscriber("uav/uav1/obstacles/*", self.on_frame)
        self.session.declare_subscriber("uav/uav1/sync/*", self.on_marker)
        self.records = self.session.declare_publisher(
            "uav/uav1/companion/setpoint", congestion_control=zenoh.CongestionControl.BLOCK
        )
        self.token = self.session.liveliness().declare_token("uav/uav1/companion/alive")

    def on_frame(self, sample: zenoh.Sample) -> None:
        frame = json.loads(sample.payload.to_bytes())
        assert frame["clock"] == "vehicle"
        self.frames[str(sample.key_expr).rsplit("/", 1)[1]] += 1

    def on_marker(self, sample: zenoh.Sample) -> None:
        self.markers.put((str(sample.key_expr).rsplit("/", 1)[1], json.loads(sample.payload.to_bytes())))

    def run(self) -> None:
        while not self.quit.is_set():
            for message in self.peer.receive():
                self.handle(message)
        self.session.close()
        self.peer.socket.close()

    def handle(self, message: Any) -> None:
        kind = message.get_type()
        if not self.stamps:
            self.tick_order.append(kind)
        if kind == "HEARTBEAT" and message.get_srcComponent() == 1:
            self.offboard = message.custom_mode == 6 << 16
            self.peer.send(dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
        elif kind == "COMMAND_LONG" and message.target_component == 196:
            self.engaged = message.param1 == 1.0
            sender = message.get_srcSystem(), message.get_srcComponent()
            self.peer.send(dialect.MAVLink_command_ack_message(message.command, 0, 0, 0, *sender))
        elif kind == "LOCAL_POSITION_NED":
            self.answer(message)

    def answer(self, state: Any) -> None:
        t_ns = state.time_boot_ms * 1_000_000
        for _ in self.frames:
            source, marker = self.markers.get(timeout=1.0)
            assert marker["through_ns"] == t_ns
            self.promised[source] += marker["frames"]
        self.stamps.append(t_ns)
        withheld = self.withhold if self.engaged else ""
        asks = self.engaged and not self.offboard
        if withheld != "setpoint":
            self.send_setpoint(state)
        if asks:
            self.peer.send(dialect.MAVLink_command_long_message(1, 1, 176, 0, 1, 6, 0, 0, 0, 0, 0))
        if withheld != "record":
            record = {"stamp_ns": t_ns, "sent": True, "messages": int(asks), "state": "READY", "verdict": "nominal"}
            self.records.put(json.dumps(record).encode())

    def send_setpoint(self, state: Any) -> None:
        error = (TARGET[1] - state.x, TARGET[0] - state.y, -TARGET[2] - state.z)  # north, east, down
        speed = (state.vx, state.vy, state.vz)
        a = [max(-3.0, min(3.0, 2.0 * e - 2.6 * v)) for e, v in zip(error, speed, strict=True)]
        self.peer.send(
            dialect.MAVLink_set_position_target_local_ned_message(
                state.time_boot_ms, 1, 1, 1, 0x0C3F, 0, 0, 0, 0, 0, 0, *a, 0, 0
            )
        )


class Operator(threading.Thread):
    """Sends each command until it is acknowledged, as MAVSDK does."""

    def __init__(self, port: int, steps: tuple[str, ...] = ("arm", "takeoff", "engage")) -> None:
        super().__init__()
        self.peer = Peer(port, 245, 190)
        self.steps = steps
        self.heard: set[tuple[int, str]] = set()
        self.acks: list[tuple[int, int, int]] = []
        self.quit = threading.Event()

    COMMANDS = {  # noqa: RUF012
        "arm": (1, 400, 1.0),
        "takeoff": (1, 22, math.nan),
        "engage": (196, 92, 1.0),
    }

    def run(self) -> None:
        for step in self.steps:
            component, command, param1 = self.COMMANDS[step]
            rest = [math.nan] * 6 if step == "takeoff" else [0.0] * 6
            last = 0.0
            while not self.quit.is_set() and (command, 0, component) not in self.acks:
                if self.peer.simulator is not None and time.monotonic() - last > 0.1:
                    last = time.monotonic()
                    self.peer.send(dialect.MAVLink_command_long_message(1, component, command, 0, param1, *rest))
                self.listen()
        while not self.quit.is_set():
            self.listen()
        self.peer.socket.close()

    def listen(self) -> None:
        for message in self.peer.receive():
            self.heard.add((message.get_srcComponent(), message.get_type()))
            if message.get_type() == "COMMAND_ACK":
                self.acks.append((message.command, message.result, message.get_srcComponent()))


@contextmanager
def flight(folder: Path, *, withhold: str = "", steps: tuple[str, ...] = ("arm", "takeoff", "engage")) -> Iterator[Any]:
    """A simulator process with companion and operator; yields (process, companion, operator, trace)."""
    folder.mkdir()
    scenario, trace = folder / "pd.toml", folder / "trace.jsonl"
    scenario.write_text(SCENARIO)
    onboard, ground = free_port(socket.SOCK_DGRAM), free_port(socket.SOCK_DGRAM)
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    arguments = ["run", "--scenario", str(scenario), "--seed", "3", "--lockstep", "--json", "--trace", str(trace)]
    arguments += ["--onboard-port", str(onboard), "--gcs-port", str(ground), "--zenoh-listen", endpoint]
    process = subprocess.Popen(
        [sys.executable, "-m", "sim_bridge.cli", *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    participants: list[Any] = []
    try:
        while process.poll() is None:  # until it listens
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", int(endpoint.rsplit(":", 1)[1]))) == 0:
                    break
            with suppress(subprocess.TimeoutExpired):
                process.wait(timeout=0.05)
        participants = [Companion(onboard, endpoint, ("camera", "radar"), withhold), Operator(ground, steps)]
        for each in participants:
            each.start()
        yield process, *participants, trace
    finally:
        process.kill()
        process.communicate()
        for each in participants:
            each.quit.set()
            each.join()


@pytest.mark.slow
def test_same_seed_same_flight_to_the_bit(tmp_path: Path) -> None:
    traces = []
    for name in ("first", "second"):
        with flight(tmp_path / name) as (process, companion, operator, trace):
            out, err = process.communicate(timeout=60.0)
            assert process.returncode == 0, err.decode()
            summary = json.loads(out)
            traces.append(trace.read_bytes())
        assert summary["reached"] is True
        assert summary["collided"] is False
        assert 1.0 < summary["flight_time_s"] < 6.0
        assert companion.stamps == [k * 50_000_000 for k in range(summary["ticks"])]
        for source, promised in companion.promised.items():  # the last frame may travel ahead of its marker
            assert 0 <= companion.frames[source] - promised <= 1
        assert companion.frames["camera"] == pytest.approx(20 * summary["sim_s"], abs=2)
        assert companion.frames["radar"] < 7 * summary["sim_s"]
        assert companion.tick_order[0] == "HEARTBEAT"
        assert companion.tick_order[-2:] == ["ATTITUDE_QUATERNION", "LOCAL_POSITION_NED"]
        assert (196, "HEARTBEAT") in operator.heard  # forwarded
        assert (92, 0, 196) in operator.acks
        print(json.dumps({key: summary[key] for key in ("real_time_factor", "tick_ms", "ticks", "wall_s", "held_s")}))
    assert traces[0] == traces[1]


@pytest.mark.parametrize(
    ("withhold", "named"),
    [
        ("record", "no record of stamp_ns"),
        ("setpoint", "no SET_POSITION_TARGET_LOCAL_NED of time_boot_ms"),
    ],
)
def test_a_missing_answer_is_named(tmp_path: Path, withhold: str, named: str) -> None:
    with flight(tmp_path / "flight", withhold=withhold) as (process, *_):
        _, err = process.communicate(timeout=60.0)
        assert process.returncode == 1
        assert named in err.decode()
        assert "1 s" in err.decode()


def test_a_port_in_use_is_one_line_and_status_2(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        arguments = ["run", "--scenario", "empty", "--zenoh-listen", endpoint]
        done = subprocess.run(
            [sys.executable, "-m", "sim_bridge.cli", *arguments],
            capture_output=True,
            timeout=30,
            check=False,
            text=True,
        )
    assert done.returncode == 2
    complaint = [line for line in done.stderr.splitlines() if line.startswith("sim-bridge: ")]
    assert len(complaint) == 1
    assert endpoint in complaint[0]
    assert "address in use" in complaint[0]
