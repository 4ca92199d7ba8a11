"""The parameter protocol from the asking side: which names matter, and how a value travels.

PX4 declares PARAM_ENCODE_BYTEWISE: an integer's bytes lie in the float field as they are. ArduPilot declares C_CAST:
every number is a float. Source: MAVLink parameter protocol.
"""

from __future__ import annotations

import struct
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.doctor.observation import ARDUPILOT, PX4

NAMES: dict[int, tuple[str, ...]] = {
    PX4: ("COM_OF_LOSS_T", "COM_OBL_RC_ACT", "COM_RCL_EXCEPT", "MPC_THR_HOVER"),
    ARDUPILOT: ("GUID_TIMEOUT", "GUID_OPTIONS", "PSC_JERK_XY", "FS_GCS_ENABLE"),
}
_MAGIC_V2, _HEADER_V2, _HEADER_V1 = 0xFD, 10, 6  # bytes
_INTEGERS = {1: "<B", 2: "<b", 3: "<H", 4: "<h", 5: "<I", 6: "<i"}  # MAV_PARAM_TYPE -> struct


def is_integer(param_type: int) -> bool:
    return param_type in _INTEGERS


def read_value(message: Any, kind: int) -> float | int:
    """The value of a PARAM_VALUE from an autopilot of ``kind`` (MAV_AUTOPILOT)."""
    if not is_integer(message.param_type):
        return float(message.param_value)
    if kind == ARDUPILOT:
        return round(float(message.param_value))
    layout = _INTEGERS[message.param_type]
    # from the packet, value first: as a float they may be a NaN, whose bits a conversion need not keep
    packet = bytes(message.get_msgbuf())
    begin = _HEADER_V2 if packet[0] == _MAGIC_V2 else _HEADER_V1
    return int(struct.unpack_from(layout, packet, begin)[0])


def wire_value(value: float, param_type: int, kind: int) -> float:
    """The float field of a PARAM_SET.

    Raises:
        ValueError: an integer parameter and a value that is none, or out of its range; says what was expected.
    """
    if not is_integer(param_type):
        return value
    if value != round(value):
        raise ValueError(f"expected a whole number, got {value:g}")
    layout = _INTEGERS[param_type]
    try:
        packed = struct.pack(layout, round(value))
    except struct.error:
        raise ValueError(f"expected a value that fits {8 * struct.calcsize(layout)} bits, got {value:g}") from None
    if kind == ARDUPILOT:
        return value
    wire = float(struct.unpack("<f", packed.ljust(4, b"\x00"))[0])
    if struct.pack("<f", wire)[: len(packed)] != packed:  # a NaN whose bits do not survive
        raise ValueError(f"expected a value that the float field can carry, got {value:g}")
    return wire


def request(name: str, system: int, component: int) -> Any:
    """PARAM_REQUEST_READ by name."""
    return dialect.MAVLink_param_request_read_message(system, component, name.encode(), -1)


def setting(name: str, wire: float, param_type: int, system: int, component: int) -> Any:
    """PARAM_SET."""
    return dialect.MAVLink_param_set_message(system, component, name.encode(), wire, param_type)
