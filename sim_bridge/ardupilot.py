"""ArduCopter as a pure state machine: no I/O, no clock; it is told the state and the time.

Its modes, arming, takeoff, landing, failsafes and GUIDED as the real one (4.7-dev, SITL) was measured, and where that
is silent as its source and parameter list say; docs/explanation/simulator-ardupilot.md tells which is which. The
parts: `ardupilot_guided` (setpoints), `ardupilot_plans` (modes), `ardupilot_copter` (takeoff, landing),
`ardupilot_follower` and `shaping` (how a plan is flown), `ardupilot_failsafe`, `ardupilot_parameters`. Here: what
comes in, what may be done, what is told.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from sim_bridge.ardupilot_arming import arming_reasons
from sim_bridge.ardupilot_copter import PILOTED, Copter
from sim_bridge.ardupilot_failsafe import LANDING_CONTINUES, PILOT_CONTINUES, Action, Event, Failsafes
from sim_bridge.ardupilot_guided import Submode
from sim_bridge.ardupilot_parameters import ArduParameters
from sim_bridge.ardupilot_plans import ArduMode
from sim_bridge.ardupilot_telemetry import LOOP_RATE_HZ, STREAMS, News, health, rates_hz
from sim_bridge.controller import Setpoint
from sim_bridge.messages import (
    FORCE,
    NS_PER_S,
    Ack,
    AttitudeTarget,
    Cmd,
    Command,
    Landed,
    LinkName,
    LocalSetpoint,
    Reply,
    Result,
    Severity,
    Sticks,
    Text,
    Vec3,
)
from sim_bridge.personality import BatteryReading
from sim_bridge.physics import BodyState

REBOOT_NS = 1_200_000_000  # from the command to the first heartbeat
FORCE_ARM = 2989.0  # param2 of COMPONENT_ARM_DISARM

_NEED_POSITION = (ArduMode.LOITER, ArduMode.RTL, ArduMode.BRAKE)
_ACTIONS = {Action.RTL: ArduMode.RTL, Action.LAND: ArduMode.LAND, Action.BRAKE: ArduMode.BRAKE}


class ArduCopter:
    """One vehicle's autopilot; conforms to `personality.Personality`.

    Args:
        start_enu: where it starts; above resting height it starts armed, in LOITER. Home is the ground z = 0 below.
        rest_height_m: height of the vehicle's centre above the ground when it stands.
        yaw_rad: initial heading, counter-clockwise from east.
        control_hz: the rate of the state on the onboard link in lockstep.
        physics_hz: the fastest stream, unless its own loop is slower.
        system_id: MAVLink system of the vehicle.
    """

    kind = 3  # MAV_AUTOPILOT_ARDUPILOTMEGA
    # float parameters, COMMAND_INT, local and global setpoints, MAVLink 2, integers as plain floats (C_CAST)
    capabilities = 2 | 8 | 128 | 256 | 8192 | 1 << 17
    version = 4 << 24 | 7 << 16  # 4.7.0-dev
    unknown_stream = Result.FAILED
    too_fast_stream = Result.DENIED

    def __init__(
        self,
        *,
        start_enu: Vec3,
        rest_height_m: float,
        yaw_rad: float,
        control_hz: int = 20,
        physics_hz: int = 240,
        system_id: int = 1,
    ) -> None:
        self.parameters = ArduParameters(system_id)
        self.max_rate_hz = min(float(physics_hz), LOOP_RATE_HZ)
        self.lockstep = False
        self.up_since_ns = 0
        self._copter = Copter(start_enu, yaw_rad, rest_height_m, self.parameters)
        self._control_hz = float(control_hz)
        self._born_airborne = self._copter.airborne
        self._failsafes = Failsafes(self.parameters)
        self._news = News(told=self._born_airborne)
        self._nan_told_ns: int | None = None
        self._attitude_told = False
        self._handlers: dict[int, Callable[[Command], tuple[Result, str]]] = {
            Cmd.COMPONENT_ARM_DISARM: self._arm_disarm,
            Cmd.NAV_TAKEOFF: self._takeoff,
            Cmd.NAV_LAND: lambda command: self._change_mode(ArduMode.LAND),
            Cmd.NAV_RETURN_TO_LAUNCH: lambda command: self._change_mode(ArduMode.RTL),
            Cmd.DO_SET_MODE: self._set_mode,
            Cmd.PREFLIGHT_REBOOT_SHUTDOWN: self._reboot,
        }

    # --- what is told of it

    @property
    def mode(self) -> ArduMode:
        return self._copter.mode

    @property
    def armed(self) -> bool:
        return self._copter.armed

    @property
    def landed(self) -> Landed:
        return self._copter.landed

    @property
    def home_enu(self) -> Vec3:
        return self._copter.home_enu

    @property
    def custom_mode(self) -> int:
        return int(self.mode)

    @property
    def mode_name(self) -> str:
        return self.mode.name

    @property
    def base_mode(self) -> int:
        guided = self.mode not in (ArduMode.STABILIZE, ArduMode.ALT_HOLD)
        return 1 | 16 | 64 | 8 * guided | 128 * self.armed  # custom, stabilised, manual input

    @property
    def system_status(self) -> int:
        if self._failsafes.active:
            return 5
        return 4 if self.armed and self.airborne else 3

    @property
    def external(self) -> bool:
        """GUIDED, in the air, and following setpoints: GUIDED is what takes off as well."""
        return self.mode is ArduMode.GUIDED and self.landed is Landed.IN_AIR and self._copter.guided.followed

    @property
    def airborne(self) -> bool:
        return self.landed is not Landed.ON_GROUND

    @property
    def position_valid(self) -> bool:
        """The EKF has a position: SIM_EKF_READY after boot; at once in lockstep, and where it starts in the air."""
        since_ns = self._copter.t_ns - self.up_since_ns
        return self._born_airborne or self.lockstep or since_ns >= self.parameters["SIM_EKF_READY"] * NS_PER_S

    @property
    def health(self) -> tuple[int, int, int]:
        return health(position_valid=self.position_valid, can_arm=self.armed or not self._arming_reasons())

    @property
    def charge_state(self) -> int:
        """MAV_BATTERY_CHARGE_STATE: 1 fine, 2 low, 3 critical."""
        return 1 + self._failsafes.battery_level

    def attitude_target(self) -> AttitudeTarget | None:
        """Never: attitude setpoints are left out."""
        return None

    def rates_hz(self, link: LinkName) -> Mapping[int, float]:
        return rates_hz(self._control_hz if self.lockstep and link is LinkName.ONBOARD else None)

    def stream_group(self, stream: int) -> tuple[int, ...]:
        return STREAMS.get(stream, ())

    def position_target(self) -> LocalSetpoint | None:
        if self.mode is not ArduMode.GUIDED:
            return None
        return self._copter.guided.echo((self._copter.t_ns - self.up_since_ns) // 1_000_000)

    # --- what comes in

    def command(self, command: Command, state: BodyState, t_ns: int) -> tuple[Reply, ...]:
        """Carry out a command; one Ack to its sender, with the reason of a refusal as Text."""
        self._copter.state, self._copter.t_ns = state, t_ns
        handler = self._handlers.get(command.command)
        if handler is None:
            return (Ack(command.command, Result.UNSUPPORTED, command.sender),)
        armed = self.armed
        result, reason = handler(command)
        texts = [Text(Severity.CRITICAL, reason)] if reason else []
        if self.armed != armed:
            texts.append(Text(Severity.INFO, "Arming motors" if self.armed else "Disarming motors"))
        return (*texts, Ack(command.command, result, command.sender))

    def setpoint(self, setpoint: LocalSetpoint, t_ns: int) -> tuple[Reply, ...]:
        """Take an external setpoint in GUIDED; what it cannot fly stops it silently."""
        copter, guided = self._copter, self._copter.guided
        if self.mode is not ArduMode.GUIDED:
            return ()
        copter.t_ns = t_ns
        before = guided.submode
        finite = guided.take(setpoint, copter.state.p_enu, self.home_enu[2], copter.nose, t_ns)
        goes = guided.submode in (Submode.POSITION, Submode.POSITION_VELOCITY)
        if goes and self._failsafes.outside(guided.p_enu, self.home_enu):
            guided.stop()
        if guided.submode is not before:
            copter.anchor()
        if finite or (self._nan_told_ns is not None and t_ns - self._nan_told_ns < NS_PER_S):
            return ()
        self._nan_told_ns = t_ns
        return (Text(Severity.CRITICAL, "NaN in setpoint: ArduCopter would crash"),)

    def attitude_setpoint(self, setpoint: AttitudeTarget, t_ns: int) -> tuple[Reply, ...]:
        """GUIDED's attitude control is left out, and says so once."""
        told, self._attitude_told = self._attitude_told, True
        return () if told else (Text(Severity.WARNING, "SET_ATTITUDE_TARGET is not simulated"),)

    def manual(self, sticks: Sticks, t_ns: int) -> tuple[Reply, ...]:
        """The sticks of the ground station that SYSID_MYGCS names; they fly the piloted modes."""
        if sticks.sender.system == self.parameters["SYSID_MYGCS"]:
            self._copter.t_ns = t_ns
            self._copter.give(None if sticks.released else sticks)
        return ()

    def heard_station(self, t_ns: int, system: int = 255) -> None:
        if system == self.parameters["SYSID_MYGCS"]:
            self._failsafes.heard_station(t_ns)

    def battery(self, reading: BatteryReading) -> None:
        self._failsafes.read_battery(reading)

    def hold(self, p_enu: Vec3) -> None:
        """GUIDED towards ``p_enu``."""
        self._copter.enter(ArduMode.GUIDED)
        self._copter.guided.go_to(p_enu)

    # --- time

    def step(self, state: BodyState, t_ns: int) -> tuple[Reply, ...]:
        copter = self._copter
        copter.state, copter.t_ns = state, t_ns
        if t_ns < self.up_since_ns:
            return ()
        texts = self._news.step(self._arming_reasons(), t_ns, position_valid=self.position_valid, armed=self.armed)
        armed = self.armed
        if armed:
            for event in self._failsafes.step(state.p_enu, self.home_enu, t_ns):
                texts.extend(self._answer(event))
        copter.watch(state, t_ns)
        if armed and not self.armed:
            texts.append(Text(Severity.INFO, "Disarming motors"))
        return tuple(texts)

    def target(self, state: BodyState) -> Setpoint:
        return self._copter.target(state)

    def turn(self, dt_s: float) -> None:
        self._copter.move(dt_s)

    def hovering(self, t_ns: int) -> bool:
        return self._copter.ground.hovers(t_ns)

    # --- commands

    def _arm_disarm(self, command: Command) -> tuple[Result, str]:
        if command.params[0] < 0.5:
            if self.armed and self.airborne and command.params[1] != FORCE:
                return Result.FAILED, ""  # as the real one: not a word
            self._copter.disarm()
            return Result.ACCEPTED, ""
        if self.armed:
            return Result.ACCEPTED, ""
        reason = "" if command.params[1] == FORCE_ARM else next(iter(self._arming_reasons()), "")
        if reason:
            return Result.FAILED, reason
        self._copter.arm()
        return Result.ACCEPTED, ""

    def _arming_reasons(self) -> list[str]:
        return arming_reasons(self._copter, self._failsafes, self.parameters, position_valid=self.position_valid)

    def _takeoff(self, command: Command) -> tuple[Result, str]:
        above_m = command.params[6]
        if not self.armed:
            return Result.FAILED, "Takeoff denied: not armed"
        if self.airborne or self.mode not in (ArduMode.GUIDED, ArduMode.LOITER, ArduMode.ALT_HOLD):
            return Result.FAILED, f"Takeoff denied: {'in the air' if self.airborne else self.mode.name}"
        goal_m = self.home_enu[2] + above_m
        if not math.isfinite(above_m) or goal_m <= self._copter.state.p_enu[2]:
            return Result.FAILED, "Takeoff denied: needs an altitude (param7)"
        self._copter.take_off(goal_m)
        return Result.ACCEPTED, ""

    def _set_mode(self, command: Command) -> tuple[Result, str]:
        """DO_SET_MODE's param2, or SET_MODE's custom_mode; only custom modes are understood."""
        number = command.params[1] if command.custom_mode is None else float(command.custom_mode)
        flags = command.params[0]
        if not math.isfinite(flags) or not int(flags) & 1:
            return Result.UNSUPPORTED, ""
        mode = next((m for m in ArduMode if m == number), None)
        if mode is None:
            return Result.FAILED, f"No such mode {number:g}"
        return self._change_mode(mode)

    def _change_mode(self, mode: ArduMode) -> tuple[Result, str]:
        reason = ""
        if mode is ArduMode.AUTO:
            reason = "init failed"  # there is no mission
        elif mode in _NEED_POSITION and self.armed and not self.position_valid:
            reason = "requires position"
        if reason:
            return Result.FAILED, f"Mode change to {mode.name} failed: {reason}"
        if self.mode is not mode:
            self._copter.enter(mode)
        return Result.ACCEPTED, ""

    def _reboot(self, command: Command) -> tuple[Result, str]:
        """Restart the autopilot: silent for 1.2 s, then its clock, mode and estimate begin anew; parameters stay."""
        if command.params[0] != 1.0:
            return Result.UNSUPPORTED, ""
        if self.armed:
            return Result.FAILED, ""
        if self.lockstep:
            return Result.DENIED, "Reboot denied: in lockstep"
        self.up_since_ns = self._copter.t_ns + REBOOT_NS
        self._born_airborne = False
        self._news = News(told=False)
        self._copter.give(None)
        self._failsafes = Failsafes(self.parameters)
        self._copter.enter(ArduMode.STABILIZE)
        return Result.ACCEPTED, ""

    # --- watching

    def _answer(self, event: Event) -> list[Text]:
        """What a failsafe leads to here."""
        action, options, texts = event.action, int(self.parameters["FS_OPTIONS"]), [event.text]
        if action is Action.NONE or not self.armed:
            return texts
        if not self.airborne or action is Action.DISARM:
            self._copter.disarm()
        elif self.mode is ArduMode.LAND and options & LANDING_CONTINUES:
            texts.append(Text(Severity.WARNING, "Failsafe - Continuing Landing"))
        elif event.station and self.mode in PILOTED and options & PILOT_CONTINUES:
            texts.append(Text(Severity.WARNING, "GCS Failsafe - Continuing Pilot Control"))
        else:
            mode = _ACTIONS[action]
            if not self.position_valid:
                mode = ArduMode.LAND
            if self.mode is not mode:
                self._copter.enter(mode)
        return texts
