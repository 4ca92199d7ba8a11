"""Obstacle messages of MAVLink to values: units, signs and validity flags, every number checked.

Sources: MAVLink common.xml and ardupilotmega.xml. Vertical velocities: ADSB_VEHICLE counts up, GLOBAL_POSITION_INT and
UTM_GLOBAL_POSITION count down. The altitude of UTM_GLOBAL_POSITION is above the WGS84 ellipsoid (so PX4 fills it), all
others are above mean sea level.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal

from companion.link import mav
from companion.link.decode import Rejected
from companion.link.events import Event
from companion.link.traffic_events import (
    GeoidHeight,
    GlobalOrigin,
    NoPosition,
    ObstaclePoint,
    ObstacleRing,
    TrafficReport,
)
from companion.types import Vec3, frozen

Door = Literal["adsb", "neighbours", "utm"]

MAX_RANGE_M = 1e4
MAX_ALTITUDE_M = 1e5
_UNKNOWN_U16 = 0xFFFF
_DEG_E7, _MM, _CM, _CDEG = 1e-7, 1e-3, 1e-2, 1e-2

# ADSB_FLAGS
_ADSB_COORDS, _ADSB_ALTITUDE, _ADSB_HEADING, _ADSB_VELOCITY, _ADSB_CLIMB = 1, 2, 4, 8, 128
_ADSB_GEOMETRIC = 1  # ADSB_ALTITUDE_TYPE
# UTM_DATA_AVAIL_FLAGS
_UTM_TIME, _UTM_ID, _UTM_POSITION, _UTM_ALTITUDE, _UTM_VELOCITY, _UTM_CLIMB = 1, 2, 4, 8, 32, 64

_GPS_FIX_3D = 3
_NORTH_ALIGNED = (0, 1, 3, 5, 6, 7)  # MAV_FRAME global and local ones
_BODY = (mav.FRAME_BODY_FRD, mav.FRAME_BODY_NED)


def adsb_vehicle(m: Any) -> list[Event]:
    """A velocity needs both course and speed; without the vertical one it is level, and the climb not known."""
    if m.ICAO_address > 0xFFFFFF:
        raise Rejected("out_of_range")
    if not (m.flags & _ADSB_COORDS and m.flags & _ADSB_ALTITUDE):
        return [NoPosition(*_sender(m), "adsb")]
    v_enu = None
    climbs = bool(m.flags & _ADSB_CLIMB)
    if m.flags & _ADSB_HEADING and m.flags & _ADSB_VELOCITY:
        course, speed = math.radians(m.heading * _CDEG), m.hor_velocity * _CM
        up = m.ver_velocity * _CM if climbs else 0.0
        v_enu = frozen([speed * math.sin(course), speed * math.cos(course), up])
    return [
        TrafficReport(
            *_sender(m),
            "adsb",
            f"{m.ICAO_address:06x}",
            *_place(m.lat, m.lon, m.altitude),
            "sea_level" if m.altitude_type == _ADSB_GEOMETRIC else "pressure",
            v_enu,
            climbs,
            float(m.tslc),
        )
    ]


def global_position_int(m: Any) -> list[Event]:
    """No flags here: latitude and longitude zero are what autopilots send before they know."""
    system, component = _sender(m)
    if m.lat == 0 and m.lon == 0:
        return [NoPosition(system, component, "neighbours")]
    place = _place(m.lat, m.lon, m.alt)
    return [TrafficReport(system, component, "neighbours", str(system), *place, "sea_level", _v_enu(m))]


def utm_global_position(m: Any) -> list[Event]:
    system, component = _sender(m)
    if not (m.flags & _UTM_POSITION and m.flags & _UTM_ALTITUDE):
        return [NoPosition(system, component, "utm")]
    climbs = bool(m.flags & _UTM_CLIMB)
    return [
        TrafficReport(
            system,
            component,
            "utm",
            bytes(m.uas_id).hex() if m.flags & _UTM_ID else f"system{system}",
            *_place(m.lat, m.lon, m.alt),
            "ellipsoid",
            _v_enu(m, climbs) if m.flags & _UTM_VELOCITY else None,
            climbs,
            unix_ns=m.time * 1000 if m.flags & _UTM_TIME else None,
            p_std_m=_stated(m.h_acc, _MM),
            z_std_m=_stated(m.v_acc, _MM),
            v_std_m_s=_stated(m.vel_acc, _CM),
        )
    ]


def obstacle_distance(m: Any) -> list[Event]:
    """Beyond the maximum is nothing; 0 (touching) and whatever is nearer than the sensor measures is at its minimum."""
    step_deg = m.increment_f if m.increment_f != 0.0 else float(m.increment)
    if not (math.isfinite(step_deg) and math.isfinite(m.angle_offset)):
        raise Rejected("not_finite")
    if not 0.0 < abs(step_deg) <= 360.0 or abs(m.angle_offset) > 360.0 or not m.min_distance <= m.max_distance:
        raise Rejected("out_of_range")
    if m.frame not in _NORTH_ALIGNED and m.frame not in _BODY:
        raise Rejected("unknown_frame")
    bins = min(len(m.distances), math.floor(360.0 / abs(step_deg) + 1e-3))
    ranges = tuple(
        None if cm == _UNKNOWN_U16 or cm > m.max_distance else max(cm, m.min_distance) * _CM
        for cm in m.distances[:bins]
    )
    first, step = math.radians(m.angle_offset), math.radians(step_deg)
    return [ObstacleRing(*_sender(m), m.frame in _BODY, first, step, ranges)]


def obstacle_distance_3d(m: Any) -> list[Event]:
    """In MAV_FRAME_LOCAL_NED a place, in the others a vector from the vehicle, dropped beyond the sensor's maximum."""
    x, y, z = m.x, m.y, m.z
    _check((x, y, z), MAX_RANGE_M)
    frame: Literal["body", "local", "offset"]
    if m.frame in _BODY:
        frame, point = "body", frozen([x + 0.0, 0.0 - y, 0.0 - z])
    elif m.frame in (mav.FRAME_LOCAL_NED, mav.FRAME_LOCAL_OFFSET_NED):
        frame = "local" if m.frame == mav.FRAME_LOCAL_NED else "offset"
        point = frozen([y + 0.0, x + 0.0, 0.0 - z])
    else:
        raise Rejected("unknown_frame")
    if frame != "local" and m.max_distance > 0.0 and math.hypot(x, y, z) > m.max_distance:
        return []
    name = None if m.obstacle_id == _UNKNOWN_U16 else str(m.obstacle_id)
    return [ObstaclePoint(*_sender(m), name, frame, point)]


