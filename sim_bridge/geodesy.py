"""Local ENU and geographic coordinates: a flat earth about PX4 SITL's home, Zurich."""

from __future__ import annotations

import math

LATITUDE_DEG, LONGITUDE_DEG = 47.397742, 8.545594  # of the local origin
_M_PER_DEG = 6371000.0 * math.pi / 180.0
_SHRINK = math.cos(math.radians(LATITUDE_DEG))


def geodetic(x_m: float, y_m: float) -> tuple[float, float]:
    """Latitude and longitude [deg] of a local point."""
    return LATITUDE_DEG + y_m / _M_PER_DEG, LONGITUDE_DEG + x_m / (_M_PER_DEG * _SHRINK)


def enu_of(latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
    """East and north [m] of a place.

    >>> [round(x, 6) for x in enu_of(*geodetic(12.0, -3.5))]
    [12.0, -3.5]
    """
    return (longitude_deg - LONGITUDE_DEG) * _M_PER_DEG * _SHRINK, (latitude_deg - LATITUDE_DEG) * _M_PER_DEG
