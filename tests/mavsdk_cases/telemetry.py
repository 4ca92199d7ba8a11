"""The Telemetry plugin: what it reports is what the vehicle does."""

from __future__ import annotations

import math

from mavsdk.plugins.offboard import AccelerationNed, PositionNedYaw, VelocityBodyYawspeed, VelocityNedYaw

from mavsdk_cases.harness import AIR, GROUND, M_PER_DEG, Drone, case, in_order, named, refused


@case(AIR)
async def position_is_above_home_by_the_relative_altitude(drone: Drone) -> None:
    """Position: "altitude relative to takeoff altitude"; HomePosition: "altitude AMSL"."""
    home = await drone.next(drone.telemetry.subscribe_home())
    await drone.goto(0.0, 0.0, 1.0)
    higher = await drone.until(drone.telemetry.subscribe_position(), lambda p: p.relative_altitude_m > 3.85)
    position = higher[-1]
    assert abs(higher[0].relative_altitude_m - 3.0) < 0.3
    assert abs(position.absolute_altitude_m - home.absolute_altitude_m - position.relative_altitude_m) < 0.05
    assert abs(position.latitude_deg - home.latitude_deg) * M_PER_DEG < 0.2


@case(AIR)
async def velocity_is_the_rate_of_the_position(drone: Drone) -> None:
    """Position and VelocityNed of a flight to the north east."""
    start = await drone.next(drone.telemetry.subscribe_position())
    await drone.goto(2.0, 1.0, 0.0)
    fast = await drone.until(drone.telemetry.subscribe_velocity_ned(), lambda v: v.north_m_s > 0.3)
    assert 0.2 < fast[-1].east_m_s / fast[-1].north_m_s < 0.8
    shift_deg = 1.8 / M_PER_DEG
    await drone.until(drone.telemetry.subscribe_position(), lambda p: p.latitude_deg > start.latitude_deg + shift_deg)


@case(AIR)
async def position_velocity_ned_integrates(drone: Drone) -> None:
    """PositionVelocityNed: the way flown is the sum of the velocities over the time that passed."""
    await drone.offboard_with(drone.offboard.set_velocity_ned(VelocityNedYaw(1.0, 0.0, 0.0, 90.0)))
    await drone.ned(lambda ned: ned.velocity.north_m_s > 0.9)
    await drone.telemetry.set_rate_odometry(20.0)
    began = await drone.next(drone.telemetry.subscribe_odometry())
    ended = (
        await drone.until(
            drone.telemetry.subscribe_odometry(), lambda o: o.position_body.x_m > began.position_body.x_m + 2.0
        )
    )[-1]
    seconds = (ended.time_usec - began.time_usec) / 1e6
    way_m = ended.position_body.x_m - began.position_body.x_m
    assert 0.9 < way_m / seconds < 1.1
    assert abs((await drone.ned()).velocity.north_m_s - 1.0) < 0.1


@case(AIR)
async def attitude_leans_into_an_acceleration(drone: Drone) -> None:
    """EulerAngle: "Positive pitch angle is nose up"; forward acceleration at 2 m/s^2 is nose down by atan(2 / g)."""
    north = AccelerationNed(2.0, 0.0, 0.0)
    await drone.offboard_with(drone.offboard.set_velocity_ned(VelocityNedYaw(0.0, 0.0, 0.0, 0.0)))
    await drone.until(drone.telemetry.subscribe_heading(), lambda h: min(h.heading_deg, 360.0 - h.heading_deg) < 5.0)
    await drone.offboard.set_acceleration_ned(north)
    angles = await drone.until(drone.telemetry.subscribe_attitude_euler(), lambda e: e.pitch_deg < -9.0)
    assert abs(angles[-1].roll_deg) < 5.0
    q = await drone.next(drone.telemetry.subscribe_attitude_quaternion())
    pitch_deg = math.degrees(math.asin(2.0 * (q.w * q.y - q.z * q.x)))
    assert -16.0 < pitch_deg < -6.0
    assert abs(q.w**2 + q.x**2 + q.y**2 + q.z**2 - 1.0) < 1e-3


@case(AIR)
async def heading_and_yaw_turn_clockwise(drone: Drone) -> None:
    """Heading "0 to 360, 0 is north, positive clockwise"; yaw rate positive to the right: 60 deg/s."""
    await drone.offboard_with(drone.offboard.set_velocity_body(VelocityBodyYawspeed(0.0, 0.0, 0.0, 60.0)))
    await drone.until(drone.telemetry.subscribe_attitude_angular_velocity_body(), lambda w: w.yaw_rad_s > 0.9)
    await drone.until(drone.telemetry.subscribe_heading(), lambda h: 170.0 < h.heading_deg < 190.0)
    await drone.until(drone.telemetry.subscribe_heading(), lambda h: 260.0 < h.heading_deg < 280.0)
    angle = await drone.next(drone.telemetry.subscribe_attitude_euler())
    assert -110.0 < angle.yaw_deg < -30.0


