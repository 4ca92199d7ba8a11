"""The ROS 2 door: obstacles of nodes that run rmw_zenoh, without ROS on this computer (docs/reference/ros2.md).

rmw_zenoh publishes a topic on ``<domain>/<topic without outer slashes>/<pkg::msg::dds_::Type_>/<type hash>``: inner
slashes stay (only its liveliness tokens turn them into ``%``), the payload is CDR behind a 4-byte header, an attachment
has sequence number, time and publisher, of which nothing is needed here. Source: design of ros2/rmw_zenoh.

The door subscribes with ``*`` in the place of the hash, so that a message of another layout is seen and told, and
decodes what has the hash of the layout it knows, one named in ``ros2.type_hashes``, or Humble's place holder.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

from companion.config_links import Ros2Config
from companion.errors import FrameRejected
from companion.link.inbox import MAX_PAYLOAD_BYTES, ObstacleInbox
from companion.link.ros2_obstacles import frame_from_detections, frame_from_tracked_objects
from companion.link.ros2_types import DETECTIONS, TRACKED_OBJECTS, UNHASHED, MessageType, load_type
from companion.link.wire import ObstacleFrame
from companion.link.zenoh import OnPayload

ToFrame = Callable[[Any, Collection[str]], ObstacleFrame]


def key_expression(config: Ros2Config, topic: str, dds_name: str, type_hash: str = "*") -> str:
    """The key of ``topic`` as rmw_zenoh makes it; ``type_hash`` ``*`` matches every release of the message.

    >>> key_expression(Ros2Config(domain_id=3), "/robot1/objects", "vision_msgs::msg::dds_::Detection3DArray_")
    '3/robot1/objects/vision_msgs::msg::dds_::Detection3DArray_/*'
    """
    prefix = f"{config.key_prefix}/" if config.key_prefix else ""
    return f"{prefix}{config.domain_id}/{topic.strip('/')}/{dds_name}/{type_hash}"


def source_name(topic: str) -> str:
    """The obstacle source that a topic becomes; no two topics share one, names in ROS have no dashes.

    >>> source_name("/robot1/objects")
    'ros2-robot1-objects'
    """
    return "ros2-" + topic.strip("/").replace("/", "-")


def subscriptions(config: Ros2Config, inbox: ObstacleInbox) -> dict[str, OnPayload]:
    """What to subscribe to, key expression by handler; empty where no topic is configured.

    The handlers take (whole key, payload, encoding), never raise, and count what they refuse in ``inbox``. A message is
    decoded by the tick that drains it: a flood costs no more than the inbox's queue.

    Raises:
        ConfigError: topics are configured and rosbags is not installed.
    """
    found: dict[str, OnPayload] = {}
    routes: tuple[tuple[str, tuple[str, ...], ToFrame], ...] = (
        (DETECTIONS, config.detections, frame_from_detections),
        (TRACKED_OBJECTS, config.tracked_objects, frame_from_tracked_objects),
    )
    for name, topics, to_frame in routes:
        if topics:
            kind = load_type(name)
            for topic in topics:
                found[key_expression(config, topic, kind.dds_name)] = _receiver(config, topic, kind, to_frame, inbox)
    return found


def _receiver(config: Ros2Config, topic: str, kind: MessageType, to_frame: ToFrame, inbox: ObstacleInbox) -> OnPayload:
    source = source_name(topic)
    known = {kind.type_hash, UNHASHED, *config.type_hashes}
    frame_ids = tuple(dict.fromkeys((config.frame_id, *config.other_frame_ids)))

    def decoded(payload: bytes) -> ObstacleFrame:
        try:
            return to_frame(kind.decode(payload), frame_ids)
        except (ArithmeticError, ValueError) as error:  # no such input is known; a tick must not fail on one
            raise FrameRejected("malformed", f"{kind.name}: {error}") from None

    def received(key: str, payload: bytes, encoding: str) -> None:
        type_hash = key.rpartition("/")[2]
        if type_hash not in known:
            detail = f"{kind.name}: expected a layout of hash {kind.type_hash}, got {type_hash[:80]}"
            inbox.reject(source, FrameRejected("type_hash", detail))
        elif len(payload) > MAX_PAYLOAD_BYTES:
            detail = f"expected at most {MAX_PAYLOAD_BYTES} bytes, got {len(payload)}"
            inbox.reject(source, FrameRejected("too_large", detail))
        else:
            inbox.push_decoded(source, lambda: decoded(payload))

    return received
