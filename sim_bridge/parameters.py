"""The parameters that exist here, under PX4's names; each acts for real, or is a constant of this vehicle.

Integers travel bytewise in the float field of PARAM_VALUE (MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE).
"""

from __future__ import annotations

import math
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

DEFINITIONS: dict[str, Definition] = {
    "COM_DISARM_LAND": Definition(2.0, 0.0, 20.0),  # landed to disarmed [s]
    "COM_DISARM_PRFLT": Definition(10.0, 0.0, 60.0),  # armed without taking off to disarmed [s], 0: never
    "COM_OBL_RC_ACT": Definition(5, 0, 7, choices=(4, 5)),  # setpoint stream lost: Land 4 or Hold 5
    "COM_OF_LOSS_T": Definition(1.0, 0.1, 60.0),  # setpoint stream lost after [s]
    "COM_RCL_EXCEPT": Definition(7, 7, 7),  # constant: there is no remote control to lose, in any mode
    "MIS_TAKEOFF_ALT": Definition(1.5, 0.5, 80.0),  # above home [m]
    "MPC_LAND_SPEED": Definition(0.5, 0.1, 2.0),  # [m/s]
    "MPC_THR_HOVER": Definition(_HOVER_THRUST, _HOVER_THRUST, _HOVER_THRUST),  # constant: share of full thrust
    "MPC_TKO_SPEED": Definition(1.0, 0.3, 3.0),  # [m/s]
    "MPC_XY_VEL_P_ACC": Definition(1.8, 0.5, 5.0),  # velocity error to acceleration [1/s]
}
NAMES = tuple(sorted(DEFINITIONS))


class Parameters:
    """Current values by name."""

    def __init__(self) -> None:
        self._values: dict[str, float | int] = {name: DEFINITIONS[name].default for name in NAMES}

    @property
    def names(self) -> tuple[str, ...]:
        """In the order of their index on the wire."""
        return NAMES

    def __getitem__(self, name: str) -> float | int:
        return self._values[name]

    def is_int(self, name: str) -> bool:
        return isinstance(DEFINITIONS[name].default, int)

    def cast_to(self, name: str) -> int | None:
        """None: values travel bytewise."""
        return None

    def write(self, name: str, value: float | int, *, is_int: bool) -> bool:
        """Set a known parameter; False (and unchanged) for a wrong type or a value out of range."""
        definition = DEFINITIONS[name]
        if is_int != isinstance(definition.default, int):
            return False
        if not math.isfinite(value) or not definition.low <= value <= definition.high:
            return False
        if definition.choices and value not in definition.choices:
            return False
        self._values[name] = value
        return True
