"""The ManualControl plugin: sticks fly the vehicle, and take it over."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

from mavsdk.plugins.offboard import VelocityNedYaw

from mavsdk_cases.direct import DENIED, TEMPORARILY_REJECTED, command
from mavsdk_cases.harness import AIR, GROUND, Drone, case, named, refused

SPEED = 2.0


class Sticks:
    """What `hands_on` sends now: pitch, roll, throttle (0.5 is the middle), yaw, each -1 to 1 but throttle 0 to 1."""

    def __init__(self) -> None:
        self.now = (0.0, 0.0, 0.5, 0.0)


@asynccontextmanager
async def hands_on(drone: Drone) -> AsyncIterator[Sticks]:
    """set_manual_control_input "needs to be sent at a rate high enough ..., a good minimum rate is 10 Hz": with each
    update of the attitude."""
    sticks, sent = Sticks(), asyncio.Event()

    async def send() -> None:
        async for _ in drone.telemetry.subscribe_attitude_quaternion():
            await drone.manual.set_manual_control_input(*sticks.now)
            sent.set()

    task = asyncio.create_task(send())
    try:
        async with asyncio.timeout(drone.limit_s):
            await sent.wait()
        await drone.elapsed(0.5)
        yield sticks
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task


@case(AIR, speed=SPEED)
async def position_control_flies_by_the_sticks(drone: Drone) -> None:
    """start_position_control; forward stick moves along the nose, which faces east; released sticks hold."""
    await drone.flying()
    async with hands_on(drone) as sticks:
        await drone.manual.start_position_control()
        await drone.mode("POSCTL")
        sticks.now = (0.6, 0.0, 0.5, 0.0)
        await drone.ned(lambda ned: ned.velocity.east_m_s > 0.5)
        sticks.now = (0.0, 0.0, 0.5, 0.0)
        await drone.ned(lambda ned: abs(ned.velocity.east_m_s) < 0.1)
        sticks.now = (0.0, 0.0, 1.0, 0.0)
        await drone.ned(lambda ned: ned.velocity.down_m_s < -0.3)


@case(AIR, speed=SPEED)
async def altitude_control_keeps_the_height(drone: Drone) -> None:
    """start_altitude_control; the throttle climbs, its middle keeps the height."""
    await drone.flying()
    async with hands_on(drone) as sticks:
        await drone.manual.start_altitude_control()
        await drone.mode("ALTCTL")
        sticks.now = (0.0, 0.0, 0.9, 0.0)
        await drone.ned(lambda ned: ned.position.down_m < -3.5)
        sticks.now = (0.0, 0.0, 0.5, 0.0)
        await drone.ned(lambda ned: abs(ned.velocity.down_m_s) < 0.1)


@case(AIR, speed=SPEED)
async def the_pilot_takes_over_from_offboard(drone: Drone) -> None:
    """Position control during offboard: the mode changes, MAVSDK's offboard is over, the setpoints count no more."""
    await drone.offboard_with(drone.offboard.set_velocity_ned(VelocityNedYaw(0.6, 0.0, 0.0, 90.0)))
    await drone.ned(lambda ned: ned.velocity.north_m_s > 0.4)
    async with hands_on(drone):
        await drone.manual.start_position_control()
        await drone.mode("POSCTL")
        await drone.ned(lambda ned: abs(ned.velocity.north_m_s) < 0.1)
        await drone.offboard_ends()


@case(AIR, speed=SPEED)
async def moved_sticks_take_over(drone: Drone) -> None:
    """PX4's COM_RC_OVERRIDE bit 0: moved by more than COM_RC_STICK_OV in an automatic mode, they have Position mode."""
    await drone.flying()
    async with hands_on(drone) as sticks:
        assert (await drone.next(drone.telemetry.subscribe_flight_mode())).name == "HOLD"
        async with drone.expecting(drone.telemetry.subscribe_flight_mode(), named("POSCTL")):
            sticks.now = (0.7, 0.0, 0.5, 0.0)
        await drone.ned(lambda ned: ned.velocity.east_m_s > 0.3)


@case(GROUND, speed=SPEED)
async def a_pilot_who_goes_silent_is_a_failsafe(drone: Drone) -> None:
    """PX4's NAV_RCL_ACT = 3: in Position mode without sticks for COM_RC_LOSS_T, it lands by itself and says why."""
    await drone.param.set_param_int("NAV_RCL_ACT", 3)
    await drone.param.set_param_float("COM_FAIL_ACT_T", 0.0)
    async with hands_on(drone):
        await drone.took_off()
        await drone.mode("HOLD")
        await drone.manual.start_position_control()
        await drone.mode("POSCTL")
    texts = drone.telemetry.subscribe_status_text()
    async with (
        drone.expecting(texts, lambda text: "manual control" in text.text.lower()),
        drone.expecting(drone.telemetry.subscribe_flight_mode(), named("LAND")),
    ):
        pass


@case(AIR, speed=SPEED)
async def manual_modes_need_input(drone: Drone) -> None:
    """start_altitude_control: "Requires manual control input to be sent regularly already"; MAVSDK says so itself,
    and the vehicle refuses the mode to whoever asks past MAVSDK."""
    await drone.flying()
    with refused("INPUT_NOT_SET"):
        await drone.manual.start_altitude_control()
    assert await command(drone, 176, 1.0, 2.0, 0.0) in (TEMPORARILY_REJECTED, DENIED)
    assert (await drone.next(drone.telemetry.subscribe_flight_mode())).name == "HOLD"
