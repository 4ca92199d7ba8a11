"""What the PX4-style autopilot makes the simulated vehicle do: offboard setpoints, goto, return, sticks."""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest

from sim_bridge.autopilot import Autopilot
from sim_bridge.flight import Flight
from sim_bridge.geodesy import geodetic
from sim_bridge.messages import (
    Ack,
    AttitudeTarget,
    Command,
    Landed,
    LocalSetpoint,
    Mode,
    Result,
    Sender,
    Sticks,
    Text,
    Vec3,
)
from sim_bridge.physics import BodyState
from sim_bridge.placement import resolve
from sim_bridge.rotation import from_euler, to_euler, yaw_of
from sim_bridge.scenario import parse_scenario

GCS, COMPANION = Sender(245, 190), Sender(1, 196)
NAN = math.nan
FREE: Vec3 = (NAN, NAN, NAN)
UP = 10.0


class Rig:
    """A flight in process: what is sent to its autopilot every control period, and where it goes."""

    def __init__(self, start: Vec3 = (0.0, 0.0, UP), **parameters: float | int) -> None:
        self.flight = Flight(
            resolve("rig", parse_scenario({"vehicle": {"start": list(start)}, "end": {"stop": False}}, source="rig"), 0)
        )
        craft = self.flight.crafts[0]
        assert isinstance(craft.autopilot, Autopilot)
        self.autopilot: Autopilot = craft.autopilot
        for name, value in parameters.items():
            assert self.autopilot.parameters.write(name, value, is_int=isinstance(value, int)), name
        self.setpoint: LocalSetpoint | AttitudeTarget | None = None
        self.sticks: Sticks | None = None
        self.texts: list[str] = []
        self.path: list[BodyState] = []
        self.modes: list[Mode] = []
        self.landings: list[Landed] = []

    @property
    def state(self) -> BodyState:
        return self.flight.crafts[0].state

    def order(self, number: int, *params: float, frame: int = 0) -> Result:
        filled = (*params, *[0.0] * (7 - len(params)))
        command = Command(number, filled, GCS, frame=frame)  # type: ignore[arg-type]
        replies = self.autopilot.command(command, self.state, self.flight.t_ns)
        self.texts += [r.text for r in replies if isinstance(r, Text)]
        (ack,) = [r for r in replies if isinstance(r, Ack)]
        return ack.result

    def fly(self, seconds: float) -> None:
        for _ in range(round(seconds * 20)):
            t_ns = self.flight.t_ns
            if isinstance(self.setpoint, LocalSetpoint):
                assert self.autopilot.setpoint(self.setpoint, t_ns) == ()
            elif self.setpoint is not None:
                assert self.autopilot.attitude_setpoint(self.setpoint, t_ns) == ()
            if self.sticks is not None:
                self.autopilot.manual(self.sticks, t_ns)
            for replies in self.flight.control():
                self.texts += [r.text for r in replies if isinstance(r, Text)]
            for _ in range(12):
                self.flight.advance()
            self.path.append(self.state)
            if self.autopilot.mode not in self.modes[-1:]:
                self.modes.append(self.autopilot.mode)
            if self.autopilot.landed not in self.landings[-1:]:
                self.landings.append(self.autopilot.landed)

    def offboard(self, setpoint: LocalSetpoint | AttitudeTarget) -> None:
        self.setpoint = setpoint
        self.fly(0.6)
        assert self.order(176, 1.0, 6.0) is Result.ACCEPTED


@pytest.fixture
def rigs() -> Iterator[list[Rig]]:
    made: list[Rig] = []
    yield made
    for rig in made:
        rig.flight.close()


@pytest.fixture
def rig(rigs: list[Rig]) -> Rig:
    rigs.append(Rig())
    return rigs[0]


def wants(
    p: Vec3 = FREE,
    v: Vec3 = FREE,
    a: Vec3 = FREE,
    *,
    yaw: float = NAN,
    rate: float = NAN,
    frame: int = 1,
    is_global: bool = False,
) -> LocalSetpoint:
    """A setpoint whose mask ignores what is NaN; vectors ENU (the mask's bits are north, east, down)."""
    fields = [x for vector in (p, v, a) for x in (vector[1], vector[0], vector[2])]
    mask = sum(1 << i for i, x in enumerate(fields) if math.isnan(x))
    mask |= 0x400 * math.isnan(yaw) | 0x800 * math.isnan(rate)
    return LocalSetpoint(0, frame, mask, p, v, a, yaw, rate, COMPANION, is_global)


