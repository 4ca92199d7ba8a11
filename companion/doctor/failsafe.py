"""What the autopilot does when the setpoints stop, from its own parameters, and whether that is wise.

Sources: PX4 parameter reference (COM_OF_LOSS_T, COM_OBL_RC_ACT, COM_RCL_EXCEPT, MPC_THR_HOVER); ArduPilot Copter
parameter list (GUID_TIMEOUT, GUID_OPTIONS, PSC_JERK_XY, FS_GCS_ENABLE), and how both act, as measured.
"""

from __future__ import annotations

from collections.abc import Iterator

from companion.config import Config
from companion.doctor.observation import ARDUPILOT, PX4, Autopilot
from companion.doctor.verdict import Check, Level, grade, skip

LONGEST_LOSS_S = 1.0  # without setpoints and without an answer of the autopilot
LONGEST_COAST_S = 1.0  # of ArduPilot on the last acceleration
JERK_M_S3 = 5.0  # ArduPilot's default, under which its response was measured
SLEW_SHARE = 1.25  # setpoints may change faster than the jerk limit by this much: what follows late stays small
G_M_S2 = 9.81

OBL_ACTIONS = {
    0: "goes to Position mode: the sticks fly it",
    1: "goes to Altitude mode: the sticks fly it, and it drifts",
    2: "goes to Stabilized mode: the sticks fly it, throttle included",
    3: "returns home, blind to obstacles",
    4: "lands where it is",
    5: "holds its position",
    6: "terminates the flight: the motors stop",
    7: "disarms: the motors stop",
}
_OBL_WISE, _OBL_DEADLY = (4, 5), (6, 7)
_RCL_OFFBOARD = 0b100  # of COM_RCL_EXCEPT: mission, hold, offboard
_GUIDED_BITS = {4: "position not stabilised", 5: "velocity not stabilised", 7: "weathervaning turns the nose"}
_GCS_ACTIONS = {
    1: "returns home",
    2: "returns home, or goes on with a mission",
    3: "returns home by its own path",
    4: "returns by its own path, or lands",
    5: "lands",
    6: "goes to the landing sequence, or returns home",
    7: "brakes, or lands",
}


def if_it_dies(autopilot: Autopilot, config: Config) -> str:
    """In plain words: what happens if the daemon dies now."""
    values = autopilot.parameters
    if autopilot.kind == PX4:
        loss_s, action = values.get("COM_OF_LOSS_T"), values.get("COM_OBL_RC_ACT")
        if loss_s is None or action is None:
            return "unknown: COM_OF_LOSS_T or COM_OBL_RC_ACT was not told"
        then = OBL_ACTIONS.get(int(action), f"does COM_OBL_RC_ACT {action}, which is not known here")
        return f"after {loss_s:g} s without setpoints the autopilot {then} (COM_OBL_RC_ACT {action})"
    if autopilot.kind == ARDUPILOT:
        coast_s = values.get("GUID_TIMEOUT")
        if coast_s is None:
            return "unknown: GUID_TIMEOUT was not told"
        gained, flown = _coast(coast_s, config)
        return (
            f"the last acceleration goes on for {coast_s:g} s (GUID_TIMEOUT), then it brakes: from"
            f" {config.limits.acceleration_m_s2:g} m/s^2 it gains up to {gained:.1f} m/s and flies {flown:.0f} m"
            " beyond its path"
        )
    return f"unknown: autopilot kind {autopilot.kind} is neither PX4 nor ArduPilot"


def failsafe_checks(autopilot: Autopilot, config: Config) -> Iterator[Check]:
    """A check a parameter; one that did not answer is skipped, the two that tell a death are then failures."""
    if autopilot.kind not in _CHECKS:
        yield skip("failsafe", f"autopilot kind {autopilot.kind}: no parameters of it are known here")
        return
    for name, check in _CHECKS[autopilot.kind].items():
        value = autopilot.parameters.get(name)
        if value is not None:
            yield check(value, config)
        elif name in _TELLING:
            yield Check(Level.FAIL, name, "no answer", "to be told: it decides what happens if the daemon dies")
        else:
            yield skip(name, "no answer: the autopilot may not have it")


