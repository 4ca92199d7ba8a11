"""Motions of obstacles: closed forms of time, so that position and velocity are exact at any instant.

The paper's three cases are `Linear`, `Accelerated` and `FigureEight`; `Static` is the obstacle of its training.
Motions through points are in `paths`; the one that reacts to a vehicle is in `pursuit`.
Time is the motions' own clock, which `World.start_motions` starts. Plain floats: these run every physics step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

Point = tuple[float, float, float]

AWAY_ENU: Point = (0.0, 0.0, -1e4)  # where an obstacle is while it is not there: out of reach of everything


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
        along, across = self.size_m * sine, self.size_m * sine * math.cos(theta)
        return _in_plane(self.center_enu, along, across, self.axis_yaw_rad, self.tilt_rad)

    def velocity(self, t_s: float) -> Point:
        theta_rate = 2.0 * math.pi / self.period_s
        theta = theta_rate * t_s + self.phase_rad
        speed = self.size_m * theta_rate
        along, across = speed * math.cos(theta), speed * math.cos(2.0 * theta)
        return _in_plane((0.0, 0.0, 0.0), along, across, self.axis_yaw_rad, self.tilt_rad)


@dataclass(frozen=True, slots=True)
class Circle:
    """With theta = +-2 pi t / period + phase (minus: clockwise),

        p(t) = center + radius cos(theta) e1 + radius sin(theta) e2,

    e1 and e2 as for `FigureEight`. The speed is 2 pi radius / period throughout.
    """

    center_enu: Point
    radius_m: float
    period_s: float
    phase_rad: float = 0.0
    axis_yaw_rad: float = 0.0
    tilt_rad: float = 0.0
    clockwise: bool = False

    def position(self, t_s: float) -> Point:
        theta = self._theta_rate * t_s + self.phase_rad
        along, across = self.radius_m * math.cos(theta), self.radius_m * math.sin(theta)
        return _in_plane(self.center_enu, along, across, self.axis_yaw_rad, self.tilt_rad)

    def velocity(self, t_s: float) -> Point:
        rate = self._theta_rate
        theta, speed = rate * t_s + self.phase_rad, self.radius_m * rate
        return _in_plane(
            (0.0, 0.0, 0.0), -speed * math.sin(theta), speed * math.cos(theta), self.axis_yaw_rad, self.tilt_rad
        )

    @property
    def _theta_rate(self) -> float:
        return (-2.0 if self.clockwise else 2.0) * math.pi / self.period_s


@dataclass(frozen=True, slots=True)
class Timed:
    """A motion whose obstacle is there from ``start_s`` until just before ``end_s``, and at `AWAY_ENU` else."""

    motion: Motion
    start_s: float = 0.0
    end_s: float = math.inf

    def position(self, t_s: float) -> Point:
        return self.motion.position(t_s) if self.start_s <= t_s < self.end_s else AWAY_ENU

    def velocity(self, t_s: float) -> Point:
        return self.motion.velocity(t_s) if self.start_s <= t_s < self.end_s else (0.0, 0.0, 0.0)


def _in_plane(origin: Point, along_e1: float, along_e2: float, axis_yaw_rad: float, tilt_rad: float) -> Point:
    """origin + along_e1 e1 + along_e2 e2."""
    cos_yaw, sin_yaw = math.cos(axis_yaw_rad), math.sin(axis_yaw_rad)
    level, up = along_e2 * math.cos(tilt_rad), along_e2 * math.sin(tilt_rad)
    x, y, z = origin
    return (x + along_e1 * cos_yaw - level * sin_yaw, y + along_e1 * sin_yaw + level * cos_yaw, z + up)
