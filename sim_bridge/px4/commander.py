"""PX4's commander: arming, the pilot's mode and the mode that flies, failsafes, landing and disarming.

The pilot's mode is the one that was asked for; the failsafe framework may let another fly, and gives the pilot's back
when its condition ends. Source: PX4 1.15, user guide "Flight Modes" and "Safety Configuration".
"""

from __future__ import annotations

import math

from sim_bridge.messages import (
    NS_PER_S,
    AttitudeTarget,
    Landed,
    Mode,
    Reply,
    Severity,
    Text,
    Vec3,
)
from sim_bridge.parameters import Parameters
from sim_bridge.physics import BodyState
from sim_bridge.px4.arming import refusals
from sim_bridge.px4.conditions import Charge, Situation, failing, fallback
from sim_bridge.px4.failsafe import Action, Failsafe, Reaction, Verdict
from sim_bridge.px4.ground import Ground
from sim_bridge.px4.navigation import ARRIVED_M, NEAR_M, Navigator, Phase
from sim_bridge.px4.sticks import ManualControl
from sim_bridge.rotation import yaw_of
from sim_bridge.stream import SetpointStream

_MANUAL = (Mode.POSITION, Mode.ALTITUDE, Mode.STABILIZED)
_MODE_OF = {
    Action.POSITION: Mode.POSITION,
    Action.ALTITUDE: Mode.ALTITUDE,
    Action.STABILIZED: Mode.STABILIZED,
    Action.HOLD: Mode.HOLD,
    Action.RETURN: Mode.RETURN,
    Action.LAND: Mode.LAND,
}
_DOES = {
    Action.POSITION: "Position mode",
    Action.ALTITUDE: "Altitude mode",
    Action.STABILIZED: "Stabilized mode",
    Action.HOLD: "holding",
    Action.RETURN: "returning",
    Action.LAND: "landing",
    Action.DISARM: "disarming",
    Action.TERMINATE: "terminating",
}
_WARNINGS = {
    "low battery": Text(Severity.WARNING, "Low battery level, return advised"),
    "critical battery": Text(Severity.CRITICAL, "Critical battery level, land now"),
    "emergency battery": Text(Severity.EMERGENCY, "Emergency battery level, land immediately"),
}


