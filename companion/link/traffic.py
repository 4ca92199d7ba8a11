"""The MAVLink doors for obstacles: events in, frames into the inbox, in the local frame and on the vehicle's clock.

Global positions are placed through GPS_GLOBAL_ORIGIN, the local frame's origin (HOME_POSITION is another place), which
is asked for until it is known. Autopilots measure the local z as the difference of altitudes, so z is that, not the
height above a tangent plane (0.3 m less at 2 km).

Messages are gathered until the next vehicle state, and shown to the tick that it begins: one frame a source. In
lockstep that tick's frames may have been taken before its state is here, so there they are shown to the one after it,
always. What is refused counts in the inbox as ``traffic_<reason>``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from companion.config_traffic import TrafficConfig
from companion.errors import FrameRejected
from companion.link import mav
from companion.link.geo import TangentPlane
from companion.link.inbox import ObstacleInbox
from companion.link.proximity import point_obstacle, ring_obstacles
from companion.link.reports import Report, Reports
from companion.link.traffic_events import (
    GeoidHeight,
    GlobalOrigin,
    NoPosition,
    ObstaclePoint,
    ObstacleRing,
    TrafficEvent,
    TrafficReport,
)
from companion.link.wire import Obstacle, ObstacleFrame
from companion.types import NS_PER_S, Vec3, VehicleState, frozen

ASK_NS = 2 * NS_PER_S
MAX_POINTS = 256  # of OBSTACLE_DISTANCE_3D between two vehicle states
GEOID_STD_M = 30.0  # of an altitude above the ellipsoid where the geoid is not known
CLIMB_STD_M_S = 5.0  # of a vertical velocity that is not stated
UNSTATED_STD_M_S = 30.0  # of a velocity that is not stated at all
WHOLE_SECONDS_STD_S = 0.3  # of an age in whole seconds, along the track
STILL_S = 0.2  # a report without a velocity is used up to this age
_PREFIXES = {"adsb": "adsb", "neighbours": "system", "utm": "utm"}


class TrafficDoors:
    """What comes in through ADSB_VEHICLE, GLOBAL_POSITION_INT, UTM_GLOBAL_POSITION and OBSTACLE_DISTANCE(_3D).

    Args:
        request: asks the autopilot for a message by its id.
        elapsed_ns: our clock, for the time since the last vehicle state; None: lockstep, time stands between ticks.
    """

    def __init__(
        self,
        config: TrafficConfig,
        inbox: ObstacleInbox,
        request: Callable[[int], None],
        *,
        elapsed_ns: Callable[[], int] | None = None,
    ) -> None:
        self._config = config
        self._inbox = inbox
        self._request = request
        self._elapsed_ns = elapsed_ns
        self._open = frozenset(config.open_doors)
        self._own_names = {(config.own_icao or "").lower(), (config.own_uas_id or "").lower()} - {""}
        self._reports = {
            door: Reports(prefix, max_range_m=config.max_range_m, carry_s=config.carry_s)
            for door, prefix in _PREFIXES.items()
            if door in self._open
        }
        self.reset()

    def reset(self) -> None:
        """The autopilot rebooted: its clock, its origin and where the vehicle was are void."""
        self._origin: TangentPlane | None = None
        self._geoid_m = self._config.geoid_m
        self._asked_ns: int | None = None
        self._vehicle: VehicleState | None = None
        self._arrived_ns = 0
        self._rings: dict[tuple[int, int], list[Obstacle]] = {}  # the newest of each sender
        self._points: list[Obstacle] = []
        self._waiting: list[tuple[str, ObstacleFrame]] = []  # lockstep: for the next tick
        self._stamps: dict[str, int] = {}  # of the newest message of each of the two doors
        for reports in self._reports.values():
            reports.clear()

    @property
    def origin(self) -> TangentPlane | None:
        """The local frame's origin, altitude above mean sea level; None until it is known."""
        return self._origin

    def poll(self, now_ns: int) -> None:
        """Ask for what is needed and not known, every 2 s of the caller's clock."""
        if not self._reports or (self._asked_ns is not None and 0 <= now_ns - self._asked_ns < ASK_NS):
            return
        wanted = [mav.MSG_GPS_GLOBAL_ORIGIN] if self._origin is None else []
        if "utm" in self._open and self._geoid_m is None:
            wanted.append(mav.MSG_GPS_RAW_INT)
        for message in wanted:
            self._asked_ns = now_ns
            self._request(message)

    def handle(self, event: TrafficEvent, system: int, unix_minus_vehicle_ns: int | None) -> None:
        """Take one event.

        Args:
            system: the vehicle's system id.
            unix_minus_vehicle_ns: offset of the clocks, None while it is unknown.
        """
        match event:
            case GlobalOrigin() if _from_autopilot(event, system):
                self._on_origin(TangentPlane(event.lat_deg, event.lon_deg, event.alt_m))
            case GeoidHeight() if _from_autopilot(event, system) and self._config.geoid_m is None:
                self._geoid_m = event.geoid_m
            case TrafficReport() | NoPosition() if event.door in self._open:
                if not self._is_ourselves(event, system):
                    self._on_report(event, unix_minus_vehicle_ns)
            case ObstacleRing() if "obstacle_distance" in self._open and event.system == system:
                self._on_ring(event)
            case ObstaclePoint() if "obstacle_distance_3d" in self._open and event.system == system:
                self._on_point(event)
            case _:
                pass

    def on_vehicle(self, vehicle: VehicleState) -> None:
        """A new vehicle state: what was gathered goes to its tick."""
        self._vehicle = vehicle
        self._arrived_ns = 0 if self._elapsed_ns is None else self._elapsed_ns()
        for door, reports in self._reports.items():
            frame = reports.frame(vehicle.stamp_ns, vehicle.p_enu)
            if frame is not None:
                self._waiting.append((door, frame))
        self._show("obstacle_distance", [obstacle for ring in self._rings.values() for obstacle in ring])
        self._show("obstacle_distance_3d", _each_name_once(self._points))
        self._rings, self._points, self._stamps = {}, [], {}
        if self._elapsed_ns is not None:
            self.frames_taken()

    def frames_taken(self) -> None:
        """The tick of the newest vehicle state has its frames: what is still here is for the next."""
        waiting, self._waiting = self._waiting, []
        for door, frame in waiting:
            self._inbox.push_decoded(door, frame)

    def _show(self, door: str, obstacles: list[Obstacle]) -> None:
        stamp_ns = self._stamps.get(door)
        if stamp_ns is None or self._vehicle is None:
            return
        stamp_ns = min(stamp_ns, self._vehicle.stamp_ns)  # the state may have been long under way
        self._waiting.append((door, ObstacleFrame(stamp_ns=stamp_ns, clock="vehicle", obstacles=obstacles)))

    def _on_origin(self, origin: TangentPlane) -> None:
        if origin != self._origin:
            self._origin = origin
            for reports in self._reports.values():
                reports.clear()  # they were placed by another one

    def _is_ourselves(self, event: TrafficReport | NoPosition, system: int) -> bool:
        """Our own position, by system id, by ICAO address or by UAS id; told by name it is counted."""
        if event.door == "neighbours":
            return event.system == system
        name = event.name if isinstance(event, TrafficReport) else None
        own = name in self._own_names
        if event.door == "utm" and _from_autopilot(event, system):
            own = True
            if name is not None:
                self._own_names.add(name)  # others may repeat it to us
        if own:
            self._inbox.counts["traffic_own"] += 1
        return own

    def _on_report(self, event: TrafficReport | NoPosition, unix_minus_vehicle_ns: int | None) -> None:
        now = self._now()
        if isinstance(event, NoPosition):
            self._refuse(event.door, "no_position", "expected a valid position and altitude")
        elif self._origin is None:
            self._refuse(event.door, "no_origin", "expected GPS_GLOBAL_ORIGIN of the autopilot first")
        elif now is None:
            self._inbox.counts["traffic_no_vehicle"] += 1
        else:
            age_s = _age_s(event, now.stamp_ns, unix_minus_vehicle_ns)
            if age_s > (self._config.carry_s if event.v_enu is not None else STILL_S):
                self._refuse(
                    event.door, "stale", f"{age_s:.1f} s old, expected at most traffic.carry_s with a velocity"
                )
                return
            report = self._placed(event, self._origin, now.stamp_ns - round(age_s * NS_PER_S))
            refused = self._reports[event.door].note(event.name, report, now.p_enu)
            if refused is not None:
                self._inbox.counts[refused] += 1

    def _placed(self, event: TrafficReport, origin: TangentPlane, stamp_ns: int) -> Report:
        """The report in local ENU, with what it states about its accuracy and the door's deviations for the rest."""
        door = getattr(self._config, event.door)
        alt_m, z_std_m = event.alt_m, event.z_std_m or door.altitude_std_m
        if event.altitude == "ellipsoid":
            alt_m -= self._geoid_m or 0.0
            z_std_m = z_std_m if self._geoid_m is not None else math.hypot(z_std_m, GEOID_STD_M)
        elif event.altitude == "pressure":
            z_std_m = door.pressure_altitude_std_m
        east, north, _ = origin.enu(event.lat_deg, event.lon_deg, alt_m).tolist()
        p_std_m = event.p_std_m or door.position_std_m
        v_std_m_s = climb_std_m_s = UNSTATED_STD_M_S
        if event.v_enu is not None:
            v_std_m_s = climb_std_m_s = event.v_std_m_s or door.velocity_std_m_s
            if event.door == "adsb":
                p_std_m = math.hypot(p_std_m, WHOLE_SECONDS_STD_S * math.hypot(*event.v_enu[:2].tolist()))
            if not event.climbs:
                climb_std_m_s = CLIMB_STD_M_S
        return Report(
            stamp_ns=stamp_ns,
            p_enu=frozen([east, north, alt_m - origin.alt_m]),
            p_std_m=np.array([p_std_m, p_std_m, z_std_m]),
            v_enu=event.v_enu,
            v_std_m_s=np.array([v_std_m_s, v_std_m_s, climb_std_m_s]),
            radius_m=door.radius_m,
        )

    def _on_ring(self, ring: ObstacleRing) -> None:
        now = self._now()
        if now is None:
            self._inbox.counts["traffic_no_vehicle"] += 1
            return
        std_m = self._config.obstacle_distance.position_std_m
        self._rings[ring.system, ring.component] = ring_obstacles(ring, now, std_m)
        self._stamps["obstacle_distance"] = now.stamp_ns

    def _on_point(self, point: ObstaclePoint) -> None:
        now, door = self._now(), self._config.obstacle_distance_3d
        if now is None:
            self._inbox.counts["traffic_no_vehicle"] += 1
        elif len(self._points) >= MAX_POINTS:
            self._inbox.counts["traffic_many"] += 1
        else:
            self._points.append(point_obstacle(point, now, door.radius_m, door.position_std_m))
            self._stamps["obstacle_distance_3d"] = now.stamp_ns

    def _now(self) -> VehicleState | None:
        """The vehicle now: the newest state, carried on by the time since its arrival."""
        vehicle = self._vehicle
        if vehicle is None or self._elapsed_ns is None:
            return vehicle
        since_ns = self._elapsed_ns() - self._arrived_ns
        p_enu: Vec3 = frozen(vehicle.p_enu + vehicle.v_enu * (since_ns / NS_PER_S))
        return replace(vehicle, stamp_ns=vehicle.stamp_ns + since_ns, p_enu=p_enu)

    def _refuse(self, door: str, reason: str, detail: str) -> None:
        """Count, and tell once a second at most."""
        self._inbox.reject(door, FrameRejected(f"traffic_{reason}", detail))


def _from_autopilot(event: TrafficEvent, system: int) -> bool:
    return (event.system, event.component) == (system, mav.AUTOPILOT_COMPONENT)


def _age_s(event: TrafficReport, now_ns: int, unix_minus_vehicle_ns: int | None) -> float:
    """How long ago the position was true, as far as the message says; a stamp from the future says nothing."""
    if event.unix_ns is None or unix_minus_vehicle_ns is None:
        return event.age_s
    return max(0.0, (now_ns - (event.unix_ns - unix_minus_vehicle_ns)) / NS_PER_S)


def _each_name_once(points: list[Obstacle]) -> list[Obstacle]:
    """The newest of each id, and all without one."""
    newest = {point.id: index for index, point in enumerate(points) if point.id is not None}
    return [point for index, point in enumerate(points) if point.id is None or newest[point.id] == index]
