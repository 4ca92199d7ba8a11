"""A PX4-style autopilot as a pure state machine: no I/O, no clock; it is told the state and the time.

The commander (``px4/``) decides which mode flies; here is what each mode asks of the controller, and what the wire
sees of the vehicle. Behaviour follows PX4 1.15's user guide: "Offboard Mode" (setpoints at 2 Hz or more before and
during the mode), "Takeoff", "Land", "Return", "Position Mode", "Safety Configuration".
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from sim_bridge.controller import AccelerationSetpoint, MotorsOff, Setpoint
from sim_bridge.messages import (
    NS_PER_S,
    AttitudeTarget,
    Command,
    Landed,
    LinkName,
    LocalSetpoint,
    Mode,
    Reply,
    Result,
    Sticks,
    Vec3,
)
from sim_bridge.parameters import Parameters
from sim_bridge.personality import BatteryReading
from sim_bridge.physics import BodyState
from sim_bridge.px4.arming import health
from sim_bridge.px4.commander import Commander
from sim_bridge.px4.commands import Commands
from sim_bridge.px4.conditions import charge
from sim_bridge.px4.ground import TOUCH_M
from sim_bridge.px4.manual import ManualFlight
from sim_bridge.px4.navigation import Navigator
from sim_bridge.px4.position import FREE, PositionControl, Trajectory
from sim_bridge.px4.rates import ground_rates_hz, onboard_rates_hz
from sim_bridge.px4.sticks import ManualControl
from sim_bridge.rotation import from_euler
from sim_bridge.setpoints import echo, flown_attitude
from sim_bridge.stream import SetpointStream

HOVER_NS = NS_PER_S // 2
LIFT_OFF_M_S2 = 0.2  # setpoints with more upward acceleration leave the ground
LIFT_OFF_SHARE = 0.95  # of the hover thrust: an attitude setpoint with less stays on it
_LEVEL_DESCENT = AccelerationSetpoint((0.0, 0.0, -0.3))  # without a position: drag limits it

_BY_STICKS = (Mode.POSITION, Mode.ALTITUDE, Mode.STABILIZED)
_CUSTOM_MODE, _AUTO, _GUIDED, _STABILIZED, _MANUAL, _ARMED = 1, 4, 8, 16, 64, 128  # MAV_MODE_FLAG
_STANDBY, _ACTIVE, _CRITICAL, _TERMINATED = 3, 4, 5, 8  # MAV_STATE


class Autopilot:
    """One vehicle's autopilot.

    Args:
        start_enu: where it starts; above resting height it starts armed, in Hold. Home, from which takeoff
            altitudes count, is the ground z = 0 below [m].
        rest_height_m: height of the vehicle's centre above the ground when it stands.
        yaw_rad: initial heading, counter-clockwise from east.
        control_hz: the rate of the state on the onboard link.
        physics_hz: the fastest stream.
        system_id: MAVLink system of the vehicle.
    """

    kind = 12  # MAV_AUTOPILOT_PX4
    position_valid = True
    lockstep = False
    up_since_ns = 0
    # float and bytewise parameters, COMMAND_INT, attitude, local and global setpoints, termination, MAVLink 2
    capabilities = 2 | 8 | 16 | 64 | 128 | 256 | 2048 | 8192
    version = 1 << 24 | 15 << 16 | 255  # 1.15.0, release
    unknown_stream = Result.FAILED
    too_fast_stream = Result.DENIED  # PX4 grants what its link cannot carry; here it is said

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
        airborne = start_enu[2] > rest_height_m + TOUCH_M
        self.max_rate_hz = float(physics_hz)
        self.parameters = Parameters({"MAV_SYS_ID": system_id})
        self._control_hz = float(control_hz)
        self._state = BodyState(start_enu, (0.0, 0.0, 0.0), from_euler(0.0, 0.0, yaw_rad), (0.0, 0.0, 0.0))
        self._t_ns = 0
        self._stream = SetpointStream()
        self._sticks = ManualControl(self.parameters)
        self._navigator = Navigator(self.parameters, rest_z_m=rest_height_m, yaw_rad=yaw_rad)
        self._control = PositionControl(self.parameters)
        self._manual = ManualFlight(self.parameters, self._sticks, self._control)
        self._commander = Commander(
            self.parameters,
            self._navigator,
            self._stream,
            self._sticks,
            home_enu=(start_enu[0], start_enu[1], 0.0),
            rest_z_m=rest_height_m,
            airborne=airborne,
        )
        self._commands = Commands(self._commander, self._navigator)
        self._flown_mode = Mode.HOLD
        self._accelerated = AccelerationSetpoint((0.0, 0.0, 0.0))  # kept while it is the same: it is asked for often
        self._tilt_deg = math.nan
        self._hover_since_ns: int | None = None
        if airborne:
            self._navigator.hold(start_enu)

    # --- in

    def command(self, command: Command, state: BodyState, t_ns: int) -> tuple[Reply, ...]:
        """Carry out a command; one Ack to its sender, with the reason of a refusal as Text."""
        return self._commands.carry_out(command, state, t_ns)

    def setpoint(self, setpoint: LocalSetpoint, t_ns: int) -> tuple[Reply, ...]:
        """Take an external setpoint; one that cannot be flown is dropped whole and does not count as stream."""
        return self._stream.take(setpoint, self._state, self.home_enu[2], t_ns)

    def attitude_setpoint(self, setpoint: AttitudeTarget, t_ns: int) -> tuple[Reply, ...]:
        """Take an external attitude or rate setpoint, as `setpoint` does."""
        return self._stream.take_attitude(setpoint, t_ns)

    def manual(self, sticks: Sticks, t_ns: int) -> tuple[Reply, ...]:
        """Take a pilot's sticks."""
        if sticks.released:
            self._sticks.release()
        else:
            self._sticks.take(sticks, t_ns)
        return ()

    def heard_station(self, t_ns: int, system: int = 255) -> None:
        """A ground station's heartbeat came."""
        self._commander.heard_station(t_ns)

    def stream_group(self, stream: int) -> tuple[int, ...]:
        return ()

    def battery(self, reading: BatteryReading) -> None:
        """The power monitor's newest reading."""
        self._commander.charge = charge(reading.share, self.parameters)

    def hold(self, p_enu: Vec3) -> None:
        """Enter Hold at ``p_enu``."""
        self._commander.hold(p_enu)

    def step(self, state: BodyState, t_ns: int) -> tuple[Reply, ...]:
        """Watch the clock once a control period: failsafes, takeoff, landing, disarming."""
        self._state, self._t_ns = state, t_ns
        replies = self._commander.step(state, t_ns, descends=self._descends())
        self._watch_hover(state, t_ns)
        return replies

    # --- out: to the controller

    def target(self, state: BodyState) -> Setpoint:
        """What the controller flies now."""
        self._state = state
        mode = self._commander.mode
        if mode is not self._flown_mode:
            self._flown_mode = mode
            self._manual.enter(state)
        if not self._commander.armed or self._commander.terminated:
            return MotorsOff()
        if mode is Mode.OFFBOARD and self._stream.wanted is not None:
            return self._offboard(self._stream.wanted, state)
        if mode in _BY_STICKS and not self._sticks.lost(self._t_ns):
            self._navigator.forget()
            return self._by_sticks(mode, state)
        if self._flies_by_sticks:  # and they are gone
            self._navigator.hold(state.p_enu)
        return self._to_goal(mode, state)

    def turn(self, dt_s: float) -> None:
        """One physics step has passed: headings follow yaw rates, integrals and sticks go on."""
        mode, wanted = self._commander.mode, self._stream.wanted
        self._control.integrate(dt_s)
        if mode is Mode.OFFBOARD and isinstance(wanted, Trajectory):
            if math.isfinite(wanted.yaw_rad):
                self._navigator.yaw_rad = wanted.yaw_rad
            elif math.isfinite(wanted.yaw_rate_rad_s):
                self._turn_by(wanted.yaw_rate_rad_s * dt_s)
        elif self._flies_by_sticks:
            self._manual.advance(dt_s)
            self._turn_by(self._sticks.turn_rad_s() * dt_s)

    def _turn_by(self, angle_rad: float) -> None:
        self._navigator.yaw_rad = math.remainder(self._navigator.yaw_rad + angle_rad, math.tau)

    @property
    def _flies_by_sticks(self) -> bool:
        return self._commander.mode in _BY_STICKS and self.armed and self._navigator.goal is None

    def _offboard(self, wanted: Trajectory | AttitudeTarget, state: BodyState) -> Setpoint:
        if isinstance(wanted, AttitudeTarget):
            return flown_attitude(wanted)
        return self._accelerate(self._control.update(wanted, state))

    def _by_sticks(self, mode: Mode, state: BodyState) -> Setpoint:
        yaw_rad = self._navigator.yaw_rad
        if mode is Mode.POSITION:
            return self._accelerate(self._control.update(self._manual.trajectory(state, yaw_rad), state))
        setpoint = self._manual.attitude(mode, state, yaw_rad)
        return MotorsOff() if not self.airborne and not self._lifts(setpoint.thrust) else setpoint

    def _accelerate(self, a_enu: Vec3) -> Setpoint:
        if a_enu[2] < LIFT_OFF_M_S2 and not self.airborne:
            self._control.relax()
            return MotorsOff()
        tilt_deg, yaw_rad, last = float(self.parameters["MPC_TILTMAX_AIR"]), self._navigator.yaw_rad, self._accelerated
        if a_enu is not last.a_enu or yaw_rad != last.yaw_rad or tilt_deg != self._tilt_deg:
            self._tilt_deg = tilt_deg
            last = self._accelerated = AccelerationSetpoint(a_enu, yaw_rad, math.tan(math.radians(tilt_deg)))
        return last

    def _to_goal(self, mode: Mode, state: BodyState) -> Setpoint:
        goal = self._navigator.target(state)
        if goal is None or (not self.airborne and mode is not Mode.TAKEOFF):
            return MotorsOff()
        return goal if all(map(math.isfinite, goal.p_enu)) else _LEVEL_DESCENT

    def _lifts(self, thrust: float) -> bool:
        return thrust > LIFT_OFF_SHARE * float(self.parameters["MPC_THR_HOVER"])

    def _descends(self) -> bool:
        """What is flown asks for no climb: standing still on the ground is having landed."""
        mode, wanted = self._commander.mode, self._stream.wanted
        if mode is Mode.OFFBOARD and wanted is not None:
            if isinstance(wanted, AttitudeTarget):
                return not self._lifts(wanted.thrust)
            return self._control.a_enu[2] < LIFT_OFF_M_S2
        if self._flies_by_sticks:
            return not self._lifts(self._sticks.thrust()) or self._control.a_enu[2] < -LIFT_OFF_M_S2
        return self._navigator.descends

    def _watch_hover(self, state: BodyState, t_ns: int) -> None:
        in_hold = self._commander.mode is Mode.HOLD and self.landed is Landed.IN_AIR
        if not in_hold or not self._navigator.arrived(state, t_ns):
            self._hover_since_ns = None
        elif self._hover_since_ns is None:
            self._hover_since_ns = t_ns

    def hovering(self, t_ns: int) -> bool:
        """Airborne in Hold and at rest at the goal for half a second."""
        return self._hover_since_ns is not None and t_ns - self._hover_since_ns >= HOVER_NS

    # --- out: to the wire

    @property
    def mode(self) -> Mode:
        return self._commander.mode

    @property
    def armed(self) -> bool:
        return self._commander.armed

    @property
    def landed(self) -> Landed:
        return self._commander.landed

    @property
    def airborne(self) -> bool:
        return self._commander.airborne

    @property
    def home_enu(self) -> Vec3:
        return self._commander.home_enu

    @property
    def last_setpoint(self) -> LocalSetpoint | AttitudeTarget | None:
        return self._stream.last

    def streaming(self, t_ns: int) -> bool:
        """A setpoint stream of at least 2 Hz has run for half a second."""
        return self._stream.proven(t_ns)

    @property
    def custom_mode(self) -> int:
        return int(self._commander.mode)

    @property
    def base_mode(self) -> int:
        mode = self._commander.mode
        base = _CUSTOM_MODE | _STABILIZED
        if mode in _BY_STICKS or mode is Mode.MANUAL:
            base |= _MANUAL | (_GUIDED if mode is Mode.POSITION else 0)
        else:
            base |= _AUTO | _GUIDED
        return base | (_ARMED if self.armed else 0)

    @property
    def system_status(self) -> int:
        if self._commander.terminated:
            return _TERMINATED
        if self.armed:
            return _CRITICAL if self._commander.in_failsafe else _ACTIVE
        return _STANDBY

    @property
    def mode_name(self) -> str:
        return "TERMINATION" if self._commander.terminated else self._commander.mode.name

    @property
    def external(self) -> bool:
        return self._commander.mode is Mode.OFFBOARD

    @property
    def health(self) -> tuple[int, int, int]:
        """SYS_STATUS's sensors: present, enabled, healthy."""
        now = self._commander.situation(self._state, self._t_ns)
        can_arm = self.armed or not self._commander.refusals(self._state, self._t_ns)
        return health(now, self.parameters, can_arm=can_arm)

    @property
    def charge_state(self) -> int:
        """MAV_BATTERY_CHARGE_STATE."""
        return int(self._commander.charge)

    def position_target(self) -> LocalSetpoint | None:
        """What is flown, NaN and a bit of the mask for what is free; None on stopped motors or an attitude."""
        mode, wanted, yaw_rad = self._commander.mode, self._stream.wanted, self._navigator.yaw_rad
        if not self.armed or self._commander.terminated:
            return None
        if mode is Mode.OFFBOARD and wanted is not None:
            if isinstance(wanted, AttitudeTarget):
                return None
            rate = wanted.yaw_rate_rad_s if math.isfinite(wanted.yaw_rate_rad_s) else 0.0
            return echo(wanted.p_enu, self._control.v_enu, self._control.a_enu, yaw_rad, rate)
        goal = self._navigator.goal
        return None if goal is None else echo(goal.p_enu, FREE, FREE, goal.yaw_rad, 0.0)

    def attitude_target(self) -> AttitudeTarget | None:
        """The attitude or rates that are flown, None where the position loops fly."""
        wanted = self._stream.wanted
        return wanted if isinstance(wanted, AttitudeTarget) and self.armed and self.external else None

    def rates_hz(self, link: LinkName) -> Mapping[int, float]:
        """What streams unasked on ``link``."""
        return onboard_rates_hz(self._control_hz) if link is LinkName.ONBOARD else ground_rates_hz()
