"""The Action plugin: arming, takeoff, hold, goto, land, return, kill; and what is refused."""

from __future__ import annotations

import math

from mavsdk.plugins.offboard import VelocityNedYaw

from mavsdk_cases.direct import ACCEPTED, command
from mavsdk_cases.harness import AIR, GROUND, M_PER_DEG, Drone, case, in_order, named, refused


@case(GROUND, alters=False)
async def arms_and_disarms(drone: Drone) -> None:
    """arm and disarm "a drone that considers itself landed"."""
    await drone.healthy()
    async with drone.expecting(drone.telemetry.subscribe_armed(), bool):
        await drone.action.arm()
    async with drone.expecting(drone.telemetry.subscribe_armed(), lambda armed: not armed):
        await drone.action.disarm()


@case(AIR)
async def disarm_in_the_air_is_rejected(drone: Drone) -> None:
    """disarm: "If flying, the drone should reject the disarm command"."""
    await drone.flying()
    with refused("COMMAND_DENIED", "COMMAND_DENIED_NOT_LANDED"):
        await drone.action.disarm()
    await drone.elapsed(1.0)
    assert await drone.next(drone.telemetry.subscribe_armed())
    assert (await drone.ned()).position.down_m < -2.8


@case(GROUND)
async def arming_is_refused_with_its_reason(drone: Drone) -> None:
    """arm: "the error contains the reason"; PX4 says it by STATUSTEXT, and arms by force "without any checks".

    The force is plain MAVLink here: MAVSDK 4.1.0's arm_force sends MAV_CMD_COMPONENT_ARM_DISARM with param1 = 0.
    """
    await drone.healthy()
    await drone.fenced_out()
    await drone.until(drone.telemetry.subscribe_health(), lambda health: not health.is_armable)
    texts = drone.telemetry.subscribe_status_text()
    async with drone.expecting(texts, lambda text: "fence" in text.text.lower()):
        with refused("COMMAND_DENIED"):
            await drone.action.arm()
    assert not await drone.next(drone.telemetry.subscribe_armed())
    async with drone.expecting(drone.telemetry.subscribe_armed(), bool):
        assert await command(drone, 400, 1.0, 21196.0) == ACCEPTED


@case(GROUND, more="[physics]\nbattery_start = 0.06")
async def arming_is_refused_with_an_empty_battery(drone: Drone) -> None:
    """arm below PX4's BAT_CRIT_THR."""
    await drone.next(drone.telemetry.subscribe_battery())
    await drone.until(drone.telemetry.subscribe_health(), lambda health: not health.is_armable)
    texts = drone.telemetry.subscribe_status_text()
    async with drone.expecting(texts, lambda text: "battery" in text.text.lower()):
        with refused("COMMAND_DENIED"):
            await drone.action.arm()


@case(AIR, more="[physics]\nbattery_start = 0.08")
async def an_empty_battery_lands_the_vehicle(drone: Drone) -> None:
    """PX4's COM_LOW_BAT_ACT = 2: Land at BAT_CRIT_THR, by itself and with a STATUSTEXT."""
    await drone.param.set_param_float("COM_FAIL_ACT_T", 0.0)
    texts = drone.telemetry.subscribe_status_text()
    async with (
        drone.expecting(texts, lambda text: "battery" in text.text.lower()),
        drone.expecting(drone.telemetry.subscribe_flight_mode(), named("LAND")),
    ):
        await drone.param.set_param_int("COM_LOW_BAT_ACT", 2)


@case(GROUND)
async def takeoff_waits_for_arming(drone: Drone) -> None:
    """takeoff: "the vehicle must be armed before it can take off"; PX4 grants the mode, and goes when it is armed."""
    await drone.healthy()
    await drone.action.takeoff()
    await drone.mode("TAKEOFF")
    await drone.elapsed(1.5)
    assert not await drone.next(drone.telemetry.subscribe_in_air())
    assert (await drone.ned()).position.down_m > -0.5
    async with drone.expecting(drone.telemetry.subscribe_in_air(), bool):
        await drone.action.arm()