@case(AIR)
async def battery_falls_in_flight(drone: Drone) -> None:
    """Battery: "estimated battery remaining", voltage, current and the charge consumed."""
    batteries = drone.telemetry.subscribe_battery()
    first = await drone.next(batteries)
    assert 0.0 < first.remaining_percent <= 100.0
    assert 2.5 < first.voltage_v < 5.0  # one cell, as the Crazyflie has
    later = await drone.until(
        drone.telemetry.subscribe_battery(), lambda battery: battery.remaining_percent < first.remaining_percent
    )
    assert later[-1].current_battery_a > 0.0
    assert later[-1].capacity_consumed_ah > 0.0


@case(GROUND)
async def in_air_and_landed_state_follow_the_flight(drone: Drone) -> None:
    """LandedState: taking off, in air, landing, on ground; in_air with it."""
    await drone.healthy()
    assert not await drone.next(drone.telemetry.subscribe_in_air())
    order = in_order("TAKING_OFF", "IN_AIR", "LANDING", "ON_GROUND")
    async with drone.expecting(drone.telemetry.subscribe_landed_state(), order):
        await drone.action.arm()
        await drone.action.takeoff()
        await drone.until(drone.telemetry.subscribe_in_air(), bool)
        await drone.mode("HOLD")
        await drone.action.land()
    await drone.until(drone.telemetry.subscribe_in_air(), lambda in_air: not in_air)


@case(GROUND)
async def flight_mode_follows_the_commands(drone: Drone) -> None:
    """FlightMode: TAKEOFF, then HOLD by itself, RETURN_TO_LAUNCH, LAND."""
    await drone.healthy()
    await drone.action.arm()
    async with drone.expecting(drone.telemetry.subscribe_flight_mode(), in_order("TAKEOFF", "HOLD")):
        await drone.action.takeoff()
    async with drone.expecting(drone.telemetry.subscribe_flight_mode(), named("LAND")):
        await drone.action.land()
    async with drone.expecting(drone.telemetry.subscribe_flight_mode(), named("HOLD")):
        await drone.action.hold()


@case(AIR)
async def odometry_velocity_is_in_the_body_frame(drone: Drone) -> None:
    """Odometry: "linear speed (m/s)" in the child frame; facing west, a flight to the north goes to the right."""
    await drone.offboard_with(drone.offboard.set_velocity_ned(VelocityNedYaw(0.8, 0.0, 0.0, -90.0)))
    await drone.until(drone.telemetry.subscribe_heading(), lambda h: 255.0 < h.heading_deg < 285.0)
    await drone.telemetry.set_rate_odometry(20.0)
    seen = await drone.until(drone.telemetry.subscribe_odometry(), lambda o: o.velocity_body.y_m_s > 0.6)
    assert abs(seen[-1].velocity_body.x_m_s) < 0.3
    assert abs(seen[-1].position_body.z_m + 3.0) < 0.5
    q = seen[-1].q
    assert abs(math.degrees(math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y**2 + q.z**2))) + 90.0) < 20.0


@case(AIR, more="[physics.estimator]\nposition_std_m = 0.05\nvelocity_std_m_s = 0.1")
async def odometry_has_a_covariance(drone: Drone) -> None:
    """Covariance: "Row-major representation of a 6x6 cross-covariance matrix upper right triangle. Needs to be 21
    entries": the estimator's variances are its first, seventh and twelfth."""
    await drone.telemetry.set_rate_odometry(10.0)
    odometry = await drone.next(drone.telemetry.subscribe_odometry())
    for covariance, variance in ((odometry.pose_covariance, 0.0025), (odometry.velocity_covariance, 0.01)):
        assert len(covariance.covariance_matrix) == 21
        diagonal = [covariance.covariance_matrix[i] for i in (0, 6, 11)]
        assert all(0.3 * variance < x < 3.0 * variance for x in diagonal), diagonal


