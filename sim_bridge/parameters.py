"""The parameters that exist here, under PX4's names; each acts for real, or is a constant of this vehicle.

Type, default and range are those of PX4 1.15 for a multicopter. Where this vehicle's differ, as an airframe file's may,
the line says so. Integers travel bytewise in the float field of PARAM_VALUE
(MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE).
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass

from sim_bridge.crazyflie import Crazyflie


@dataclass(frozen=True, slots=True)
class Definition:
    """A parameter's default and range; ``choices`` where only some values act."""

    default: float | int
    low: float
    high: float
    choices: tuple[int, ...] = ()


_HOVER_THRUST = 1.0 / Crazyflie().thrust_to_weight
_LINK_LOSS = (0, 1, 2, 3, 5, 6)  # disabled, Hold, Return, Land, terminate, disarm

DEFINITIONS: dict[str, Definition] = {
    # battery, share of the charge left
    "BAT_CRIT_THR": Definition(0.07, 0.05, 0.5),
    "BAT_EMERGEN_THR": Definition(0.05, 0.03, 0.5),
    "BAT_LOW_THR": Definition(0.15, 0.12, 0.5),
    # commander
    "COM_DISARM_LAND": Definition(2.0, 0.0, 20.0),  # landed to disarmed [s], 0: never
    "COM_DISARM_PRFLT": Definition(10.0, 0.0, 60.0),  # armed without taking off to disarmed [s], 0: never
    "COM_DLL_EXCEPT": Definition(0, 0, 7),  # modes that ignore the loss of the ground station: bit 1 Hold, 2 Offboard
    "COM_DL_LOSS_T": Definition(10, 5, 300),  # ground station lost after [s]
    "COM_FAIL_ACT_T": Definition(5.0, 0.0, 25.0),  # hold this long before a failsafe acts [s]
    "COM_HOME_EN": Definition(1, 0, 1),  # home is set at arming, and by command
    "COM_LOW_BAT_ACT": Definition(0, 0, 3, choices=(0, 2, 3)),  # warn; land; return at critical, land at emergency
    "COM_OBL_RC_ACT": Definition(5, 0, 7),  # setpoint stream lost; PX4's default is 0, Position
    "COM_OF_LOSS_T": Definition(1.0, 0.1, 60.0),  # setpoint stream lost after [s]; PX4's least is 0
    "COM_RCL_EXCEPT": Definition(7, 0, 7),  # modes that ignore the loss of the sticks; PX4's default is 0
    "COM_RC_IN_MODE": Definition(3, 0, 4),  # sticks from: 0 radio, 1 MANUAL_CONTROL, 2 and 3 either, 4 nowhere
    "COM_RC_LOSS_T": Definition(0.5, 0.0, 35.0),  # sticks lost after [s]
    "COM_RC_OVERRIDE": Definition(1, 0, 7),  # moved sticks take over: bit 0 from auto, 1 offboard, 2 not by throttle
    "COM_RC_STICK_OV": Definition(30.0, 5.0, 80.0),  # moved by more than [%]
    "FD_FAIL_P": Definition(60, 60, 180),  # tilt with which arming is denied [deg]
    "FD_FAIL_R": Definition(60, 60, 180),
    # geofence
    "GF_ACTION": Definition(2, 0, 5),  # none, warn, Hold, Return, terminate, Land
    "GF_MAX_HOR_DIST": Definition(0.0, 0.0, 10000.0),  # from home [m], 0: off
    "GF_MAX_VER_DIST": Definition(0.0, 0.0, 10000.0),
    # missions and returning
    "MIS_TAKEOFF_ALT": Definition(1.5, 0.5, 80.0),  # above home [m]; PX4's default is 2.5
    # position control
    "MPC_ACC_HOR": Definition(3.0, 2.0, 15.0),  # [m/s^2]
    "MPC_HOLD_DZ": Definition(0.1, 0.0, 1.0),  # dead zone of the sticks
    "MPC_LAND_SPEED": Definition(0.5, 0.1, 2.0),  # [m/s]; PX4's default is 0.7
    "MPC_MAN_TILT_MAX": Definition(35.0, 1.0, 70.0),  # full stick in Altitude and Stabilized [deg]
    "MPC_MAN_Y_MAX": Definition(150.0, 0.0, 400.0),  # full yaw stick [deg/s]
    "MPC_THR_HOVER": Definition(_HOVER_THRUST, _HOVER_THRUST, _HOVER_THRUST),  # constant: share of full thrust
    "MPC_TILTMAX_AIR": Definition(45.0, 20.0, 89.0),  # [deg]
    "MPC_TKO_SPEED": Definition(1.0, 0.3, 5.0),  # [m/s]; PX4's default is 1.5
    "MPC_VEL_MANUAL": Definition(10.0, 3.0, 20.0),  # full stick in Position [m/s]
    "MPC_XY_CRUISE": Definition(5.0, 3.0, 20.0),  # goto and Return [m/s]
    "MPC_XY_P": Definition(0.95, 0.0, 2.0),  # position error to velocity [1/s]
    "MPC_XY_VEL_I_ACC": Definition(0.4, 0.0, 60.0),  # integral of the velocity error to acceleration [1/s^2]
    "MPC_XY_VEL_MAX": Definition(12.0, 0.0, 20.0),  # [m/s]
    "MPC_XY_VEL_P_ACC": Definition(1.8, 1.2, 5.0),  # velocity error to acceleration [1/s]
    "MPC_Z_P": Definition(1.0, 0.1, 1.5),
    "MPC_Z_VEL_I_ACC": Definition(2.0, 0.2, 3.0),
    "MPC_Z_VEL_MAX_DN": Definition(1.5, 0.5, 4.0),
    "MPC_Z_VEL_MAX_UP": Definition(3.0, 0.5, 8.0),
    "MPC_Z_VEL_P_ACC": Definition(4.0, 2.0, 15.0),
    "MPC_Z_V_AUTO_DN": Definition(1.5, 0.5, 4.0),  # goto and Return [m/s]
    "MPC_Z_V_AUTO_UP": Definition(3.0, 0.5, 8.0),
    # link losses
    "NAV_ACC_RAD": Definition(2.0, 0.05, 200.0),  # [m]; 2 on every multicopter
    "NAV_DLL_ACT": Definition(0, 0, 6, choices=_LINK_LOSS),  # ground station lost
    "NAV_RCL_ACT": Definition(2, 1, 6, choices=_LINK_LOSS[1:]),  # sticks lost
    "RTL_CONE_ANG": Definition(45, 0, 90, choices=(0, 25, 45, 65, 80, 90)),  # [deg]
    "RTL_DESCEND_ALT": Definition(10.0, 0.0, 10000.0),  # above home [m]; 10 on every multicopter
    "RTL_LAND_DELAY": Definition(0.0, -1.0, 10000.0),  # hover above home before landing [s], -1: for ever
    "RTL_MIN_DIST": Definition(10.0, 0.5, 10000.0),  # nearer than this RTL_CONE_ANG limits the climb [m]
    "RTL_RETURN_ALT": Definition(30.0, 0.0, 10000.0),  # above home [m]; 30 on every multicopter
}