@case(GROUND)
async def takes_off_to_the_altitude_that_was_set(drone: Drone) -> None:
    """set_takeoff_altitude "in meters above ground"; takeoff: "take off and hover at the takeoff altitude"."""
    await drone.action.set_takeoff_altitude(2.25)
    assert abs(await drone.action.get_takeoff_altitude() - 2.25) < 1e-4
    await drone.healthy()
    await drone.action.arm()
    async with drone.expecting(drone.telemetry.subscribe_flight_mode(), in_order("TAKEOFF", "HOLD")):
        await drone.action.takeoff()
    hover = await drone.ned(lambda ned: abs(ned.velocity.down_m_s) < 0.05)
    assert abs(hover.position.down_m + 2.25) < 0.2


@case(GROUND)
async def disarms_by_itself_when_it_does_not_take_off(drone: Drone) -> None:
    """PX4's COM_DISARM_PRFLT: armed without a takeoff, it disarms after this time."""
    await drone.param.set_param_float("COM_DISARM_PRFLT", 2.0)
    await drone.healthy()
    async with drone.expecting(drone.telemetry.subscribe_armed(), bool):
        await drone.action.arm()
    await drone.until(drone.telemetry.subscribe_armed(), lambda armed: not armed)


@case(AIR, speed=3.0)
async def hold_stops_where_it_is(drone: Drone) -> None:
    """hold: "causing the vehicle to stop and maintain its current GPS position and altitude"."""
    await drone.offboard_with(drone.offboard.set_velocity_ned(VelocityNedYaw(2.0, 0.0, 0.0, 90.0)))
    moving = await drone.ned(lambda ned: ned.velocity.north_m_s > 1.5)
    await drone.action.hold()
    await drone.mode("HOLD")
    still = await drone.ned(lambda ned: math.hypot(ned.velocity.north_m_s, ned.velocity.east_m_s) < 0.05)
    await drone.elapsed(1.5)
    later = await drone.ned()
    assert moving.position.north_m < still.position.north_m < moving.position.north_m + 5.0
    assert abs(later.position.north_m - still.position.north_m) < 0.3
    assert abs(later.position.down_m + 3.0) < 0.3


@case(AIR)
async def goto_location_arrives_and_faces_as_told(drone: Drone) -> None:
    """goto_location: latitude, longitude, altitude AMSL, yaw "0 is North, positive is clockwise"."""
    start = await drone.next(drone.telemetry.subscribe_position())
    await drone.goto(2.0, -1.5, 0.8, yaw_deg=200.0)
    there = await drone.ned(lambda ned: ned.position.north_m > 1.85 and ned.position.east_m < -1.35)
    assert abs(there.position.north_m - 2.0) < 0.3
    assert abs(there.position.east_m + 1.5) < 0.3
    await drone.until(drone.telemetry.subscribe_heading(), lambda h: abs(h.heading_deg - 200.0) < 8.0)
    arrived = await drone.until(
        drone.telemetry.subscribe_position(), lambda p: p.absolute_altitude_m > start.absolute_altitude_m + 0.7
    )
    assert abs((arrived[-1].latitude_deg - start.latitude_deg) * M_PER_DEG - 2.0) < 0.3
    await drone.mode("HOLD")


@case(AIR)
async def set_current_speed_holds_for_a_reposition(drone: Drone) -> None:
    """set_current_speed: "This will set the speed during a mission, reposition, and similar"."""
    await drone.goto(60.0, 0.0, 0.0)
    await drone.ned(lambda ned: ned.velocity.north_m_s > 0.5)
    await drone.action.set_current_speed(1.0)
    await drone.elapsed(3.0)
    slow = [await drone.ned() for _ in range(5)]
    assert all(0.7 < ned.velocity.north_m_s < 1.2 for ned in slow)
    await drone.action.set_current_speed(2.0)
    await drone.ned(lambda ned: ned.velocity.north_m_s > 1.7)


