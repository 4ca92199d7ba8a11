"""The MavlinkDirect plugin, which any client of the protocol can do: commands, SET_MODE, requests for messages."""

from __future__ import annotations

import json
from typing import Any

from mavsdk.plugins.mavlink_direct import MavlinkMessage
from mavsdk.plugins.offboard import VelocityNedYaw

from mavsdk_cases.harness import AIR, GROUND, Drone, case, refused

ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED = 0, 1, 2, 3
HOLD, LAND, OFFBOARD = 4 << 16 | 3 << 24, 4 << 16 | 6 << 24, 6 << 16


async def command(drone: Drone, number: int, *params: float, component: int = 1) -> int:
    """COMMAND_LONG; the MAV_RESULT of its COMMAND_ACK."""
    fields: dict[str, Any] = {"target_system": 1, "target_component": component, "command": number, "confirmation": 0}
    fields |= {f"param{i + 1}": params[i] if i < len(params) else 0.0 for i in range(7)}
    message = MavlinkMessage("COMMAND_LONG", 245, 190, 1, component, json.dumps(fields))
    ack = await drone.direct.send_command(message)
    return int(json.loads(ack.fields_json)["result"])


@case(AIR)
async def do_set_mode_changes_the_mode(drone: Drone) -> None:
    """MAV_CMD_DO_SET_MODE (176) with PX4's main and sub mode: Land."""
    await drone.flying()
    async with drone.expecting(drone.telemetry.subscribe_flight_mode(), lambda mode: mode.name == "LAND"):
        assert await command(drone, 176, 1.0, 4.0, 6.0) == ACCEPTED
    await drone.ned(lambda ned: ned.velocity.down_m_s > 0.2)


@case(AIR)
async def set_mode_changes_the_mode(drone: Drone) -> None:
    """The message SET_MODE (11), the older way to the same."""
    await drone.flying()
    fields = {"target_system": 1, "base_mode": 1, "custom_mode": LAND}
    async with drone.expecting(drone.telemetry.subscribe_flight_mode(), lambda mode: mode.name == "LAND"):
        await drone.direct.send_message(MavlinkMessage("SET_MODE", 245, 190, 1, 1, json.dumps(fields)))


@case(AIR)
async def offboard_by_command_needs_a_stream(drone: Drone) -> None:
    """MAV_CMD_DO_SET_MODE into offboard without setpoints is not accepted."""
    await drone.flying()
    assert await command(drone, 176, 1.0, 6.0, 0.0) in (TEMPORARILY_REJECTED, DENIED)


@case(GROUND, alters=False)
async def a_command_that_nobody_knows_is_unsupported(drone: Drone) -> None:
    """The command protocol: MAV_RESULT_UNSUPPORTED for MAV_CMD_USER_5 (31014)."""
    assert await command(drone, 31014) == UNSUPPORTED


@case(GROUND, alters=False)
async def a_command_to_another_component_is_not_answered(drone: Drone) -> None:
    """Component 42 is not there, so that no final ack comes and the result is TIMEOUT."""
    with refused("TIMEOUT"):
        await command(drone, 176, 1.0, 4.0, 6.0, component=42)


@case(GROUND, alters=False)
async def a_requested_message_comes(drone: Drone) -> None:
    """MAV_CMD_REQUEST_MESSAGE (512) for AUTOPILOT_VERSION (148), with its capabilities."""
    versions = drone.direct.subscribe_message("AUTOPILOT_VERSION")
    async with drone.expecting(versions, lambda message: True) as seen:
        assert await command(drone, 512, 148.0) == ACCEPTED
    capabilities = int(json.loads(seen[-1].fields_json)["capabilities"])
    for bit in (1 << 7, 1 << 13):  # SET_POSITION_TARGET_LOCAL_NED, MAVLink 2
        assert capabilities & bit


@case(GROUND, alters=False)
async def message_intervals_are_granted_told_and_limited(drone: Drone) -> None:
    """SET_MESSAGE_INTERVAL (511) and GET_MESSAGE_INTERVAL (510) of ATTITUDE_QUATERNION; 1 MHz cannot be had, and where
    it is not denied the interval that is told is the one that can be had."""
    assert await command(drone, 511, 31.0, 50_000.0) == ACCEPTED
    assert await interval_us(drone) == 50_000
    if await command(drone, 511, 31.0, 1.0) == ACCEPTED:
        assert await interval_us(drone) >= 1000


async def interval_us(drone: Drone) -> int:
    """MESSAGE_INTERVAL of ATTITUDE_QUATERNION."""
    intervals = drone.direct.subscribe_message("MESSAGE_INTERVAL")
    async with drone.expecting(intervals, lambda message: True) as seen:
        assert await command(drone, 510, 31.0) == ACCEPTED
    return int(json.loads(seen[-1].fields_json)["interval_us"])


@case(AIR, speed=3.0)
async def a_setpoint_is_echoed(drone: Drone) -> None:
    """POSITION_TARGET_LOCAL_NED says what the autopilot flies, as MAVLink's offboard service has it."""
    assert await command(drone, 511, 85.0, 100_000.0) == ACCEPTED
    await drone.offboard_with(drone.offboard.set_velocity_ned(VelocityNedYaw(0.5, 0.25, 0.0, 0.0)))
    echoes = drone.direct.subscribe_message("POSITION_TARGET_LOCAL_NED")
    await drone.until(
        echoes, lambda echo: (json.loads(echo.fields_json)["vx"], json.loads(echo.fields_json)["vy"]) == (0.5, 0.25)
    )
