"""The conditions that PX4 watches in flight, by its parameters: which fail now, and what each asks for.

Batteries, links, sticks and geofence; the loss of the setpoint stream is what a mode falls back from.
Source: PX4 user guide, "Safety Configuration (Failsafes)".
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

from sim_bridge.messages import Mode, Vec3
from sim_bridge.personality import ParameterTable
from sim_bridge.px4.failsafe import Action, Clear, Reaction, Takeover


class Charge(IntEnum):
    """Of the battery, with the numbers of MAV_BATTERY_CHARGE_STATE."""

    OK = 1
    LOW = 2
    CRITICAL = 3
    EMERGENCY = 4


def charge(share: float, parameters: ParameterTable) -> Charge:
    """What the share left, 0 to 1, means by BAT_LOW_THR, BAT_CRIT_THR and BAT_EMERGEN_THR."""
    if share < parameters["BAT_EMERGEN_THR"]:
        return Charge.EMERGENCY
    if share < parameters["BAT_CRIT_THR"]:
        return Charge.CRITICAL
    return Charge.LOW if share < parameters["BAT_LOW_THR"] else Charge.OK


@dataclass(frozen=True, slots=True)
class Situation:
    """What the conditions are judged by."""

    mode: Mode  # that the pilot asked for
    armed: bool
    airborne: bool
    p_enu: Vec3
    home_enu: Vec3
    charge: Charge
    charge_at_arming: Charge
    station_lost: bool
    sticks_lost: bool
    sticks_lost_at_arming: bool  # armed without any: none are missed
    stream_lost: bool

    @property
    def has_position(self) -> bool:
        return all(map(math.isfinite, self.p_enu))


_FLOWN = {1: Action.HOLD, 2: Action.RETURN, 3: Action.LAND}  # NAV_DLL_ACT, NAV_RCL_ACT
_OFFBOARD_LOST = (
    Action.POSITION,
    Action.ALTITUDE,
    Action.STABILIZED,
    Action.RETURN,
    Action.LAND,
    Action.HOLD,
    Action.TERMINATE,
    Action.DISARM,
)  # by COM_OBL_RC_ACT
_AUTO = (Mode.HOLD, Mode.TAKEOFF, Mode.LAND, Mode.RETURN)
_TERMINATE, _DISARM = 5, 6


def failing(now: Situation, parameters: ParameterTable) -> dict[str, Reaction]:
    """Every condition that fails now, with what it asks for."""
    found: dict[str, Reaction] = {}
    if (
        parameters["COM_RC_IN_MODE"] != 4
        and now.sticks_lost
        and not now.sticks_lost_at_arming
        and not _excepted(now.mode, int(parameters["COM_RCL_EXCEPT"]))
    ):
        found["sticks"] = _link_loss("manual control lost", int(parameters["NAV_RCL_ACT"]))
    if (
        parameters["NAV_DLL_ACT"] != 0
        and now.station_lost
        and now.armed
        and now.mode is not Mode.LAND
        and not _excepted(now.mode, int(parameters["COM_DLL_EXCEPT"]))
    ):
        found["station"] = _link_loss("ground station lost", int(parameters["NAV_DLL_ACT"]))
    if parameters["GF_ACTION"] != 0 and now.airborne and outside_fence(now.p_enu, now.home_enu, parameters):
        found["fence"] = _fence(int(parameters["GF_ACTION"]))
    if now.charge is not Charge.OK:
        worse = now.charge > now.charge_at_arming
        act = int(parameters["COM_LOW_BAT_ACT"]) if worse else 0
        found[f"battery {now.charge.name}"] = _battery(now.charge, act)
    return found


def fallback(now: Situation, parameters: ParameterTable) -> Reaction | None:
    """What the pilot's mode falls back to, None where it can run.

    Offboard without its stream does COM_OBL_RC_ACT; a manual mode among those without sticks does NAV_RCL_ACT.
    """
    if now.mode is Mode.OFFBOARD and now.stream_lost:
        action = _OFFBOARD_LOST[int(parameters["COM_OBL_RC_ACT"])]
        if action in (Action.POSITION, Action.ALTITUDE, Action.STABILIZED) and now.sticks_lost:
            action = _link_loss("", int(parameters["NAV_RCL_ACT"])).action
        if not now.has_position and action < Action.LAND:
            action = Action.LAND
        return Reaction("offboard setpoints lost", action, Takeover.ALWAYS)
    if not now.has_position and now.mode not in (Mode.LAND, Mode.STABILIZED):
        return Reaction("position lost", Action.LAND, Takeover.ALWAYS)
    return None


def outside_fence(p_enu: Vec3, home_enu: Vec3, parameters: ParameterTable) -> bool:
    """Farther from home than GF_MAX_HOR_DIST or higher above it than GF_MAX_VER_DIST, each off at 0."""
    level_m, height_m = float(parameters["GF_MAX_HOR_DIST"]), float(parameters["GF_MAX_VER_DIST"])
    too_far = level_m > 0.0 and math.dist(p_enu[:2], home_enu[:2]) > level_m
    return too_far or (height_m > 0.0 and p_enu[2] - home_enu[2] > height_m)


def _excepted(mode: Mode, bits: int) -> bool:
    if mode in _AUTO:
        return bool(bits & 2)
    return mode is Mode.OFFBOARD and bool(bits & 4)


def _link_loss(cause: str, act: int) -> Reaction:
    if act == _TERMINATE:
        return Reaction(cause, Action.TERMINATE, Takeover.NEVER, Clear.NEVER)
    if act == _DISARM:
        return Reaction(cause, Action.DISARM, Takeover.NEVER)
    return Reaction(cause, _FLOWN[act], clear=Clear.MODE_CHANGE_OR_DISARM)


def _fence(act: int) -> Reaction:
    cause = "geofence breached"
    if act == 1:
        return Reaction(cause, Action.WARN)
    if act == 2:  # the pilot must be able to fly back
        return Reaction(cause, Action.HOLD, Takeover.MODE_SWITCH, Clear.MODE_CHANGE_OR_DISARM)
    if act == 4:
        return Reaction(cause, Action.TERMINATE, Takeover.NEVER, Clear.NEVER)
    return Reaction(cause, Action.RETURN if act == 3 else Action.LAND, clear=Clear.MODE_CHANGE_OR_DISARM)


def _battery(level: Charge, act: int) -> Reaction:
    """COM_LOW_BAT_ACT: 0 warns, 2 lands, 3 returns when critical and lands in an emergency."""
    cause = f"{level.name.lower()} battery"
    if level is Charge.LOW or act == 0:
        return Reaction(cause, Action.WARN)
    if act == 3 and level is Charge.CRITICAL:
        return Reaction(cause, Action.RETURN)
    return Reaction(cause, Action.LAND)