# offboard


def test_a_position_setpoint_is_flown_to_and_held(rig: Rig) -> None:
    rig.offboard(wants(p=(2.0, -1.0, UP + 1.0), yaw=1.0))
    rig.fly(10.0)
    assert rig.state.p_enu == pytest.approx((2.0, -1.0, UP + 1.0), abs=0.05)
    assert yaw_of(rig.state.q_wxyz) == pytest.approx(1.0, abs=0.02)
    assert max(state.p_enu[0] for state in rig.path) < 2.25  # little overshoot


@pytest.mark.parametrize(
    ("name", "limit", "axis", "sign"),
    [("MPC_XY_VEL_MAX", 2.0, 0, 1.0), ("MPC_Z_VEL_MAX_UP", 1.0, 2, 1.0), ("MPC_Z_VEL_MAX_DN", 0.5, 2, -1.0)],
)
def test_speed_limits_act_on_positions_and_velocities(
    rigs: list[Rig], name: str, limit: float, axis: int, sign: float
) -> None:
    for kind in ("position", "velocity"):
        rig = Rig(**{name: limit})
        rigs.append(rig)
        p, v = list(rig.state.p_enu), [0.0, 0.0, 0.0]
        p[axis] += sign * 30.0
        v[axis] = sign * 30.0
        rig.offboard(wants(p=tuple(p)) if kind == "position" else wants(v=tuple(v)))  # type: ignore[arg-type]
        rig.fly(4.0)
        assert sign * rig.state.v_enu[axis] == pytest.approx(limit, abs=0.15), kind


def test_a_velocity_setpoint_is_followed_without_a_lasting_error(rig: Rig) -> None:
    rig.offboard(wants(v=(2.0, 1.0, 0.5), rate=0.5))
    rig.fly(6.0)
    assert rig.state.v_enu == pytest.approx((2.0, 1.0, 0.5), abs=0.06)  # against rotor drag: the integral
    turned = math.remainder(yaw_of(rig.path[-1].q_wxyz) - yaw_of(rig.path[-41].q_wxyz), math.tau)
    assert turned == pytest.approx(1.0, abs=0.05)  # 2 s at 0.5 rad/s


def test_axes_may_be_mixed(rig: Rig) -> None:
    rig.offboard(wants(p=(NAN, NAN, UP + 1.0), v=(1.0, 0.0, NAN)))
    rig.fly(6.0)
    assert rig.state.p_enu[2] == pytest.approx(UP + 1.0, abs=0.05)
    assert rig.state.v_enu[0] == pytest.approx(1.0, abs=0.06)
    assert rig.state.p_enu[1] == pytest.approx(0.0, abs=0.05)


def test_an_acceleration_setpoint_tilts_no_more_than_mpc_tiltmax_air(rigs: list[Rig]) -> None:
    for tilt_deg in (20.0, 40.0):
        rig = Rig(MPC_TILTMAX_AIR=tilt_deg)
        rigs.append(rig)
        rig.offboard(wants(a=(9.0, 0.0, 0.0)))
        rig.fly(0.8)
        roll, pitch, _ = to_euler(rig.state.q_wxyz)
        assert math.degrees(math.hypot(roll, pitch)) == pytest.approx(tilt_deg, abs=2.0)


def test_the_body_frame_turns_velocities_with_the_heading(rig: Rig) -> None:
    rig.offboard(wants(p=(0.0, 0.0, UP), yaw=math.pi / 2))  # faces north
    rig.fly(3.0)
    rig.setpoint = wants(v=(1.0, 0.5, 0.25), frame=8)  # forward, left, up
    rig.fly(4.0)
    assert rig.state.v_enu == pytest.approx((-0.5, 1.0, 0.25), abs=0.06)


@pytest.mark.parametrize(("frame", "altitude"), [(5, 488.0 + UP + 1.0), (6, UP + 1.0)])
def test_global_setpoints(rig: Rig, frame: int, altitude: float) -> None:
    rig.offboard(wants(p=(2.0, 1.0, altitude), frame=frame, is_global=True))
    rig.fly(8.0)
    assert rig.state.p_enu == pytest.approx((2.0, 1.0, UP + 1.0), abs=0.05)


HOVER = 1.0 / 2.25


