"""A PX4-style commander as a pure state machine: no I/O, no clock; it is told the state and the time.

Mode changes, arming, takeoff, landing, offboard's proof of life and the failsafe on setpoint loss. The controller
flies what `target` returns. Behaviour follows PX4's user guide: "Offboard Mode" (setpoints at 2 Hz or more before and
during the mode), "Takeoff", "Land" (auto-disarm), and COM_OF_LOSS_T, COM_OBL_RC_ACT, COM_DISARM_LAND, COM_DISARM_PRFLT.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from sim_bridge.controller import AccelerationSetpoint, MotorsOff, PositionSetpoint, Setpoint
from sim_bridge.messages import (
    FORCE_DISARM,
    HOME_ALTITUDE_AMSL_M,
    NS_PER_S,
    Ack,
    AttitudeTarget,
    Cmd,
    Command,
    Landed,
    LinkName,
    LocalSetpoint,
    Mode,
    Reply,
    Result,
    Severity,
    Sticks,
    Text,
    Vec3,
)
from sim_bridge.parameters import Parameters
from sim_bridge.personality import BatteryReading
from sim_bridge.physics import BodyState
from sim_bridge.setpoints import YAW_IGNORED, YAW_RATE_IGNORED
from sim_bridge.stream import SetpointStream, acceleration

LANDED_NS = NS_PER_S // 2  # at rest on the ground for this long
HOVER_NS = NS_PER_S // 2
REST_M_S = 0.1
TOUCH_M = 0.03  # above resting height: still on the ground
ARRIVED_M = 0.05
LIFT_OFF_M_S2 = 0.2  # offboard setpoints with more upward acceleration leave the ground

ATTITUDE_QUATERNION, LOCAL_POSITION_NED, GLOBAL_POSITION_INT = 31, 32, 33
_SLOW_HZ: Mapping[int, float] = {0: 1.0, 245: 5.0, 1: 1.0, 242: 1.0, 49: 0.2, 24: 1.0, 147: 0.5}

_REQUESTABLE = (Mode.HOLD, Mode.TAKEOFF, Mode.LAND, Mode.POSITION, Mode.OFFBOARD)


class Autopilot:
    """Modes, arming and failsafes of one vehicle.

    Args:
        start_enu: where it starts; above resting height it starts armed, in Hold. Home, from which takeoff
            altitudes count, is the ground z = 0 below [m].
        rest_height_m: height of the vehicle's centre above the ground when it stands.
        yaw_rad: initial heading, counter-clockwise from east.
        control_hz: the rate of the state on the onboard link.
        physics_hz: the fastest stream.
    """

    kind = 12  # MAV_AUTOPILOT_PX4
    position_valid = True
    lockstep = False
    up_since_ns = 0
    capabilities = 2 | 8 | 16 | 128 | 8192  # float and bytewise parameters, COMMAND_INT, local setpoints, MAVLink 2
    version = 1 << 24 | 15 << 16 | 255  # 1.15.0, release

    def __init__(
        self,
        *,
        start_enu: Vec3,
        rest_height_m: float,
        yaw_rad: float,
        control_hz: int = 20,
        physics_hz: int = 240,
    ) -> None:
        self.max_rate_hz = float(physics_hz)
        self._control_hz = float(control_hz)
        airborne = start_enu[2] > rest_height_m + TOUCH_M
        self.parameters = Parameters()
        self.home_enu: Vec3 = (start_enu[0], start_enu[1], 0.0)
        self.mode = Mode.HOLD
        self.armed = airborne
        self.landed = Landed.IN_AIR if airborne else Landed.ON_GROUND
        self._stream = SetpointStream()
        self._rest_z_m = rest_height_m
        self._yaw_rad = yaw_rad
        # what every mode but OFFBOARD flies to
        self._goal: PositionSetpoint | None = PositionSetpoint(start_enu, yaw_rad) if airborne else None
        self._armed_ns = 0
        self._rest_since_ns: int | None = None
        self._hover_since_ns: int | None = None
        self._handlers: dict[int, Callable[[Command, BodyState, int], tuple[Result, str]]] = {
            Cmd.COMPONENT_ARM_DISARM: self._arm_disarm,
            Cmd.NAV_TAKEOFF: self._takeoff,
            Cmd.NAV_LAND: self._land,
            Cmd.DO_SET_MODE: self._set_mode,
        }

    def command(self, command: Command, state: BodyState, t_ns: int) -> tuple[Reply, ...]:
        """Carry out a command; one Ack to its sender, with the reason of a refusal as Text."""
        handler = self._handlers.get(command.command)
        if handler is None:
            return (Ack(command.command, Result.UNSUPPORTED, command.sender),)
        result, reason = handler(command, state, t_ns)
        ack = Ack(command.command, result, command.sender)
        return (ack,) if result is Result.ACCEPTED else (Text(Severity.CRITICAL, reason), ack)

    def setpoint(self, setpoint: LocalSetpoint, t_ns: int) -> tuple[Reply, ...]:
        """Take an external setpoint; one that cannot be flown is dropped whole and does not count as stream."""
        return self._stream.take(setpoint, t_ns)

    def attitude_setpoint(self, setpoint: AttitudeTarget, t_ns: int) -> tuple[Reply, ...]:
        return ()

    def manual(self, sticks: Sticks, t_ns: int) -> tuple[Reply, ...]:
        return ()

    def heard_station(self, t_ns: int, system: int = 255) -> None:
        pass

    def stream_group(self, stream: int) -> tuple[int, ...]:
        return ()

    def battery(self, reading: BatteryReading) -> None:
        pass

    @property
    def custom_mode(self) -> int:
        return int(self.mode)

    @property
    def base_mode(self) -> int:
        base = 1 | 8 * (self.mode is Mode.OFFBOARD) | 4 * (self.mode is not Mode.MANUAL) | 16
        return base | (128 if self.armed else 0)

    @property
    def system_status(self) -> int:
        return 4 if self.armed else 3

    @property
    def mode_name(self) -> str:
        return self.mode.name

    @property
    def external(self) -> bool:
        return self.mode is Mode.OFFBOARD

    def position_target(self) -> LocalSetpoint | None:
        return self.last_setpoint

    def rates_hz(self, link: LinkName) -> Mapping[int, float]:
        if link is LinkName.ONBOARD:
            return {**_SLOW_HZ, ATTITUDE_QUATERNION: self._control_hz, LOCAL_POSITION_NED: self._control_hz}
        return {**_SLOW_HZ, ATTITUDE_QUATERNION: 10.0, LOCAL_POSITION_NED: 10.0, GLOBAL_POSITION_INT: 5.0}

    @property
    def last_setpoint(self) -> LocalSetpoint | None:
        return self._stream.last

    def streaming(self, t_ns: int) -> bool:
        """A setpoint stream of at least 2 Hz has run for half a second."""
        return self._stream.proven(t_ns)

    def step(self, state: BodyState, t_ns: int) -> tuple[Reply, ...]:
        """Watch the clock once a control period: failsafe, takeoff, landing, disarming."""
        replies: list[Reply] = []
        if self.mode is Mode.OFFBOARD and self.armed and self._stream.lost(t_ns, self.parameters["COM_OF_LOSS_T"]):
            replies.append(self._lose_offboard(state))
        if self.armed:
            self._watch_ground(state, t_ns)
            self._watch_takeoff(state)
            replies.extend(self._watch_disarm(t_ns))
        self._watch_hover(state, t_ns)
        return tuple(replies)

    def target(self, state: BodyState) -> Setpoint:
        """What the controller flies now."""
        if not self.armed:
            return MotorsOff()
        setpoint = self.last_setpoint
        if self.mode is Mode.OFFBOARD and setpoint is not None:
            if self.landed is Landed.ON_GROUND and setpoint.a_enu[2] < LIFT_OFF_M_S2:
                return MotorsOff()
            a_enu = acceleration(setpoint, state.v_enu, gain_per_s=self.parameters["MPC_XY_VEL_P_ACC"])
            return AccelerationSetpoint(a_enu, self._yaw_rad)
        if self._goal is None or (self.landed is Landed.ON_GROUND and self.mode is not Mode.TAKEOFF):
            return MotorsOff()
        return self._goal

    def turn(self, dt_s: float) -> None:
        """Let the heading follow the setpoint's yaw, or its yaw rate over ``dt_s``."""
        setpoint = self.last_setpoint
        if self.mode is not Mode.OFFBOARD or setpoint is None:
            return
        if not setpoint.type_mask & YAW_IGNORED:
            self._yaw_rad = setpoint.yaw_rad
        elif not setpoint.type_mask & YAW_RATE_IGNORED:
            self._yaw_rad = math.remainder(self._yaw_rad + setpoint.yaw_rate_rad_s * dt_s, math.tau)

    def hovering(self, t_ns: int) -> bool:
        """Airborne in Hold and at rest at the goal for half a second."""
        return self._hover_since_ns is not None and t_ns - self._hover_since_ns >= HOVER_NS

    @property
    def airborne(self) -> bool:
        return self.landed is not Landed.ON_GROUND

    def hold(self, p_enu: Vec3) -> None:
        """Enter Hold at ``p_enu``."""
        self._enter(Mode.HOLD, PositionSetpoint(p_enu, self._yaw_rad))

    # --- commands

    def _arm_disarm(self, command: Command, state: BodyState, t_ns: int) -> tuple[Result, str]:
        if command.params[0] >= 0.5:
            return self._arm(t_ns)
        if self.armed and self.airborne and command.params[1] != FORCE_DISARM:
            return Result.TEMPORARILY_REJECTED, "Disarming denied: not landed"
        self._disarm()
        return Result.ACCEPTED, ""

    def _arm(self, t_ns: int) -> tuple[Result, str]:
        if self.armed:
            return Result.ACCEPTED, ""
        if self.mode is Mode.OFFBOARD and not self.streaming(t_ns):
            return Result.TEMPORARILY_REJECTED, "Arming denied: no offboard setpoints"
        self.armed = True
        self._armed_ns = t_ns
        self._rest_since_ns = None
        return Result.ACCEPTED, ""

    def _disarm(self) -> None:
        self.armed = False
        if self.mode in (Mode.TAKEOFF, Mode.LAND):
            self.mode = Mode.HOLD
        self._goal = None

    def _takeoff(self, command: Command, state: BodyState, t_ns: int) -> tuple[Result, str]:
        if not self.armed:
            return Result.TEMPORARILY_REJECTED, "Takeoff denied: not armed"
        altitude_amsl_m = command.params[6]  # NaN: MIS_TAKEOFF_ALT, as MAVSDK asks for it
        x, y, z = state.p_enu
        above_home_m = self.parameters["MIS_TAKEOFF_ALT"]
        if math.isfinite(altitude_amsl_m):
            above_home_m = altitude_amsl_m - HOME_ALTITUDE_AMSL_M
        climb_to_m = max(self.home_enu[2] + above_home_m, z if self.airborne else self._rest_z_m + ARRIVED_M)
        speed_m_s = float(self.parameters["MPC_TKO_SPEED"])
        self._enter(Mode.TAKEOFF, PositionSetpoint((x, y, climb_to_m), self._yaw_rad, v_max_m_s=speed_m_s))
        return Result.ACCEPTED, ""

    def _land(self, command: Command, state: BodyState, t_ns: int) -> tuple[Result, str]:
        self._descend(state)
        return Result.ACCEPTED, ""

    def _set_mode(self, command: Command, state: BodyState, t_ns: int) -> tuple[Result, str]:
        flags, main, sub = command.params[:3]
        if not all(math.isfinite(x) and 0.0 <= x <= 255.0 for x in (flags, main, sub)) or not int(flags) & 1:
            return Result.DENIED, "Mode denied: expected a custom mode (param1 bit 1)"
        number = int(main) << 16 | int(sub) << 24
        mode = next((m for m in _REQUESTABLE if m == number), None)
        if mode is None:
            return Result.TEMPORARILY_REJECTED, f"Mode {int(main)}/{int(sub)} denied: not available here"
        if mode is Mode.OFFBOARD:
            return self._enter_offboard(t_ns)
        if mode is Mode.TAKEOFF:
            return self._takeoff(_takeoff_to_default(command), state, t_ns)
        if mode is Mode.LAND:
            return self._land(command, state, t_ns)
        if self.mode is not mode:
            self.hold(state.p_enu)
            self.mode = mode
        return Result.ACCEPTED, ""

    def _enter_offboard(self, t_ns: int) -> tuple[Result, str]:
        if not self.streaming(t_ns):
            return Result.TEMPORARILY_REJECTED, "Offboard denied: no setpoint stream"
        self.mode = Mode.OFFBOARD
        return Result.ACCEPTED, ""

    def _descend(self, state: BodyState) -> None:
        x, y, _ = state.p_enu
        below = (x, y, self.home_enu[2] - 10.0)  # never reached: descends at the speed limit until it stands
        speed_m_s = float(self.parameters["MPC_LAND_SPEED"])
        self._enter(Mode.LAND, PositionSetpoint(below, self._yaw_rad, v_max_m_s=speed_m_s))

    def _enter(self, mode: Mode, goal: PositionSetpoint) -> None:
        self.mode = mode
        self._goal = goal
        self._rest_since_ns = None
        self._hover_since_ns = None

    # --- watching

    def _lose_offboard(self, state: BodyState) -> Reply:
        if self.parameters["COM_OBL_RC_ACT"] == 4:
            self._descend(state)
            return Text(Severity.CRITICAL, "Failsafe: offboard setpoints lost, landing")
        self.hold(state.p_enu)
        return Text(Severity.CRITICAL, "Failsafe: offboard setpoints lost, holding")

    def _watch_ground(self, state: BodyState, t_ns: int) -> None:
        grounded = state.p_enu[2] < self._rest_z_m + TOUCH_M
        if not grounded:
            self._rest_since_ns = None
            self.landed = {Mode.TAKEOFF: Landed.TAKEOFF, Mode.LAND: Landed.LANDING}.get(self.mode, Landed.IN_AIR)
            return
        if self.landed is Landed.ON_GROUND or math.hypot(*state.v_enu) > REST_M_S or not self._descending():
            self._rest_since_ns = None
            return
        if self._rest_since_ns is None:
            self._rest_since_ns = t_ns
        if t_ns - self._rest_since_ns >= LANDED_NS:
            self.landed = Landed.ON_GROUND
            self._armed_ns = t_ns

    def _descending(self) -> bool:
        if self.mode is Mode.OFFBOARD and self.last_setpoint is not None:
            return self.last_setpoint.a_enu[2] < LIFT_OFF_M_S2
        return self._goal is None or self._goal.p_enu[2] < self._rest_z_m

    def _watch_takeoff(self, state: BodyState) -> None:
        goal = self._goal
        if self.mode is not Mode.TAKEOFF or goal is None:
            return
        if math.dist(state.p_enu, goal.p_enu) < ARRIVED_M and math.hypot(*state.v_enu) < REST_M_S:
            self.landed = Landed.IN_AIR
            self.hold(goal.p_enu)

    def _watch_disarm(self, t_ns: int) -> tuple[Reply, ...]:
        if self.landed is not Landed.ON_GROUND or self.mode is Mode.TAKEOFF:
            return ()
        landing = self.mode is Mode.LAND
        delay_s = self.parameters["COM_DISARM_LAND" if landing else "COM_DISARM_PRFLT"]
        if (delay_s > 0 or landing) and t_ns - self._armed_ns >= delay_s * NS_PER_S:
            self._disarm()
            return (Text(Severity.INFO, "Disarmed by landing" if landing else "Disarmed by auto preflight disarming"),)
        return ()

    def _watch_hover(self, state: BodyState, t_ns: int) -> None:
        goal = self._goal
        at_rest = (
            goal is not None
            and self.mode is Mode.HOLD
            and self.landed is Landed.IN_AIR
            and math.dist(state.p_enu, goal.p_enu) < ARRIVED_M
            and math.hypot(*state.v_enu) < REST_M_S
        )
        if not at_rest:
            self._hover_since_ns = None
        elif self._hover_since_ns is None:
            self._hover_since_ns = t_ns


def _takeoff_to_default(command: Command) -> Command:
    """A takeoff to MIS_TAKEOFF_ALT out of a request for the takeoff mode."""
    return Command(Cmd.NAV_TAKEOFF, (math.nan,) * 7, command.sender)
