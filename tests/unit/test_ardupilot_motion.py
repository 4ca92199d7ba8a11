"""ArduCopter's GUIDED flown in PyBullet, row by row against what was measured on ArduCopter 4.7-dev (SITL).

The bands are the measurements' own where the simulated vehicle can meet them; where it differs the test says by how
much. Figures of the measured one: first velocity 0.21 s after a step, slopes within 7 % up to 3 m/s^2, +a then -a for
the same time leaves 0.2 m/s at 1 m/s^2 and 0.85 at 2, GUID_TIMEOUT 3 s, nose into the flight above 0.7 m/s.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from ardupilot_rig import (
    ACCELERATION_YAW,
    ACCELERATION_YAW_RATE,
    ARM,
    POSITION,
    VELOCITY,
    VELOCITY_ACCELERATION,
    Rig,
    result,
    set_mode,
    setpoint,
    takeoff,
)

from sim_bridge.messages import Landed, LocalSetpoint, Result

JERK_M_S3 = 5.0


@pytest.fixture
def rig() -> Iterator[Callable[..., Rig]]:
    made: list[Rig] = []

    def make(*args: object, **kwargs: object) -> Rig:
        made.append(Rig(*args, **kwargs))  # type: ignore[arg-type]
        return made[-1]

    yield make
    for each in made:
        each.close()


def first_time(path: np.ndarray, column: int, beyond: float) -> float:
    return float(path[np.argmax(np.abs(path[:, column]) > beyond), 0])


def ramp_delay_s(path: np.ndarray, column: int, a: float) -> float:
    """How much later than the jerk-limited ramp the acceleration comes to 63 % of the step."""
    achieved = np.diff(path[:, column]) * 240.0
    return float(path[np.argmax(achieved >= 0.632 * a), 0]) - 0.632 * a / JERK_M_S3


def test_first_velocity_comes_0_21_s_after_a_level_step(rig: Callable[..., Rig]) -> None:
    path = rig().guided().fly(0.5, setpoint((1.0, 0.0, 0.0)))
    assert first_time(path, 4, 0.05) == pytest.approx(0.21, abs=0.02)


@pytest.mark.parametrize("a", [1.0, 3.0])
def test_level_steps_are_jerk_limited_then_lag_0_06_s(rig: Callable[..., Rig], a: float) -> None:
    path = rig().guided().fly(1.0, setpoint((a, 0.0, 0.0)))
    assert ramp_delay_s(path, 4, a) == pytest.approx(0.06, abs=0.02)


@pytest.mark.parametrize("a", [0.5, 2.0, 3.0])
def test_vertical_steps_lag_0_13_to_0_20_s(rig: Callable[..., Rig], a: float) -> None:
    path = rig().guided().fly(1.0, setpoint((0.0, 0.0, a)))
    assert 0.13 <= ramp_delay_s(path, 6, a) <= 0.20


@pytest.mark.parametrize("a_enu", [(0.0, 0.5, 0.0), (3.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, -2.0)])
def test_slopes_are_right_within_7_per_cent(rig: Callable[..., Rig], a_enu: tuple[float, float, float]) -> None:
    path = rig().guided().fly(1.8, setpoint(a_enu))
    column, a = 4 + int(np.argmax(np.abs(a_enu))), float(np.sum(a_enu))
    slope = (path[-1, column] - path[240, column]) / (path[-1, 0] - path[240, 0])
    assert slope == pytest.approx(a, rel=0.07)


@pytest.mark.parametrize(("a", "measured_m_s"), [(1.0, 0.2), (2.0, 0.85)])
def test_plus_then_minus_leaves_what_the_jerk_limit_owes(
    rig: Callable[..., Rig], a: float, measured_m_s: float
) -> None:
    flown = rig().guided()
    flown.fly(1.0, setpoint((a, 0.0, 0.0)))
    flown.fly(1.0, setpoint((-a, 0.0, 0.0)))
    flown.fly(1.0, setpoint())
    assert flown.v[0] == pytest.approx(measured_m_s, abs=0.1)
    assert flown.v[0] == pytest.approx(a * a / JERK_M_S3, abs=0.05)  # the limit's own account


def test_psc_jerk_xy_acts(rig: Callable[..., Rig]) -> None:
    path = rig(PSC_JERK_XY=20.0).guided().fly(0.5, setpoint((1.0, 0.0, 0.0)))
    assert first_time(path, 4, 0.05) < 0.17


def test_zero_acceleration_keeps_the_velocity(rig: Callable[..., Rig]) -> None:
    flown = rig().guided()
    flown.fly(1.0, setpoint((1.0, 0.0, 0.5)))
    flown.fly(0.5, setpoint())
    before = flown.v
    flown.fly(3.0, setpoint())
    assert flown.v == pytest.approx(before, abs=0.12)
    assert before[0] > 0.8


def test_the_last_acceleration_goes_on_for_guid_timeout_then_it_brakes_and_holds(rig: Callable[..., Rig]) -> None:
    flown = rig().guided()
    flown.fly(0.2, setpoint((1.0, 0.0, 0.0)))
    path = flown.fly(3.0)  # not a word for 3 s: the default
    assert path[-1, 4] == pytest.approx(2.9, rel=0.1)
    braking = flown.fly(4.0)
    peak = braking[np.argmax(braking[:, 4])]
    assert peak[0] < 0.7
    assert braking[-1, 4:7] == pytest.approx(0.0, abs=0.05)
    stood = flown.fly(2.0)
    assert np.ptp(stood[:, 1]) < 0.05
    assert flown.autopilot.mode_name == "GUIDED"
    # from the last setpoint: v t + a t^2 / 2 in 3 s, and the way of braking from nearly 3 m/s
    assert 4.0 < path[-1, 1] - path[0, 1] < 5.5


def test_guid_timeout_acts(rig: Callable[..., Rig]) -> None:
    flown = rig(GUID_TIMEOUT=0.5).guided()
    flown.fly(0.2, setpoint((1.0, 0.0, 0.0)))
    flown.fly(3.0)
    assert flown.v == pytest.approx(0.0, abs=0.1)


@pytest.mark.parametrize(
    "bad",
    [
        setpoint((2.0, 0.0, 0.0), mask=0x0E3F),  # FORCE
        setpoint((2.0, 0.0, 0.0), mask=0x0C7F),  # one axis ignored
        setpoint((2.0, 0.0, 0.0), mask=0x0C38, p=(9.0, 9.0, 9.0)),  # position and acceleration
        setpoint((2.0, 0.0, 0.0), mask=0x0DFF),  # everything ignored
        setpoint((2.0, 0.0, 0.0), frame=5),
    ],
    ids=["force", "one-axis", "position+acceleration", "all-ignored", "frame-5"],
)
def test_what_it_dislikes_stops_it_silently(rig: Callable[..., Rig], bad: LocalSetpoint) -> None:
    flown = rig().guided()
    flown.fly(1.0, setpoint((2.0, 0.0, 0.0)))
    assert flown.v[0] > 1.4
    flown.fly(3.0, bad)
    assert flown.v == pytest.approx(0.0, abs=0.08)
    assert flown.said == []
    assert flown.autopilot.mode_name == "GUIDED"
    echo = flown.autopilot.position_target()
    assert echo is not None
    assert (echo.type_mask, echo.v_enu, echo.a_enu) == (0x0C07, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def test_nan_stops_it_and_is_told_where_the_real_one_crashed(rig: Callable[..., Rig]) -> None:
    flown = rig().guided()
    flown.fly(1.0, setpoint((2.0, 0.0, 0.0)))
    flown.fly(2.95, setpoint((math.nan, 0.0, 0.0)))
    assert flown.v == pytest.approx(0.0, abs=0.08)
    assert flown.said == ["NaN in setpoint: ArduCopter would crash"] * 3  # once a second


@pytest.mark.parametrize("frame", [1, 7, 8, 9])
def test_frames_turn_with_the_nose_or_do_not(rig: Callable[..., Rig], frame: int) -> None:
    """Forward (x of the wire) in a body frame is where the nose points; in a local one it is north."""
    flown = rig(yaw_deg=180.0).guided()
    north, ahead = (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)  # as the decoder makes x of the wire: ENU, and FLU
    flown.fly(1.0, setpoint(north if frame in (1, 7) else ahead, mask=ACCELERATION_YAW_RATE, frame=frame))
    assert flown.v[0] == pytest.approx(0.0 if frame in (1, 7) else -0.85, abs=0.08)
    assert flown.v[1] == pytest.approx(0.85 if frame in (1, 7) else 0.0, abs=0.08)


def test_position_masks_fly_there_and_hold(rig: Callable[..., Rig]) -> None:
    flown = rig().guided()
    flown.fly(0.1, setpoint(mask=POSITION, p=(2.0, -1.0, 21.0)))
    flown.fly(7.0)  # positions do not age
    assert flown.p == pytest.approx((2.0, -1.0, 21.0), abs=0.05)
    flown.fly(0.1, setpoint(mask=POSITION, p=(-1.0, 0.0, 0.0), frame=7))
    flown.fly(5.0)
    assert flown.p == pytest.approx((1.0, -1.0, 21.0), abs=0.05)


@pytest.mark.parametrize(("frame", "z"), [(6, 21.0), (5, 509.0), (11, None)])
def test_global_positions_above_home_or_the_sea(rig: Callable[..., Rig], frame: int, z: float | None) -> None:
    """The local origin is 488 m above the sea; there is no terrain, and what is above it stops."""
    flown = rig().guided()
    there = replace(setpoint(mask=POSITION, p=(1.0, 0.0, z or 21.0), frame=frame), is_global=True)
    flown.fly(6.0, there)
    assert flown.p == pytest.approx((1.0, 0.0, 21.0) if z else (0.0, 0.0, 20.0), abs=0.06)


def test_velocity_masks_and_the_one_with_acceleration(rig: Callable[..., Rig]) -> None:
    flown = rig().guided()
    flown.fly(2.5, setpoint(mask=VELOCITY, v=(1.5, 0.0, 0.0)))
    assert flown.v == pytest.approx((1.5, 0.0, 0.0), abs=0.08)
    flown.fly(2.5, setpoint(mask=VELOCITY_ACCELERATION, v=(0.0, 1.0, 0.0)))
    assert flown.v == pytest.approx((0.0, 1.0, 0.0), abs=0.1)
    echo = flown.autopilot.position_target()
    assert echo is not None
    assert (echo.type_mask, echo.v_enu) == (0x0C07, (0.0, 1.0, 0.0))


def test_yaw_ignored_turns_the_nose_into_the_flight_above_0_7_m_s(rig: Callable[..., Rig]) -> None:
    flown = rig().guided()
    flown.fly(0.5, setpoint((0.0, 1.0, 0.0)))
    slow = flown.fly(1.5, setpoint())
    assert 0.3 < slow[-1, 5] < 0.7
    assert flown.heading_deg == pytest.approx(0.0, abs=2.0)
    flown.fly(0.7, setpoint((0.0, 1.0, 0.0)))
    flown.fly(2.5, setpoint())
    assert flown.v[1] > 0.8
    assert flown.heading_deg == pytest.approx(90.0, abs=6.0)


def test_yaw_rate_zero_holds_the_nose_and_a_yaw_turns_it(rig: Callable[..., Rig]) -> None:
    flown = rig(yaw_deg=30.0).guided()
    flown.fly(1.5, setpoint((0.0, 1.0, 0.0), mask=ACCELERATION_YAW_RATE))
    assert flown.v[1] > 1.0
    assert flown.heading_deg == pytest.approx(30.0, abs=2.0)
    flown.fly(2.5, setpoint(mask=ACCELERATION_YAW, yaw=math.radians(-60.0)))
    assert flown.heading_deg == pytest.approx(-60.0, abs=4.0)


def test_takeoff_flies_to_param7_above_home_and_says_so(rig: Callable[..., Rig]) -> None:
    flown = rig((0.0, 0.0, 0.2))
    flown.fly(2.1)
    flown.guided()
    assert result(flown.order(ARM)) is Result.ACCEPTED
    assert result(flown.order(takeoff(3.0))) is Result.ACCEPTED
    flown.fly(0.8)
    assert flown.autopilot.landed is Landed.TAKEOFF
    assert not flown.autopilot.external
    flown.fly(8.0, until=lambda: flown.autopilot.landed is Landed.IN_AIR)
    assert flown.p[2] == pytest.approx(3.0, abs=0.15)
    flown.fly(2.5)
    assert flown.autopilot.hovering(flown.t_ns)
    assert flown.p == pytest.approx((0.0, 0.0, 3.0), abs=0.05)
    assert not flown.autopilot.external  # nothing from outside yet
    flown.fly(0.2, setpoint((1.0, 0.0, 0.0)))
    assert flown.autopilot.external


def test_setpoints_on_the_ground_do_nothing_and_during_takeoff_cancel_it_and_keep_the_climb(
    rig: Callable[..., Rig],
) -> None:
    flown = rig((0.0, 0.0, 0.2))
    flown.fly(2.1)
    flown.guided()
    flown.order(ARM)
    flown.fly(1.0, setpoint((2.0, 0.0, 3.0)))
    assert flown.p == pytest.approx((0.0, 0.0, 0.2), abs=0.01)
    flown.order(takeoff(2.0))
    flown.fly(3.0, until=lambda: flown.p[2] > 0.7)
    climb = flown.v[2]
    assert climb > 0.3
    flown.fly(3.0, setpoint())
    assert flown.p[2] > 2.2  # beyond the takeoff's altitude
    assert flown.v[2] == pytest.approx(climb, abs=0.15)


def test_land_disarms_at_once_and_from_guided_after_disarm_delay(rig: Callable[..., Rig]) -> None:
    flown = rig((0.0, 0.0, 1.2))
    flown.order(set_mode(9))
    path = flown.fly(8.0, until=lambda: not flown.autopilot.armed)
    assert -0.6 < path[:, 6].min() < -0.4  # LAND_SPEED
    assert flown.autopilot.landed is Landed.ON_GROUND
    assert flown.said == ["Disarming motors"]
    again = rig((0.0, 0.0, 0.6), DISARM_DELAY=3).guided()
    again.fly(4.0, setpoint(mask=VELOCITY, v=(0.0, 0.0, -0.4)), until=lambda: not again.autopilot.airborne)
    assert again.autopilot.armed
    again.fly(4.0, until=lambda: not again.autopilot.armed)
    assert not again.autopilot.armed


def test_brake_stops_and_holds_loiter_as_well(rig: Callable[..., Rig]) -> None:
    for mode in (17, 5):
        flown = rig().guided()
        flown.fly(1.5, setpoint((2.0, 0.0, 0.0)))
        assert result(flown.order(set_mode(mode))) is Result.ACCEPTED
        path = flown.fly(5.0, setpoint((2.0, 0.0, 0.0)))  # setpoints are not obeyed here
        assert path[-1, 4:7] == pytest.approx(0.0, abs=0.05)
        assert flown.autopilot.position_target() is None


def test_rtl_climbs_the_cone_comes_home_waits_and_lands(rig: Callable[..., Rig]) -> None:
    flown = rig((0.0, 0.0, 1.5), RTL_LOIT_TIME=500).guided()
    flown.fly(0.1, setpoint(mask=POSITION, p=(1.0, 0.0, 1.5)))
    flown.fly(4.0)
    assert result(flown.order(set_mode(6))) is Result.ACCEPTED
    path = flown.fly(25.0, until=lambda: not flown.autopilot.armed)
    assert path[:, 3].max() == pytest.approx(3.0, abs=0.2)  # RTL_CONE_SLOPE times the distance, not RTL_ALT
    assert path[-1, 1:3] == pytest.approx((0.0, 0.0), abs=0.1)
    assert flown.autopilot.landed is Landed.ON_GROUND