def test_an_attitude_setpoint_is_flown(rig: Rig) -> None:
    q = from_euler(0.1, 0.2, 0.3)
    rig.offboard(AttitudeTarget(0, 0x07, q, (0.0, 0.0, 0.0), HOVER / (math.cos(0.1) * math.cos(0.2)), COMPANION))
    rig.fly(1.0)
    assert to_euler(rig.state.q_wxyz) == pytest.approx((0.1, 0.2, 0.3), abs=0.02)
    assert rig.state.p_enu[2] == pytest.approx(UP, abs=0.15)
    assert rig.state.v_enu[0] > 1.0  # nose down, facing east: forward
    target = rig.autopilot.attitude_target()
    assert target is not None
    assert target.q_wxyz == q
    assert rig.autopilot.position_target() is None
    rig.setpoint = None
    rig.fly(2.0)
    assert rig.modes[-1] is Mode.HOLD  # the proof of life holds for attitudes, too
    assert math.remainder(yaw_of(rig.state.q_wxyz) - 0.3, math.tau) == pytest.approx(0.0, abs=0.05)


def test_thrust_alone_climbs_and_falls(rigs: list[Rig]) -> None:
    for share, expected in ((1.2, 1.96), (0.8, -1.96)):
        rig = Rig()
        rigs.append(rig)
        level = AttitudeTarget(0, 0x07, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), share * HOVER, COMPANION)
        rig.offboard(level)
        rig.fly(0.1)
        before = rig.state.v_enu[2]
        rig.fly(0.2)
        assert (rig.state.v_enu[2] - before) / 0.2 == pytest.approx(expected, abs=0.15)  # g (share - 1)


def test_body_rates_are_flown(rig: Rig) -> None:
    rig.offboard(AttitudeTarget(0, 0x80, (NAN,) * 4, (0.0, 0.0, 1.0), HOVER, COMPANION))
    rig.fly(1.0)
    assert rig.state.omega_flu == pytest.approx((0.0, 0.0, 1.0), abs=0.05)


