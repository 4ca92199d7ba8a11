"""ArduCopter's failsafes: ground station, battery, fence; what happened, and which mode it leads to.

Sources: ArduPilot's events.cpp, AP_BattMonitor, AC_Fence and the Copter parameter list. The texts are ArduPilot's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum, auto

from sim_bridge.ardupilot_parameters import ArduParameters
from sim_bridge.messages import NS_PER_S, Severity, Text, Vec3
from sim_bridge.personality import BatteryReading

PILOT_CONTINUES, LANDING_CONTINUES = 1 << 4, 1 << 3  # FS_OPTIONS


class Action(Enum):
    """What a failsafe asks for."""

    NONE = auto()
    RTL = auto()
    LAND = auto()
    BRAKE = auto()
    DISARM = auto()


# FS_GCS_ENABLE, BATT_FS_*_ACT; there is no SmartRTL and no mission here: RTL in their place, or landing
_GCS = {1: Action.RTL, 2: Action.RTL, 3: Action.RTL, 4: Action.LAND, 5: Action.LAND, 6: Action.RTL, 7: Action.BRAKE}
_BATTERY = {
    1: Action.LAND, 2: Action.RTL, 3: Action.RTL, 4: Action.LAND, 5: Action.DISARM, 6: Action.RTL, 7: Action.BRAKE
}  # fmt: skip
_FENCE = {1: Action.RTL, 2: Action.LAND, 3: Action.RTL, 4: Action.BRAKE}


@dataclass(frozen=True, slots=True)
class Event:
    """A failsafe that has begun, or ended (no action)."""

    text: Text
    action: Action
    station: bool = False  # of the ground station: the pilot's modes may go on


class Failsafes:
    """Latched conditions of one vehicle."""

    def __init__(self, parameters: ArduParameters) -> None:
        self._parameters = parameters
        self._station_ns: int | None = None
        self._station_lost = False
        self._reading: BatteryReading | None = None
        self._low_since_ns: dict[str, int] = {}
        self.battery_level = 0  # 1 low, 2 critical; it does not recover
        self._breached: frozenset[str] = frozenset()

    @property
    def active(self) -> bool:
        return self._station_lost or self.battery_level > 0

    def heard_station(self, t_ns: int) -> None:
        self._station_ns = t_ns

    def read_battery(self, reading: BatteryReading) -> None:
        self._reading = reading

    def step(self, p_enu: Vec3, home_enu: Vec3, t_ns: int) -> list[Event]:
        """What begins or ends now."""
        events = [self._watch_station(t_ns), self._watch_battery(t_ns), self._watch_fence(p_enu, home_enu)]
        return [event for event in events if event is not None]

    def outside(self, p_enu: Vec3, home_enu: Vec3) -> tuple[str, ...]:
        """The fences that ``p_enu`` is beyond."""
        parameters, breached = self._parameters, []
        if parameters["FENCE_ENABLE"]:
            kinds = int(parameters["FENCE_TYPE"])
            if kinds & 1 and p_enu[2] - home_enu[2] > parameters["FENCE_ALT_MAX"]:
                breached.append("Max Alt")
            if kinds & 2 and math.dist(p_enu[:2], home_enu[:2]) > parameters["FENCE_RADIUS"]:
                breached.append("Circle")
        return tuple(breached)

    def battery_reasons(self) -> list[str]:
        """Why the battery forbids arming."""
        parameters, reading = self._parameters, self._reading
        if reading is None:
            return []
        reasons = []
        if reading.share * parameters["BATT_CAPACITY"] < parameters["BATT_ARM_MAH"]:
            reasons.append("Battery 1 below minimum arming capacity")
        for prefix, name in (("BATT_CRT", "critical"), ("BATT_LOW", "low")):
            what = self._beneath(prefix, reading)
            if what:
                reasons.append(f"Battery 1 {name} {what} failsafe")
                break
        return reasons

    def _watch_station(self, t_ns: int) -> Event | None:
        parameters = self._parameters
        if not parameters["FS_GCS_ENABLE"] or self._station_ns is None:
            self._station_lost = False
            return None
        lost = t_ns - self._station_ns > parameters["FS_GCS_TIMEOUT"] * NS_PER_S
        if lost == self._station_lost:
            return None
        self._station_lost = lost
        if not lost:
            return Event(Text(Severity.WARNING, "GCS Failsafe Cleared"), Action.NONE)
        action = _GCS.get(int(parameters["FS_GCS_ENABLE"]), Action.RTL)
        return Event(Text(Severity.WARNING, "GCS Failsafe"), action, station=True)

    def _beneath(self, prefix: str, reading: BatteryReading) -> str:
        """Which limit the battery is at or below: voltage, capacity, or none."""
        parameters = self._parameters
        volt, left_mah = float(parameters[f"{prefix}_VOLT"]), float(parameters[f"{prefix}_MAH"])
        if volt > 0.0 and reading.voltage_v <= volt:
            return "voltage"
        if left_mah > 0.0 and reading.share * parameters["BATT_CAPACITY"] <= left_mah:
            return "capacity"
        return ""

    def _watch_battery(self, t_ns: int) -> Event | None:
        reading, parameters = self._reading, self._parameters
        if reading is None:
            return None
        for level, prefix, name in ((2, "BATT_CRT", "critical"), (1, "BATT_LOW", "low")):
            what = self._beneath(prefix, reading)
            if not what:
                self._low_since_ns.pop(prefix, None)
                continue
            since_ns = self._low_since_ns.setdefault(prefix, t_ns)
            waits_s = float(parameters["BATT_LOW_TIMER"]) if what == "voltage" else 0.0
            if self.battery_level < level and t_ns - since_ns >= waits_s * NS_PER_S:
                self.battery_level = level
                action = _BATTERY.get(int(parameters["BATT_FS_CRT_ACT" if level == 2 else "BATT_FS_LOW_ACT"]))
                used = f"{reading.voltage_v:.2f}V used {reading.consumed_mah:.0f} mAh"
                return Event(Text(Severity.WARNING, f"Battery 1 is {name} {used}"), action or Action.NONE)
        return None

    def _watch_fence(self, p_enu: Vec3, home_enu: Vec3) -> Event | None:
        outside = frozenset(self.outside(p_enu, home_enu))
        new, self._breached = outside - self._breached, outside
        if not new:
            return None
        names = " and ".join(sorted(new, reverse=True))
        action = _FENCE.get(int(self._parameters["FENCE_ACTION"]), Action.NONE)
        return Event(Text(Severity.WARNING, f"{names} fence breached"), action)
