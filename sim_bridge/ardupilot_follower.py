"""From what a mode wants to the acceleration that is flown: a shaped reference and the loops that keep to it.

    a = a_ref + k_v (v_ref + k_p (p_ref - p) - v), its vertical part through a first-order lag

The reference is `shaping`'s. The level gains are ArduCopter's defaults (PSC_POSXY_P, PSC_VELXY_P), the vertical ones
softened for the lag. The vehicle's own attitude and motor lag follows; the vertical lag here stands for ArduCopter's
acceleration loop and its filters, so that steps answer as measured.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from sim_bridge.messages import Vec3
from sim_bridge.physics import BodyState
from sim_bridge.shaping import Goal, Limits, Reference, shortened

_KP_XY, _KV_XY = 1.0, 2.0  # [1/s]
_KP_Z, _KV_Z = 0.5, 1.5
_LAG_Z_S = 0.2
_LEASH_M, _LEASH_M_S = 2.0, 3.0  # the reference does not run further ahead of a vehicle that cannot follow
_G_M_S2 = 9.81


@dataclass(frozen=True, slots=True)
class Plan:
    """Goals of both axis groups. ``holds_*`` false: the loop about that part of the level reference is open."""

    level: Goal
    level_limits: Limits
    up: Goal
    up_limits: Limits
    holds_position: bool = True
    holds_velocity: bool = True
    holds_height: bool = True


class Follower:
    """References of one vehicle, advanced every physics step."""

    def __init__(self, state: BodyState) -> None:
        self._up_lagged_m_s2 = 0.0
        self._level = Reference((0.0, 0.0), (0.0, 0.0), (0.0, 0.0))
        self._up = Reference((0.0,), (0.0,), (0.0,))
        self.rest(state)

    @property
    def v_enu(self) -> Vec3:
        """Of the reference [m/s]."""
        (x, y), (z,) = self._level.v, self._up.v
        return (x, y, z)

    @property
    def a_enu(self) -> Vec3:
        (x, y), (z,) = self._level.a, self._up.a
        return (x, y, z)

    def rest(self, state: BodyState) -> None:
        """Begin at the vehicle's position and velocity, without acceleration."""
        self._level = Reference(state.p_enu[:2], state.v_enu[:2], (0.0, 0.0))
        self._up = Reference(state.p_enu[2:], state.v_enu[2:], (0.0,))
        self._up_lagged_m_s2 = 0.0

    def anchor(self, state: BodyState) -> None:
        """Begin anew at the vehicle's position and velocity under the acceleration of before."""
        self._level = Reference(state.p_enu[:2], state.v_enu[:2], self._level.a)
        self._up = Reference(state.p_enu[2:], state.v_enu[2:], self._up.a)

    def move(self, plan: Plan, state: BodyState, dt_s: float) -> None:
        """One physics step of the references and of the vertical lag."""
        self._level = _leashed(self._level.moved(plan.level, plan.level_limits, dt_s), state.p_enu[:2], state.v_enu[:2])
        self._up = _leashed(self._up.moved(plan.up, plan.up_limits, dt_s), state.p_enu[2:], state.v_enu[2:])
        asked = self._up_asked(plan, state)
        self._up_lagged_m_s2 += (asked - self._up_lagged_m_s2) * -math.expm1(-dt_s / _LAG_Z_S)

    def acceleration(self, plan: Plan, state: BodyState, lean_max_rad: float) -> Vec3:
        """Net acceleration to fly now, ENU [m/s^2]; its level part within what the lean angle gives."""
        ref = self._level
        (px, py, _), (vx, vy, _) = state.p_enu, state.v_enu
        ax, ay = ref.a
        if plan.holds_velocity:
            kp = _KP_XY if plan.holds_position else 0.0
            ax += _KV_XY * (ref.v[0] + kp * (ref.p[0] - px) - vx)
            ay += _KV_XY * (ref.v[1] + kp * (ref.p[1] - py) - vy)
        ax, ay = shortened((ax, ay), _G_M_S2 * math.tan(lean_max_rad))
        return (ax, ay, self._up_lagged_m_s2)

    def _up_asked(self, plan: Plan, state: BodyState) -> float:
        (p,), (v,), (a,) = self._up.p, self._up.v, self._up.a
        if not plan.holds_height:
            return a
        return a + _KV_Z * (v + _KP_Z * (p - state.p_enu[2]) - state.v_enu[2])


def _leashed(ref: Reference, p: tuple[float, ...], v: tuple[float, ...]) -> Reference:
    ahead = tuple(r - x for r, x in zip(ref.p, p, strict=True))
    faster = tuple(r - x for r, x in zip(ref.v, v, strict=True))
    if math.hypot(*ahead) <= _LEASH_M and math.hypot(*faster) <= _LEASH_M_S:
        return ref
    ahead, faster = shortened(ahead, _LEASH_M), shortened(faster, _LEASH_M_S)
    return Reference(
        tuple(x + d for x, d in zip(p, ahead, strict=True)),
        tuple(x + d for x, d in zip(v, faster, strict=True)),
        ref.a,
    )
