"""What the tests of the MAVLink doors share: a neighbour that packs with pymavlink, the way from bytes to frames."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.config import Config, parse_config
from companion.link.inbox import ObstacleInbox
from companion.link.mavlink import MavlinkCodec
from companion.link.traffic import TrafficDoors
from companion.link.traffic_events import TrafficEvent
from companion.types import DetectionFrame, VehicleState, frozen

S = 1_000_000_000
LAT, LON, ALT = 47.397742, 8.545594, 488.0  # the origin: a field near Zurich
SIN2 = math.sin(math.radians(LAT)) ** 2
# radii of curvature of WGS84 there: of the meridian, of the parallel
NORTH_M_PER_DEG = math.radians(6378137.0 * (1.0 - 0.00669437999) / (1.0 - 0.00669437999 * SIN2) ** 1.5)  # 111.18 km
EAST_M_PER_DEG = math.radians(6378137.0 * math.cos(math.radians(LAT)) / math.sqrt(1.0 - 0.00669437999 * SIN2))
OURS = 1
UNIX_NS = 1_700_000_000 * S
ALL_DOORS = ("adsb", "neighbours", "utm", "obstacle_distance", "obstacle_distance_3d")


def lat_e7(north_m: float) -> int:
    return round((LAT + north_m / NORTH_M_PER_DEG) * 1e7)


def lon_e7(east_m: float) -> int:
    return round((LON + east_m / EAST_M_PER_DEG) * 1e7)


def alt_mm(up_m: float) -> int:
    return round((ALT + up_m) * 1e3)


def adsb(p: Any = (0.0, 0.0, 0.0), **change: Any) -> Any:
    """ADSB_VEHICLE at (east, north, up) of the origin: all valid, geometric, flying 10 m/s towards 30 degrees."""
    east, north, up = p
    fields = {
        "ICAO_address": 0xA1B2C3,
        "lat": lat_e7(north),
        "lon": lon_e7(east),
        "altitude_type": 1,
        "altitude": alt_mm(up),
        "heading": 3000,
        "hor_velocity": 1000,
        "ver_velocity": 0,
        "callsign": b"TEST",
        "emitter_type": 14,
        "tslc": 0,
        "flags": 1 | 2 | 4 | 8 | 128,
        "squawk": 0,
    }
    return dialect.MAVLink_adsb_vehicle_message(**{**fields, **change})


def position_int(p: Any = (0.0, 0.0, 0.0), *, v_ned_cm_s: Any = (0, 0, 0)) -> Any:
    east, north, up = p
    place = lat_e7(north), lon_e7(east), alt_mm(up)
    return dialect.MAVLink_global_position_int_message(12345, *place, 0, *v_ned_cm_s, 65535)


def utm(p: Any = (0.0, 0.0, 0.0), **change: Any) -> Any:
    """UTM_GLOBAL_POSITION, everything available, at rest, no accuracy stated."""
    east, north, up = p
    fields = {
        "time": UNIX_NS // 1000,
        "uas_id": list(range(18)),
        "lat": lat_e7(north),
        "lon": lon_e7(east),
        "alt": alt_mm(up),
        "relative_alt": 0,
        "vx": 0,
        "vy": 0,
        "vz": 0,
        "h_acc": 0,
        "v_acc": 0,
        "vel_acc": 0,
        "next_lat": 0,
        "next_lon": 0,
        "next_alt": 0,
        "update_rate": 0,
        "flight_state": 3,
        "flags": 1 | 2 | 4 | 8 | 32 | 64,
    }
    return dialect.MAVLink_utm_global_position_message(**{**fields, **change})


def distances(ranges_cm: dict[int, int], **change: Any) -> Any:
    """OBSTACLE_DISTANCE of 5 degrees a bin about the nose, nothing known but ``ranges_cm``."""
    fields = {
        "time_usec": 0,
        "sensor_type": 0,
        "distances": [ranges_cm.get(k, 65535) for k in range(72)],
        "increment": 5,
        "min_distance": 20,
        "max_distance": 3000,
        "increment_f": 0.0,
        "angle_offset": 0.0,
        "frame": 12,
    }
    return dialect.MAVLink_obstacle_distance_message(**{**fields, **change})


def origin(lat_deg: float = LAT, lon_deg: float = LON, alt_m: float = ALT) -> Any:
    return dialect.MAVLink_gps_global_origin_message(round(lat_deg * 1e7), round(lon_deg * 1e7), round(alt_m * 1e3), 0)


def geoid(geoid_m: float = 47.0) -> Any:
    fields = {"alt": 500_000, "alt_ellipsoid": round((500.0 + geoid_m) * 1e3)}
    return dialect.MAVLink_gps_raw_int_message(0, 3, 0, 0, fields["alt"], 0, 0, 0, 0, 9, fields["alt_ellipsoid"])


def vehicle(
    t_s: float, p: Any = (0.0, 0.0, 0.0), v: Any = (0.0, 0.0, 0.0), *, heading_deg: float = 0.0
) -> VehicleState:
    """Level, the nose ``heading_deg`` clockwise from north."""
    yaw = math.pi / 2.0 - math.radians(heading_deg)  # counter-clockwise from east
    q = frozen([math.cos(yaw / 2.0), 0.0, 0.0, math.sin(yaw / 2.0)])
    return VehicleState(round(t_s * S), frozen(p), frozen(v), q)


class Sky:
    """A codec, the doors and the inbox, as the service wires them; a clock of None is lockstep."""

    def __init__(
        self, *doors: str, clock_ns: Any = lambda: 0, origin_known: bool = True, max_age_s: float = 0.5, **traffic: Any
    ) -> None:
        self.config: Config = parse_config({"traffic": {**traffic, **{door: {"enabled": True} for door in doors}}})
        self.reports: list[str] = []
        self.inbox = ObstacleInbox(queue=64, max_age_s=max_age_s, on_report=self.reports.append, doors=doors)
        self.asked: list[int] = []
        self.doors = TrafficDoors(self.config.traffic, self.inbox, self.asked.append, elapsed_ns=clock_ns)
        self.codec = MavlinkCodec(system=OURS)
        self.unix_minus_vehicle_ns: int | None = None
        if origin_known:
            self.hear(origin(), geoid(0.0))

    def hear(self, *messages: Any, system: int = OURS, component: int = 1) -> None:
        """Bytes of ``messages`` as a sender with these ids packs them."""
        sender = dialect.MAVLink(None, system, component)
        for message in messages:
            for event in self.codec.receive(bytes(message.pack(sender))):
                assert isinstance(event, TrafficEvent)
                self.doors.handle(event, OURS, self.unix_minus_vehicle_ns)

    def tick(self, state: VehicleState) -> tuple[DetectionFrame, ...]:
        """A vehicle state, and the frames of its tick."""
        self.doors.on_vehicle(state)
        return self.inbox.drain(state.stamp_ns, unix_minus_vehicle_ns=self.unix_minus_vehicle_ns)


def std(detection: Any) -> np.ndarray:
    """Deviations (6,) of a detection with a covariance."""
    return np.sqrt(np.diag(detection.covariance))
