"""What MAVLink says about obstacles, as values; `companion.link.traffic` places them in the local frame.

``system`` and ``component`` are the sender's. Angles of latitude and longitude in degrees, everything else SI and ENU.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

from companion.types import Vec3


@dataclass(frozen=True, slots=True)
class TrafficReport:
    """ADSB_VEHICLE, GLOBAL_POSITION_INT or UTM_GLOBAL_POSITION: an aircraft that knows where it is."""

    system: int
    component: int
    door: Literal["adsb", "neighbours", "utm"]
    name: str  # ICAO address or UAS id in hexadecimal; the system id of a neighbour
    lat_deg: float
    lon_deg: float
    alt_m: float
    altitude: Literal["sea_level", "pressure", "ellipsoid"]  # above what ``alt_m`` is
    v_enu: Vec3 | None = None  # [m/s]; None: not stated
    climbs: bool = True  # the vertical velocity is stated too
    age_s: float = 0.0  # stated by the message, whole seconds
    unix_ns: int | None = None  # when the position was true
    p_std_m: float | None = None  # horizontal, of each axis; None: not stated
    z_std_m: float | None = None
    v_std_m_s: float | None = None


@dataclass(frozen=True, slots=True)
class NoPosition:
    """A report without a valid position or altitude."""

    system: int
    component: int
    door: Literal["adsb", "neighbours", "utm"]


@dataclass(frozen=True, slots=True)
class ObstacleRing:
    """OBSTACLE_DISTANCE: ranges in the horizontal plane, clockwise from ``first_rad`` where ``step_rad`` > 0.

    Bearings count from the nose (``body``) or from north. None: nothing there, or not known.
    """

    system: int
    component: int
    body: bool
    first_rad: float  # bearing of the middle of the first bin
    step_rad: float
    ranges_m: tuple[float | None, ...]


@dataclass(frozen=True, slots=True)
class ObstaclePoint:
    """OBSTACLE_DISTANCE_3D: one point."""

    system: int
    component: int
    name: str | None
    frame: Literal["body", "local", "offset"]  # FLU of the vehicle; local ENU; ENU from the vehicle
    point: Vec3  # [m]


@dataclass(frozen=True, slots=True)
class GlobalOrigin:
    """GPS_GLOBAL_ORIGIN: where the local frame's origin lies; altitude above mean sea level."""

    system: int
    component: int
    lat_deg: float
    lon_deg: float
    alt_m: float


@dataclass(frozen=True, slots=True)
class GeoidHeight:
    """Of GPS_RAW_INT: how far mean sea level lies above the ellipsoid here."""

    system: int
    component: int
    geoid_m: float


TrafficEvent: TypeAlias = TrafficReport | NoPosition | ObstacleRing | ObstaclePoint | GlobalOrigin | GeoidHeight
