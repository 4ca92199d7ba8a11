"""What each of ArduCopter's modes asks of the `Follower`, and the stages of a return.

Speeds and accelerations are the parameters'; all motion is limited in jerk by PSC_JERK_XY and PSC_JERK_Z.
Sources: ArduCopter's mode_*.cpp and the Copter parameter list.
"""

from __future__ import annotations

import math
from dataclasses import replace
from enum import IntEnum

from sim_bridge.ardupilot_follower import Plan
from sim_bridge.ardupilot_guided import Guided, Submode, turned
from sim_bridge.ardupilot_parameters import ArduParameters
from sim_bridge.messages import Sticks, Vec3
from sim_bridge.physics import BodyState
from sim_bridge.shaping import Axes, Goal, Limits

_G_M_S2 = 9.81
_LAND_SLOWLY_M = 10.0  # LAND_ALT_LOW
_DEAD_ZONE = 0.05  # of a stick
_NEAR_M = 0.3
_STABILIZE_M_S2 = 5.0  # vertical acceleration of full throttle, from hover
_POSITION_FREE, _VELOCITY_FREE = 1 << 4, 1 << 5  # GUID_OPTIONS
_STILL2: Axes = (0.0, 0.0)
_STILL1: Axes = (0.0,)


class ArduMode(IntEnum):
    """Custom modes (ArduCopter mode.h)."""

    STABILIZE = 0
    ALT_HOLD = 2
    AUTO = 3
    GUIDED = 4
    LOITER = 5
    RTL = 6
    LAND = 9
    BRAKE = 17


class Return:
    """RTL: climb, fly home, wait there, land."""

    def __init__(self, state: BodyState, home_enu: Vec3, parameters: ArduParameters) -> None:
        x, y, z = state.p_enu
        level_m = math.dist((x, y), home_enu[:2])
        slope = float(parameters["RTL_CONE_SLOPE"])
        above_m = parameters.metres("RTL_ALT")
        if slope > 0.0:
            above_m = min(above_m, level_m * slope)
        self.height_m = max(z + parameters.metres("RTL_CLIMB_MIN"), home_enu[2] + above_m)
        self._from: Vec3 = (x, y, self.height_m)
        self._above: Vec3 = (home_enu[0], home_enu[1], self.height_m)
        self._stage = 0  # climb, home, wait, land
        self._wait_ns = round(float(parameters["RTL_LOIT_TIME"]) * 1e6)
        self._since_ns = 0

    @property
    def landing(self) -> bool:
        return self._stage == 3

    @property
    def goal_enu(self) -> Vec3:
        return self._from if self._stage == 0 else self._above

    def step(self, state: BodyState, t_ns: int) -> None:
        """Go on to the next stage where this one is done."""
        if self._stage < 2 and math.dist(state.p_enu, self.goal_enu) < _NEAR_M:
            self._stage += 1
            self._since_ns = t_ns
        elif self._stage == 2 and t_ns - self._since_ns >= self._wait_ns:
            self._stage = 3


