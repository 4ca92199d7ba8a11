"""From what a mode wants to the acceleration that is flown: a shaped reference and the loops that keep to it.

    a = a_ref + k_v (v_ref + k_p (p_ref - p) - v)

The reference is `shaping`'s, its vertical part through a first-order lag. The gains are ArduCopter's defaults
(PSC_POSXY_P, PSC_VELXY_P, PSC_POSZ_P), but for the vertical velocity's. The vehicle's own attitude and motor lag
follows; the vertical lag here stands for ArduCopter's acceleration loop and its filters, so that steps answer as
measured.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from sim_bridge.messages import Vec3
from sim_bridge.physics import BodyState
from sim_bridge.shaping import Goal, Limits, Reference, shortened

_KP_XY, _KV_XY = 1.0, 2.0  # [1/s]
_KP_Z, _KV_Z = 1.0, 3.0
_LAG_Z_S = 0.15
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
        self._level = Reference((0.0, 0.0), (0.0, 0.0), (0.0, 0.0))
        self._up = self._up_lagged = Reference((0.0,), (0.0,), (0.0,))
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
        self._up = self._up_lagged = Reference(state.p_enu[2:], state.v_enu[2:], (0.0,))

    def anchor(self, state: BodyState) -> None:
        """Begin anew at the vehicle's position and velocity under the acceleration of before."""
        self._level = Reference(state.p_enu[:2], state.v_enu[:2], self._level.a)
        self._up = Reference(state.p_enu[2:], state.v_enu[2:], self._up.a)
        self._up_lagged = Reference(self._up.p, self._up.v, self._up_lagged.a)

    def move(self, plan: Plan, state: BodyState, dt_s: float) -> None:
        """One physics step of the references and of the vertical lag."""
        self._level = _leashed(self._level.moved(plan.level, plan.level_limits, dt_s), state.p_enu[:2], state.v_enu[:2])
        self._up = _leashed(self._up.moved(plan.up, plan.up_limits, dt_s), state.p_enu[2:], state.v_enu[2:])
        self._up_lagged = _lagged(self._up_lagged, self._up, -math.expm1(-dt_s / _LAG_Z_S))

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
        (pz,), (vz,), (az,) = self._up_lagged.p, self._up_lagged.v, self._up_lagged.a
        if plan.holds_height:
            az += _KV_Z * (vz + _KP_Z * (pz - state.p_enu[2]) - state.v_enu[2])
        return (ax, ay, az)


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


def _lagged(behind: Reference, ahead: Reference, share: float) -> Reference:
    """``behind`` drawn towards ``ahead``; position, velocity and acceleration by the same filter stay consistent."""
    (p, v, a), (q, w, b) = (behind.p, behind.v, behind.a), (ahead.p, ahead.v, ahead.a)
    return Reference(
        *(tuple(x + share * (y - x) for x, y in zip(m, n, strict=True)) for m, n in ((p, q), (v, w), (a, b)))
    )
