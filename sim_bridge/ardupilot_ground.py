"""When ArduCopter counts as standing, landed, or hovering at rest."""

from __future__ import annotations

import math

from sim_bridge.messages import NS_PER_S
from sim_bridge.physics import BodyState

LANDED_NS = NS_PER_S  # at rest on the ground, not climbing, for this long
HOVER_NS = NS_PER_S // 2
REST_M_S = 0.1
TOUCH_M = 0.03  # above resting height: still on the ground


class Ground:
    """The land detector: LAND_DETECTOR_TRIGGER_SEC of ArduCopter is 1 s."""

    def __init__(self, rest_z_m: float) -> None:
        self._rest_z_m = rest_z_m
        self._still_since_ns: int | None = None
        self._hover_since_ns: int | None = None

    def forget(self) -> None:
        """A mode or the arming has changed."""
        self._still_since_ns = self._hover_since_ns = None

    def touches(self, z_m: float) -> bool:
        return z_m < self._rest_z_m + TOUCH_M

    def landed(self, state: BodyState, t_ns: int, *, climbs: bool) -> bool:
        """Whether it has stood for long enough, up to now."""
        still = self.touches(state.p_enu[2]) and math.hypot(*state.v_enu) <= REST_M_S and not climbs
        if not still:
            self._still_since_ns = None
            return False
        if self._still_since_ns is None:
            self._still_since_ns = t_ns
        return t_ns - self._still_since_ns >= LANDED_NS

    def watch_hover(self, state: BodyState, t_ns: int, *, holds: bool) -> None:
        """``holds``: it is in the air and in a mode that holds its position now."""
        if not holds or math.hypot(*state.v_enu) > REST_M_S:
            self._hover_since_ns = None
        elif self._hover_since_ns is None:
            self._hover_since_ns = t_ns

    def hovers(self, t_ns: int) -> bool:
        return self._hover_since_ns is not None and t_ns - self._hover_since_ns >= HOVER_NS