def _offboard_loss(value: float, config: Config) -> Check:
    least_s = 4.0 / config.rate_hz  # a few late setpoints are no loss
    return grade(
        "COM_OF_LOSS_T",
        f"{value:g} s until lost setpoints are answered",
        f"{least_s:g} .. {LONGEST_LOSS_S:g} s",
        warn=not least_s <= value <= LONGEST_LOSS_S,
    )


def _offboard_action(value: float, config: Config) -> Check:
    known = OBL_ACTIONS.get(int(value), "does something that is not known here")
    return grade(
        "COM_OBL_RC_ACT",
        f"{value:g}: on lost setpoints it {known}",
        "4 (land) or 5 (hold)",
        fail=int(value) in _OBL_DEADLY,
        warn=int(value) not in _OBL_WISE,
    )


def _rc_exceptions(value: float, config: Config) -> Check:
    ignored = bool(int(value) & _RCL_OFFBOARD)
    return grade(
        "COM_RCL_EXCEPT",
        f"{value:g}: a lost remote control is {'ignored' if ignored else 'answered'} in Offboard",
        "bit 2 clear, unless it flies without a remote control on purpose",
        warn=ignored,
    )


def _hover_thrust(value: float, config: Config) -> Check:
    upward = config.limits.acceleration_m_s2
    needed = value * (1.0 + upward / G_M_S2)
    return grade(
        "MPC_THR_HOVER",
        f"{value:.2f} of full thrust hovers, {needed:.2f} climbs at {upward:g} m/s^2",
        "at most 1 for limits.acceleration_m_s2; measured in a hover, because an error is a vertical drift",
        fail=not 0.0 < value < 1.0,
        warn=needed > 1.0,
    )


def _guided_timeout(value: float, config: Config) -> Check:
    gained, flown = _coast(value, config)
    least_s = 4.0 / config.rate_hz
    return grade(
        "GUID_TIMEOUT",
        f"{value:g} s on the last acceleration: up to {gained:.1f} m/s faster, {flown:.0f} m farther",
        f"{least_s:g} .. {LONGEST_COAST_S:g} s",
        warn=not least_s <= value <= LONGEST_COAST_S,
    )


def _guided_options(value: float, config: Config) -> Check:
    set_bits = [text for bit, text in _GUIDED_BITS.items() if int(value) >> bit & 1]
    return grade(
        "GUID_OPTIONS",
        f"{value:g}: {', '.join(set_bits) or 'position and velocity stabilised, heading kept'}",
        "bits 4, 5 and 7 clear",
        warn=bool(set_bits),
    )


def _jerk(value: float, config: Config) -> Check:
    slew = config.limits.slew_m_s3
    least = max(JERK_M_S3, (slew or 0.0) / SLEW_SHARE)
    within = "" if slew is None else f", setpoints change by up to {slew:g} m/s^3"
    return grade(
        "PSC_JERK_XY",
        f"{value:g} m/s^3{within}: {config.limits.acceleration_m_s2 / value if value > 0 else 0:.1f} s to full"
        " acceleration",
        f"at least {least:g} m/s^3, for which the profile's delay stands",
        warn=value < least,
    )


def _gcs_failsafe(value: float, config: Config) -> Check:
    action = _GCS_ACTIONS.get(int(value))
    return grade(
        "FS_GCS_ENABLE",
        f"{value:g}: a lost ground station is {'not answered' if action is None else f'answered, it {action}'}",
        "above 0; it watches the ground station, never this daemon",
        warn=action is None,
    )


def _coast(seconds: float, config: Config) -> tuple[float, float]:
    """Speed gained [m/s] and way gained [m] under the greatest acceleration of an axis: a t and a t^2 / 2."""
    a = config.limits.acceleration_m_s2
    return a * seconds, 0.5 * a * seconds**2


_TELLING = {"COM_OF_LOSS_T", "COM_OBL_RC_ACT", "GUID_TIMEOUT"}
_CHECKS = {
    PX4: {
        "COM_OF_LOSS_T": _offboard_loss,
        "COM_OBL_RC_ACT": _offboard_action,
        "COM_RCL_EXCEPT": _rc_exceptions,
        "MPC_THR_HOVER": _hover_thrust,
    },
    ARDUPILOT: {
        "GUID_TIMEOUT": _guided_timeout,
        "GUID_OPTIONS": _guided_options,
        "PSC_JERK_XY": _jerk,
        "FS_GCS_ENABLE": _gcs_failsafe,
    },
}
