"""The Param plugin: types, the whole list, errors, and values that act."""

from __future__ import annotations

from mavsdk.plugins.offboard import VelocityNedYaw

from mavsdk_cases.harness import AIR, GROUND, Drone, case, refused


@case(GROUND, alters=False)
async def an_int_is_an_int_and_a_float_a_float(drone: Drone) -> None:
    """get_param_int, get_param_float: "If the type is wrong, the result will be `WRONG_TYPE`"."""
    assert 0 <= await drone.param.get_param_int("COM_OBL_RC_ACT") <= 7
    assert 0.0 < await drone.param.get_param_float("COM_OF_LOSS_T") <= 60.0
    with refused("WRONG_TYPE"):
        await drone.param.get_param_float("COM_OBL_RC_ACT")
    with refused("WRONG_TYPE"):
        await drone.param.get_param_int("COM_OF_LOSS_T")


@case(GROUND, alters=False)
async def all_parameters_are_listed(drone: Drone) -> None:
    """get_all_params lists what get_param_* then reads, of both types."""
    every = await drone.param.get_all_params()
    floats = {each.name: each.value for each in every.float_params}
    ints = {each.name: each.value for each in every.int_params}
    assert {"COM_OF_LOSS_T", "MIS_TAKEOFF_ALT", "MPC_THR_HOVER", "COM_DISARM_LAND"} <= set(floats)
    assert "COM_OBL_RC_ACT" in ints
    for name in sorted(floats)[:5]:
        assert await drone.param.get_param_float(name) == floats[name]
    for name in sorted(ints)[:3]:
        assert await drone.param.get_param_int(name) == ints[name]


@case(GROUND, alters=False)
async def an_unknown_name_is_an_error(drone: Drone) -> None:
    """get_param_float of a name that the vehicle has not."""
    with refused("TIMEOUT", "DOES_NOT_EXIST"):
        await drone.param.get_param_float("NO_SUCH_PARAM")


@case(GROUND, alters=False)
async def a_value_out_of_range_changes_nothing(drone: Drone) -> None:
    """A refused set_param_* leaves the old value, whether or not the client is told."""
    before = await drone.param.get_param_float("COM_OF_LOSS_T")
    try:
        await drone.param.set_param_float("COM_OF_LOSS_T", -5.0)
    except Exception as error:  # noqa: BLE001  (MAVSDK may tell, by several results)
        assert type(error).__name__ == "ParamError"  # noqa: PT017
    assert await drone.param.get_param_float("COM_OF_LOSS_T") == before
    assert before > 0.0


@case(AIR)
async def the_landing_speed_acts(drone: Drone) -> None:
    """MPC_LAND_SPEED, set through set_param_float, is how fast it comes down near the ground."""
    await drone.param.set_param_float("MPC_LAND_SPEED", 0.8)
    await drone.action.land()
    await drone.ned(lambda ned: 0.65 < ned.velocity.down_m_s < 0.95 and ned.position.down_m > -1.5)


@case(AIR)
async def the_speed_limit_acts(drone: Drone) -> None:
    """MPC_XY_VEL_MAX bounds an offboard velocity that asks for more."""
    await drone.param.set_param_float("MPC_XY_VEL_MAX", 1.0)
    await drone.offboard_with(drone.offboard.set_velocity_ned(VelocityNedYaw(3.0, 0.0, 0.0, 0.0)))
    await drone.ned(lambda ned: ned.velocity.north_m_s > 0.85)
    await drone.elapsed(1.5)
    seen = [await drone.ned() for _ in range(5)]
    assert all(0.8 < ned.velocity.north_m_s < 1.2 for ned in seen)


@case(GROUND, speed=2.0)
async def the_time_to_disarm_acts(drone: Drone) -> None:
    """COM_DISARM_LAND: landed to disarmed, 2 s by default, 4 s here."""
    await drone.param.set_param_float("COM_DISARM_LAND", 4.0)
    await drone.took_off()
    await drone.action.land()
    await drone.until(drone.telemetry.subscribe_landed_state(), lambda state: state.name == "ON_GROUND")
    began = await drone.next(drone.telemetry.subscribe_attitude_quaternion())
    await drone.until(drone.telemetry.subscribe_armed(), lambda armed: not armed)
    ended = await drone.next(drone.telemetry.subscribe_attitude_quaternion())
    assert 2.8 < (ended.timestamp_us - began.timestamp_us) / 1e6 < 6.0