@case(AIR)
async def status_text_says_why_a_mode_is_denied(drone: Drone) -> None:
    """StatusText: type and text; offboard without a stream is refused and the reason said."""
    await drone.flying()
    offboard = lambda text: "offboard" in text.text.lower()  # noqa: E731
    async with drone.expecting(drone.telemetry.subscribe_status_text(), offboard) as texts:
        await drone.offboard.set_position_ned(PositionNedYaw(0.0, 0.0, -3.0, 0.0))
        with refused("COMMAND_DENIED"):
            await drone.offboard.start()
    assert texts[-1].type.name in ("WARNING", "ERROR", "CRITICAL")


@case(AIR)
async def gps_follows_the_vehicle(drone: Drone) -> None:
    """GpsInfo: a 3D fix of satellites; RawGps: position, ground speed and course over ground."""
    info = await drone.next(drone.telemetry.subscribe_gps_info())
    assert info.num_satellites >= 6
    assert info.fix_type.name in ("FIX_3D", "FIX_DGPS", "RTK_FLOAT", "RTK_FIXED")
    start = await drone.next(drone.telemetry.subscribe_raw_gps())
    await drone.goto(6.0, 0.0, 0.0)
    moving = (await drone.until(drone.telemetry.subscribe_raw_gps(), lambda gps: gps.velocity_m_s > 0.5))[-1]
    assert moving.latitude_deg > start.latitude_deg
    assert min(moving.cog_deg, 360.0 - moving.cog_deg) < 10.0


@case(AIR)
async def altitude_counts_from_sea_from_home_and_from_the_origin(drone: Drone) -> None:
    """Altitude: AMSL, local, relative to home, all of one climb."""
    start = await drone.next(drone.telemetry.subscribe_altitude())
    assert abs(start.altitude_relative_m - 3.0) < 0.1
    await drone.goto(0.0, 0.0, 1.5)
    higher = await drone.until(drone.telemetry.subscribe_altitude(), lambda a: a.altitude_relative_m > 4.3)
    for name in ("altitude_amsl_m", "altitude_local_m", "altitude_monotonic_m"):
        assert abs(getattr(higher[-1], name) - getattr(start, name) - 1.4) < 0.25, name


@case(GROUND, alters=False)
async def origin_of_the_local_frame_is_told(drone: Drone) -> None:
    """Telemetry.get_gps_global_origin: "the GPS location of where the estimator has been initialized"."""
    home = await drone.next(drone.telemetry.subscribe_home())
    origin = await drone.telemetry.get_gps_global_origin()
    north_m = (home.latitude_deg - origin.latitude_deg) * M_PER_DEG
    assert abs(north_m - home.local_north_m) < 0.1
    assert abs(home.absolute_altitude_m - origin.altitude_m + home.local_down_m) < 0.1


@case(AIR)
async def ground_speed_and_climb_are_told(drone: Drone) -> None:
    """FixedwingMetrics (VFR_HUD): ground speed, climb rate and throttle of a climb to the east."""
    await drone.offboard_with(drone.offboard.set_velocity_ned(VelocityNedYaw(0.0, 0.8, -0.6, 90.0)))
    steady = lambda m: m.climb_rate_m_s > 0.45 and m.groundspeed_m_s > 0.65  # noqa: E731
    metrics = (await drone.until(drone.telemetry.subscribe_fixedwing_metrics(), steady))[-1]
    assert 0.2 < metrics.throttle_percentage < 1.0  # MAVSDK 4.1 gives a share here, its documentation says percent
    assert abs(metrics.heading_deg - 90.0) < 15.0


@case(GROUND)
async def health_is_not_armable_outside_the_fence(drone: Drone) -> None:
    """Health: calibrations and positions are good, and is_armable is "True if system can be armed": not with home far
    outside PX4's GF_MAX_HOR_DIST."""
    healthy = (await drone.until(drone.telemetry.subscribe_health(), lambda health: health.is_armable))[-1]
    assert healthy.is_gyrometer_calibration_ok
    assert healthy.is_accelerometer_calibration_ok
    assert healthy.is_magnetometer_calibration_ok
    assert healthy.is_local_position_ok
    assert healthy.is_global_position_ok
    async with drone.expecting(drone.telemetry.subscribe_health(), lambda health: not health.is_armable):
        await drone.fenced_out()
    await drone.until(drone.telemetry.subscribe_health(), lambda health: health.is_home_position_ok)


@case(GROUND, more="[physics]\nbattery_start = 0.06")
async def health_is_not_armable_with_an_empty_battery(drone: Drone) -> None:
    """Health.is_armable, with less than PX4's BAT_CRIT_THR left."""
    battery = await drone.next(drone.telemetry.subscribe_battery())
    assert battery.remaining_percent < 7.0
    await drone.until(drone.telemetry.subscribe_health(), lambda health: not health.is_armable)
