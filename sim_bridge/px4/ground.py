"""Landed or not, and when a vehicle that stands disarms itself.

Source: PX4 user guide, "Land Detector" and COM_DISARM_LAND, COM_DISARM_PRFLT.
"""

from __future__ import annotations

import math

from sim_bridge.messages import NS_PER_S, Landed, Mode
from sim_bridge.personality import ParameterTable
from sim_bridge.physics import BodyState
from sim_bridge.px4.navigation import REST_M_S

LANDED_NS = NS_PER_S // 2  # at rest on the ground for this long
TOUCH_M = 0.03  # above resting height: still on the ground


class Ground:
    """The land detector of one vehicle."""

    def __init__(self, parameters: ParameterTable, *, rest_z_m: float, airborne: bool) -> None:
        self._parameters = parameters
        self._rest_z_m = rest_z_m
        self.landed = Landed.IN_AIR if airborne else Landed.ON_GROUND
        self._flown = airborne  # since arming
        self._stands_since_ns = 0
        self._rest_since_ns: int | None = None

    def arm(self, t_ns: int) -> None:
        self._flown = False
        self._stands_since_ns = t_ns
        self._rest_since_ns = None

    def set_off(self) -> None:
        """Something new is flown: rest begins anew."""
        self._rest_since_ns = None

    def watch(self, state: BodyState, t_ns: int, mode: Mode, *, descends: bool, landing: bool) -> None:
        """Once a control period while armed; ``descends``: nothing asks it to climb, ``landing``: it goes down."""
        z = state.p_enu[2]
        if not (math.isnan(z) or z < self._rest_z_m + TOUCH_M):
            self._rest_since_ns = None
            self._flown = True
            self.landed = Landed.IN_AIR
            if mode is Mode.TAKEOFF:
                self.landed = Landed.TAKEOFF
            elif landing:
                self.landed = Landed.LANDING
            return
        if self.landed is Landed.ON_GROUND or math.hypot(*state.v_enu) > REST_M_S or not descends:
            self._rest_since_ns = None
            return
        if self._rest_since_ns is None:
            self._rest_since_ns = t_ns
        if t_ns - self._rest_since_ns >= LANDED_NS:
            self.landed = Landed.ON_GROUND
            self._stands_since_ns = t_ns

    def disarms(self, t_ns: int, mode: Mode) -> str:
        """Why it disarms now, or nothing."""
        if self.landed is not Landed.ON_GROUND or (mode is Mode.TAKEOFF and not self._flown):
            return ""
        delay_s = self._parameters["COM_DISARM_LAND" if self._flown else "COM_DISARM_PRFLT"]
        if delay_s <= 0 or t_ns - self._stands_since_ns < delay_s * NS_PER_S:
            return ""
        return "Disarmed by landing" if self._flown else "Disarmed by auto preflight disarming"
