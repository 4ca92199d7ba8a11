"""Which vehicle state a companion must answer: the newest that has really reached it.

The wire contract in numbers: a state needs a heartbeat and an attitude before it; one whose stamp does not go on from
the newest is ignored, unless it lies more than one second back: that is a reboot, after which the attitude is needed
anew and the companion's queues and markers are empty.
"""

from __future__ import annotations

from collections.abc import Iterable

from sim_bridge.impairments import Passage, message_id, payload
from sim_bridge.mavlink import COMPONENT
from sim_bridge.messages import NS_PER_S

HEARTBEAT, ATTITUDE_QUATERNION, LOCAL_POSITION_NED = 0, 31, 32
REBOOT_NS = NS_PER_S


class Delivery:
    """What one companion has received, datagram by datagram."""

    def __init__(self) -> None:
        self.rebooted = False  # by the last datagram: the vehicle's clock began anew
        self._known = False
        self._attitude = False
        self._newest_ns: int | None = None

    def heard(self) -> None:
        """A heartbeat has reached it."""
        self._known = True

    def datagram(self, passages: Iterable[Passage[bytes]]) -> int | None:
        """The stamp [ns] of the state that these messages, sent together, make it answer; None: none."""
        self.rebooted = False
        owed: int | None = None
        for passage in passages:
            if not passage.intact:
                continue
            kind = message_id(passage.item)
            self._known = self._known or (kind == HEARTBEAT and passage.item[6] == COMPONENT)
            self._attitude = self._attitude or (kind == ATTITUDE_QUATERNION and self._known)
            if kind == LOCAL_POSITION_NED and self._known and self._attitude:
                owed = self._state(passage.item, owed)
        return owed

    def _state(self, message: bytes, owed: int | None) -> int | None:
        stamp_ns = int.from_bytes(payload(message)[:4].ljust(4, b"\0"), "little") * 1_000_000
        newest_ns = self._newest_ns
        if newest_ns is not None and stamp_ns < newest_ns - REBOOT_NS:
            self.rebooted, self._attitude = True, False
        elif newest_ns is not None and stamp_ns <= newest_ns:
            return owed
        self._newest_ns = stamp_ns
        return stamp_ns