class Parameters:
    """Current values by name; ``constants`` are values of this one vehicle that nobody can change."""

    def __init__(self, constants: Mapping[str, float | int] | None = None) -> None:
        self._definitions = dict(DEFINITIONS)
        for name, value in (constants or {}).items():
            self._definitions[name] = Definition(value, value, value)
        self._names = tuple(sorted(self._definitions))
        self._values: dict[str, float | int] = {name: self._definitions[name].default for name in self._names}

    @property
    def names(self) -> tuple[str, ...]:
        """In the order of their index on the wire."""
        return self._names

    def __getitem__(self, name: str) -> float | int:
        return self._values[name]

    def is_int(self, name: str) -> bool:
        return isinstance(self._definitions[name].default, int)

    def cast_to(self, name: str) -> int | None:
        """None: values travel bytewise."""
        return None

    def write(self, name: str, value: float | int, *, is_int: bool) -> bool:
        """Set a known parameter; False (and unchanged) for a wrong type or a value out of range."""
        definition = self._definitions[name]
        if is_int != isinstance(definition.default, int) or (is_int and not isinstance(value, int)):
            return False
        if not math.isfinite(value) or not definition.low <= value <= definition.high:
            return False
        if definition.choices and value not in definition.choices:
            return False
        self._values[name] = value
        return True

    def checksum(self) -> int:
        """PX4's ``_HASH_CHECK``: CRC-32 without inversions over each name and its value's four bytes, in order."""
        crc = 0
        for name in self._names:
            value = self._values[name]
            raw = name.encode() + (struct.pack("<i", value) if isinstance(value, int) else struct.pack("<f", value))
            crc = zlib.crc32(raw, crc ^ 0xFFFFFFFF) ^ 0xFFFFFFFF
        return crc
