"""``[traffic]``: obstacles that come by MAVLink. Every door is shut until its ``enabled`` opens it."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta, Struct

from companion.errors import ConfigError

Radius = Annotated[float, Meta(gt=0.0, le=100.0)]
Deviation = Annotated[float, Meta(gt=0.0, le=100.0)]

UNAUTHENTICATED = ("adsb", "utm")  # anyone with a transmitter may say anything there
UNTRUSTED = ("adsb", "neighbours", "utm")  # default of tracking.untrusted


class AdsbDoor(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """ADSB_VEHICLE."""

    enabled: bool = False
    radius_m: Radius = 5.0
    position_std_m: Deviation = 5.0  # of each horizontal axis
    altitude_std_m: Deviation = 5.0  # of an altitude by GNSS
    pressure_altitude_std_m: Deviation = 30.0
    velocity_std_m_s: Deviation = 1.0


class NeighboursDoor(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """GLOBAL_POSITION_INT of other systems."""

    enabled: bool = False
    radius_m: Radius = 1.0
    position_std_m: Deviation = 1.5
    altitude_std_m: Deviation = 2.0
    velocity_std_m_s: Deviation = 0.3


class UtmDoor(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """UTM_GLOBAL_POSITION; the deviations are those of messages that state none."""

    enabled: bool = False
    radius_m: Radius = 2.0
    position_std_m: Deviation = 3.0
    altitude_std_m: Deviation = 3.0
    velocity_std_m_s: Deviation = 0.5


class ObstacleDistanceDoor(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """OBSTACLE_DISTANCE; radii follow from the width of the bins."""

    enabled: bool = False
    position_std_m: Deviation = 0.1


class ObstacleDistance3dDoor(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """OBSTACLE_DISTANCE_3D."""

    enabled: bool = False
    radius_m: Radius = 0.3
    position_std_m: Deviation = 0.1


class TrafficConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    max_range_m: Annotated[float, Meta(gt=0.0, le=1e4)] = 2000.0  # farther aircraft are not tracked
    carry_s: Annotated[float, Meta(ge=0.0, le=30.0)] = 3.0  # a silent aircraft is carried on along its velocity
    own_icao: Annotated[str, Meta(pattern="^[0-9a-fA-F]{6}$")] | None = None  # of this vehicle's transponder
    own_uas_id: Annotated[str, Meta(pattern="^[0-9a-fA-F]{36}$")] | None = None  # None: as the autopilot reports it
    geoid_m: Annotated[float, Meta(ge=-150.0, le=150.0)] | None = None  # sea level above WGS84; None: by GPS_RAW_INT
    adsb: AdsbDoor = AdsbDoor()
    neighbours: NeighboursDoor = NeighboursDoor()
    utm: UtmDoor = UtmDoor()
    obstacle_distance: ObstacleDistanceDoor = ObstacleDistanceDoor()
    obstacle_distance_3d: ObstacleDistance3dDoor = ObstacleDistance3dDoor()

    @property
    def open_doors(self) -> tuple[str, ...]:
        """Names of the doors that are enabled: the sources under which their obstacles are tracked."""
        names = ("adsb", "neighbours", "utm", "obstacle_distance", "obstacle_distance_3d")
        return tuple(name for name in names if getattr(self, name).enabled)


def check_traffic(traffic: TrafficConfig, untrusted: tuple[str, ...], source: str) -> None:
    """Raise ConfigError where an open door that nobody guards would be trusted."""
    for door in traffic.open_doors:
        if door in UNAUTHENTICATED and door not in untrusted:
            raise ConfigError(
                f'{source}: tracking.untrusted: expected "{door}" in it with traffic.{door}.enabled: '
                "these messages are not authenticated"
            )
