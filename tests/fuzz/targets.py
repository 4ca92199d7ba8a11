"""What is fuzzed: one function of arbitrary bytes for each door. Whatever the bytes, nothing may raise."""

from __future__ import annotations

import struct
import tomllib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.config import parse_config
from companion.config_links import Ros2Config
from companion.errors import ConfigError, FrameRejected
from companion.link import mav, wire
from companion.link.decode import DECODERS
from companion.link.decode_traffic import TRAFFIC_DECODERS
from companion.link.inbox import ObstacleInbox
from companion.link.mavlink import MavlinkCodec
from companion.link.ros2 import subscriptions
from companion.link.ros2_types import UNHASHED
from companion.types import NS_PER_S

Target = Callable[[bytes], None]
_NOW_NS = 1_000 * NS_PER_S
READ = (*DECODERS, *TRAFFIC_DECODERS, mav.MSG_COMMAND_LONG, mav.MSG_COMMAND_INT, mav.MSG_STATUSTEXT)
_FORGET = 4096  # inputs, after which the state that a door keeps begins anew, so that inputs stay reproducible


class Mavlink:
    """A stream: the codec keeps what it has half received."""

    def __init__(self) -> None:
        self._codec, self._count = MavlinkCodec(system=1), 0

    def __call__(self, data: bytes) -> None:
        self._count += 1
        if self._count % _FORGET == 0:
            self._codec = MavlinkCodec(system=1)
        for event in self._codec.receive(data):
            for name in ("p_enu", "v_enu", "a_enu", "q_enu_from_flu"):
                value = getattr(event, name, None)
                assert value is None or np.isfinite(value).all()


class MavlinkPayload(Mavlink):
    """Any payload of any message that is read, with the right checksum: the first byte chooses the message."""

    def __call__(self, data: bytes) -> None:
        if len(data) > 1:
            message_id = READ[data[0] % len(READ)]
            super().__call__(packet(message_id, data[1:]))


def packet(message_id: int, payload: bytes) -> bytes:
    """A MAVLink 2 packet of system 1, component 1, whose payload is cut to its message's length."""
    kind = dialect.mavlink_map[message_id]
    payload = payload[: kind.unpacker.size]
    body = bytes([len(payload), 0, 0, 0, 1, 1]) + message_id.to_bytes(3, "little") + payload
    return b"\xfd" + body + struct.pack("<H", dialect.x25crc(body + bytes([kind.crc_extra])).crc)


class Obstacles:
    """A frame, JSON or msgpack by its first byte, through the inbox to the brain's type."""

    def __init__(self) -> None:
        self._inbox, self._count = ObstacleInbox(queue=4, max_age_s=1e6), 0

    def __call__(self, data: bytes) -> None:
        self._count += 1
        encoding = wire.MSGPACK if data[:1] > b"\x7f" else wire.JSON
        self._inbox.push(f"s{self._count % 80}", data, encoding)
        for frame in self._inbox.drain(_NOW_NS, unix_minus_vehicle_ns=0):
            for detection in frame.detections:
                assert np.isfinite(detection.p_enu).all()
        if self._count % _FORGET == 0:
            self._inbox.reset()


class Cdr:
    """A ROS 2 message, Detection3DArray or TrackedObjects by its first byte, through the inbox to the brain's type."""

    def __init__(self) -> None:
        config = Ros2Config(detections=("seen",), tracked_objects=("tracked",))
        self._inbox, self._count = ObstacleInbox(queue=4, max_age_s=1e9), 0
        self._doors = [(key.replace("*", UNHASHED), door) for key, door in subscriptions(config, self._inbox).items()]

    def __call__(self, data: bytes) -> None:
        self._count += 1
        key, door = self._doors[data[0] % 2 if data else 0]
        door(key, data[1:], "")
        for frame in self._inbox.drain(_NOW_NS, unix_minus_vehicle_ns=0):
            for detection in frame.detections:
                assert np.isfinite(detection.p_enu).all()
        if self._count % _FORGET == 0:
            self._inbox.reset()


def commands(data: bytes) -> None:
    """Targets, engagement, vehicle states and markers."""
    kinds: tuple[Any, ...] = (wire.TargetCommand, wire.EngageCommand, wire.VehicleStateIn, wire.SyncMarker)
    for kind in kinds:
        for encoding in (wire.JSON, wire.MSGPACK):
            with suppress(FrameRejected):
                wire.decode(data, kind, encoding)


def configuration(data: bytes) -> None:
    """A TOML file."""
    try:
        raw = tomllib.loads(data.decode("utf-8", errors="replace"))
    except tomllib.TOMLDecodeError:
        return
    with suppress(ConfigError):
        parse_config(raw)


TARGETS: dict[str, Callable[[], Target]] = {
    "mavlink": Mavlink,
    "mavlink_payload": MavlinkPayload,
    "obstacles": Obstacles,
    "commands": lambda: commands,
    "cdr": Cdr,
    "configuration": lambda: configuration,
}


def seeds(name: str) -> list[bytes]:
    """Inputs from which mutation starts: valid ones."""
    if name == "mavlink":
        return [packet(message_id, bytes(range(60))) for message_id in READ]
    if name == "mavlink_payload":
        return [bytes([index]) + bytes(40) for index in range(len(READ))]
    if name == "obstacles":
        ball = wire.Obstacle(id="a", position=(1.0, 2.0, 3.0), radius=0.2, position_std=0.1, velocity=(0.0, 1.0, 0.0))
        frame = wire.ObstacleFrame(stamp_ns=_NOW_NS, clock="vehicle", obstacles=[ball, ball])
        return [wire.encode(frame, encoding) for encoding in (wire.JSON, wire.MSGPACK)]
    if name == "cdr":
        from ros2_oracle import Detection3DArray as Detections
        from ros2_oracle import TrackedObjects, cdr, detection, header, tracked

        stamp = header(_NOW_NS)
        seen = Detections(header=stamp, detections=[detection(1.0, 2.0, 3.0, name="a")])
        objects = TrackedObjects(header=stamp, objects=[tracked(1)])
        return [bytes([index]) + cdr(message) for index, message in enumerate((seen, objects))]
    if name == "commands":
        written = (
            wire.TargetCommand(position=(1.0, 2.0, 3.0)),
            wire.EngageCommand(engaged=True),
            wire.VehicleStateIn(stamp_ns=1, position=(0.0, 0.0, 1.0), velocity=(0.0, 0.0, 0.0)),
            wire.SyncMarker(through_ns=1, frames=2),
        )
        return [wire.encode(value, encoding) for value in written for encoding in (wire.JSON, wire.MSGPACK)]
    lines = (Path(__file__).parents[2] / "configs" / "default.toml").read_text(encoding="utf-8").split("\n\n")
    return ["\n".join(lines).encode(), *(part.encode() for part in lines)]
