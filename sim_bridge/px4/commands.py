"""MAV_CMDs to the commander: their parameters read, their results and the reasons of a refusal told, as PX4 does."""

from __future__ import annotations

import math
from collections.abc import Callable

from sim_bridge.geodesy import enu_of
from sim_bridge.messages import (
    FORCE,
    HOME_ALTITUDE_AMSL_M,
    Ack,
    Cmd,
    Command,
    Mode,
    Reply,
    Result,
    Severity,
    Text,
    Vec3,
)
from sim_bridge.physics import BodyState
from sim_bridge.px4.commander import Commander
from sim_bridge.px4.conditions import outside_fence
from sim_bridge.px4.navigation import Navigator

_REQUESTABLE = (
    Mode.ALTITUDE,
    Mode.POSITION,
    Mode.TAKEOFF,
    Mode.HOLD,
    Mode.RETURN,
    Mode.LAND,
    Mode.OFFBOARD,
    Mode.STABILIZED,
)
_AMSL, _ABOVE_HOME = (0, 5), (3, 6)  # MAV_FRAME

Answer = tuple[Result, list[str]]
_DONE: Answer = (Result.ACCEPTED, [])


class Commands:
    """What each MAV_CMD does."""

    def __init__(self, commander: Commander, navigator: Navigator) -> None:
        self._commander = commander
        self._navigator = navigator
        self._handlers: dict[int, Callable[[Command, BodyState, int], Answer]] = {
            Cmd.COMPONENT_ARM_DISARM: self._arm_disarm,
            Cmd.RUN_PREARM_CHECKS: self._check,
            Cmd.NAV_TAKEOFF: self._takeoff,
            Cmd.NAV_LAND: lambda command, state, t_ns: self._change(Mode.LAND, state, t_ns),
            Cmd.NAV_RETURN_TO_LAUNCH: lambda command, state, t_ns: self._change(Mode.RETURN, state, t_ns),
            Cmd.DO_SET_MODE: self._set_mode,
            Cmd.DO_REPOSITION: self._reposition,
            Cmd.DO_CHANGE_SPEED: self._change_speed,
            Cmd.DO_SET_HOME: self._set_home,
            Cmd.DO_FLIGHTTERMINATION: self._terminate,
            Cmd.PREFLIGHT_STORAGE: self._store,
        }

    def carry_out(self, command: Command, state: BodyState, t_ns: int) -> tuple[Reply, ...]:
        """One Ack to the sender; before it, as Text, why it was refused."""
        handler = self._handlers.get(command.command)
        if handler is None:
            return (Ack(command.command, Result.UNSUPPORTED, command.sender),)
        result, reasons = handler(command, state, t_ns)
        texts = [Text(Severity.CRITICAL, reason) for reason in reasons]
        return (*texts, Ack(command.command, result, command.sender))

    def _change(self, mode: Mode, state: BodyState, t_ns: int) -> Answer:
        return _answer(self._commander.change(mode, state, t_ns))

    def _arm_disarm(self, command: Command, state: BodyState, t_ns: int) -> Answer:
        commander, forced = self._commander, command.params[1] == FORCE
        if command.params[0] not in (0.0, 1.0):
            return Result.UNSUPPORTED, [f"Unsupported ARM_DISARM param: {command.params[0]:.3f}"]
        if command.params[0] == 0.0:
            if commander.armed and commander.airborne and not forced:
                return Result.TEMPORARILY_REJECTED, ["Disarming denied: not landed"]
            commander.disarm()
            return _DONE
        if commander.armed:
            return _DONE
        reasons = [] if forced else commander.refusals(state, t_ns)
        if reasons:
            told = [*_preflight(reasons), "Arming denied: Resolve system health failures first"]
            return Result.TEMPORARILY_REJECTED, told
        commander.arm(state, t_ns)
        return _DONE

    def _check(self, command: Command, state: BodyState, t_ns: int) -> Answer:
        if self._commander.armed:
            return Result.TEMPORARILY_REJECTED, []
        return Result.ACCEPTED, _preflight(self._commander.refusals(state, t_ns))

    def _takeoff(self, command: Command, state: BodyState, t_ns: int) -> Answer:
        altitude_amsl_m = command.params[6]  # NaN: MIS_TAKEOFF_ALT, as MAVSDK asks for it
        commander = self._commander
        to_z_m = commander.home_enu[2] + float(commander.parameters["MIS_TAKEOFF_ALT"])
        if math.isfinite(altitude_amsl_m):
            to_z_m = self._height(command, altitude_amsl_m)
        return _answer(commander.takeoff(state, t_ns, to_z_m))

    def _set_mode(self, command: Command, state: BodyState, t_ns: int) -> Answer:
        flags, main, sub = command.params[:3]
        if not all(math.isfinite(x) and 0.0 <= x <= 255.0 for x in (flags, main, sub)) or not int(flags) & 1:
            return Result.DENIED, ["Mode denied: expected a custom mode (param1 bit 1)"]
        number = int(main) << 16 | int(sub) << 24
        mode = next((m for m in _REQUESTABLE if m == number), None)
        if mode is None:
            return Result.TEMPORARILY_REJECTED, [f"Mode {int(main)}/{int(sub)} denied: not available here"]
        if mode is Mode.HOLD is self._commander.mode and self._navigator.goes:
            self._navigator.hold(state.p_enu)  # on its way somewhere: stop here
        return self._change(mode, state, t_ns)

    def _reposition(self, command: Command, state: BodyState, t_ns: int) -> Answer:
        """Goto: param1 speed (-1 default), param2 bit 1 change the mode, param4 heading from north [rad]."""
        speed_m_s, flags, _, heading_rad, *_ = command.params
        if not math.isfinite(flags) or int(flags) != 1:
            return Result.UNSUPPORTED, []
        if command.frame not in (*_AMSL, *_ABOVE_HOME):
            return Result.DENIED, [f"Reposition denied: frame {command.frame}"]
        p_enu = self._place(command, state)
        if self._commander.parameters["GF_ACTION"] and outside_fence(
            p_enu, self._commander.home_enu, self._commander.parameters
        ):
            return Result.DENIED, ["Reposition is outside geofence"]
        answer = _answer(self._commander.go(p_enu, 0.5 * math.pi - heading_rad, state, t_ns))
        if answer is _DONE and math.isfinite(speed_m_s) and speed_m_s > 0.0:
            self._navigator.cruise_m_s = speed_m_s
        return answer

    def _change_speed(self, command: Command, state: BodyState, t_ns: int) -> Answer:
        speed_m_s = command.params[1]
        if not math.isfinite(speed_m_s):
            return Result.DENIED, ["Speed denied: not a finite number"]
        self._navigator.cruise_m_s = speed_m_s if speed_m_s > 0.0 else None  # otherwise the default again
        return _DONE

    def _set_home(self, command: Command, state: BodyState, t_ns: int) -> Answer:
        commander = self._commander
        if not commander.parameters["COM_HOME_EN"]:
            return Result.DENIED, ["Home denied: COM_HOME_EN is 0"]
        if command.params[0] > 0.5:
            if not all(map(math.isfinite, state.p_enu)):
                return Result.TEMPORARILY_REJECTED, ["Home denied: no position"]
            commander.home_here(state)
            return _DONE
        if not all(map(math.isfinite, command.params[4:])):
            return Result.DENIED, ["Home denied: expected latitude, longitude, altitude"]
        commander.home_enu = self._place(command, state)
        return _DONE

    def _terminate(self, command: Command, state: BodyState, t_ns: int) -> Answer:
        if not command.params[0] > 0.5 or not self._commander.armed:
            return Result.DENIED, ["Termination denied: not armed" if command.params[0] > 0.5 else "Termination denied"]
        self._commander.terminate()
        return Result.ACCEPTED, ["Flight termination: motors off"]

    def _store(self, command: Command, state: BodyState, t_ns: int) -> Answer:
        """Parameters are written when they are set: there is nothing to be saved, and nothing to be loaded."""
        return (Result.ACCEPTED if command.params[0] in (0.0, 1.0) else Result.UNSUPPORTED), []

    def _height(self, command: Command, altitude_m: float) -> float:
        if command.frame in _ABOVE_HOME:
            return self._commander.home_enu[2] + altitude_m
        return altitude_m - HOME_ALTITUDE_AMSL_M

    def _place(self, command: Command, state: BodyState) -> Vec3:
        """Latitude, longitude and altitude as a local point; what is NaN stays where the vehicle is."""
        latitude_deg, longitude_deg, altitude_m = command.params[4:]
        x, y, z = state.p_enu
        if math.isfinite(latitude_deg) and math.isfinite(longitude_deg):
            x, y = enu_of(latitude_deg, longitude_deg)
        return (x, y, self._height(command, altitude_m) if math.isfinite(altitude_m) else z)


def _answer(refusal: str) -> Answer:
    return (Result.TEMPORARILY_REJECTED, [refusal]) if refusal else _DONE


def _preflight(reasons: list[str]) -> list[str]:
    return [f"Preflight Fail: {reason}" for reason in reasons]
