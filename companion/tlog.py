"""MAVLink telemetry logs: what QGroundControl, Mission Planner and mavlogdump write and read.

For each packet, eight bytes of big-endian unix time in microseconds, then the packet as it was on the wire. Source:
MAVLink guide, "Telemetry logs", and pymavlink's ``mavutil.mavlogfile``.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

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


def read_tlog(path: Path) -> Iterator[tuple[int, bytes]]:
    """Unix time [us] and packet of each entry of a file; stops at an entry that was cut short or is none."""
    data = path.read_bytes()
    at = 0
    while (start := at + _STAMP.size) + 3 <= len(data):
        end = start + _packet_length(data, start)
        if end == start or end > len(data):
            return
        yield _STAMP.unpack_from(data, at)[0], data[start:end]
        at = end


def _packet_length(data: bytes, at: int) -> int:
    """From its header; 0 where there is no packet."""
    if data[at] == 0xFE:
        return data[at + 1] + 8
    if data[at] == 0xFD:
        return data[at + 1] + 12 + (13 if data[at + 2] & 1 else 0)
    return 0
