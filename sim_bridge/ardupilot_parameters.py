"""ArduCopter's parameters that exist here, under its names, types and units; each acts for real.

Every number travels as a plain float, integers too (MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST), and a value is taken
as it comes: rounded to the parameter's type, its range not checked. Only what is not finite is refused.
Source: ArduPilot's Copter parameter list (4.6), its defaults but for those marked.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

INT8, INT16, INT32, REAL32 = 2, 4, 6, 9  # MAV_PARAM_TYPE
_SPANS = {INT8: 1 << 7, INT16: 1 << 15, INT32: 1 << 31}


@dataclass(frozen=True, slots=True)
class Definition:
    default: float | int
    kind: int  # MAV_PARAM_TYPE


DEFINITIONS: dict[str, Definition] = {
    "ANGLE_MAX": Definition(3000, INT16),  # lean angle [0.01 deg]
    "ARMING_CHECK": Definition(1, INT32),  # 0: the battery is not looked at before arming
    "BATT_ARM_MAH": Definition(0, INT32),  # least that is left for arming [mAh]
    "BATT_CAPACITY": Definition(250, INT32),  # [mAh]; the Crazyflie's, ArduPilot's default is 3300
    "BATT_CRT_MAH": Definition(0.0, REAL32),  # critical when no more is left [mAh], 0: never
    "BATT_CRT_VOLT": Definition(0.0, REAL32),  # or when the voltage is no more [V], 0: never
    "BATT_FS_CRT_ACT": Definition(0, INT8),  # 0 nothing, 1 land, 2 RTL, 3 and 6 RTL, 4 land, 5 motors off, 7 brake
    "BATT_FS_LOW_ACT": Definition(0, INT8),
    "BATT_LOW_MAH": Definition(0.0, REAL32),
    "BATT_LOW_TIMER": Definition(10, INT8),  # voltage low for this long [s]
    "BATT_LOW_VOLT": Definition(0.0, REAL32),  # ArduPilot's default is 10.5 V, three cells
    "DISARM_DELAY": Definition(10, INT8),  # armed on the ground for this long [s], 0: never
    "FENCE_ACTION": Definition(1, INT8),  # 0 report, 1 RTL or land, 2 land, 3 RTL, 4 brake or land
    "FENCE_ALT_MAX": Definition(100.0, REAL32),  # above home [m]
    "FENCE_ENABLE": Definition(0, INT8),
    "FENCE_RADIUS": Definition(300.0, REAL32),  # about home [m]
    "FENCE_TYPE": Definition(7, INT8),  # bit 0 altitude, bit 1 circle
    "FS_GCS_ENABLE": Definition(0, INT8),  # 0 no, 1 and 2 RTL, 3 RTL, 4 land, 5 land, 6 RTL, 7 brake or land
    "FS_GCS_TIMEOUT": Definition(5.0, REAL32),  # [s]
    "FS_OPTIONS": Definition(16, INT32),  # bit 3: a landing goes on; bit 4: the pilot's modes go on at GCS loss
    "GUID_OPTIONS": Definition(0, INT32),  # bit 4, 5: position, velocity not stabilised under accelerations
    "GUID_TIMEOUT": Definition(3.0, REAL32),  # [s]
    "LAND_SPEED": Definition(50, INT16),  # below 10 m [cm/s]
    "LOIT_SPEED": Definition(1250.0, REAL32),  # of full stick in LOITER [cm/s]
    "PILOT_SPEED_UP": Definition(250, INT16),  # of full throttle [cm/s]
    "PILOT_TKOFF_ALT": Definition(0.0, REAL32),  # of a takeoff by the throttle stick [cm]
    "PSC_JERK_XY": Definition(5.0, REAL32),  # [m/s^3]
    "PSC_JERK_Z": Definition(5.0, REAL32),
    "RTL_ALT": Definition(1500.0, REAL32),  # above home [cm]
    "RTL_CLIMB_MIN": Definition(0, INT16),  # [cm]
    "RTL_CONE_SLOPE": Definition(3.0, REAL32),  # near home RTL climbs to slope times distance only
    "RTL_LOIT_TIME": Definition(5000, INT32),  # over home before landing [ms]
    "SIM_EKF_READY": Definition(2.0, REAL32),  # from boot to a position [s]; ours: the real one takes about 40 s
    "SYSID_MYGCS": Definition(255, INT16),  # system id of the ground station that is watched and whose sticks count
    "SYSID_THISMAV": Definition(1, INT16),  # constant: the scenario's
    "WPNAV_ACCEL": Definition(250.0, REAL32),  # [cm/s^2]
    "WPNAV_ACCEL_Z": Definition(100.0, REAL32),
    "WPNAV_SPEED": Definition(1000.0, REAL32),  # [cm/s]
    "WPNAV_SPEED_DN": Definition(150.0, REAL32),
    "WPNAV_SPEED_UP": Definition(250.0, REAL32),
}

_CONSTANT = ("SYSID_THISMAV",)


class ArduParameters:
    """Current values by name."""

    names = tuple(sorted(DEFINITIONS))

    def __init__(self, system_id: int = 1) -> None:
        self._values: dict[str, float | int] = {name: DEFINITIONS[name].default for name in self.names}
        self._values["SYSID_THISMAV"] = system_id

    def __getitem__(self, name: str) -> float | int:
        return self._values[name]

    def is_int(self, name: str) -> bool:
        return DEFINITIONS[name].kind != REAL32

    def cast_to(self, name: str) -> int:
        """MAV_PARAM_TYPE; the value travels as a plain float."""
        return DEFINITIONS[name].kind

    def write(self, name: str, value: float | int, *, is_int: bool) -> bool:
        """Set a known parameter, whatever type the sender declared; False for what is not finite."""
        if not math.isfinite(value) or name in _CONSTANT:
            return False
        kind = DEFINITIONS[name].kind
        if kind == REAL32:
            self._values[name] = float(value)
        else:
            span = _SPANS[kind]
            self._values[name] = min(max(round(value), -span), span - 1)
        return True

    def checksum(self) -> None:
        """None: ArduPilot has no _HASH_CHECK, it is an unknown name."""

    def metres(self, name: str) -> float:
        """A value in centimetres (or cm/s, cm/s^2), as metres."""
        return float(self._values[name]) * 0.01

    def positive(self, name: str) -> float:
        """The value, or the default where it is not above zero."""
        value = float(self._values[name])
        return value if value > 0.0 else float(DEFINITIONS[name].default)
