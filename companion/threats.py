"""Who is on a collision course: obstacles that come within their margin if the vehicle just flew on.

The vehicle goes straight on at its velocity, the obstacle along its prediction, r(t) = o(t) - p - v t, linear between
the instants of the grid. That is the encounter which the filter works against, so a threat does not disappear from the
ground station because it is being avoided; it disappears when the vehicle's velocity no longer leads there.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass

import numpy as np

from companion.types import NS_PER_S, FilterResult, FloatArray, Prediction, VehicleState, Verdict

LOW, HIGH = 1, 2  # MAV_COLLISION_THREAT_LEVEL
_TINY_M2 = 1e-12


@dataclass(frozen=True, slots=True)
class Threat:
    """What COLLISION says of one obstacle."""

    track: str
    number: int  # a name for the track that stays the same, 32 bits
    level: int
    time_s: float  # from the vehicle's stamp to the closest point
    altitude_m: float  # vertical distance there, centre to centre
    horizontal_m: float


def threats(
    vehicle: VehicleState, prediction: Prediction, result: FilterResult, *, drone_radius_m: float, cushion_m: float
) -> list[Threat]:
    """Obstacles whose closest point within the horizon lies inside their margin, the soonest first.

    The margin is the greatest D of the obstacle's rows in ``result``, radii and cushion where it has none. The level
    is HIGH where the bodies would touch, or where the filter changed the reference because of this obstacle most.

    Args:
        prediction: obstacles from ``start_ns`` on, at or after the vehicle's stamp.
    """
    if not len(prediction):
        return []
    lead_s = (prediction.start_ns - vehicle.stamp_ns) / NS_PER_S
    t_s = lead_s + prediction.dt_s * np.arange(prediction.p_enu.shape[1])
    r = prediction.p_enu - (vehicle.p_enu + t_s[:, None] * vehicle.v_enu)  # (M, K, 3)
    worst = None if result.worst is None or result.verdict is Verdict.NOMINAL else result.worst.track
    margins: dict[str, float] = {}
    for row in result.rows:
        if row.margin is not None:
            margins[row.track] = max(row.margin.total, margins.get(row.track, 0.0))
    found = []
    for name, radius_m, path in zip(prediction.ids, prediction.radius_m.tolist(), r, strict=True):
        step, nearest = _closest(path)
        distance_m, radii_m = math.hypot(*nearest), radius_m + drone_radius_m
        if distance_m > margins.get(name, radii_m + cushion_m):
            continue
        x, y, z = nearest
        level = HIGH if distance_m <= radii_m or name == worst else LOW
        time_s = lead_s + prediction.dt_s * step
        found.append(Threat(name, zlib.crc32(name.encode()), level, time_s, abs(z), math.hypot(x, y)))
    found.sort(key=lambda threat: (threat.time_s, threat.track))
    return found


def _closest(path: FloatArray) -> tuple[float, tuple[float, float, float]]:
    """The point of a polygon (K, 3) nearest to the origin, and where on it, in steps from its start."""
    if len(path) == 1:
        x, y, z = path[0].tolist()
        return 0.0, (x, y, z)
    begin, along = path[:-1], np.diff(path, axis=0)
    share = -np.vecdot(begin, along) / np.maximum(np.vecdot(along, along), _TINY_M2)
    np.clip(share, 0.0, 1.0, out=share)
    points = begin + share[:, None] * along
    best = int(np.vecdot(points, points).argmin())
    x, y, z = points[best].tolist()
    return best + float(share[best]), (x, y, z)
