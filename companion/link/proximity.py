"""OBSTACLE_DISTANCE and OBSTACLE_DISTANCE_3D to spheres in the local frame.

A ring of ranges lies in the horizontal plane through the vehicle. Neighbouring bins become one sphere as long as it
stays small beside their distance: a sphere about points of a surface reaches towards the vehicle by its radius.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from companion.frames import rotate
from companion.link.traffic_events import ObstaclePoint, ObstacleRing
from companion.link.wire import Obstacle
from companion.types import VehicleState

MAX_SPHERES = 48  # of a ring, the nearest
SHARE = 0.25  # radius of merged bins over their distance, at most
MERGED_MAX_M = 0.5
RADIUS_MIN_M, RADIUS_MAX_M = 0.05, 2.0

Plane = tuple[float, float]  # forward and right of the bearing zero [m]


def ring_obstacles(ring: ObstacleRing, vehicle: VehicleState, std_m: float) -> list[Obstacle]:
    """The spheres of a ring that was measured about ``vehicle``, anonymous, in local ENU."""
    zero_rad = heading_rad(vehicle) if ring.body else 0.0
    east, north, up = vehicle.p_enu.tolist()
    spheres = sorted(_merged(ring, zero_rad), key=lambda sphere: math.hypot(*sphere[0]))[:MAX_SPHERES]
    return [
        Obstacle(position=(east + right, north + ahead, up), radius=radius_m, position_std=std_m)
        for (ahead, right), radius_m in spheres
    ]


def point_obstacle(point: ObstaclePoint, vehicle: VehicleState, radius_m: float, std_m: float) -> Obstacle:
    """The sphere about one point."""
    p_enu = point.point
    if point.frame == "body":
        p_enu = rotate(vehicle.q_enu_from_flu, p_enu)
    if point.frame != "local":
        p_enu = vehicle.p_enu + p_enu
    x, y, z = p_enu.tolist()
    return Obstacle(id=point.name, position=(x, y, z), radius=radius_m, position_std=std_m)


def heading_rad(vehicle: VehicleState) -> float:
    """Where the nose points in the horizontal plane, clockwise from north."""
    east, north, _ = rotate(vehicle.q_enu_from_flu, (1.0, 0.0, 0.0)).tolist()
    return math.atan2(east, north)


def _merged(ring: ObstacleRing, zero_rad: float) -> list[tuple[Plane, float]]:
    """Centre (north, east) and radius of the spheres about runs of bins."""
    spheres: list[tuple[Plane, float]] = []
    run: list[Plane] = []  # both edges of every bin in the run
    nearest_m = math.inf
    for index, range_m in enumerate(ring.ranges_m):
        if range_m is None:
            run = []
            continue
        middle_rad = zero_rad + ring.first_rad + index * ring.step_rad
        edges = [_polar(range_m, middle_rad + side * ring.step_rad) for side in (-0.5, 0.5)]
        longer, nearer_m = [*run, *edges], min(nearest_m, range_m)
        sphere = _about(_middle(longer), longer)
        if run and sphere[1] <= min(SHARE * nearer_m, MERGED_MAX_M):
            run, nearest_m = longer, nearer_m
            spheres[-1] = sphere
        else:
            run, nearest_m = edges, range_m
            spheres.append(_about(_polar(range_m, middle_rad), edges))
    return spheres


def _middle(points: Iterable[Plane]) -> Plane:
    """Centre of the bounding box."""
    x, y = zip(*points, strict=True)
    return 0.5 * (min(x) + max(x)), 0.5 * (min(y) + max(y))


def _about(centre: Plane, points: Iterable[Plane]) -> tuple[Plane, float]:
    """The sphere about ``centre`` that holds all ``points``, its radius within bounds."""
    reach_m = max(math.dist(centre, point) for point in points)
    return centre, min(max(reach_m, RADIUS_MIN_M), RADIUS_MAX_M)


def _polar(range_m: float, bearing_rad: float) -> Plane:
    return range_m * math.cos(bearing_rad), range_m * math.sin(bearing_rad)
