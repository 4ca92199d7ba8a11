"""The two ROS 2 messages that carry obstacles: names, layout, type hash, and CDR bytes to message objects.

The layouts are the texts in ``ros2_msgs``; rosbags (extra ``ros2``) reads CDR by them and hashes them as ROS 2 does
(RIHS01, REP 2011). It is imported when the door is configured, never before.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from typing import Any

from companion.errors import ConfigError, FrameRejected

DETECTIONS = "vision_msgs/msg/Detection3DArray"
TRACKED_OBJECTS = "autoware_perception_msgs/msg/TrackedObjects"
MAX_SEQUENCE = 1024  # of any sequence in a message: the wire contract's bound of obstacles a frame
UNHASHED = "TypeHashNotSupported"  # what rmw_zenoh of ROS 2 Humble puts in the place of a hash


@dataclass(frozen=True, slots=True)
class MessageType:
    """One message as this door knows it. ``type_hash``: RIHS01 of the layout that ``decode`` reads."""

    name: str
    type_hash: str
    decode: Callable[[bytes], Any]

    @property
    def dds_name(self) -> str:
        """The name in keys: ``pkg::msg::dds_::Type_``."""
        package, _, kind = self.name.partition("/msg/")
        return f"{package}::msg::dds_::{kind}_"


def load_type(name: str) -> MessageType:
    """The message type ``name``, DETECTIONS or TRACKED_OBJECTS.

    ``decode`` takes CDR with its encapsulation header (plain CDR, little or big endian) and raises FrameRejected,
    reason ``malformed``, for whatever is not exactly one message of this layout.

    Raises:
        ConfigError: rosbags is not installed.
    """
    try:
        from rosbags.serde import SerdeError
        from rosbags.typesys import get_types_from_msg
        from rosbags.typesys.store import Typestore
    except ImportError:
        raise ConfigError("ros2: expected rosbags, install companion-safety[ros2]") from None
    store = Typestore(max_sequence_length=MAX_SEQUENCE)
    text = resources.files("companion.link").joinpath("ros2_msgs", f"{name.rpartition('/')[2]}.msg").read_text("utf-8")
    store.register(get_types_from_msg(text, name))
    store.get_msgdef(name)  # generates the reader now, not at the first message

    def decode(payload: bytes) -> Any:
        try:
            return store.deserialize_cdr(payload, name)
        except (SerdeError, struct.error, ValueError, IndexError, OverflowError) as error:
            raise FrameRejected("malformed", f"expected CDR of {name}: {error}") from None

    return MessageType(name, store.hash_rihs01(name), decode)
