"""MAV_CMD_DO_REPOSITION: where an operator wants the vehicle, in the local frame."""

from __future__ import annotations

import math

from companion.errors import CompanionError
from companion.link import mav
from companion.link.events import Command
from companion.link.geo import TangentPlane
from companion.types import Vec3, frozen

_GLOBAL = (mav.FRAME_GLOBAL, mav.FRAME_GLOBAL_INT)


class CommandRefused(CompanionError):
    """A command that cannot be followed; ``result`` is the MAV_RESULT to acknowledge it with."""

    def __init__(self, result: int, detail: str) -> None:
        super().__init__(detail)
        self.result = result


class OriginUnknown(CommandRefused):
    """A global target before the autopilot has told its local frame's origin: ask for it, the operator repeats."""


def reposition_target(command: Command, origin: TangentPlane | None = None) -> Vec3:
    """The target of a MAV_CMD_DO_REPOSITION, ENU [m].

    Only the COMMAND_INT form. MAV_FRAME_LOCAL_NED: x (north) and y (east) in 1e-4 m, z (down) in m. MAV_FRAME_GLOBAL
    and GLOBAL_INT: latitude and longitude in 1e-7 degrees, altitude above mean sea level in m, through the
    ``origin`` of the local frame (GPS_GLOBAL_ORIGIN); the local z is the difference of altitudes.

    Raises:
        CommandRefused: with the MAV_RESULT to answer.
    """
    if not command.is_int:
        raise CommandRefused(mav.RESULT_COMMAND_INT_ONLY, "DO_REPOSITION: expected as COMMAND_INT")
    if not math.isfinite(command.z):
        raise CommandRefused(mav.RESULT_DENIED, f"DO_REPOSITION: expected a finite z, got {command.z}")
    if command.frame == mav.FRAME_LOCAL_NED:
        return frozen([command.y * 1e-4, command.x * 1e-4, -command.z])
    if command.frame not in _GLOBAL:
        raise CommandRefused(
            mav.RESULT_COMMAND_UNSUPPORTED_MAV_FRAME,
            f"DO_REPOSITION: expected frame MAV_FRAME_LOCAL_NED (1) or GLOBAL (0, 5), got {command.frame}",
        )
    if origin is None:
        raise OriginUnknown(mav.RESULT_TEMPORARILY_REJECTED, "DO_REPOSITION: expected GPS_GLOBAL_ORIGIN first")
    lat_deg, lon_deg = command.x * 1e-7, command.y * 1e-7
    if not (abs(lat_deg) <= 90.0 and abs(lon_deg) <= 180.0):
        raise CommandRefused(mav.RESULT_DENIED, f"DO_REPOSITION: expected a place, got {lat_deg}, {lon_deg}")
    east, north, _ = origin.enu(lat_deg, lon_deg, command.z).tolist()
    return frozen([east, north, command.z - origin.alt_m])