@pytest.mark.parametrize(
    "bad",
    [
        AttitudeTarget(0, 0x83, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.5, COMPANION),  # neither attitude nor rates
        AttitudeTarget(0, 0x07, (NAN, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.5, COMPANION),
        AttitudeTarget(0, 0x07, (0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.5, COMPANION),
        AttitudeTarget(0, 0x07, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), NAN, COMPANION),
    ],
)
def test_attitudes_that_cannot_be_flown_are_refused(rig: Rig, bad: AttitudeTarget) -> None:
    (text,) = rig.autopilot.attitude_setpoint(bad, 0)
    assert isinstance(text, Text)
    assert rig.autopilot.last_setpoint is None


def test_offboard_takes_off_and_lands(rigs: list[Rig]) -> None:
    rig = Rig((0.0, 0.0, 0.2))
    rigs.append(rig)
    rig.offboard(wants(p=(0.0, 0.0, 1.5)))
    assert rig.order(400, 1.0) is Result.ACCEPTED
    rig.fly(5.0)
    assert rig.state.p_enu == pytest.approx((0.0, 0.0, 1.5), abs=0.05)
    assert rig.autopilot.airborne
    rig.setpoint = wants(v=(0.0, 0.0, -0.5))
    rig.fly(4.0)
    assert rig.autopilot.landed is Landed.ON_GROUND
    rig.fly(2.5)
    assert not rig.autopilot.armed
    assert "Disarmed by landing" in rig.texts


# automatic modes


def test_takeoff_first_and_arming_then_as_qgroundcontrol_does(rigs: list[Rig]) -> None:
    rig = Rig((0.0, 0.0, 0.2))
    rigs.append(rig)
    assert rig.order(22, *[NAN] * 6, 490.0) is Result.ACCEPTED
    rig.fly(1.0)
    assert not rig.autopilot.airborne
    assert rig.order(400, 1.0) is Result.ACCEPTED
    rig.fly(6.0)
    assert rig.autopilot.mode is Mode.HOLD
    assert rig.state.p_enu[2] == pytest.approx(2.0, abs=0.05)


def goto(rig: Rig, p: Vec3, *, speed: float = -1.0, heading: float = NAN) -> Result:
    latitude, longitude = geodetic(p[0], p[1])
    return rig.order(192, speed, 1.0, 0.0, heading, latitude, longitude, p[2] + 488.0)


def test_goto_with_speed_and_heading(rig: Rig) -> None:
    assert goto(rig, (8.0, 6.0, UP + 2.0), speed=1.5, heading=0.0) is Result.ACCEPTED
    rig.fly(3.0)
    assert math.hypot(*rig.state.v_enu[:2]) == pytest.approx(1.5, abs=0.1)
    assert rig.autopilot.mode is Mode.HOLD
    rig.fly(8.0)
    assert rig.state.p_enu == pytest.approx((8.0, 6.0, UP + 2.0), abs=0.05)
    assert yaw_of(rig.state.q_wxyz) == pytest.approx(math.pi / 2, abs=0.02)  # north
    assert rig.order(178, 1.0, 3.0) is Result.ACCEPTED  # DO_CHANGE_SPEED
    assert goto(rig, (20.0, 6.0, UP + 2.0)) is Result.ACCEPTED
    rig.fly(3.0)
    assert math.hypot(*rig.state.v_enu[:2]) == pytest.approx(3.0, abs=0.15)
    rig.fly(6.0)
    assert max(state.p_enu[0] for state in rig.path) < 20.1  # brakes in time


def test_goto_needs_its_flag_and_a_global_frame(rig: Rig) -> None:
    assert rig.order(192, -1.0, 0.0) is Result.UNSUPPORTED
    assert rig.order(192, -1.0, 1.0, frame=1) is Result.DENIED
    assert rig.order(192, -1.0, 1.0, 0.0, NAN, NAN, NAN, UP + 1.0, frame=6) is Result.ACCEPTED  # above home, here
    rig.fly(4.0)
    assert rig.state.p_enu == pytest.approx((0.0, 0.0, UP + 1.0), abs=0.05)


def test_return_climbs_flies_home_and_lands(rigs: list[Rig]) -> None:
    rig = Rig((0.0, 0.0, 0.2), RTL_RETURN_ALT=4.0, RTL_DESCEND_ALT=2.0, RTL_MIN_DIST=5.0, NAV_ACC_RAD=0.5)
    rigs.append(rig)
    assert rig.order(400, 1.0) is Result.ACCEPTED
    assert rig.order(22, *[NAN] * 7) is Result.ACCEPTED
    rig.fly(4.0)
    assert goto(rig, (12.0, 0.0, 1.5)) is Result.ACCEPTED
    rig.fly(8.0)
    rig.path.clear()
    assert rig.order(20) is Result.ACCEPTED
    rig.fly(0.8)
    assert rig.state.p_enu[0] == pytest.approx(12.0, abs=0.1)  # climbs first
    assert rig.state.v_enu[2] > 1.0
    rig.fly(30.0)
    assert max(state.p_enu[2] for state in rig.path) == pytest.approx(4.0, abs=0.1)
    assert not rig.autopilot.armed
    assert rig.state.p_enu[:2] == pytest.approx((0.0, 0.0), abs=0.2)
    assert rig.landings[-2:] == [Landed.LANDING, Landed.ON_GROUND]
    assert rig.modes[-2:] == [Mode.RETURN, Mode.HOLD]


@pytest.mark.parametrize(
    ("distance", "cone", "z"),
    [
        (50.0, 45, 30.0),  # RTL_RETURN_ALT
        (8.0, 45, 8.0),  # on the cone
        (3.0, 45, 4.0),  # but twice NAV_ACC_RAD
        (8.0, 0, 30.0),  # no cone
        (8.0, 90, 4.0),
        (1.0, 45, 2.0),  # within NAV_ACC_RAD: twice the distance
    ],
)
def test_the_return_altitude(rig: Rig, distance: float, cone: int, z: float) -> None:
    assert rig.autopilot.parameters.write("RTL_CONE_ANG", cone, is_int=True)
    assert rig.autopilot._navigator.return_z_m((distance, 0.0, 1.5), (0.0, 0.0, 0.0)) == pytest.approx(z)
    assert rig.autopilot._navigator.return_z_m((distance, 0.0, 40.0), (0.0, 0.0, 0.0)) == 40.0  # never down


def test_home_can_be_set(rig: Rig) -> None:
    latitude, longitude = geodetic(3.0, 4.0)
    assert rig.order(179, 0.0, 0.0, 0.0, 0.0, latitude, longitude, 493.0) is Result.ACCEPTED
    assert rig.autopilot.home_enu == pytest.approx((3.0, 4.0, 5.0), abs=1e-3)
    assert rig.order(179, 1.0) is Result.ACCEPTED
    assert rig.autopilot.home_enu == rig.state.p_enu
    assert rig.order(179, 0.0, 0.0, 0.0, 0.0, NAN, NAN, NAN) is Result.DENIED
    assert rig.autopilot.parameters.write("COM_HOME_EN", 0, is_int=True)
    assert rig.order(179, 1.0) is Result.DENIED


# sticks


def sticks(forward: float = 0.0, left: float = 0.0, up: float = 0.0, turn: float = 0.0) -> Sticks:
    return Sticks(forward, left, up, turn, GCS)


def by_sticks(rigs: list[Rig], main: int, **parameters: float | int) -> Rig:
    rig = Rig(**parameters)
    rigs.append(rig)
    rig.sticks = sticks()
    rig.fly(0.5)
    assert rig.order(176, 1.0, float(main)) is Result.ACCEPTED
    return rig


def test_position_mode_flies_by_the_sticks(rigs: list[Rig]) -> None:
    rig = by_sticks(rigs, 3, MPC_VEL_MANUAL=3.0, MPC_HOLD_DZ=0.0)
    rig.sticks = sticks(forward=0.5, up=0.5)
    rig.fly(5.0)
    assert rig.state.v_enu == pytest.approx((1.5, 0.0, 1.5), abs=0.1)  # half of MPC_VEL_MANUAL and MPC_Z_VEL_MAX_UP
    rig.sticks = sticks(turn=0.5)
    rig.fly(0.5)
    assert rig.state.omega_flu[2] == pytest.approx(math.radians(75.0), abs=0.1)  # half of MPC_MAN_Y_MAX
    rig.sticks = sticks()
    rig.fly(6.0)
    held = rig.state.p_enu
    rig.fly(3.0)
    assert math.dist(rig.state.p_enu, held) < 0.05
    facing = yaw_of(rig.state.q_wxyz)
    rig.sticks = sticks(left=0.5)
    rig.fly(3.0)
    assert rig.state.v_enu[:2] == pytest.approx((-1.5 * math.sin(facing), 1.5 * math.cos(facing)), abs=0.1)


def test_position_mode_accelerates_by_mpc_acc_hor(rigs: list[Rig]) -> None:
    rig = by_sticks(rigs, 3, MPC_ACC_HOR=2.0)
    rig.sticks = sticks(forward=1.0)
    rig.fly(2.0)
    before = rig.state.v_enu[0]
    rig.fly(1.0)
    assert rig.state.v_enu[0] - before == pytest.approx(2.0, abs=0.25)  # rotor drag takes some


def test_altitude_mode_tilts_and_holds_its_height(rigs: list[Rig]) -> None:
    rig = by_sticks(rigs, 2, MPC_MAN_TILT_MAX=20.0)
    rig.sticks = sticks(left=1.0)
    rig.fly(1.5)
    roll, _, _ = to_euler(rig.state.q_wxyz)
    assert math.degrees(roll) == pytest.approx(-20.0, abs=1.0)
    assert rig.state.v_enu[1] > 2.0  # drifts left: no velocity is held
    assert rig.state.p_enu[2] == pytest.approx(UP, abs=0.15)
    rig.sticks = sticks(up=-1.0)
    rig.fly(2.0)
    assert rig.state.v_enu[2] == pytest.approx(-1.5, abs=0.1)  # MPC_Z_VEL_MAX_DN


def test_stabilized_mode_is_thrust(rigs: list[Rig]) -> None:
    rig = by_sticks(rigs, 7)
    rig.fly(1.0)
    assert rig.state.v_enu[2] == pytest.approx(0.0, abs=0.1)  # centred: hover thrust
    rig.sticks = sticks(up=-0.5)
    rig.fly(0.5)
    assert rig.state.v_enu[2] < -1.0


@pytest.mark.parametrize("main", [2, 7])
def test_modes_without_a_position_loop_need_sticks(rig: Rig, main: int) -> None:
    assert rig.order(176, 1.0, float(main)) is Result.TEMPORARILY_REJECTED
    assert "no manual control" in rig.texts[-1]


def test_a_pilot_takes_off_and_lands_by_the_sticks(rigs: list[Rig]) -> None:
    rig = Rig((0.0, 0.0, 0.2))
    rigs.append(rig)
    rig.sticks = sticks(up=-1.0)
    rig.fly(0.2)
    assert rig.order(176, 1.0, 3.0) is Result.ACCEPTED
    assert rig.order(400, 1.0) is Result.ACCEPTED
    rig.fly(0.5)
    assert not rig.autopilot.airborne
    rig.sticks = sticks(up=0.5)
    rig.fly(2.0)
    assert rig.state.p_enu[2] > 1.0
    rig.sticks = sticks(up=-0.6)
    rig.fly(5.0)
    assert rig.autopilot.landed is Landed.ON_GROUND
    rig.fly(2.0)
    assert not rig.autopilot.armed