class Plans:
    """Plans by mode, under the present parameters."""

    def __init__(self, parameters: ArduParameters) -> None:
        self._parameters = parameters

    def guided(self, guided: Guided, t_ns: int) -> Plan:
        """Targets of the submode; those that aged beyond GUID_TIMEOUT are taken for zero velocity."""
        p, v, a = guided.p_enu, guided.v_enu, guided.a_enu
        match guided.submode:
            case Submode.TAKEOFF | Submode.POSITION:
                return self._to(p)
            case _ if guided.lost(t_ns, float(self._parameters["GUID_TIMEOUT"])):
                return self.stop()
            case Submode.POSITION_VELOCITY:
                level, up = Goal(a[:2], v[:2], p[:2]), Goal(a[2:], v[2:], p[2:])
            case Submode.VELOCITY:
                level, up = Goal(a[:2], v[:2]), Goal(a[2:], v[2:])
            case _:
                level, up = Goal(a[:2]), Goal(a[2:])
        options = int(self._parameters["GUID_OPTIONS"])
        opens = guided.submode is Submode.ACCELERATION
        return Plan(
            level,
            self._level_limits(),
            up,
            self._up_limits(),
            holds_position=not options & (_POSITION_FREE | _VELOCITY_FREE * opens),
            holds_velocity=not (opens and options & _VELOCITY_FREE),
        )

    def stop(self) -> Plan:
        """Brake to a stop and stay: BRAKE, and GUIDED without a target."""
        return Plan(Goal(_STILL2, _STILL2), self._level_limits(), Goal(_STILL1, _STILL1), self._up_limits())

    def land(self, above_home_m: float) -> Plan:
        """Stop over the place and sink, slowly below 10 m."""
        name = "LAND_SPEED" if above_home_m < _LAND_SLOWLY_M else "WPNAV_SPEED_DN"
        sink_m_s = self._parameters.positive(name) * 0.01
        return Plan(Goal(_STILL2, _STILL2), self._level_limits(), Goal(_STILL1, (-sink_m_s,)), self._up_limits())

    def back(self, way: Return, above_home_m: float) -> Plan:
        return self.land(above_home_m) if way.landing else self._to(way.goal_enu)

    def loiter(self, sticks: Sticks, yaw_rad: float) -> Plan:
        """Sticks are velocities of the nose's frame; centred they brake, then hold the position."""
        speed_m_s = self._parameters.positive("LOIT_SPEED") * 0.01
        forward, left, _ = turned((_dead(sticks.forward), _dead(sticks.left), 0.0), yaw_rad)
        level = Goal(_STILL2, (forward * speed_m_s, left * speed_m_s))
        return Plan(level, self._level_limits(), self._climb(sticks), self._up_limits())

    def lean(self, sticks: Sticks, yaw_rad: float, *, holds_height: bool) -> Plan:
        """ALT_HOLD and STABILIZE: sticks are lean angles, so accelerations; STABILIZE's throttle one as well."""
        most_rad = self.lean_max_rad
        ax, ay, _ = turned(
            (
                _G_M_S2 * math.tan(_dead(sticks.forward) * most_rad),
                _G_M_S2 * math.tan(_dead(sticks.left) * most_rad),
                0.0,
            ),
            yaw_rad,
        )
        level = Limits(0.0, 1.0, 1e3)  # angles are not limited in jerk
        up = self._climb(sticks) if holds_height else Goal((_STABILIZE_M_S2 * _dead(sticks.up),))
        return Plan(Goal((ax, ay)), level, up, self._up_limits(), holds_velocity=False, holds_height=holds_height)

    def climbing(self, plan: Plan, z_m: float) -> Plan:
        """``plan`` with its height replaced by a climb to ``z_m``."""
        return replace(plan, up=Goal(_STILL1, _STILL1, (z_m,)), up_limits=self._up_limits(), holds_height=True)

    @property
    def lean_max_rad(self) -> float:
        return math.radians(min(max(float(self._parameters["ANGLE_MAX"]) * 0.01, 10.0), 80.0))

    def _to(self, p: Vec3) -> Plan:
        level, up = Goal(_STILL2, _STILL2, p[:2]), Goal(_STILL1, _STILL1, p[2:])
        return Plan(level, self._level_limits(), up, self._up_limits())

    def _climb(self, sticks: Sticks) -> Goal:
        return Goal(_STILL1, (_dead(sticks.up) * self._parameters.positive("PILOT_SPEED_UP") * 0.01,))

    def _level_limits(self) -> Limits:
        of = self._parameters.positive
        return Limits(of("WPNAV_SPEED") * 0.01, of("WPNAV_ACCEL") * 0.01, of("PSC_JERK_XY"))

    def _up_limits(self) -> Limits:
        of = self._parameters.positive
        speed_m_s = min(of("WPNAV_SPEED_UP"), of("WPNAV_SPEED_DN")) * 0.01
        return Limits(speed_m_s, of("WPNAV_ACCEL_Z") * 0.01, of("PSC_JERK_Z"))


def _dead(stick: float) -> float:
    """A stick's deflection -1 to 1 with a dead zone about its centre."""
    return 0.0 if abs(stick) < _DEAD_ZONE else min(max(stick, -1.0), 1.0)
