"""Which external setpoints the autopilot flies, and why it refuses others."""

from __future__ import annotations

import math

from sim_bridge.messages import LocalSetpoint

FRAME_LOCAL_NED = 1
FORCE_BIT = 0x0200
YAW_IGNORED = 0x0400
YAW_RATE_IGNORED = 0x0800
VELOCITY_IGNORED = 0x0038
MASKS = (0x0C3F, 0x083F, 0x043F, 0x0C07)  # acceleration; with yaw; with yaw rate; with velocity


def refusal(setpoint: LocalSetpoint) -> str:
    """Why a setpoint cannot be flown, or nothing."""
    mask = setpoint.type_mask
    if mask & FORCE_BIT:
        return f"type_mask 0x{mask:04X} FORCE"
    if mask not in MASKS:
        return f"type_mask 0x{mask:04X}"
    if setpoint.frame != FRAME_LOCAL_NED:
        return f"frame {setpoint.frame}"
    used = list(setpoint.a_enu)
    if not mask & VELOCITY_IGNORED:
        used += setpoint.v_enu
    if not mask & YAW_IGNORED:
        used.append(setpoint.yaw_rad)
    if not mask & YAW_RATE_IGNORED:
        used.append(setpoint.yaw_rate_rad_s)
    return "" if all(map(math.isfinite, used)) else "not a finite number"
