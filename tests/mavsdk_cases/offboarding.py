"""The Offboard plugin: each kind of setpoint is flown, and the mode has PX4's rules."""

from __future__ import annotations

import math

from mavsdk.plugins.offboard import (
    AccelerationNed,
    Attitude,
    AttitudeRate,
    PositionGlobalYaw,
    PositionNedYaw,
    VelocityBodyYawspeed,
    VelocityNedYaw,
)

from mavsdk_cases.harness import AIR, M_PER_DEG, Drone, case, in_order, refused

SPEED = 3.0  # MAVSDK streams at 20 Hz of wall time


@case(AIR, speed=SPEED)
async def start_needs_a_setpoint_and_a_stream(drone: Drone) -> None:
    """start: "Client code must specify a setpoint before", and PX4 wants it streamed at 2 Hz before the mode."""
    await drone.flying()
    with refused("NO_SETPOINT_SET"):
        await drone.offboard.start()
    await drone.offboard.set_velocity_ned(VelocityNedYaw(0.0, 0.0, 0.0, 0.0))
    with refused("COMMAND_DENIED"):
        await drone.offboard.start()
    assert (await drone.next(drone.telemetry.subscribe_flight_mode())).name == "HOLD"


@case(AIR, speed=SPEED)
async def position_ned_is_flown_to(drone: Drone) -> None:
    """set_position_ned: "Set the position in NED coordinates and yaw"."""
    await drone.offboard_with(drone.offboard.set_position_ned(PositionNedYaw(1.5, -1.0, -4.0, 45.0)))
    await drone.ned(lambda ned: near(ned, 1.5, -1.0, -4.0, 0.2))
    await drone.until(drone.telemetry.subscribe_heading(), lambda h: abs(h.heading_deg - 45.0) < 8.0)
    await drone.offboard.set_position_ned(PositionNedYaw(0.0, 0.0, -3.0, 45.0))
    await drone.ned(lambda ned: near(ned, 0.0, 0.0, -3.0, 0.2))


@case(AIR, speed=SPEED)
async def position_global_is_flown_to(drone: Drone) -> None:
    """set_position_global: latitude, longitude, altitude relative to home."""
    here = await drone.next(drone.telemetry.subscribe_position())
    goal = PositionGlobalYaw(
        here.latitude_deg + 1.5 / M_PER_DEG,
        here.longitude_deg,
        3.5,
        0.0,
        PositionGlobalYaw.AltitudeType.REL_HOME,
    )
    await drone.offboard_with(drone.offboard.set_position_global(goal))
    await drone.ned(lambda ned: near(ned, 1.5, 0.0, -3.5, 0.25))


@case(AIR, speed=SPEED)
async def velocity_ned_is_flown(drone: Drone) -> None:
    """set_velocity_ned: "Set the velocity in NED coordinates and yaw"; zero stops."""
    await drone.offboard_with(drone.offboard.set_velocity_ned(VelocityNedYaw(0.0, 1.0, -0.5, 90.0)))
    await drone.ned(lambda ned: abs(ned.velocity.east_m_s - 1.0) < 0.1 and abs(ned.velocity.down_m_s + 0.5) < 0.1)
    await drone.offboard.set_velocity_ned(VelocityNedYaw(0.0, 0.0, 0.0, 90.0))
    await drone.ned(lambda ned: math.hypot(ned.velocity.east_m_s, ned.velocity.down_m_s) < 0.05)


@case(AIR, speed=SPEED)
async def velocity_body_follows_the_nose(drone: Drone) -> None:
    """set_velocity_body: "in body coordinates and yaw angular rate"; forward while turning is a curve."""
    await drone.offboard_with(drone.offboard.set_velocity_body(VelocityBodyYawspeed(1.0, 0.0, 0.0, 45.0)))
    await drone.ned(lambda ned: ned.velocity.north_m_s < -0.7)  # it has turned to the south
    await drone.ned(lambda ned: ned.velocity.north_m_s > 0.7)  # and to the north


@case(AIR, speed=SPEED)
async def position_is_flown_with_velocity_fed_forward(drone: Drone) -> None:
    """set_position_velocity_ned: "with the velocity to be used as feed-forward"."""
    position, velocity = PositionNedYaw(2.0, 0.0, -3.0, 90.0), VelocityNedYaw(0.0, 0.0, 0.0, 90.0)
    await drone.offboard_with(drone.offboard.set_position_velocity_ned(position, velocity))
    await drone.ned(lambda ned: near(ned, 2.0, 0.0, -3.0, 0.2))


