"""Missions and fences by upload are not flown here: they are refused, not swallowed; fences by parameter act."""

from __future__ import annotations

from mavsdk.asyncio.plugins.geofence import GeofenceAsync
from mavsdk.asyncio.plugins.mission import MissionAsync
from mavsdk.plugins.geofence import FenceType, GeofenceData, Point, Polygon
from mavsdk.plugins.mission import MissionItem, MissionPlan
from mavsdk.plugins.offboard import VelocityNedYaw

from mavsdk_cases.harness import AIR, GROUND, Drone, case, refused

REFUSED = ("UNSUPPORTED", "DENIED", "ERROR", "UNSUPPORTED_MISSION_CMD", "INT_MESSAGES_NOT_SUPPORTED")


@case(GROUND, alters=False)
async def a_mission_is_refused(drone: Drone) -> None:
    """Mission.upload_mission: "The mission items are uploaded to a drone. Once uploaded the mission can be started"."""
    mission = MissionAsync(drone.system)
    home = await drone.next(drone.telemetry.subscribe_home())
    items = [MissionItem(home.latitude_deg + 1e-5 * i, home.longitude_deg, 3.0, 1.0, True) for i in range(2)]
    with refused(*REFUSED):
        await mission.upload_mission(MissionPlan(items))


@case(GROUND, alters=False)
async def a_fence_is_refused(drone: Drone) -> None:
    """Geofence.upload_geofence: "Polygon and Circular geofences are uploaded to a drone"."""
    geofence = GeofenceAsync(drone.system)
    home = await drone.next(drone.telemetry.subscribe_home())
    corners = [Point(home.latitude_deg + a, home.longitude_deg + b) for a, b in ((1e-4, 0), (0, 1e-4), (-1e-4, 0))]
    with refused(*REFUSED):
        await geofence.upload_geofence(GeofenceData([Polygon(corners, FenceType.INCLUSION)], []))


@case(AIR, speed=3.0)
async def a_fence_by_parameter_stops_the_flight(drone: Drone) -> None:
    """PX4's GF_MAX_HOR_DIST and GF_ACTION = 3 (Return): beyond the fence the mode changes and a STATUSTEXT says why."""
    await drone.param.set_param_float("GF_MAX_HOR_DIST", 4.0)
    await drone.param.set_param_int("GF_ACTION", 3)
    texts = drone.telemetry.subscribe_status_text()
    async with (
        drone.expecting(texts, lambda text: "fence" in text.text.lower()),
        drone.expecting(drone.telemetry.subscribe_flight_mode(), lambda mode: mode.name == "RETURN_TO_LAUNCH"),
    ):
        await drone.offboard_with(drone.offboard.set_velocity_ned(VelocityNedYaw(3.0, 0.0, 0.0, 0.0)))
