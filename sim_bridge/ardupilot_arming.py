"""Why ArduCopter cannot be armed now; the words are its own."""

from __future__ import annotations

from sim_bridge.ardupilot_copter import PILOTED, Copter
from sim_bridge.ardupilot_failsafe import Failsafes
from sim_bridge.ardupilot_parameters import ArduParameters
from sim_bridge.ardupilot_plans import ArduMode

_ARMABLE = (*PILOTED, ArduMode.GUIDED)


def arming_reasons(
    copter: Copter, failsafes: Failsafes, parameters: ArduParameters, *, position_valid: bool
) -> list[str]:
    """In the order in which ArduCopter looks; ``PreArm`` is what it looks at all the time, ``Arm`` on the command.

    STABILIZE and ALT_HOLD need no position, unless there is a fence. ARMING_CHECK 0 leaves out the battery alone.
    """
    reasons = []
    if parameters["ARMING_CHECK"]:
        reasons += [f"PreArm: {reason}" for reason in failsafes.battery_reasons()]
    needs_position = copter.mode in (ArduMode.LOITER, ArduMode.GUIDED) or bool(parameters["FENCE_ENABLE"])
    if needs_position and not position_valid:
        reasons.append("PreArm: Need Position Estimate")
    outside = failsafes.outside(copter.state.p_enu, copter.home_enu)
    reasons += [f"PreArm: Vehicle breaching {name} fence" for name in outside]
    if copter.mode not in _ARMABLE:
        reasons.append(f"Arm: {copter.mode.name} mode not armable")
    return reasons
