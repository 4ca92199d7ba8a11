"""Telemetry's set_rate_*: what was asked for comes, by the vehicle's own stamps."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

from mavsdk_cases.harness import GROUND, Drone, case, refused


async def rate_hz(drone: Drone, stream: Callable[[], Any], stamp_us: Callable[[Any], int], count: int) -> float:
    """Mean rate of the newest ``count`` updates in vehicle time; the first two may be of the old rate."""
    updates = await drone.take(stream(), count + 3)
    stamps = [stamp_us(update) for update in updates[2:]]
    return count * 1e6 / (stamps[-1] - stamps[0])


@case(GROUND, alters=False)
async def rate_of_the_attitude(drone: Drone) -> None:
    """set_rate_attitude_quaternion: 40 Hz, then 5 Hz."""

    async def seen_hz(count: int) -> float:
        stream = drone.telemetry.subscribe_attitude_quaternion
        return await rate_hz(drone, stream, lambda q: q.timestamp_us, count)

    await drone.telemetry.set_rate_attitude_quaternion(40.0)
    assert 36.0 < await seen_hz(40) < 44.0
    await drone.telemetry.set_rate_attitude_quaternion(5.0)
    assert 4.0 < await seen_hz(8) < 6.0


@case(GROUND, alters=False)
async def rate_of_the_odometry(drone: Drone) -> None:
    """set_rate_odometry: 10 Hz."""
    await drone.telemetry.set_rate_odometry(10.0)
    assert 9.0 < await rate_hz(drone, drone.telemetry.subscribe_odometry, lambda o: o.time_usec, 20) < 11.0


@case(GROUND, alters=False)
async def rate_of_the_raw_gps(drone: Drone) -> None:
    """set_rate_raw_gps: 8 Hz."""
    await drone.telemetry.set_rate_raw_gps(8.0)
    assert 7.0 < await rate_hz(drone, drone.telemetry.subscribe_raw_gps, lambda gps: gps.timestamp_us, 16) < 9.0


@case(GROUND, alters=False)
async def rate_of_the_position(drone: Drone) -> None:
    """set_rate_position: 20 Hz, measured against the attitude at 10 Hz, for a position has no stamp."""
    await drone.telemetry.set_rate_position(20.0)
    await drone.telemetry.set_rate_attitude_quaternion(10.0)
    async with drone.watching(drone.telemetry.subscribe_position()) as positions:
        await drone.take(drone.telemetry.subscribe_attitude_quaternion(), 3)
        before = len(positions)
        await drone.take(drone.telemetry.subscribe_attitude_quaternion(), 21)
        assert 30 < len(positions) - before < 50


@case(GROUND, alters=False)
async def the_rate_of_what_is_not_there_is_refused(drone: Drone) -> None:
    """set_rate_distance_sensor: a TelemetryError "contains the reason for the failure"; there is no such sensor."""
    with refused("COMMAND_DENIED", "UNSUPPORTED", "UNKNOWN"):
        await drone.telemetry.set_rate_distance_sensor(10.0)


@case(GROUND, speed=1.0)
async def unix_time_runs_at_the_rate_asked_for(drone: Drone) -> None:
    """unix_epoch_time [us] advances, and faster updates come when asked for."""
    await drone.telemetry.set_rate_unix_epoch_time(10.0)
    times = (await drone.take(drone.telemetry.subscribe_unix_epoch_time(), 22))[2:]
    steps = [later - earlier for earlier, later in pairwise(times)]
    assert all(step > 0 for step in steps)
    assert 0.08e6 < sum(steps) / len(steps) < 0.12e6