@case(AIR)
async def lands_and_disarms(drone: Drone) -> None:
    """land: "at the current position", "switches the drone to 'Land' flight mode"; then COM_DISARM_LAND."""
    before = await drone.ned()
    async with drone.expecting(drone.telemetry.subscribe_landed_state(), in_order("LANDING", "ON_GROUND")):
        await drone.action.land()
        await drone.mode("LAND")
    await drone.until(drone.telemetry.subscribe_armed(), lambda armed: not armed)
    after = await drone.ned()
    assert math.hypot(after.position.north_m - before.position.north_m, after.position.east_m) < 0.5
    assert after.position.down_m > -0.5


@case(AIR)
async def returns_climbing_first_lands_and_disarms(drone: Drone) -> None:
    """return_to_launch: "rise up to a certain altitude ... heading back to the launch position and land there";
    set_return_to_launch_altitude is that altitude."""
    await drone.action.set_return_to_launch_altitude(5.0)
    assert abs(await drone.action.get_return_to_launch_altitude() - 5.0) < 1e-4
    await drone.param.set_param_int("RTL_CONE_ANG", 0)  # climb so high however near it is
    await drone.goto(8.0, 0.0, 0.0)
    await drone.ned(lambda ned: ned.position.north_m > 7.5)
    async with drone.expecting(drone.telemetry.subscribe_position_velocity_ned(), at_home_low) as way:
        await drone.action.return_to_launch()
        await drone.mode("RETURN_TO_LAUNCH")
    height_m = max(-ned.position.down_m for ned in way)
    assert 4.7 < height_m < 5.5
    high = next(ned for ned in way if ned.position.down_m < -4.5)
    assert high.position.north_m > 5.0  # climbed before it went home
    await drone.until(drone.telemetry.subscribe_landed_state(), named("ON_GROUND"))
    await drone.until(drone.telemetry.subscribe_armed(), lambda armed: not armed)


def at_home_low(ned: object) -> bool:
    """Within half a metre of the launch position and about to touch it."""
    position = ned.position  # type: ignore[attr-defined]
    return math.hypot(position.north_m, position.east_m) < 0.5 and position.down_m > -0.6


@case(AIR)
async def kill_stops_the_motors_in_the_air(drone: Drone) -> None:
    """kill: "will fall out of the sky if this command is used while flying"."""
    await drone.flying()
    async with drone.expecting(drone.telemetry.subscribe_velocity_ned(), lambda v: v.down_m_s > 3.0):
        await drone.action.kill()
    await drone.until(drone.telemetry.subscribe_armed(), lambda armed: not armed)


@case(AIR)
async def terminate_ends_the_flight(drone: Drone) -> None:
    """terminate: "run the terminate routine as configured on the drone", by default in PX4: stop the motors."""
    await drone.flying()
    async with drone.expecting(drone.telemetry.subscribe_velocity_ned(), lambda v: v.down_m_s > 3.0):
        await drone.action.terminate()


@case(AIR)
async def home_moves_when_it_is_set(drone: Drone) -> None:
    """set_home to where the vehicle is, then to a place that is named."""
    old = await drone.next(drone.telemetry.subscribe_home())
    latitude_deg = old.latitude_deg + 3.0 / M_PER_DEG
    moved = lambda home: abs(home.latitude_deg - latitude_deg) * M_PER_DEG < 0.1  # noqa: E731
    async with drone.expecting(drone.telemetry.subscribe_home(), moved):
        await drone.action.set_home(False, latitude_deg, old.longitude_deg, old.absolute_altitude_m)


@case(GROUND, alters=False)
async def what_the_vehicle_has_not_is_refused(drone: Drone) -> None:
    """A relay or an actuator that does not exist: the action "contains the reason for the failure"."""
    from mavsdk.plugins.action import RelayCommand

    with refused("UNSUPPORTED", "COMMAND_DENIED"):
        await drone.action.set_relay(0, RelayCommand.ON)
    with refused("UNSUPPORTED", "COMMAND_DENIED"):
        await drone.action.set_actuator(1, 0.5)
