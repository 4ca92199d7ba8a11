"""What ArduCopter's modes do with the vehicle: taking off, flying, landing, and when it disarms by itself.

Whether it may (arming, mode changes, failsafes) is `ardupilot`'s business.
"""

from __future__ import annotations

import math

from sim_bridge.ardupilot_follower import Follower, Plan
from sim_bridge.ardupilot_ground import REST_M_S, Ground
from sim_bridge.ardupilot_guided import Guided, Nose, Submode
from sim_bridge.ardupilot_parameters import ArduParameters
from sim_bridge.ardupilot_plans import ArduMode, Plans, Return
from sim_bridge.controller import AccelerationSetpoint, MotorsOff, Setpoint
from sim_bridge.messages import NS_PER_S, Landed, Sticks, Vec3
from sim_bridge.physics import BodyState

STICKS_NS = 3 * NS_PER_S  # RC_OVERRIDE_TIME
ARRIVED_M = 0.1
LIFT_STICK = 0.1  # more throttle than this above the centre leaves the ground
PILOTED = (ArduMode.STABILIZE, ArduMode.ALT_HOLD, ArduMode.LOITER)
_CENTRED = Sticks(0.0, 0.0, 0.0, 0.0)
_STICK_YAW_RAD_S = math.radians(90.0)  # PILOT_Y_RATE is 202.5 deg/s on the real one