@case(AIR, speed=SPEED)
async def acceleration_ned_changes_the_velocity(drone: Drone) -> None:
    """set_acceleration_ned: 1 m/s^2 to the north for two seconds gives about 2 m/s."""
    await drone.telemetry.set_rate_odometry(20.0)
    await drone.offboard_with(drone.offboard.set_velocity_ned(VelocityNedYaw(0.0, 0.0, 0.0, 90.0)))
    await drone.offboard.set_acceleration_ned(AccelerationNed(1.0, 0.0, 0.0))
    await drone.ned(lambda ned: ned.velocity.north_m_s > 0.3)
    before, *_, after = await drone.take(drone.telemetry.subscribe_odometry(), 21)
    speeds_m_s = [math.hypot(o.velocity_body.x_m_s, o.velocity_body.y_m_s) for o in (before, after)]
    seconds = (after.time_usec - before.time_usec) / 1e6
    assert 0.7 < (speeds_m_s[1] - speeds_m_s[0]) / seconds < 1.3
    assert abs((await drone.ned()).velocity.east_m_s) < 0.2


@case(AIR, speed=SPEED)
async def attitude_and_thrust_are_flown(drone: Drone) -> None:
    """set_attitude: "roll, pitch and yaw in degrees with thrust"; nose north, rolled right: to the east."""
    hover = await drone.param.get_param_float("MPC_THR_HOVER")
    await drone.offboard_with(drone.offboard.set_attitude(Attitude(10.0, 0.0, 0.0, hover / math.cos(math.radians(10)))))
    await drone.until(
        drone.telemetry.subscribe_attitude_euler(), lambda e: abs(e.roll_deg - 10.0) < 3.0 and abs(e.yaw_deg) < 10.0
    )
    await drone.ned(lambda ned: ned.velocity.east_m_s > 1.0)


@case(AIR, speed=SPEED)
async def attitude_rate_is_flown(drone: Drone) -> None:
    """set_attitude_rate: "pitch, roll and yaw angular rate along with thrust"."""
    hover = await drone.param.get_param_float("MPC_THR_HOVER")
    await drone.offboard_with(drone.offboard.set_attitude_rate(AttitudeRate(0.0, 0.0, 40.0, hover)))
    rates = drone.telemetry.subscribe_attitude_angular_velocity_body()
    await drone.until(rates, lambda w: abs(w.yaw_rad_s - math.radians(40.0)) < 0.1)


@case(AIR, speed=SPEED)
async def stop_returns_to_hold(drone: Drone) -> None:
    """stop: "The vehicle will be put into Hold mode"; is_active tells both."""
    await drone.offboard_with(drone.offboard.set_velocity_ned(VelocityNedYaw(0.5, 0.0, 0.0, 0.0)))
    assert await drone.offboard.is_active()
    async with drone.expecting(drone.telemetry.subscribe_flight_mode(), in_order("HOLD")):
        await drone.offboard.stop()
    assert not await drone.offboard.is_active()
    await drone.ned(lambda ned: abs(ned.velocity.north_m_s) < 0.05)


@case(AIR, speed=SPEED)
async def is_active_ends_when_another_mode_takes_over(drone: Drone) -> None:
    """is_active: "the vehicle is in offboard mode and we are actively sending setpoints"."""
    await drone.offboard_with(drone.offboard.set_velocity_ned(VelocityNedYaw(0.5, 0.0, 0.0, 0.0)))
    assert await drone.offboard.is_active()
    await drone.action.land()
    await drone.mode("LAND")
    await drone.offboard_ends()


@case(AIR, speed=SPEED)
async def a_stream_that_stops_is_a_failsafe(drone: Drone) -> None:
    """COM_OF_LOSS_T and COM_OBL_RC_ACT = 5: Hold by itself, and a STATUSTEXT that says so."""
    await drone.param.set_param_int("COM_OBL_RC_ACT", 5)
    await drone.offboard_with(drone.offboard.set_velocity_ned(VelocityNedYaw(0.5, 0.0, 0.0, 0.0)), loss_s=1.5)
    texts = drone.telemetry.subscribe_status_text()
    async with (
        drone.expecting(texts, lambda text: "offboard" in text.text.lower()),
        drone.expecting(drone.telemetry.subscribe_flight_mode(), in_order("HOLD")),
    ):
        drone.offboard.destroy()  # the plugin streams no more
    await drone.ned(lambda ned: abs(ned.velocity.north_m_s) < 0.05)


@case(AIR, speed=SPEED)
async def a_lost_stream_lands_where_that_is_chosen(drone: Drone) -> None:
    """COM_OBL_RC_ACT = 4: Land, down to the ground."""
    await drone.param.set_param_int("COM_OBL_RC_ACT", 4)
    await drone.offboard_with(drone.offboard.set_velocity_ned(VelocityNedYaw(0.0, 0.0, 0.0, 0.0)))
    async with drone.expecting(drone.telemetry.subscribe_flight_mode(), in_order("LAND")):
        drone.offboard.destroy()
    await drone.until(drone.telemetry.subscribe_landed_state(), in_order("ON_GROUND"))


def near(ned: object, north_m: float, east_m: float, down_m: float, within_m: float) -> bool:
    """Position of a PositionVelocityNed close to a point."""
    p = ned.position  # type: ignore[attr-defined]
    return math.dist((p.north_m, p.east_m, p.down_m), (north_m, east_m, down_m)) < within_m
