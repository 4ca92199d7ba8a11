"""The `[[obstacles]]` tables: one struct a motion. `placement` turns them into the motions of `obstacles`.

Every motion is a path over the motions' clock, which starts with the first vehicle's entry into external control.
It is placed by its ``origin``, or by ``cross_point`` and ``cross_at_s``: it then passes that point that long after
the start. ``start_s`` and ``end_s`` are when the obstacle is there at all; the path runs on regardless.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal, TypeAlias

from msgspec import Meta

from sim_bridge.scenario_types import Name, NonNegative, Point, Positive, Table

Tilt = Annotated[float, Meta(ge=-180.0, le=180.0)]
Points = Annotated[tuple[Point, ...], Meta(min_length=2, max_length=1000)]
Times = Annotated[tuple[NonNegative, ...], Meta(min_length=2, max_length=1000)]


class Jitter(Table, frozen=True, kw_only=True):
    """Half widths of the uniform draws of a seed."""

    position_m: tuple[NonNegative, NonNegative, NonNegative] = (0.0, 0.0, 0.0)  # of the origin or crossing point
    time_s: NonNegative = 0.0  # of cross_at_s; of start_s where the obstacle has no crossing and appears later
    yaw_deg: NonNegative = 0.0  # the whole motion about the vertical through its origin or crossing point


class _Placed(Table, frozen=True, kw_only=True, tag_field="motion"):
    """What every obstacle states."""

    id: Name
    radius_m: Positive = 0.2  # of its sphere
    origin: Point | None = None  # where its motion is placed, ENU [m]
    cross_point: Point | None = None  # that it passes, ENU [m]
    cross_at_s: NonNegative | None = None  # on the motions' clock
    start_s: NonNegative = 0.0  # it appears
    end_s: NonNegative | None = None  # it vanishes; None: never
    jitter: Jitter = Jitter()


class StaticObstacle(_Placed, frozen=True, kw_only=True, tag="static"):
    """It stands at its origin."""


class LinearObstacle(_Placed, frozen=True, kw_only=True, tag="linear"):
    velocity: Point  # [m/s]


class AcceleratedObstacle(_Placed, frozen=True, kw_only=True, tag="accelerated"):
    velocity: Point  # at the start [m/s]
    acceleration: Point  # [m/s^2]


class EightObstacle(_Placed, frozen=True, kw_only=True, tag="figure_eight"):
    """A lemniscate whose ``origin`` is its centre; ``cross_phase_deg`` is its phase at the crossing, 0 the centre."""

    size_m: Positive  # reach along its axis; half of it across
    period_s: Positive  # of the whole figure
    phase_deg: float | None = None  # at the start of the clock
    cross_phase_deg: float = 0.0  # at the crossing
    axis_yaw_deg: float = 90.0  # of its long axis, from east towards north
    tilt_deg: Tilt = 0.0  # out of the horizontal, about the long axis


class CircleObstacle(_Placed, frozen=True, kw_only=True, tag="circle"):
    """A circle whose ``origin`` is its centre; ``cross_phase_deg`` is its phase at the crossing."""

    radius_path_m: Positive  # of the circle
    period_s: Positive  # of one round
    clockwise: bool = False  # seen from above, where it is flat
    phase_deg: float | None = None  # at the start of the clock
    cross_phase_deg: float = 0.0  # at the crossing
    axis_yaw_deg: float = 0.0  # of phase 0, from east towards north
    tilt_deg: Tilt = 0.0  # 90: upright


class WaypointsObstacle(_Placed, frozen=True, kw_only=True, tag="waypoints"):
    """Straight legs at constant speed. ``origin`` is added to the points and may be left out."""

    points: Points  # ENU [m]
    speed_m_s: Positive  # along the legs
    loop: bool = False  # from the last point back to the first, again and again; else it stays at the last


class SplineObstacle(_Placed, frozen=True, kw_only=True, tag="spline"):
    """A cubic spline through points at their times; it rests before and after. ``origin`` as for waypoints."""

    points: Points  # ENU [m]
    times_s: Times  # one for each point, rising


class TrackObstacle(_Placed, frozen=True, kw_only=True, tag="track"):
    """A recorded track: a CSV file with the header ``t_s,x,y,z``. ``origin`` as for waypoints."""

    file: Annotated[str, Meta(min_length=1, max_length=1000)]  # relative to the scenario's folder
    interpolation: Literal["linear", "cubic"] = "linear"  # between the recorded points


class PursuitObstacle(_Placed, frozen=True, kw_only=True, tag="pursuit"):
    """It starts at its origin at ``start_s`` and chases a vehicle."""

    of: Name | None = None  # the vehicle's name; None: the first
    speed_m_s: Positive  # at most
    accel_m_s2: Positive  # at most
    velocity: Point = (0.0, 0.0, 0.0)  # at the start [m/s]
    law: Literal["pure", "proportional"] = "pure"  # pure: at the vehicle; proportional: navigation
    navigation: Annotated[float, Meta(gt=0.0, le=10.0)] = 3.0  # N of the proportional law
    until_s: NonNegative | None = None  # from then on it flies straight on; None: never


Obstacle: TypeAlias = (
    StaticObstacle
    | LinearObstacle
    | AcceleratedObstacle
    | EightObstacle
    | CircleObstacle
    | WaypointsObstacle
    | SplineObstacle
    | TrackObstacle
    | PursuitObstacle
)
Path: TypeAlias = WaypointsObstacle | SplineObstacle | TrackObstacle  # whose points are where they are


def placing_error(obstacle: Obstacle) -> str | None:
    """What is wrong with how an obstacle is placed and timed, or None."""
    crossing = obstacle.cross_point is not None
    if crossing != (obstacle.cross_at_s is not None):
        return "expected cross_at_s with cross_point, and only with it"
    if crossing and isinstance(obstacle, PursuitObstacle):
        return "expected origin instead of cross_point for a pursuit"
    placed_twice = crossing and obstacle.origin is not None
    needs_place = not isinstance(obstacle, Path) and not crossing and obstacle.origin is None
    if placed_twice or needs_place:
        return "expected exactly one of origin and cross_point"
    if crossing and isinstance(obstacle, EightObstacle | CircleObstacle) and obstacle.phase_deg is not None:
        return "expected cross_phase_deg instead of phase_deg with cross_point"
    if obstacle.end_s is not None and obstacle.end_s <= obstacle.start_s:
        return f"end_s: expected later than start_s {obstacle.start_s}, got {obstacle.end_s}"
    return _path_error(obstacle)


def _path_error(obstacle: Obstacle) -> str | None:
    if isinstance(obstacle, PursuitObstacle) and math.hypot(*obstacle.velocity) > obstacle.speed_m_s:
        return f"velocity: expected at most speed_m_s {obstacle.speed_m_s}"
    if isinstance(obstacle, WaypointsObstacle):
        legs = [*zip(obstacle.points, obstacle.points[1:], strict=False)]
        legs += [(obstacle.points[-1], obstacle.points[0])] if obstacle.loop else []
        if any(start == end for start, end in legs):
            return "points: expected consecutive points to differ"
    if isinstance(obstacle, SplineObstacle):
        if len(obstacle.times_s) != len(obstacle.points):
            return f"times_s: expected {len(obstacle.points)} times, one for each point, got {len(obstacle.times_s)}"
        if any(b <= a for a, b in zip(obstacle.times_s, obstacle.times_s[1:], strict=False)):
            return "times_s: expected rising times"
    return None
