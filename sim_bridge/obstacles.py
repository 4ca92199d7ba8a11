"""Motions of obstacles: closed forms of time, so that position and velocity are exact at any instant.

The paper's three cases are `Linear`, `Accelerated` and `FigureEight`; `Static` is the obstacle of its training.
Time is the motions' own clock, which `World.start_motions` starts. Plain floats: these run every physics step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

Point = tuple[float, float, float]


class Motion(Protocol):
    """Where an obstacle's centre is, ENU."""

    def position(self, t_s: float) -> Point:
        """[m]"""

    def velocity(self, t_s: float) -> Point:
        """[m/s], the derivative of ``position``."""


@dataclass(frozen=True, slots=True)
class Static:
    """p(t) = p0."""

    p0_enu: Point

    def position(self, t_s: float) -> Point:
        return self.p0_enu

    def velocity(self, t_s: float) -> Point:
        return (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Linear:
    """p(t) = p0 + v t (Case 1 of the paper)."""

    p0_enu: Point
    v_enu: Point

    def position(self, t_s: float) -> Point:
        (px, py, pz), (vx, vy, vz) = self.p0_enu, self.v_enu
        return (px + vx * t_s, py + vy * t_s, pz + vz * t_s)

    def velocity(self, t_s: float) -> Point:
        return self.v_enu


@dataclass(frozen=True, slots=True)
class Accelerated:
    """p(t) = p0 + v0 t + a t^2 / 2 (Case 2 of the paper)."""

    p0_enu: Point
    v0_enu: Point
    a_enu: Point

    def position(self, t_s: float) -> Point:
        (px, py, pz), (vx, vy, vz), (ax, ay, az) = self.p0_enu, self.v0_enu, self.a_enu
        half = 0.5 * t_s * t_s
        return (px + vx * t_s + ax * half, py + vy * t_s + ay * half, pz + vz * t_s + az * half)

    def velocity(self, t_s: float) -> Point:
        (vx, vy, vz), (ax, ay, az) = self.v0_enu, self.a_enu
        return (vx + ax * t_s, vy + ay * t_s, vz + az * t_s)


@dataclass(frozen=True, slots=True)
class FigureEight:
    """Lemniscate of Gerono (Case 3 of the paper): with theta = 2 pi t / period + phase,

        p(t) = center + size sin(theta) e1 + size sin(theta) cos(theta) e2.

    It reaches ``size_m`` either way along e1 and half of that along e2, and passes its centre, where it is fastest
    (2 pi sqrt(2) size / period), at every theta = k pi. e1 is horizontal, ``axis_yaw_rad`` from east towards north;
    e2 is e1 turned by 90 degrees about the vertical, then lifted by ``tilt_rad`` about e1 (0: a flat eight,
    pi / 2: an upright one).
    """

    center_enu: Point
    size_m: float
    period_s: float
    phase_rad: float = 0.0
    axis_yaw_rad: float = 0.0
    tilt_rad: float = 0.0

    def position(self, t_s: float) -> Point:
        theta = 2.0 * math.pi * t_s / self.period_s + self.phase_rad
        sine = math.sin(theta)
        return self._along(self.center_enu, self.size_m * sine, self.size_m * sine * math.cos(theta))

    def velocity(self, t_s: float) -> Point:
        theta_rate = 2.0 * math.pi / self.period_s
        theta = theta_rate * t_s + self.phase_rad
        speed = self.size_m * theta_rate
        return self._along((0.0, 0.0, 0.0), speed * math.cos(theta), speed * math.cos(2.0 * theta))

    def _along(self, origin: Point, along_e1: float, along_e2: float) -> Point:
        cos_yaw, sin_yaw = math.cos(self.axis_yaw_rad), math.sin(self.axis_yaw_rad)
        level, up = along_e2 * math.cos(self.tilt_rad), along_e2 * math.sin(self.tilt_rad)
        x, y, z = origin
        return (x + along_e1 * cos_yaw - level * sin_yaw, y + along_e1 * sin_yaw + level * cos_yaw, z + up)
