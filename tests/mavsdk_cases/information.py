"""Discovery, the Info plugin and the link: who is there, what it is, how fast its time runs."""

from __future__ import annotations

import signal

from mavsdk.asyncio import Autopilot, Vehicle

from mavsdk_cases.harness import AIR, GROUND, Drone, case, named


@case(GROUND, alters=False)
async def version_is_told(drone: Drone) -> None:
    """Info.get_version: "Get the version information of the system"."""
    version = await drone.info.get_version()
    assert version.flight_sw_major >= 1
    assert version.flight_sw_version_type.name == "RELEASE"


@case(GROUND, alters=False)
async def identification_is_told(drone: Drone) -> None:
    """Info.get_identification: a UID that is one."""
    identification = await drone.info.get_identification()
    assert identification.legacy_uid != 0 or identification.hardware_uid.strip("0")


@case(GROUND, alters=False)
async def product_is_told(drone: Drone) -> None:
    """Info.get_product: vendor and product of the autopilot."""
    product = await drone.info.get_product()
    assert product.vendor_id > 0
    assert product.product_id > 0


@case(GROUND, speed=3.0)
async def speed_factor_is_that_of_the_simulation(drone: Drone) -> None:
    """Info.get_speed_factor: "a simulation can run faster or slower than realtime"."""
    info = drone.info  # hears the clock from here on, and smooths

    async def right() -> bool:
        return bool(0.75 * drone.speed < await info.get_speed_factor() < 1.25 * drone.speed)

    await drone.take(drone.telemetry.subscribe_attitude_euler(), 20)
    await drone.poll(right)


@case(AIR)
async def a_vehicle_in_flight_is_found_and_described(drone: Drone) -> None:
    """System: is connected, a PX4, a multicopter, system 1 component 1; it flies, and then lands."""
    assert await drone.system.is_connected()
    assert await drone.system.has_autopilot()
    assert await drone.system.autopilot_type() == Autopilot.PX4
    assert await drone.system.vehicle_type() == Vehicle.MULTICOPTER
    assert await drone.system.get_system_id() == 1
    assert 1 in await drone.system.component_ids()
    await drone.until(drone.telemetry.subscribe_landed_state(), named("IN_AIR"))
    await drone.until(drone.telemetry.subscribe_armed(), bool)
    async with drone.expecting(drone.telemetry.subscribe_landed_state(), named("LANDING")):
        await drone.action.land()


@case(AIR)
async def a_lost_link_is_told_and_the_flight_is_found_again(drone: Drone) -> None:
    """System.is_connected_state: "True when the system connects, False when it disconnects"."""
    await drone.flying()
    states = drone.system.is_connected_state()
    async with drone.expecting(states, lambda connected: not connected):
        drone.process.send_signal(signal.SIGSTOP)
    assert not await drone.system.is_connected()
    async with drone.expecting(drone.system.is_connected_state(), bool):
        drone.process.send_signal(signal.SIGCONT)
    await drone.flying()
    await drone.action.land()
    await drone.mode("LAND")
