"""ROS 2 messages on rmw_zenoh's keys, by plain Zenoh sessions over loopback TCP, to the daemon.

The publisher is what rmw_zenoh_cpp is on the wire, as its design says: the key, CDR, an attachment of sequence number,
time and publisher id. ROS itself is not here.
"""

from __future__ import annotations

import asyncio
import json
import socket
import struct
import time
from collections.abc import Callable
from typing import Any

import pytest
import ros2_oracle as oracle
import zenoh
from datagrams import listen
from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.clock import SystemClock
from companion.config import parse_config
from companion.config_links import Ros2Config, ZenohConfig
from companion.link import wire
from companion.link.inbox import ObstacleInbox
from companion.link.ros2 import subscriptions
from companion.link.zenoh import ZenohHandlers, ZenohLink, open_session
from companion.service import Service
from companion.types import DetectionFrame, DetectionKind
from sim_bridge.testing import free_port

pytestmark = pytest.mark.integration

S = 1_000_000_000
STAMP = 1_700_000_000 * S
DETECTIONS = "vision_msgs::msg::dds_::Detection3DArray_"
DETECTIONS_HASH = "RIHS01_793f5eab9595ac1c0da07873cc859db42eae51f0ee76056db8562515d830e018"
TRACKED = "autoware_perception_msgs::msg::dds_::TrackedObjects_"
TRACKED_HASH = "RIHS01_3559bd4e62ce8a4d96e32720c02bbe656cc090bb2b3f3f91f52a7c3ab095417a"
CONFIG = Ros2Config(domain_id=7, detections=("/lidar/boxes",), tracked_objects=("/perception/objects",))


def attachment(sequence: int) -> bytes:
    return struct.pack("<qqB", sequence, STAMP, 16) + bytes(range(16))


def tcp() -> str:
    return f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(10.0):
        while not condition():
            await asyncio.sleep(0)


def router(endpoint: str) -> zenoh.Session:
    """What `ros2 run rmw_zenoh_cpp rmw_zenohd` is: a Zenoh router that listens."""
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)


async def received(daemon: ZenohConfig, node: ZenohConfig) -> tuple[tuple[DetectionFrame, ...], dict[str, int]]:
    """What the inbox makes of two messages that ``node`` publishes and one of a layout that nobody knows."""
    inbox = ObstacleInbox(queue=64, max_age_s=0.5)

    def refuse(_: object) -> wire.Reply:
        return wire.Reply(accepted=False)

    handlers = ZenohHandlers(
        on_obstacles=inbox.push,
        on_target=refuse,
        on_engage=refuse,
        config=lambda: b"{}",
        health=lambda: b"{}",
        extra=subscriptions(CONFIG, inbox),
    )
    link = ZenohLink.open(daemon, "uav/test", asyncio.get_running_loop(), handlers)
    peer = open_session(node)
    try:
        boxes = oracle.Detection3DArray(oracle.header(STAMP), [oracle.detection(1.0, 2.0, 3.0, name="a")])
        objects = oracle.TrackedObjects(oracle.header(STAMP), [oracle.tracked(4)])
        messages = (
            (f"7/lidar/boxes/{DETECTIONS}/{DETECTIONS_HASH}", oracle.cdr(boxes, "big")),
            (f"7/perception/objects/{TRACKED}/{TRACKED_HASH}", oracle.cdr(objects)),
            (f"7/lidar/boxes/{DETECTIONS}/RIHS01_{'0' * 64}", oracle.cdr(boxes)),
            (f"0/lidar/boxes/{DETECTIONS}/{DETECTIONS_HASH}", b"of another domain"),
        )
        for number, (key, payload) in enumerate(messages):
            publisher = peer.declare_publisher(key)
            if key.startswith("7/"):
                await until(lambda publisher=publisher: publisher.matching_status.matching)
            else:
                assert not publisher.matching_status.matching
            publisher.put(payload, attachment=attachment(number))
        await until(lambda: link.counts["received"] == 3)
        await until(lambda: inbox.counts["type_hash"] == 1 and len(inbox.sources) == 2)
        frames = inbox.drain(S, unix_minus_vehicle_ns=STAMP - S)
        return frames, dict(inbox.counts)
    finally:
        peer.close()
        link.close()


