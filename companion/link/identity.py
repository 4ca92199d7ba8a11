"""What component 196 says of itself: AUTOPILOT_VERSION and COMPONENT_INFORMATION_BASIC.

Source: MAVLink common.xml. pymavlink's ardupilotmega dialect has no COMPONENT_INFORMATION_BASIC, so its payload is
packed here: fields by size, largest first, as MAVLink 2 orders them; CRC_EXTRA 50 follows from names and types.
"""

from __future__ import annotations

import re
import struct
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

MSG_AUTOPILOT_VERSION, MSG_COMPONENT_INFORMATION_BASIC = 148, 396
CAPABILITIES = (
    dialect.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
    | dialect.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | dialect.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    | dialect.MAV_PROTOCOL_CAPABILITY_MAVLINK2
)
MODEL = "companion"
_BASIC_CRC_EXTRA = 50


def packed_version(version: str) -> int:
    """major.minor.patch as AUTOPILOT_VERSION has it: a byte each, then the type: 255 a release, 0 anything else.

    >>> hex(packed_version("1.2.3")), hex(packed_version("1.2.3.dev4"))
    ('0x10203ff', '0x1020300')
    """
    found = re.match(r"(\d+)\.(\d+)\.(\d+)", version)
    if found is None:
        return 0
    major, minor, patch = (min(int(part), 255) for part in found.groups())
    return major << 24 | minor << 16 | patch << 8 | (0xFF if found.end() == len(version) else 0)


def autopilot_version(version: str) -> Any:
    """AUTOPILOT_VERSION: the name is history, every component may send it. What is not known is 0."""
    none = [0] * 8
    number = packed_version(version)
    return dialect.MAVLink_autopilot_version_message(CAPABILITIES, number, 0, 0, 0, none, none, none, 0, 0, 0, [0] * 18)


def component_information_basic(version: str, *, time_boot_ms: int) -> Any:
    """COMPONENT_INFORMATION_BASIC: capabilities, model and software version."""
    software = version.encode("ascii", "replace")[:23]
    payload = struct.pack(
        "<QII32s32s24s24s32s", CAPABILITIES, time_boot_ms & 0xFFFFFFFF, 0, b"", MODEL.encode(), software, b"", b""
    )
    return _Packed(MSG_COMPONENT_INFORMATION_BASIC, "COMPONENT_INFORMATION_BASIC", _BASIC_CRC_EXTRA, payload)


class _Packed(dialect.MAVLink_message):  # type: ignore[misc]
    """A message that the dialect does not know, packed already; header, checksum and signature are the dialect's."""

    def __init__(self, message_id: int, name: str, extra: int, payload: bytes) -> None:
        super().__init__(message_id, name)
        self._extra = extra
        self._fields = payload

    def pack(self, mav: Any, force_mavlink1: bool = False) -> bytes:
        packet: bytes = self._pack(mav, self._extra, self._fields, force_mavlink1)
        return packet
