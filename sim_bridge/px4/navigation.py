"""Where the automatic modes fly: takeoff, hold, goto, return and land, each as a goal for the position loops.

Return (AUTO.RTL) climbs to the return altitude, flies home at it, descends to RTL_DESCEND_ALT and lands. The return
altitude is RTL_RETURN_ALT above home; nearer than RTL_MIN_DIST it is the height of a cone of half angle RTL_CONE_ANG
that stands on home, but twice NAV_ACC_RAD at least, and within NAV_ACC_RAD twice the distance. It never descends to it.

Source: PX4 user guide, "Return Mode (Multicopter)" and its parameters.
"""

from __future__ import annotations

import math
from enum import Enum

from sim_bridge.controller import PositionSetpoint
from sim_bridge.messages import NS_PER_S, Vec3
from sim_bridge.personality import ParameterTable
from sim_bridge.physics import BodyState

ARRIVED_M = 0.05
REST_M_S = 0.1
NEAR_M = 0.5  # wind and a wrong hover thrust hold it off its goal by this much
_PATIENT_NS = 3 * NS_PER_S
_HOLD_M_S = 2.0  # back to where it was caught
_SHARE_OF_BRAKING = 0.7  # of MPC_ACC_HOR, so that the loops follow the braking curve
_LOOP_HZ = 4.0  # velocity loop of the controller: v* - v = a / this


class Phase(Enum):
    """Of Return."""

    CLIMB = "climb"
    HOME = "home"
    DESCEND = "descend"
    WAIT = "wait"
    LAND = "land"