class Copter:
    """The vehicle under one mode at a time."""

    def __init__(self, start_enu: Vec3, yaw_rad: float, rest_z_m: float, parameters: ArduParameters) -> None:
        self.state = BodyState(start_enu, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        self.t_ns = 0
        self.home_enu: Vec3 = (start_enu[0], start_enu[1], 0.0)
        self.ground = Ground(rest_z_m)
        airborne = not self.ground.touches(start_enu[2])
        self.armed = airborne
        self.landed = Landed.IN_AIR if airborne else Landed.ON_GROUND
        self.mode = ArduMode.LOITER if airborne else ArduMode.STABILIZE
        self.guided = Guided()
        self.nose = Nose(yaw_rad)
        self._parameters = parameters
        self._plans = Plans(parameters)
        self._follower = Follower(self.state)
        self._return: Return | None = None
        self._climb_to_m: float | None = None  # a takeoff
        self._sticks: tuple[int, Sticks] | None = None
        self._plan: Plan | None = None  # flown in this physics step
        self._idle_since_ns = 0  # armed or landed

    @property
    def airborne(self) -> bool:
        return self.landed is not Landed.ON_GROUND

    @property
    def landing(self) -> bool:
        return self.mode is ArduMode.LAND or (self._return is not None and self._return.landing)

    # --- what is done to it

    def arm(self) -> None:
        self.armed = True
        self._idle_since_ns = self.t_ns
        self.ground.forget()
        self.guided.begin()

    def disarm(self) -> None:
        self.armed = False
        if self.ground.touches(self.state.p_enu[2]):
            self.landed = Landed.ON_GROUND
        self._climb_to_m = None
        self.guided.begin()

    def enter(self, mode: ArduMode) -> None:
        """Change the mode; what it flies begins at the present position and velocity."""
        self.mode = mode
        self._climb_to_m = None
        self.ground.forget()
        self._follower.anchor(self.state)
        self._return = Return(self.state, self.home_enu, self._parameters) if mode is ArduMode.RTL else None
        if mode is ArduMode.GUIDED:
            self.guided.begin()
            self.nose.ahead()
        else:
            self.nose.hold()

    def take_off(self, z_m: float) -> None:
        """Climb to ``z_m`` in the present mode."""
        self._climb_to_m = z_m
        if self.mode is ArduMode.GUIDED:
            x, y, _ = self.state.p_enu
            self.guided.take_off((x, y, z_m))
            self.nose.hold()
        self._follower.rest(self.state)

    def anchor(self) -> None:
        """GUIDED has changed its submode: begin where it is, under the acceleration of before."""
        self._follower.anchor(self.state)

    def give(self, sticks: Sticks | None) -> None:
        """The pilot's sticks now; None: given back."""
        self._sticks = None if sticks is None else (self.t_ns, sticks)

    # --- every physics step

    def target(self, state: BodyState) -> Setpoint:
        """What the controller flies now."""
        self.state = state
        flies = self.armed and (self.airborne or self._climbs())
        self._plan = self._planned() if flies else None
        if self._plan is None:
            return MotorsOff()
        a_enu = self._follower.acceleration(self._plan, state, self._plans.lean_max_rad)
        return AccelerationSetpoint(a_enu, self.nose.yaw_rad)

    def move(self, dt_s: float) -> None:
        """The shaped reference and the nose move on."""
        if self._plan is None:
            self._follower.rest(self.state)
            return
        self._follower.move(self._plan, self.state, dt_s)
        if self.mode in PILOTED:
            self.nose.rate_rad_s = self._piloted().turn_left * _STICK_YAW_RAD_S
        elif self.mode is ArduMode.GUIDED and self.guided.lost(self.t_ns, float(self._parameters["GUID_TIMEOUT"])):
            self.nose.stop_turning()
        self.nose.turn(self._follower.v_enu, dt_s)

    def _planned(self) -> Plan:
        plans, above_m = self._plans, self.state.p_enu[2] - self.home_enu[2]
        match self.mode:
            case ArduMode.GUIDED:
                return plans.guided(self.guided, self.t_ns)
            case ArduMode.BRAKE:
                return plans.stop()
            case ArduMode.RTL if self._return is not None:
                return plans.back(self._return, above_m)
            case ArduMode.LAND:
                return plans.land(above_m)
            case ArduMode.LOITER:
                plan = plans.loiter(self._piloted(), self.nose.yaw_rad)
            case _:
                holds_height = self.mode is ArduMode.ALT_HOLD
                plan = plans.lean(self._piloted(), self.nose.yaw_rad, holds_height=holds_height)
        return plan if self._climb_to_m is None else plans.climbing(plan, self._climb_to_m)

    def _piloted(self) -> Sticks:
        """The pilot's sticks; centred where none were heard for RC_OVERRIDE_TIME: there is no other receiver."""
        if self._sticks is None or self.t_ns - self._sticks[0] > STICKS_NS:
            return _CENTRED
        return self._sticks[1]

    def _climbs(self) -> bool:
        """Wants to leave the ground."""
        if self.mode is ArduMode.GUIDED:
            return self.guided.taking_off
        return self.mode in PILOTED and (self._climb_to_m is not None or self._piloted().up > LIFT_STICK)

    # --- every control period

    def watch(self, state: BodyState, t_ns: int) -> None:
        """Takeoff, landing, disarming, the stages of a return."""
        self.state, self.t_ns = state, t_ns
        if self.armed:
            self._watch_ground()
            self._watch_takeoff()
            self._watch_idle()
            if self._return is not None:
                self._return.step(state, t_ns)
        self.ground.watch_hover(state, t_ns, holds=self._holds())

    def _watch_ground(self) -> None:
        state, climbs = self.state, self._climbs() or self._follower.v_enu[2] > REST_M_S
        landed = self.ground.landed(state, self.t_ns, climbs=climbs)
        if not self.airborne:
            if not self.ground.touches(state.p_enu[2]):
                self.landed = self._in_the_air()
            return
        self.landed = Landed.ON_GROUND if landed else self._in_the_air()
        if landed:
            self._idle_since_ns = self.t_ns
            if self.landing:
                self.disarm()

    def _in_the_air(self) -> Landed:
        if self.landing:
            return Landed.LANDING
        taking_off = self.guided.taking_off if self.mode is ArduMode.GUIDED else self._climb_to_m is not None
        return Landed.TAKEOFF if taking_off else Landed.IN_AIR

    def _watch_takeoff(self) -> None:
        """A takeoff that has arrived; one that the throttle stick begins, to PILOT_TKOFF_ALT."""
        state, goal_m = self.state, self._climb_to_m
        if goal_m is None:
            above_m = self._parameters.metres("PILOT_TKOFF_ALT")
            by_stick = self.mode in (ArduMode.LOITER, ArduMode.ALT_HOLD) and self._climbs()
            if by_stick and not self.airborne and above_m > 0.0:
                self._climb_to_m = self.home_enu[2] + above_m
        elif self.airborne and abs(state.p_enu[2] - goal_m) < ARRIVED_M and abs(state.v_enu[2]) < REST_M_S:
            self._climb_to_m = None
            if self.guided.submode is Submode.TAKEOFF:
                self.guided.took_off = True
            self.landed = self._in_the_air()

    def _watch_idle(self) -> None:
        """DISARM_DELAY: armed on the ground without climbing."""
        if self.airborne or self._climbs():
            self._idle_since_ns = self.t_ns
        delay_s = self._parameters["DISARM_DELAY"]
        if self.armed and delay_s > 0 and self.t_ns - self._idle_since_ns >= delay_s * NS_PER_S:
            self.disarm()

    def _holds(self) -> bool:
        """In the air, and its mode holds a position now."""
        if not self.armed or self.landed is not Landed.IN_AIR:
            return False
        if self.mode is ArduMode.GUIDED:
            return self.guided.submode in (Submode.TAKEOFF, Submode.POSITION) or not self.guided.followed
        return self.mode in (ArduMode.LOITER, ArduMode.BRAKE)
