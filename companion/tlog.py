"""MAVLink telemetry logs: what QGroundControl, Mission Planner and mavlogdump write and read.

For each packet, eight bytes of big-endian unix time in microseconds, then the packet as it was on the wire. Source:
MAVLink guide, "Telemetry logs", and pymavlink's ``mavutil.mavlogfile``.
"""

from __future__ import annotations

import struct

SETUP_SIGNING = 256  # carries the secret key of the link: what holds it must not lie about in a log

_STAMP = struct.Struct(">Q")


def entry(unix_us: int, packet: bytes) -> bytes:
    """One packet with its time.

    >>> entry(1, b"x").hex()
    '000000000000000178'
    """
    return _STAMP.pack(unix_us) + packet


def is_secret(packet: bytes) -> bool:
    """Whether a packet must not be logged: SETUP_SIGNING, of either protocol version."""
    if packet[:1] == b"\xfd":
        return int.from_bytes(packet[7:10], "little") == SETUP_SIGNING
    return False  # its id does not fit into a packet of version 1
