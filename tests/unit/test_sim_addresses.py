"""Where the simulator's links listen and which Zenoh it joins: beyond the loopback only when told to."""

from __future__ import annotations

import json
import queue
import socket
from collections.abc import Iterator

import pytest
import zenoh
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sim_bridge.cli import main
from sim_bridge.errors import ScenarioError
from sim_bridge.links import Router
from sim_bridge.placement import resolve
from sim_bridge.scenario import parse_scenario
from sim_bridge.testing import free_port
from sim_bridge.wires import Wires
from sim_bridge.zenoh_io import session_config

SCENARIO = {"sensors": [{"source": "sim"}]}


def heartbeat() -> bytes:
    message = dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)
    return bytes(message.pack(dialect.MAVLink(None, 1, 196)))


def wires(**changes: object) -> Wires:
    settings: dict[str, object] = {"onboard_port": free_port(), "ground_port": free_port(), "endpoint": None}
    settings |= {"lockstep": False} | changes
    return Wires(resolve("addresses", parse_scenario(SCENARIO, source="addresses"), 0), **settings)  # type: ignore[arg-type]


def test_unbound_links_listen_on_the_loopback_alone() -> None:
    router = Router(free_port(), free_port())
    try:
        assert [link.socket.getsockname()[0] for link in router.links] == ["127.0.0.1", "127.0.0.1"]
    finally:
        router.close()


def test_who_speaks_first_to_a_bound_link_is_answered() -> None:
    port = free_port()
    router = Router(free_port(), free_port(), onboard_bind=("0.0.0.0", port))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as companion:
        try:
            companion.bind(("127.0.0.2", 0))
            companion.settimeout(5.0)
            companion.sendto(heartbeat(), ("127.0.0.1", port))
            assert [packet.sender.component for _, packet in router.receive()] == [196]
            router.onboard.send(b"answer")
            assert companion.recv(100) == b"answer"
        finally:
            router.close()


def test_each_vehicle_has_a_bound_port_of_its_own() -> None:
    fleet = {"vehicles": [{"start": [0.0, 0.0, 0.2]}, {"start": [3.0, 0.0, 0.2]}]}
    port = free_port() & ~1
    flown = resolve("fleet", parse_scenario(fleet, source="fleet"), 0)
    two = Wires(
        flown,
        onboard_port=free_port() & ~1,
        ground_port=(free_port() & ~1) ^ 64,
        endpoint=None,
        lockstep=False,
        onboard_bind=("127.0.0.1", port),
    )
    try:
        assert [own.router.onboard.socket.getsockname()[1] for own in two.crafts] == [port, port + 1]
    finally:
        two.close()


@pytest.mark.parametrize("option", ["--onboard-bind", "--gcs-bind"])
def test_a_bound_address_in_use_is_one_line_and_status_2(option: str, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        assert main(["run", "--scenario", "empty", "--zenoh-listen", "none", option, address]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert option in told
    assert address in told


@pytest.mark.parametrize("words", [["--onboard-bind", "14580"], ["--gcs-bind", "0.0.0.0:x"], ["--gcs-bind", "h:0"]])
def test_what_is_no_address_is_refused(words: list[str]) -> None:
    with pytest.raises(SystemExit) as done:
        main(["run", *words])
    assert done.value.code == 2


def test_a_zenoh_is_listened_on_or_connected_to_not_both() -> None:
    with pytest.raises(SystemExit) as done:
        main(["run", "--zenoh-listen", "none", "--zenoh-connect", "tcp/127.0.0.1:7447"])
    assert done.value.code == 2


@pytest.fixture
def endpoint() -> Iterator[str]:
    """Of a Zenoh router."""
    where = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    with zenoh.open(session_config([where], mode="router")):
        yield where


def test_frames_pass_a_router_to_its_other_clients(endpoint: str) -> None:
    came: queue.Queue[bytes] = queue.Queue()
    with zenoh.open(session_config([], [endpoint], mode="client")) as other:
        other.declare_subscriber("uav/uav1/obstacles/sim", lambda sample: came.put(bytes(sample.payload)))
        joined = wires(endpoint=endpoint, connect=True)
        try:
            bridge = joined.crafts[0].bridge
            assert bridge is not None
            for _ in range(200):  # until the router has told of the subscriber
                bridge.publish_frame("sim", json.dumps({"stamp_ns": 1}).encode())
                try:
                    assert json.loads(came.get(timeout=0.05)) == {"stamp_ns": 1}
                except queue.Empty:
                    continue
                break
            else:
                pytest.fail("no frame came")
        finally:
            joined.close()


def test_a_router_that_does_not_answer_is_named() -> None:
    where = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    with pytest.raises(ScenarioError, match=f"--zenoh-connect {where}: no Zenoh router answers there"):
        wires(endpoint=where, connect=True)


def test_a_flight_that_must_reach_its_target_and_does_not_has_status_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from sim_bridge.runner import RealTime

    told_to_stop = RealTime.__init__

    def stopped(self: RealTime, *args: object, **options: object) -> None:
        told_to_stop(self, *args, **options)  # type: ignore[arg-type]
        self.stop()

    monkeypatch.setattr(RealTime, "__init__", stopped)
    words = ["run", "--scenario", "demo", "--zenoh-listen", "none", "--json"]
    words += ["--onboard-port", str(free_port()), "--gcs-port", str(free_port())]
    assert main(words) == 0
    assert main([*words, "--must-reach"]) == 1
    assert [json.loads(line)["reached"] for line in capsys.readouterr().out.splitlines()] == [False, False]
