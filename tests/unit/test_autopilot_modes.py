"""The autopilot's state machine, told states and times by hand."""

from __future__ import annotations

import math

import pytest

from sim_bridge.autopilot import Autopilot
from sim_bridge.controller import AccelerationSetpoint, MotorsOff, PositionSetpoint
from sim_bridge.messages import Ack, Command, Landed, LocalSetpoint, Mode, Result, Sender, Severity, Text
from sim_bridge.physics import BodyState

GCS, COMPANION = Sender(245, 190), Sender(1, 196)
MS = 1_000_000
S = 1000 * MS
NAN = math.nan


def state(z: float, vz: float = 0.0, v: tuple[float, float] = (0.0, 0.0)) -> BodyState:
    return BodyState((0.0, 0.0, z), (*v, vz), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


GROUND, AIR = state(0.2), state(1.5)


def command(number: int, *params: float) -> Command:
    filled = (*params, *[0.0] * (7 - len(params)))
    return Command(number, filled, GCS)


ARM, DISARM, LAND = command(400, 1.0), command(400, 0.0), command(21)
TAKEOFF = Command(22, (NAN,) * 7, GCS)
OFFBOARD, HOLD, POSITION = command(176, 1.0, 6.0), command(176, 1.0, 4.0, 3.0), command(176, 1.0, 3.0)


def setpoint(mask: int = 0x0C3F, *, a: tuple[float, float, float] = (1.0, 0.0, 0.0), frame: int = 1) -> LocalSetpoint:
    return LocalSetpoint(0, frame, mask, (NAN,) * 3, (0.5, 0.0, 0.0), a, 0.7, 0.2, COMPANION)


@pytest.fixture
def grounded() -> Autopilot:
    return Autopilot(start_enu=(0.0, 0.0, 0.2), rest_height_m=0.2, yaw_rad=0.3)


@pytest.fixture
def airborne() -> Autopilot:
    return Autopilot(start_enu=(0.0, 0.0, 1.5), rest_height_m=0.2, yaw_rad=0.3)


def result(replies: tuple[object, ...]) -> Result:
    (ack,) = [reply for reply in replies if isinstance(reply, Ack)]
    return ack.result


def stream(autopilot: Autopilot, start_ns: int, end_ns: int, period_ns: int = 50 * MS) -> None:
    for t_ns in range(start_ns, end_ns + 1, period_ns):
        assert autopilot.setpoint(setpoint(), t_ns) == ()


def test_a_whole_flight(grounded: Autopilot) -> None:
    assert isinstance(grounded.target(GROUND), MotorsOff)
    assert grounded.command(ARM, GROUND, 0) == (Ack(400, Result.ACCEPTED, GCS),)
    assert isinstance(grounded.target(GROUND), MotorsOff)  # armed on the ground: no thrust
    assert result(grounded.command(TAKEOFF, GROUND, 0)) is Result.ACCEPTED
    assert grounded.mode is Mode.TAKEOFF
    goal = grounded.target(GROUND)
    assert isinstance(goal, PositionSetpoint)
    assert goal.p_enu == (0.0, 0.0, 1.5)
    assert goal.yaw_rad == 0.3
    grounded.step(state(0.6, 0.9), S)
    assert grounded.landed is Landed.TAKEOFF
    grounded.step(state(1.49, 0.02), 3 * S)
    assert grounded.mode is Mode.HOLD
    assert not grounded.hovering(3 * S)
    grounded.step(AIR, 3 * S)
    grounded.step(AIR, 3 * S + 500 * MS)
    assert grounded.hovering(3 * S + 500 * MS)
    assert grounded.landed is Landed.IN_AIR
    assert result(grounded.command(DISARM, AIR, 4 * S)) is Result.TEMPORARILY_REJECTED
    assert result(grounded.command(LAND, AIR, 4 * S)) is Result.ACCEPTED
    grounded.step(state(0.8, -0.5), 5 * S)
    assert grounded.landed is Landed.LANDING
    for t_ns in range(6 * S, 7 * S + 1, 50 * MS):
        grounded.step(GROUND, t_ns)
    assert grounded.landed is Landed.ON_GROUND
    assert grounded.armed
    replies = grounded.step(GROUND, 8 * S + 500 * MS)
    assert not grounded.armed
    assert grounded.mode is Mode.HOLD
    assert "landing" in replies[0].text  # type: ignore[union-attr]


def test_touching_the_ground_at_speed_is_not_landing(airborne: Autopilot) -> None:
    airborne.command(LAND, AIR, 0)
    for t_ns in range(0, S + 1, 50 * MS):
        airborne.step(state(0.21, -0.5), t_ns)
    assert airborne.landed is not Landed.ON_GROUND


def test_arming_without_taking_off_ends_after_ten_seconds(grounded: Autopilot) -> None:
    grounded.command(ARM, GROUND, 0)
    grounded.step(GROUND, 9_950 * MS)
    assert grounded.armed
    grounded.step(GROUND, 10 * S)
    assert not grounded.armed


def test_kill_disarms_in_the_air(airborne: Autopilot) -> None:
    assert result(airborne.command(command(400, 0.0, 21196.0), AIR, 0)) is Result.ACCEPTED
    assert isinstance(airborne.target(AIR), MotorsOff)


@pytest.mark.parametrize(("altitude_amsl_m", "z_m"), [(NAN, 1.5), (490.5, 2.5), (400.0, 0.25)])
def test_takeoff_altitude(grounded: Autopilot, altitude_amsl_m: float, z_m: float) -> None:
    grounded.command(ARM, GROUND, 0)
    grounded.command(Command(22, (0.0,) * 6 + (altitude_amsl_m,), GCS), GROUND, 0)
    goal = grounded.target(GROUND)
    assert isinstance(goal, PositionSetpoint)
    assert goal.p_enu[2] == pytest.approx(z_m)


@pytest.mark.parametrize(
    ("streamed_ns", "granted"),
    [((), False), ((0, 0), False), ((0, 400 * MS), False), ((0, 500 * MS), True), ((0, 2 * S), True)],
)
def test_offboard_needs_half_a_second_of_stream(
    airborne: Autopilot, streamed_ns: tuple[int, ...], granted: bool
) -> None:
    if streamed_ns:
        stream(airborne, *streamed_ns)
    replies = airborne.command(OFFBOARD, AIR, streamed_ns[-1] if streamed_ns else S)
    assert (result(replies) is Result.ACCEPTED) is granted
    assert (airborne.mode is Mode.OFFBOARD) is granted
    reasons = [reply.text for reply in replies if isinstance(reply, Text)]
    assert reasons == ([] if granted else ["Offboard denied: no setpoint stream"])


def test_a_stream_slower_than_2_hz_is_none(airborne: Autopilot) -> None:
    stream(airborne, 0, 3 * S, period_ns=600 * MS)
    assert not airborne.streaming(3 * S)
    stream(airborne, 10 * S, 11 * S, period_ns=500 * MS)
    assert airborne.streaming(11 * S)
    assert not airborne.streaming(11 * S + 501 * MS)


def test_setpoint_loss_holds_after_one_second(airborne: Autopilot) -> None:
    stream(airborne, 0, S)
    airborne.command(OFFBOARD, AIR, S)
    assert airborne.target(AIR) == AccelerationSetpoint((1.0, 0.0, 0.0), 0.3)
    assert airborne.step(AIR, 2 * S) == ()
    here = BodyState((4.0, 1.0, 2.0), (3.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    (text,) = airborne.step(here, 2 * S + 50 * MS)
    assert isinstance(text, Text)
    assert text.severity is Severity.CRITICAL
    assert len(text.text) <= 50
    assert airborne.mode is Mode.HOLD
    goal = airborne.target(here)
    assert isinstance(goal, PositionSetpoint)
    assert goal.p_enu == (4.0, 1.0, 2.0)


def test_setpoint_loss_lands_where_the_parameter_says_so_and_later_where_it_says_later(airborne: Autopilot) -> None:
    assert airborne.parameters.write("COM_OBL_RC_ACT", 4, is_int=True)
    assert airborne.parameters.write("COM_OF_LOSS_T", 3.0, is_int=False)
    stream(airborne, 0, S)
    airborne.command(OFFBOARD, AIR, S)
    airborne.step(AIR, 4 * S)
    assert airborne.mode is Mode.OFFBOARD
    airborne.step(AIR, 4 * S + 1)
    assert airborne.mode is Mode.LAND


@pytest.mark.parametrize(
    ("name", "value", "is_int"),
    [
        ("COM_OBL_RC_ACT", 8, True),
        ("COM_LOW_BAT_ACT", 1, True),  # not one of PX4's values any more
        ("COM_OBL_RC_ACT", 4.0, False),
        ("COM_OF_LOSS_T", 0.0, False),
        ("COM_OF_LOSS_T", NAN, False),
    ],
)
def test_parameters_refuse_what_would_not_act(airborne: Autopilot, name: str, value: float, is_int: bool) -> None:
    before = airborne.parameters[name]
    assert not airborne.parameters.write(name, value, is_int=is_int)
    assert airborne.parameters[name] == before


@pytest.mark.parametrize("mask", [0x0C3F, 0x083F, 0x043F, 0x0C07, 0x0DC7, 0x05C7, 0x0FC7])
def test_accepted_masks(airborne: Autopilot, mask: int) -> None:
    assert airborne.setpoint(setpoint(mask), 0) == ()
    assert airborne.last_setpoint is not None
    assert airborne.last_setpoint.type_mask == mask


@pytest.mark.parametrize(
    ("bad", "named"),
    [
        (setpoint(0x0E3F), "FORCE"),
        (setpoint(0x0C38), "finite"),  # position and acceleration
        (setpoint(0x0DDF), "0x0DDF"),  # no horizontal setpoint
        (setpoint(0x0FFF), "0x0FFF"),  # nothing
        (setpoint(0x0C3F, frame=7), "frame 7"),
        (setpoint(0x0DF8, frame=8), "0x0DF8"),  # PX4 takes no position in the body frame
        (setpoint(0x0C3F, a=(1.0, NAN, 0.0)), "finite"),
        (setpoint(0x0C3F, a=(1.0, math.inf, 0.0)), "finite"),
    ],
)
def test_refused_setpoints_are_no_stream_and_told_once_a_second(
    airborne: Autopilot, bad: LocalSetpoint, named: str
) -> None:
    told = [airborne.setpoint(bad, t_ns) for t_ns in range(0, 1001 * MS, 50 * MS)]
    texts = [reply.text for replies in told for reply in replies if isinstance(reply, Text)]
    assert len(texts) == 2
    assert named in texts[0]
    assert len(texts[0]) <= 50
    assert airborne.last_setpoint is None
    assert not airborne.streaming(S)


def test_yaw_and_velocity_of_the_mask(airborne: Autopilot) -> None:
    def after(mask: int) -> AccelerationSetpoint:
        autopilot = Autopilot(start_enu=(0.0, 0.0, 1.5), rest_height_m=0.2, yaw_rad=0.3)
        for t_ns in range(0, S + 1, 50 * MS):
            autopilot.setpoint(setpoint(mask), t_ns)
        autopilot.command(OFFBOARD, AIR, S)
        autopilot.turn(0.5)
        target = autopilot.target(state(1.5, v=(0.3, 0.0)))
        assert isinstance(target, AccelerationSetpoint)
        return target

    assert after(0x0C3F) == AccelerationSetpoint((1.0, 0.0, 0.0), 0.3)  # heading kept
    assert after(0x083F).yaw_rad == 0.7
    assert after(0x043F).yaw_rad == pytest.approx(0.3 + 0.5 * 0.2)
    assert after(0x0C07).a_enu == pytest.approx((1.0 + 1.8 * (0.5 - 0.3), 0.0, 0.0))


@pytest.mark.parametrize(
    ("request_", "expected"),
    [
        (POSITION, Result.ACCEPTED),
        (HOLD, Result.ACCEPTED),
        (command(176, 1.0, 1.0), Result.TEMPORARILY_REJECTED),  # manual: there are no sticks
        (command(176, 1.0, 4.0, 4.0), Result.TEMPORARILY_REJECTED),  # mission
        (command(176, 0.0, 6.0), Result.DENIED),  # no custom mode
        (command(176, 1.0, NAN), Result.DENIED),
        (command(300), Result.UNSUPPORTED),
    ],
)
def test_mode_requests(airborne: Autopilot, request_: Command, expected: Result) -> None:
    assert result(airborne.command(request_, AIR, 0)) is expected


def test_arming_in_offboard_needs_the_stream(grounded: Autopilot) -> None:
    stream(grounded, 0, S)
    grounded.command(OFFBOARD, GROUND, S)
    assert result(grounded.command(ARM, GROUND, 5 * S)) is Result.TEMPORARILY_REJECTED
    stream(grounded, 5 * S, 6 * S)
    assert result(grounded.command(ARM, GROUND, 6 * S)) is Result.ACCEPTED
    assert isinstance(grounded.target(GROUND), MotorsOff)  # sideways on the ground: stays
    grounded.setpoint(setpoint(a=(0.0, 0.0, 2.0)), 6 * S)
    assert isinstance(grounded.target(GROUND), AccelerationSetpoint)
