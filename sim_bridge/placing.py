"""From the table of an obstacle to its motion: jitter drawn, the path turned and shifted to its place."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sim_bridge.messages import Vec3
from sim_bridge.obstacles import Accelerated, Circle, FigureEight, Linear, Motion, Static, Timed
from sim_bridge.paths import Polyline, read_track, spline, waypoints
from sim_bridge.pursuit import Pursuit
from sim_bridge.scenario_obstacles import (
    AcceleratedObstacle,
    CircleObstacle,
    EightObstacle,
    LinearObstacle,
    Obstacle,
    Path,
    PursuitObstacle,
    SplineObstacle,
    TrackObstacle,
    WaypointsObstacle,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class ResolvedObstacle:
    """One obstacle with its motion's numbers."""

    id: str
    radius_m: float
    motion: Motion


def place(obstacle: Obstacle, rng: np.random.Generator, vehicles: Sequence[str]) -> ResolvedObstacle:
    """Draw the jitter (the same number of draws for every obstacle) and shift the motion to its place.

    Args:
        vehicles: the fleet's names, by which a pursuit finds whom it chases.
    Raises:
        ScenarioError: a recorded track cannot be used.
    """
    draws = rng.uniform(-1.0, 1.0, 5).tolist()
    jitter = obstacle.jitter
    cross_s = max(0.0, (obstacle.cross_at_s or 0.0) + jitter.time_s * draws[3])
    yaw_rad = math.radians(jitter.yaw_deg * draws[4])
    anchor = _anchor(obstacle, yaw_rad)
    x, y, z = (a + w * d for a, w, d in zip(anchor, jitter.position_m, draws, strict=False))
    start_s = _start_s(obstacle, jitter.time_s * draws[3])
    if isinstance(obstacle, PursuitObstacle):
        motion: Motion = _pursuit(obstacle, (x, y, z), yaw_rad, start_s, vehicles)
        return ResolvedObstacle(id=obstacle.id, radius_m=obstacle.radius_m, motion=motion)
    if obstacle.cross_point is not None:
        dx, dy, dz = _motion(obstacle, (0.0, 0.0, 0.0), cross_s, yaw_rad).position(cross_s)
        x, y, z = x - dx, y - dy, z - dz
    motion = _motion(obstacle, (x, y, z), cross_s, yaw_rad)
    end_s = math.inf if obstacle.end_s is None else obstacle.end_s
    if start_s > 0.0 or end_s < math.inf:
        motion = Timed(motion, start_s, end_s)
    return ResolvedObstacle(id=obstacle.id, radius_m=obstacle.radius_m, motion=motion)


def _anchor(obstacle: Obstacle, yaw_rad: float) -> Vec3:
    """The point to which the position's jitter is added, and about which the yaw's turns."""
    if obstacle.cross_point is not None:
        return obstacle.cross_point
    if obstacle.origin is not None:
        return obstacle.origin
    assert isinstance(obstacle, Path), "checked when the scenario was parsed"
    first = _points(obstacle)[0]
    turned = _turned(first, yaw_rad)
    return (first[0] - turned[0], first[1] - turned[1], 0.0)


def _start_s(obstacle: Obstacle, shift_s: float) -> float:
    """An obstacle that appears later, without a crossing, does so a drawn time earlier or later."""
    if obstacle.start_s == 0.0 or obstacle.cross_point is not None:
        return obstacle.start_s
    latest = math.inf if obstacle.end_s is None else obstacle.end_s
    return min(max(0.0, obstacle.start_s + shift_s), latest)


def _motion(obstacle: Obstacle, origin: Vec3, cross_s: float, yaw_rad: float) -> Motion:
    if isinstance(obstacle, LinearObstacle):
        return Linear(origin, _turned(obstacle.velocity, yaw_rad))
    if isinstance(obstacle, AcceleratedObstacle):
        return Accelerated(origin, _turned(obstacle.velocity, yaw_rad), _turned(obstacle.acceleration, yaw_rad))
    if isinstance(obstacle, EightObstacle):
        return FigureEight(
            center_enu=origin,
            size_m=obstacle.size_m,
            period_s=obstacle.period_s,
            phase_rad=_phase_rad(obstacle, cross_s, 1.0),
            axis_yaw_rad=math.radians(obstacle.axis_yaw_deg) + yaw_rad,
            tilt_rad=math.radians(obstacle.tilt_deg),
        )
    if isinstance(obstacle, CircleObstacle):
        return Circle(
            center_enu=origin,
            radius_m=obstacle.radius_path_m,
            period_s=obstacle.period_s,
            phase_rad=_phase_rad(obstacle, cross_s, -1.0 if obstacle.clockwise else 1.0),
            axis_yaw_rad=math.radians(obstacle.axis_yaw_deg) + yaw_rad,
            tilt_rad=math.radians(obstacle.tilt_deg),
            clockwise=obstacle.clockwise,
        )
    if isinstance(obstacle, Path):
        return _path(obstacle, origin, yaw_rad)
    return Static(origin)


def _phase_rad(obstacle: EightObstacle | CircleObstacle, cross_s: float, sense: float) -> float:
    """At t = 0; with a crossing the phase there is given."""
    phase_rad = math.radians(obstacle.phase_deg or 0.0)
    if obstacle.cross_point is not None:
        phase_rad = math.radians(obstacle.cross_phase_deg) - sense * 2.0 * math.pi * cross_s / obstacle.period_s
    return math.remainder(phase_rad, math.tau)


def _points(obstacle: Path) -> tuple[Vec3, ...]:
    return read_track(obstacle.file)[1] if isinstance(obstacle, TrackObstacle) else obstacle.points


def _path(obstacle: Path, origin: Vec3, yaw_rad: float) -> Motion:
    times_s, points = read_track(obstacle.file) if isinstance(obstacle, TrackObstacle) else ((), obstacle.points)
    moved = tuple(_plus(_turned(p, yaw_rad), origin) for p in points)
    if isinstance(obstacle, WaypointsObstacle):
        return waypoints(moved, obstacle.speed_m_s, loop=obstacle.loop)
    if isinstance(obstacle, SplineObstacle):
        return spline(obstacle.times_s, moved)
    return spline(times_s, moved) if obstacle.interpolation == "cubic" else Polyline(times_s, moved)


def _pursuit(obstacle: PursuitObstacle, p_enu: Vec3, yaw_rad: float, start_s: float, vehicles: Sequence[str]) -> Motion:
    return Pursuit(
        p_enu,
        target=0 if obstacle.of is None else vehicles.index(obstacle.of),
        speed_m_s=obstacle.speed_m_s,
        accel_m_s2=obstacle.accel_m_s2,
        v0_enu=_turned(obstacle.velocity, yaw_rad),
        law=obstacle.law,
        navigation=obstacle.navigation,
        start_s=start_s,
        until_s=math.inf if obstacle.until_s is None else obstacle.until_s,
        end_s=math.inf if obstacle.end_s is None else obstacle.end_s,
    )


def _plus(a: Vec3, b: Vec3) -> Vec3:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def _turned(v: Vec3, yaw_rad: float) -> Vec3:
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return (c * v[0] - s * v[1], s * v[0] + c * v[1], v[2])