def gps_global_origin(m: Any) -> list[Event]:
    return [GlobalOrigin(*_sender(m), *_place(m.latitude, m.longitude, m.altitude))]


def gps_raw_int(m: Any) -> list[Event]:
    """Only what it tells about the geoid: receivers that do not know the ellipsoid's altitude leave it 0."""
    if m.fix_type < _GPS_FIX_3D or m.alt_ellipsoid == 0:
        return []
    geoid_m = (m.alt_ellipsoid - m.alt) * _MM
    _check((geoid_m,), 150.0)  # EGM96 stays within -107 and 86 m
    return [GeoidHeight(*_sender(m), geoid_m)]


TRAFFIC_DECODERS: dict[int, Callable[[Any], list[Event]]] = {
    mav.MSG_GPS_RAW_INT: gps_raw_int,
    mav.MSG_GLOBAL_POSITION_INT: global_position_int,
    mav.MSG_GPS_GLOBAL_ORIGIN: gps_global_origin,
    mav.MSG_ADSB_VEHICLE: adsb_vehicle,
    mav.MSG_OBSTACLE_DISTANCE: obstacle_distance,
    mav.MSG_UTM_GLOBAL_POSITION: utm_global_position,
    mav.MSG_OBSTACLE_DISTANCE_3D: obstacle_distance_3d,
}


def _sender(m: Any) -> tuple[int, int]:
    header = m._header
    return header.srcSystem, header.srcComponent


def _place(lat: int, lon: int, alt: int) -> tuple[float, float, float]:
    """Latitude and longitude [deg] and altitude [m], from 1e-7 degrees and millimetres."""
    place = lat * _DEG_E7, lon * _DEG_E7, alt * _MM
    for value, bound in zip(place, (90.0, 180.0, MAX_ALTITUDE_M), strict=True):
        _check((value,), bound)
    return place


def _v_enu(m: Any, climbs: bool = True) -> Vec3:
    """Velocity from cm/s in NED."""
    return frozen([m.vy * _CM, m.vx * _CM, 0.0 - m.vz * _CM if climbs else 0.0])


def _stated(value: int, unit: float) -> float | None:
    """An accuracy; 0 and the largest number say nothing."""
    return None if value in (0, _UNKNOWN_U16) else value * unit


def _check(values: tuple[float, ...], bound: float) -> None:
    for value in values:
        if not abs(value) <= bound:  # NaN fails this too
            raise Rejected("out_of_range" if math.isfinite(value) else "not_finite")
