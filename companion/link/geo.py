"""WGS84 geodetic coordinates to a local tangent plane and back, through earth-centred (ECEF) coordinates.

    N = a / sqrt(1 - e^2 sin^2 lat),   x = (N + h) cos lat cos lon,   y = (N + h) cos lat sin lon,
    z = (N (1 - e^2) + h) sin lat,     (e, n, u) = R(lat_0, lon_0) (x - x_0)

Exact, at any distance. Source: IOGP guidance note 7-2, methods 9602 and 9837; the way back by Bowring's iteration.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from companion.types import Vec3, frozen

A_M = 6378137.0  # semi-major axis
F = 1.0 / 298.257223563  # flattening
B_M = A_M * (1.0 - F)
E2 = F * (2.0 - F)
_EP2 = E2 / (1.0 - E2)


@dataclass(frozen=True, slots=True)
class TangentPlane:
    """Local east, north, up about a point of the earth.

    >>> TangentPlane(47.0, 8.0, 400.0).enu(47.0, 8.001, 410.0).round(3).tolist()
    [76.061, 0.0, 10.0]
    """

    lat_deg: float
    lon_deg: float
    alt_m: float  # above the ellipsoid; or all altitudes above mean sea level, 1e-5 of a distance off

    def enu(self, lat_deg: float, lon_deg: float, alt_m: float) -> Vec3:
        """East, north, up of a point, shape (3,) [m]."""
        x0, y0, z0 = ecef(self.lat_deg, self.lon_deg, self.alt_m)
        x, y, z = ecef(lat_deg, lon_deg, alt_m)
        dx, dy, dz = x - x0, y - y0, z - z0
        (sin_lat, cos_lat), (sin_lon, cos_lon) = _sin_cos(self.lat_deg), _sin_cos(self.lon_deg)
        outward = cos_lon * dx + sin_lon * dy
        return frozen(
            [
                cos_lon * dy - sin_lon * dx,
                cos_lat * dz - sin_lat * outward,
                cos_lat * outward + sin_lat * dz,
            ]
        )

    def geodetic(self, p_enu: Vec3) -> tuple[float, float, float]:
        """Latitude [deg], longitude [deg] and altitude [m] of a point given in ENU [m]."""
        x0, y0, z0 = ecef(self.lat_deg, self.lon_deg, self.alt_m)
        (sin_lat, cos_lat), (sin_lon, cos_lon) = _sin_cos(self.lat_deg), _sin_cos(self.lon_deg)
        east, north, up = p_enu.tolist()
        outward = cos_lat * up - sin_lat * north
        x = x0 + cos_lon * outward - sin_lon * east
        y = y0 + sin_lon * outward + cos_lon * east
        return geodetic_from_ecef(x, y, z0 + cos_lat * north + sin_lat * up)


def ecef(lat_deg: float, lon_deg: float, alt_m: float) -> tuple[float, float, float]:
    """Earth-centred, earth-fixed coordinates [m]."""
    (sin_lat, cos_lat), (sin_lon, cos_lon) = _sin_cos(lat_deg), _sin_cos(lon_deg)
    n_m = A_M / math.sqrt(1.0 - E2 * sin_lat * sin_lat)
    outward = (n_m + alt_m) * cos_lat
    return outward * cos_lon, outward * sin_lon, (n_m * (1.0 - E2) + alt_m) * sin_lat


def geodetic_from_ecef(x: float, y: float, z: float) -> tuple[float, float, float]:
    """Latitude [deg], longitude [deg] and altitude [m] above the ellipsoid; to 1e-9 m from -10 km to 100 km."""
    p = math.hypot(x, y)
    sin_b, cos_b = _normal(z * A_M, p * B_M)
    sin_lat, cos_lat = 0.0, 1.0
    for _ in range(3):
        sin_lat, cos_lat = _normal(z + _EP2 * B_M * sin_b**3, p - E2 * A_M * cos_b**3)
        sin_b, cos_b = _normal((1.0 - F) * sin_lat, cos_lat)
    alt_m = p * cos_lat + z * sin_lat - A_M * math.sqrt(1.0 - E2 * sin_lat * sin_lat)
    return math.degrees(math.atan2(sin_lat, cos_lat)), math.degrees(math.atan2(y, x)), alt_m


def _sin_cos(angle_deg: float) -> tuple[float, float]:
    angle = math.radians(angle_deg)
    return math.sin(angle), math.cos(angle)


def _normal(opposite: float, adjacent: float) -> tuple[float, float]:
    """Sine and cosine of the angle of a right triangle."""
    hypotenuse = math.hypot(opposite, adjacent)
    return opposite / hypotenuse, adjacent / hypotenuse
