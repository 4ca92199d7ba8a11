"""Convex limits on the acceleration that are no box: norm, tilt and speed, all second-order cones.

    |E (a + shift)| <= slope a_z + radius

with E the identity, or for tilt the projection onto the horizontal plane. The outer side of a tangent contains the
cone, so an answer to a program with tangents is judged by the cone itself, and brought back where it must hold.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from companion.types import FloatArray, Vec3

G_M_S2 = 9.80665


@dataclass(frozen=True, slots=True)
class Cone:
    """One limit. ``shift`` ENU [m/s^2]; ``radius`` [m/s^2]; ``slope`` without unit; ``level`` leaves out z."""

    name: str
    radius: float
    shift: Vec3
    slope: float = 0.0
    level: bool = False

    def excess(self, a: FloatArray) -> FloatArray:
        """How far each of ``a`` (C, 3) is outside, negative inside [m/s^2], (C,)."""
        x = self._arm(a)
        over = np.sqrt(np.vecdot(x, x)) - self.slope * a[..., 2] - self.radius
        return np.asarray(over / math.hypot(1.0, self.slope))

    @property
    def reach(self) -> float:
        """Length of the shortest way out of a cone without ``shift`` from no acceleration [m/s^2]."""
        return self.radius / math.hypot(1.0, self.slope)

    def shrunk(self, by_m_s2: float) -> Cone:
        """The cone for which a plus anything of up to ``by_m_s2`` on each axis stays in this one."""
        across = math.sqrt(2.0 if self.level else 3.0)
        return replace(self, radius=max(self.radius - (across + self.slope) * by_m_s2, 0.0))

    def tangent(self, a: Vec3) -> tuple[FloatArray, float]:
        """The cone's tangent in the direction of ``a`` as ``normal @ a >= floor``, ``normal`` (3,) of length 1.

        |x| >= n . x for the unit vector n along E (a + shift): the half space contains the cone.
        """
        x = self._arm(a)
        length = math.hypot(*x.tolist())
        unit = x / length if length > 1e-9 else np.array((1.0, 0.0, 0.0))
        scale = math.hypot(1.0, self.slope)
        normal = -unit
        normal[2] += self.slope
        return normal / scale, (float(unit @ self._arm(np.zeros(3))) - self.radius) / scale

    def share(self, inside: Vec3, a: FloatArray) -> FloatArray:
        """Largest share <= 1 of the way from ``inside``, a point of the cone, to each of ``a`` (C, 3), (C,).

        With x = x_0 + s d and the right side r_0 + s e, the crossing is the positive root of
        (|d|^2 - e^2) s^2 + 2 (x_0 . d - r_0 e) s + |x_0|^2 - r_0^2 = 0.
        """
        x, d = self._arm(inside), self._arm(a) - self._arm(inside)
        right = self.slope * float(inside[2]) + self.radius
        grow = self.slope * (a[..., 2] - inside[2])
        square, half = np.vecdot(d, d) - grow * grow, d @ x - right * grow
        rest = min(float(x @ x) - right * right, 0.0)
        root = half + np.sqrt(np.maximum(half * half - square * rest, 0.0))
        return np.asarray(np.where(root > -rest, -rest / np.where(root > -rest, root, 1.0), 1.0))

    def _arm(self, a: FloatArray) -> FloatArray:
        x = a + self.shift
        if self.level:
            x[..., 2] = 0.0
        return x


def norm_cone(norm_m_s2: float) -> Cone:
    """|a| <= norm."""
    return Cone("norm", norm_m_s2, np.zeros(3))


def tilt_cone(tilt_deg: float) -> Cone:
    """Thrust a + g e_z tilted by no more: |(a_x, a_y)| <= tan(tilt) (a_z + g)."""
    slope = math.tan(math.radians(tilt_deg))
    return Cone("tilt", slope * G_M_S2, np.zeros(3), slope, level=True)


def speed_cone(v_enu: Vec3, bound_m_s: float, ahead_s: float) -> Cone:
    """|v + a t| <= bound, divided by t."""
    return Cone("speed", bound_m_s / ahead_s, v_enu / ahead_s)