class Navigator:
    """The goal of the mode that flies now; None where there is none: on the ground, or not in an automatic mode."""

    def __init__(self, parameters: ParameterTable, *, rest_z_m: float, yaw_rad: float) -> None:
        self._parameters = parameters
        self._rest_z_m = rest_z_m
        self.yaw_rad = yaw_rad
        self.goal: PositionSetpoint | None = None
        self.phase: Phase | None = None  # of Return
        self.cruise_m_s: float | None = None  # DO_CHANGE_SPEED, until disarmed
        self._limited = False  # by cruise and climb speeds
        self._near_since_ns: int | None = None
        self._waits_since_ns = 0

    def forget(self) -> None:
        """No goal any more."""
        self.goal, self.phase, self._limited, self._near_since_ns = None, None, False, None

    def hold(self, p_enu: Vec3) -> None:
        self._aim(PositionSetpoint(p_enu, self.yaw_rad, _HOLD_M_S))

    def go(self, p_enu: Vec3, yaw_rad: float) -> None:
        """Goto: at cruise speed to ``p_enu``; a NaN heading keeps the present one."""
        if math.isfinite(yaw_rad):
            self.yaw_rad = yaw_rad
        self._aim(PositionSetpoint(p_enu, self.yaw_rad), limited=True)

    def takeoff(self, state: BodyState, to_z_m: float) -> None:
        x, y, _ = state.p_enu
        speed_m_s = float(self._parameters["MPC_TKO_SPEED"])
        self._aim(PositionSetpoint((x, y, to_z_m), self.yaw_rad, speed_m_s))

    def land(self, state: BodyState) -> None:
        """Descend where it is; without a position, just descend."""
        x, y, _ = state.p_enu
        below = (x, y, self._rest_z_m - 10.0)  # never reached: descends at the speed limit until it stands
        self._aim(PositionSetpoint(below, self.yaw_rad, float(self._parameters["MPC_LAND_SPEED"])))

    def go_home(self, state: BodyState, home_enu: Vec3) -> None:
        x, y, _ = state.p_enu
        self._aim(PositionSetpoint((x, y, self.return_z_m(state.p_enu, home_enu)), self.yaw_rad), limited=True)
        self.phase = Phase.CLIMB

    def return_z_m(self, p_enu: Vec3, home_enu: Vec3) -> float:
        """The return altitude from ``p_enu``, local [m]."""
        get = self._parameters.__getitem__
        distance_m = math.dist(p_enu[:2], home_enu[:2])
        above_m, radius_m, cone_deg = (
            float(get("RTL_RETURN_ALT")),
            float(get("NAV_ACC_RAD")),
            float(get("RTL_CONE_ANG")),
        )
        if distance_m <= radius_m:
            above_m = min(above_m, 2.0 * distance_m)
        elif cone_deg > 0.0 and distance_m <= get("RTL_MIN_DIST"):
            cone_m = 0.0 if cone_deg >= 90.0 else distance_m / math.tan(math.radians(cone_deg))
            above_m = max(min(above_m, cone_m), min(above_m, 2.0 * radius_m))
        return max(p_enu[2], home_enu[2] + above_m)

    def _aim(self, goal: PositionSetpoint, *, limited: bool = False) -> None:
        self.goal, self.phase, self._limited, self._near_since_ns = goal, None, limited, None

    @property
    def goes(self) -> bool:
        """On its way, not holding a place."""
        return self.goal is not None and self._limited

    @property
    def descends(self) -> bool:
        """Its goal is the ground."""
        return self.goal is None or self.goal.p_enu[2] < self._rest_z_m

    def watch(self, state: BodyState, home_enu: Vec3, t_ns: int) -> None:
        """Once a control period: the next phase of Return, and how long it has been near its goal."""
        goal = self.goal
        if goal is None:
            return
        if math.dist(state.p_enu, goal.p_enu) > NEAR_M:
            self._near_since_ns = None
        elif self._near_since_ns is None:
            self._near_since_ns = t_ns
        if self.phase is not None and self._phase_done(state, home_enu, t_ns):
            self._next_phase(state, home_enu, t_ns)

    def arrived(self, state: BodyState, t_ns: int) -> bool:
        """At rest at the goal, or as near to it as wind allows for some seconds."""
        goal = self.goal
        if goal is None:
            return False
        if math.dist(state.p_enu, goal.p_enu) < ARRIVED_M and math.hypot(*state.v_enu) < REST_M_S:
            return True
        return self._near_since_ns is not None and t_ns - self._near_since_ns >= _PATIENT_NS

    def target(self, state: BodyState) -> PositionSetpoint | None:
        """The goal with the speed that cruise, climb and braking allow now."""
        goal = self.goal
        if goal is None or not self._limited:
            return goal
        return PositionSetpoint(goal.p_enu, goal.yaw_rad, self._speed_m_s(state, goal))

    def _speed_m_s(self, state: BodyState, goal: PositionSetpoint) -> float:
        get = self._parameters.__getitem__
        way = [g - p for g, p in zip(goal.p_enu, state.p_enu, strict=True)]
        distance_m = math.hypot(*way)
        if distance_m < 1e-6:
            return _HOLD_M_S
        cruise_m_s = float(get("MPC_XY_CRUISE")) if self.cruise_m_s is None else self.cruise_m_s
        acceleration = float(get("MPC_ACC_HOR"))
        level_m = math.hypot(way[0], way[1])
        level = min(
            cruise_m_s,
            float(get("MPC_XY_VEL_MAX")),
            math.sqrt(2.0 * _SHARE_OF_BRAKING * acceleration * level_m),
            math.hypot(*state.v_enu[:2]) + acceleration / _LOOP_HZ,
        )
        upward = "UP" if way[2] > 0.0 else "DN"
        climb = float(min(get(f"MPC_Z_V_AUTO_{upward}"), get(f"MPC_Z_VEL_MAX_{upward}")))
        level_share, climb_share = level_m / distance_m, abs(way[2]) / distance_m
        limits = [limit / share for limit, share in ((level, level_share), (climb, climb_share)) if share > 0.02]
        return max(0.05, min(limits))

    # --- Return

    def _phase_done(self, state: BodyState, home_enu: Vec3, t_ns: int) -> bool:
        goal = self.goal
        if goal is None or self.phase is Phase.LAND:
            return False
        if self.phase is Phase.WAIT:
            delay_s = float(self._parameters["RTL_LAND_DELAY"])
            return delay_s >= 0.0 and t_ns - self._waits_since_ns >= delay_s * NS_PER_S
        if self.phase is Phase.HOME:
            level_m = math.dist(state.p_enu[:2], goal.p_enu[:2])
            return (level_m < NEAR_M and math.hypot(*state.v_enu) < NEAR_M) or self.arrived(state, t_ns)
        return abs(state.p_enu[2] - goal.p_enu[2]) < NEAR_M

    def _next_phase(self, state: BodyState, home_enu: Vec3, t_ns: int) -> None:
        x, y, _ = home_enu
        z = state.p_enu[2] if self.goal is None else self.goal.p_enu[2]
        if self.phase is Phase.CLIMB:
            self._aim(PositionSetpoint((x, y, z), self.yaw_rad), limited=True)
            self.phase = Phase.HOME
        elif self.phase is Phase.HOME:
            lower_m = min(z, home_enu[2] + float(self._parameters["RTL_DESCEND_ALT"]))
            self._aim(PositionSetpoint((x, y, lower_m), self.yaw_rad), limited=True)
            self.phase = Phase.DESCEND
        elif self.phase is Phase.DESCEND:
            self._waits_since_ns, self.phase = t_ns, Phase.WAIT
        else:
            speed_m_s = float(self._parameters["MPC_LAND_SPEED"])
            self._aim(PositionSetpoint((x, y, self._rest_z_m - 10.0), self.yaw_rad, speed_m_s))
            self.phase = Phase.LAND
