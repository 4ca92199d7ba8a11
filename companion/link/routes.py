"""MAVLink routing without input or output: who lives on which link, and where a packet belongs.

Source: MAVLink guide, "Routing", and ArduPilot's MAVLink_routing.cpp: what names nobody goes everywhere, what names
somebody goes where that one was heard, and nothing goes back to where it came from.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from functools import cache

from pymavlink.dialects.v20 import ardupilotmega as dialect

Address = tuple[int, int]  # system, component; 0 stands for all

MAX_ADDRESSES = 256
# RADIO and RADIO_STATUS speak of one link, SETUP_SIGNING carries the key: neither is anybody else's business
LINK_LOCAL = frozenset(
    (dialect.MAVLINK_MSG_ID_RADIO, dialect.MAVLINK_MSG_ID_RADIO_STATUS, dialect.MAVLINK_MSG_ID_SETUP_SIGNING)
)
SETPOINTS = frozenset(
    (
        dialect.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET,
        dialect.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED,
        dialect.MAVLINK_MSG_ID_SET_POSITION_TARGET_GLOBAL_INT,
    )
)
_V2_HEADER = 10  # [bytes]


class Routes:
    """The links on which each address was heard. Knows at most 256 addresses, those heard last.

    >>> routes = Routes(3)
    >>> routes.learn(0, (1, 1))
    >>> routes.learn(2, (255, 190))
    >>> routes.onward(2, (1, 1), vehicle=1), routes.onward(0, (0, 0), vehicle=1), routes.onward(0, (9, 1), vehicle=1)
    ((0,), (1, 2), ())
    """

    def __init__(self, links: int) -> None:
        self._links = links
        self._heard: dict[Address, frozenset[int]] = {}

    def learn(self, link: int, sender: Address) -> None:
        """A message of ``sender`` came on ``link``."""
        heard = self._heard.pop(sender, frozenset())
        self._heard[sender] = heard if link in heard else heard | {link}
        if len(self._heard) > MAX_ADDRESSES:
            del self._heard[next(iter(self._heard))]

    def to(self, target: Address, *, vehicle: int) -> tuple[int, ...]:
        """Links for a packet of our own; none where the target was never heard.

        Only within the system ``vehicle``, our own, do components count: others are reached as a whole.
        """
        system, component = target
        if system == 0:
            return tuple(range(self._links))
        whole = component == 0 or system != vehicle
        found = [links for (s, c), links in self._heard.items() if s == system and (whole or c == component)]
        return tuple(sorted(frozenset().union(*found)))

    def onward(self, came_on: int, target: Address, *, vehicle: int) -> tuple[int, ...]:
        """Links to which a packet that came on one goes on."""
        return tuple(link for link in self.to(target, vehicle=vehicle) if link != came_on)


def target_of(packet: bytes) -> Address:
    """To whom a MAVLink 2 packet speaks, from its bytes; zeros cut off its payload's end count."""
    system_at, component_at = _target_offsets(int.from_bytes(packet[7:10], "little"))
    length = packet[1]

    def field(at: int | None) -> int:
        return packet[_V2_HEADER + at] if at is not None and at < length else 0

    return field(system_at), field(component_at)


@cache
def _target_offsets(message_id: int) -> tuple[int | None, int | None]:
    kind = dialect.mavlink_map.get(message_id)
    if kind is None:
        return None, None
    formats = kind.native_format.decode().lstrip("<")
    return _offset("target_system", kind, formats), _offset("target_component", kind, formats)


def _offset(name: str, kind: type[dialect.MAVLink_message], formats: Iterable[str]) -> int | None:
    at = 0
    for field, code, count in zip(kind.ordered_fieldnames, formats, kind.array_lengths, strict=True):
        if field == name:
            return at
        at += struct.calcsize(f"<{code}") * max(1, count)
    return None