def check(frames: tuple[DetectionFrame, ...], counts: dict[str, int]) -> None:
    seen, known = frames
    assert (seen.source, seen.kind, seen.stamp_ns) == ("ros2-lidar-boxes", DetectionKind.DETECTION, S)
    assert (seen.detections[0].id, seen.detections[0].p_enu.tolist()) == ("a", [1.0, 2.0, 3.0])
    assert (known.source, known.kind) == ("ros2-perception-objects", DetectionKind.TRACK)
    assert known.detections[0].v_enu.tolist() == [5.0, 0.0, 0.0]
    assert counts == {"frames": 2, "type_hash": 1}


def test_node_and_daemon_as_peers() -> None:
    endpoint = tcp()
    check(*asyncio.run(received(ZenohConfig(listen=(endpoint,)), ZenohConfig(connect=(endpoint,)))))


def test_node_and_daemon_meet_at_a_router_as_rmw_zenoh_has_it() -> None:
    endpoint = tcp()
    hub = router(endpoint)
    try:
        daemon = ZenohConfig(mode="client", connect=(endpoint,))
        check(*asyncio.run(received(daemon, ZenohConfig(connect=(endpoint,)))))
    finally:
        hub.close()


class Autopilot:
    """A vehicle that hovers, on the clock of this process, and answers TIMESYNC."""

    def __init__(self, port: int) -> None:
        self._address = ("127.0.0.1", port)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self._mav = dialect.MAVLink(None, 1, 1)
        self._began_ns = time.monotonic_ns()

    def close(self) -> None:
        self._socket.close()

    def _send(self, message: Any) -> None:
        self._socket.sendto(message.pack(self._mav), self._address)

    async def fly(self) -> None:
        """One state; then answer for 20 ms."""
        ms = (time.monotonic_ns() - self._began_ns) // 1_000_000
        self._send(self._mav.heartbeat_encode(2, 12, 1 | 128, 4 << 16 | 3 << 24, 4))
        self._send(self._mav.attitude_quaternion_encode(ms, 1.0, 0, 0, 0, 0, 0, 0))
        self._send(self._mav.local_position_ned_encode(ms, 0, 0, -2, 0, 0, 0))
        await listen(self._socket, 0.02, self._take)

    def _take(self, data: bytes) -> None:
        for message in self._mav.parse_buffer(data) or []:
            if message.get_type() == "TIMESYNC" and message.tc1 == 0:
                self._send(self._mav.timesync_encode(time.monotonic_ns() - self._began_ns, message.ts1))


def test_the_daemon_tracks_what_a_node_publishes() -> None:
    """From the configuration to `companion/tracks`, with unix stamps and the time base of TIMESYNC."""
    endpoint, port = tcp(), free_port()
    config = parse_config(
        {
            "mavlink": {"url": f"udpin://127.0.0.1:{port}", "system_id": 1},
            "zenoh": {"listen": [endpoint]},
            "ros2": {"detections": ["/lidar/boxes"]},
        }
    )

    async def scenario() -> tuple[dict[str, Any], dict[str, int]]:
        service, autopilot = Service(config, SystemClock()), Autopilot(port)
        running = asyncio.create_task(service.run())
        peer: zenoh.Session | None = None
        heard: list[dict[str, Any]] = []
        try:
            await autopilot.fly()
            peer = open_session(ZenohConfig(connect=(endpoint,)))
            node = peer.declare_publisher(f"0/lidar/boxes/{DETECTIONS}/{DETECTIONS_HASH}")
            listening = peer.declare_subscriber(
                "uav/uav1/companion/tracks", lambda sample: heard.append(json.loads(sample.payload.to_bytes()))
            )
            await until(lambda: node.matching_status.matching)
            node.put(b"\x00\x01\x00\x00nonsense", attachment=attachment(0))
            async with asyncio.timeout(20.0):
                while not any(table["tracks"] for table in heard):
                    box = oracle.detection(3.0, -1.0, 2.0, name="balloon")
                    message = oracle.Detection3DArray(oracle.header(time.time_ns()), [box])
                    node.put(oracle.cdr(message), attachment=attachment(1))
                    await autopilot.fly()
            listening.undeclare()
        finally:
            service.stop()
            if peer is not None:
                peer.close()
            autopilot.close()
        return next(table for table in heard if table["tracks"]), (await running).counts

    table, counts = asyncio.run(scenario())
    (track,) = table["tracks"]
    assert track["id"] == "ros2-lidar-boxes/balloon"
    assert track["sources"] == ["ros2-lidar-boxes"]
    assert track["position"] == pytest.approx([3.0, -1.0, 2.0], abs=1e-6)
    assert track["radius"] == pytest.approx(0.2 * 3**0.5)
    assert counts["obstacles.malformed"] == 1
    assert counts["obstacles.frames"] >= 1