class Commander:
    """Modes, arming and failsafes of one vehicle."""

    def __init__(
        self,
        parameters: Parameters,
        navigator: Navigator,
        stream: SetpointStream,
        sticks: ManualControl,
        *,
        home_enu: Vec3,
        rest_z_m: float,
        airborne: bool,
    ) -> None:
        self.parameters = parameters
        self.mode = Mode.HOLD  # that flies
        self.intended = Mode.HOLD  # that the pilot asked for
        self.armed = airborne
        self.terminated = False
        self.home_enu = home_enu
        self.charge = Charge.OK
        self._rest_z_m = rest_z_m
        self._navigator = navigator
        self._stream = stream
        self._sticks = sticks
        self._ground = Ground(parameters, rest_z_m=rest_z_m, airborne=airborne)
        self._failsafe = Failsafe()
        self._mode_before_arming = Mode.HOLD
        self._charge_at_arming = Charge.OK
        self._sticks_lost_at_arming = True
        self._station_ns: int | None = None
        self._changed = False  # the pilot asked for a mode since the last look
        self._looked_ns = 0

    @property
    def landed(self) -> Landed:
        return self._ground.landed

    @property
    def airborne(self) -> bool:
        return self.landed is not Landed.ON_GROUND

    @property
    def in_failsafe(self) -> bool:
        return self._failsafe.verdict.action > Action.WARN

    def heard_station(self, t_ns: int) -> None:
        self._station_ns = t_ns

    def situation(self, state: BodyState, t_ns: int) -> Situation:
        heard_ns, limit_s = self._station_ns, self.parameters["COM_DL_LOSS_T"]
        never = heard_ns is None and not self.armed
        return Situation(
            mode=self.intended,
            armed=self.armed,
            airborne=self.armed and self.airborne,
            p_enu=state.p_enu,
            home_enu=self.home_enu,
            charge=self.charge,
            charge_at_arming=self._charge_at_arming,
            station_lost=never or t_ns - (heard_ns or 0) > limit_s * NS_PER_S,
            sticks_lost=self._sticks.lost(t_ns),
            sticks_lost_at_arming=self._sticks_lost_at_arming,
            stream_lost=self._stream.lost(t_ns, float(self.parameters["COM_OF_LOSS_T"]))
            if self.armed
            else not self._stream.proven(t_ns),
        )

    # --- what the pilot asks for

    def refusals(self, state: BodyState, t_ns: int) -> list[str]:
        """Why it cannot be armed now."""
        return refusals(self.situation(state, t_ns), state, self.parameters, terminated=self.terminated)

    def arm(self, state: BodyState, t_ns: int) -> None:
        """Arm without asking; home is here, unless COM_HOME_EN is 0."""
        if self.armed:
            return
        self.armed = True
        self._mode_before_arming = self.intended
        self._charge_at_arming = self.charge
        self._sticks_lost_at_arming = self._sticks.lost(t_ns)
        self._ground.arm(t_ns)
        self._sticks.settle()
        if self.parameters["COM_HOME_EN"] and not self.airborne and all(map(math.isfinite, state.p_enu)):
            self.home_here(state)

    def home_here(self, state: BodyState) -> None:
        """Home is where the vehicle is; on the ground, the ground below it."""
        x, y, z = state.p_enu
        self.home_enu = (x, y, z if self.airborne else z - self._rest_z_m)

    def disarm(self) -> None:
        """Motors off, whatever flies."""
        self.armed = False
        automatic = self._mode_before_arming in (Mode.TAKEOFF, Mode.LAND, Mode.RETURN)
        self.intended = Mode.HOLD if automatic or self.mode is not self.intended else self._mode_before_arming
        self.mode = self.intended
        self._navigator.forget()
        self._navigator.cruise_m_s = None

    def terminate(self) -> None:
        """Motors off for good; it stays armed until it lies on the ground."""
        self.terminated = True
        self.intended = self.mode = Mode.MANUAL
        self._navigator.forget()

    def change(self, mode: Mode, state: BodyState, t_ns: int) -> str:
        """The pilot asks for ``mode``; why it is refused, or nothing."""
        name = mode.name.title()
        if self.terminated:
            return f"{name} denied: flight terminated"
        if mode is Mode.OFFBOARD and not self._stream.proven(t_ns):
            return "Offboard denied: no setpoint stream"
        if mode in (Mode.ALTITUDE, Mode.STABILIZED) and self._sticks.lost(t_ns):
            return f"{name} denied: no manual control"
        if mode not in (Mode.LAND, Mode.STABILIZED) and not all(map(math.isfinite, state.p_enu)):
            return f"{name} denied: no position"
        self.intended, self._changed = mode, True
        if mode is not self.mode:
            self._fly(mode, state)
        return ""

    def takeoff(self, state: BodyState, t_ns: int, to_z_m: float) -> str:
        """Climb to the local height ``to_z_m``, at least off the ground and not down; once armed, if it is not."""
        refusal = self.change(Mode.TAKEOFF, state, t_ns)
        if not refusal:
            lowest = state.p_enu[2] if self.airborne else self._rest_z_m + ARRIVED_M
            self._navigator.takeoff(state, max(to_z_m, lowest))
        return refusal

    def go(self, p_enu: Vec3, yaw_rad: float, state: BodyState, t_ns: int) -> str:
        """Fly to ``p_enu`` in Hold."""
        refusal = self.change(Mode.HOLD, state, t_ns)
        if not refusal and self.airborne:
            self._navigator.go(p_enu, yaw_rad)
        return refusal

    def hold(self, p_enu: Vec3) -> None:
        """Enter Hold at ``p_enu``."""
        self.intended = self.mode = Mode.HOLD
        self._navigator.hold(p_enu)
        self._ground.set_off()

    # --- once a control period

    def step(self, state: BodyState, t_ns: int, *, descends: bool) -> tuple[Reply, ...]:
        """Watch everything; ``descends``: what is flown asks for no climb."""
        replies = [*self._watch_sticks(state, t_ns), *self._watch_failsafe(state, t_ns)]
        self._looked_ns, self._changed = t_ns, False
        if self.armed:
            landing = self.mode is Mode.LAND or self._navigator.phase is Phase.LAND
            self._ground.watch(
                state, t_ns, self.mode, descends=descends or self.terminated, landing=landing or self.terminated
            )
            self._navigator.watch(state, self.home_enu, t_ns)
            self._watch_takeoff(state, t_ns)
            reason = self._ground.disarms(t_ns, self.mode)
            if reason:
                self.disarm()
                replies.append(Text(Severity.INFO, reason))
        return tuple(replies)

    def _watch_sticks(self, state: BodyState, t_ns: int) -> list[Reply]:
        """Moved sticks take over from an automatic mode or offboard, by COM_RC_OVERRIDE, where no failsafe acts."""
        if self._wants_sticks(t_ns) and not self.in_failsafe and not self.change(Mode.POSITION, state, t_ns):
            return [Text(Severity.INFO, "Pilot took over using sticks")]
        return []

    def _wants_sticks(self, t_ns: int) -> bool:
        if not self.armed or not self.airborne or self.mode in _MANUAL or self._sticks.lost(t_ns):
            return False
        bit = 2 if self.mode is Mode.OFFBOARD else 1
        return bool(int(self.parameters["COM_RC_OVERRIDE"]) & bit) and self._sticks.moved()

    def _watch_failsafe(self, state: BodyState, t_ns: int) -> list[Reply]:
        if not self._sticks.lost(t_ns):
            self._sticks_lost_at_arming = False  # from now on they are missed
        now = self.situation(state, t_ns)
        before = self._failsafe.verdict

        def falls_back(by_sticks: bool) -> Reaction | None:
            return None if by_sticks or not now.armed else fallback(now, self.parameters)

        verdict = self._failsafe.update(
            failing(now, self.parameters),
            armed=self.armed,
            changed=self._changed,
            sticks=self.in_failsafe and self._wants_sticks(t_ns),
            landing=self.intended is Mode.LAND,
            fallback=falls_back,
            hold_s=float(self.parameters["COM_FAIL_ACT_T"]),
            dt_s=(t_ns - self._looked_ns) / NS_PER_S,
        )
        if not self.armed or self.terminated:
            return []
        replies = self._say(verdict)
        if verdict.by_sticks:
            self.intended = Mode.POSITION
            replies.append(Text(Severity.INFO, "Pilot took over using sticks"))
        self._act(verdict, before, state)
        return replies

    def _act(self, verdict: Verdict, before: Verdict, state: BodyState) -> None:
        if verdict.action is Action.TERMINATE:
            self.terminate()
        elif verdict.action is Action.DISARM:
            self.disarm()
        elif self.mode is not (mode := _MODE_OF.get(verdict.action, self.intended)):
            self._fly(mode, state)
        elif verdict.action is Action.HOLD is not before.action:
            self._navigator.hold(state.p_enu)  # it was on its way

    def _say(self, verdict: Verdict) -> list[Reply]:
        if not verdict.notify:
            return []
        if verdict.action is Action.WARN:
            plain = Text(Severity.WARNING, f"Failsafe warning: {verdict.cause}")
            return [_WARNINGS.get(verdict.cause, plain)]
        text = f"Failsafe: {verdict.cause}, {_DOES[verdict.action]}"
        if verdict.delayed is not Action.NONE:
            text += f" {self.parameters['COM_FAIL_ACT_T']:g} s"
            text += "" if verdict.delayed is Action.HOLD else f", then {_DOES[verdict.delayed]}"
        return [Text(Severity.CRITICAL, text)]

    def _fly(self, mode: Mode, state: BodyState) -> None:
        """Let ``mode`` fly from here on."""
        self._ground.set_off()
        self._sticks.settle()
        if self.mode in _MANUAL or (self.mode is Mode.OFFBOARD and isinstance(self._stream.wanted, AttitudeTarget)):
            self._navigator.yaw_rad = yaw_of(state.q_wxyz)
        self.mode = mode
        if mode is Mode.LAND:
            self._navigator.land(state)
        elif mode is Mode.RETURN:
            self._navigator.go_home(state, self.home_enu)
        elif mode is Mode.TAKEOFF:
            self._navigator.takeoff(state, self.home_enu[2] + float(self.parameters["MIS_TAKEOFF_ALT"]))
        elif mode is Mode.OFFBOARD:
            self._navigator.forget()
        else:
            self._navigator.hold(state.p_enu)

    def _watch_takeoff(self, state: BodyState, t_ns: int) -> None:
        goal = self._navigator.goal
        if self.mode is not Mode.TAKEOFF or goal is None or not self._navigator.arrived(state, t_ns):
            return
        if abs(state.p_enu[2] - goal.p_enu[2]) < NEAR_M:
            self._ground.landed = Landed.IN_AIR
            self.intended = Mode.HOLD if self.intended is Mode.TAKEOFF else self.intended
            self.mode = Mode.HOLD
            self._navigator.hold(goal.p_enu)
