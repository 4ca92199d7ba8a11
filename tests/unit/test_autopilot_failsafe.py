"""The failsafes of the PX4-style autopilot, told states and times by hand: each a mode change and a text."""

from __future__ import annotations

import math
from dataclasses import dataclass

import pytest

from sim_bridge.autopilot import Autopilot
from sim_bridge.controller import AccelerationSetpoint, MotorsOff, PositionSetpoint
from sim_bridge.messages import Ack, Command, LocalSetpoint, Mode, Result, Sender, Severity, Sticks, Text, Vec3
from sim_bridge.physics import BodyState

GCS = Sender(245, 190)
MS = 1_000_000
S = 1000 * MS
NAN = math.nan


@dataclass(frozen=True)
class Reading:
    share: float
    voltage_v: float = 3.7
    current_a: float = 5.0
    consumed_mah: float = 0.0


class Pilot:
    """An airborne autopilot at ``p``, its clock, what it said, and what is sent to it every 50 ms."""

    def __init__(self, p: Vec3 = (0.0, 0.0, 1.5), **parameters: float | int) -> None:
        self.autopilot = Autopilot(start_enu=(0.0, 0.0, 1.5), rest_height_m=0.2, yaw_rad=0.0)
        for name, value in parameters.items():
            assert self.autopilot.parameters.write(name, value, is_int=isinstance(value, int)), name
        self.p = p
        self.v: Vec3 = (0.0, 0.0, 0.0)
        self.t_ns = 0
        self.texts: list[Text] = []
        self.streams = False
        self.sticks: Sticks | None = None
        self.station = False
        self.modes: list[str] = []

    @property
    def state(self) -> BodyState:
        return BodyState(self.p, self.v, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))

    @property
    def mode(self) -> Mode:
        return self.autopilot.mode

    def fly(self, seconds: float) -> None:
        for _ in range(round(seconds * 20)):
            self.t_ns += 50 * MS
            if self.streams:
                self.autopilot.setpoint(_hover(), self.t_ns)
            if self.sticks is not None:
                self.autopilot.manual(self.sticks, self.t_ns)
            if self.station:
                self.autopilot.heard_station(self.t_ns)
            self.texts += [r for r in self.autopilot.step(self.state, self.t_ns) if isinstance(r, Text)]
            self.autopilot.target(self.state)
            if not self.modes or self.modes[-1] != self.autopilot.mode_name:
                self.modes.append(self.autopilot.mode_name)

    def order(self, number: int, *params: float) -> Result:
        command = Command(number, (*params, *[0.0] * (7 - len(params))), GCS)  # type: ignore[arg-type]
        replies = self.autopilot.command(command, self.state, self.t_ns)
        self.texts += [r for r in replies if isinstance(r, Text)]
        (ack,) = [r for r in replies if isinstance(r, Ack)]
        return ack.result

    def offboard(self) -> None:
        self.streams = True
        self.fly(1.0)
        assert self.order(176, 1.0, 6.0) is Result.ACCEPTED
        self.fly(0.2)
        assert self.mode is Mode.OFFBOARD

    def said(self, text: str) -> int:
        return sum(text in each.text for each in self.texts)


def _hover() -> LocalSetpoint:
    return LocalSetpoint(0, 1, 0x0C3F, (NAN,) * 3, (NAN,) * 3, (0.0, 0.0, 0.0), 0.0, 0.0, Sender(1, 196))


def sticks(
    forward: float = 0.0, left: float = 0.0, up: float = 0.0, turn: float = 0.0, *, radio: bool = False
) -> Sticks:
    return Sticks(forward, left, up, turn, GCS, radio=radio)


# the setpoint stream


@pytest.mark.parametrize(
    ("act", "mode", "said"),
    [
        (3, "RETURN", "returning"),
        (4, "LAND", "landing"),
        (5, "HOLD", "holding"),
        (6, "TERMINATION", "terminating"),
        (7, "HOLD", "disarming"),
        (0, "RETURN", "returning"),  # no sticks: NAV_RCL_ACT
        (1, "RETURN", "returning"),
        (2, "RETURN", "returning"),
    ],
)
def test_a_lost_stream_does_what_com_obl_rc_act_says(act: int, mode: str, said: str) -> None:
    pilot = Pilot(p=(3.0, 0.0, 1.5), COM_OBL_RC_ACT=act)
    pilot.offboard()
    pilot.streams = False
    pilot.fly(0.9)
    assert pilot.mode is Mode.OFFBOARD
    pilot.fly(0.3)
    assert pilot.autopilot.mode_name == mode
    assert pilot.autopilot.armed is (act != 7)
    assert pilot.said(f"Failsafe: offboard setpoints lost, {said}") == 1
    assert pilot.texts[-1].severity is Severity.CRITICAL
    if act in (6, 7):
        assert isinstance(pilot.autopilot.target(pilot.state), MotorsOff)
    assert pilot.autopilot.system_status == {6: 8, 7: 3}.get(act, 5)  # TERMINATION, STANDBY, CRITICAL
    pilot.fly(5.0)
    assert pilot.said("Failsafe") == 1


@pytest.mark.parametrize(("act", "mode"), [(0, Mode.POSITION), (1, Mode.ALTITUDE), (2, Mode.STABILIZED)])
def test_a_lost_stream_goes_to_a_manual_mode_where_there_are_sticks(act: int, mode: Mode) -> None:
    pilot = Pilot(COM_OBL_RC_ACT=act)
    pilot.sticks = sticks()
    pilot.offboard()
    pilot.streams = False
    pilot.fly(1.2)
    assert pilot.mode is mode


def test_a_stream_that_comes_back_flies_on_unless_the_pilot_has_asked_for_something_else() -> None:
    """PX4 keeps the pilot's mode under a failsafe, and gives it back with the condition."""
    pilot = Pilot()
    pilot.offboard()
    pilot.streams = False
    pilot.fly(1.2)
    assert pilot.mode is Mode.HOLD
    pilot.streams = True
    pilot.fly(0.2)
    assert pilot.mode is Mode.OFFBOARD
    pilot.streams = False
    pilot.fly(1.2)
    assert pilot.order(176, 1.0, 4.0, 3.0) is Result.ACCEPTED  # Hold, by the pilot
    pilot.streams = True
    pilot.fly(2.0)
    assert pilot.mode is Mode.HOLD
    assert pilot.autopilot.system_status == 4  # no failsafe any more


def test_during_a_stream_loss_the_pilots_mode_change_is_obeyed() -> None:
    pilot = Pilot(COM_OBL_RC_ACT=4)
    pilot.offboard()
    pilot.streams = False
    pilot.fly(1.2)
    assert pilot.mode is Mode.LAND
    assert pilot.order(176, 1.0, 3.0) is Result.ACCEPTED
    pilot.fly(1.0)
    assert pilot.mode is Mode.POSITION
    assert pilot.order(176, 1.0, 6.0) is Result.TEMPORARILY_REJECTED  # still no stream


# sticks


@pytest.mark.parametrize(
    ("override", "offboard", "taken"),
    [(1, False, True), (1, True, False), (2, True, True), (2, False, False), (0, True, False)],
)
def test_moved_sticks_take_over_by_com_rc_override(override: int, offboard: bool, taken: bool) -> None:
    pilot = Pilot(COM_RC_OVERRIDE=override)
    pilot.sticks = sticks()
    if offboard:
        pilot.offboard()
    pilot.fly(1.0)
    pilot.sticks = sticks(forward=0.25)  # less than COM_RC_STICK_OV
    pilot.fly(0.5)
    assert pilot.mode is not Mode.POSITION
    pilot.sticks = sticks(forward=0.4)
    pilot.fly(0.1)
    assert (pilot.mode is Mode.POSITION) is taken
    assert pilot.said("Pilot took over using sticks") == taken
    pilot.sticks = sticks()
    pilot.fly(1.0)
    assert (pilot.mode is Mode.POSITION) is taken  # letting go gives nothing back
    if taken and offboard:
        assert pilot.order(176, 1.0, 6.0) is Result.ACCEPTED  # the pilot releases by asking for the mode
        pilot.fly(1.0)
        assert pilot.mode is Mode.OFFBOARD


def test_the_throttle_stick_counts_from_its_rest_and_may_be_ignored() -> None:
    for override, taken in ((1, True), (5, False)):
        pilot = Pilot(COM_RC_OVERRIDE=override)
        pilot.sticks = sticks(up=-1.0)  # a throttle stick without a spring lies at its end
        pilot.fly(1.0)
        assert pilot.mode is Mode.HOLD
        pilot.sticks = sticks(up=-0.4)
        pilot.fly(0.1)
        assert (pilot.mode is Mode.POSITION) is taken


@pytest.mark.parametrize(
    ("mode", "radio", "heard"),
    [(0, True, True), (0, False, False), (1, True, False), (1, False, True), (3, True, True), (4, False, False)],
)
def test_sticks_come_from_where_com_rc_in_mode_says(mode: int, radio: bool, heard: bool) -> None:
    pilot = Pilot(COM_RC_IN_MODE=mode)
    pilot.sticks = sticks(forward=1.0, radio=radio)
    pilot.fly(0.2)
    assert (pilot.mode is Mode.POSITION) is heard


def lost_sticks(act: int, **parameters: float | int) -> Pilot:
    pilot = Pilot(p=(3.0, 0.0, 1.5), NAV_RCL_ACT=act, COM_FAIL_ACT_T=0.0, **parameters)
    pilot.order(400, 0.0, 21196.0)
    pilot.sticks = sticks()
    pilot.fly(0.2)
    assert pilot.order(400, 1.0, 21196.0) is Result.ACCEPTED
    assert pilot.order(176, 1.0, 3.0) is Result.ACCEPTED
    pilot.fly(0.5)
    pilot.sticks = None
    pilot.fly(0.4)
    assert pilot.mode is Mode.POSITION
    pilot.fly(0.3)
    return pilot


@pytest.mark.parametrize(("act", "mode"), [(1, "HOLD"), (2, "RETURN"), (3, "LAND"), (5, "TERMINATION"), (6, "HOLD")])
def test_lost_sticks_do_what_nav_rcl_act_says(act: int, mode: str) -> None:
    pilot = lost_sticks(act)
    assert pilot.autopilot.mode_name == mode
    assert pilot.autopilot.armed is (act != 6)
    assert pilot.said("Failsafe: manual control lost, ") == 1


def test_sticks_that_never_were_are_not_missed_and_excepted_modes_do_not_mind() -> None:
    pilot = Pilot(COM_RCL_EXCEPT=0)
    pilot.fly(3.0)
    assert pilot.mode is Mode.HOLD
    for bits, mode in ((7, Mode.HOLD), (0, Mode.RETURN)):
        pilot = Pilot(p=(3.0, 0.0, 1.5), COM_RCL_EXCEPT=bits, COM_FAIL_ACT_T=0.0)
        pilot.sticks = sticks()
        pilot.fly(1.0)
        pilot.sticks = None
        pilot.fly(1.0)
        assert pilot.mode is mode


# the ground station


def test_the_loss_of_the_ground_station_means_nothing_by_default() -> None:
    pilot = Pilot()
    pilot.fly(30.0)
    assert pilot.mode is Mode.HOLD
    assert pilot.texts == []


@pytest.mark.parametrize(("act", "mode"), [(1, "HOLD"), (2, "RETURN"), (3, "LAND"), (5, "TERMINATION"), (6, "HOLD")])
def test_the_loss_of_the_ground_station_holds_then_does_what_nav_dll_act_says(act: int, mode: str) -> None:
    pilot = Pilot(p=(3.0, 0.0, 1.5), NAV_DLL_ACT=act)
    pilot.station = True
    pilot.fly(12.0)
    pilot.station = False
    pilot.fly(9.9)
    assert pilot.texts == []
    pilot.fly(0.3)
    if act in (1, 2, 3):
        assert pilot.mode is Mode.HOLD  # COM_FAIL_ACT_T, for the pilot to notice
        assert pilot.said("Failsafe: ground station lost, holding 5 s") == 1
        pilot.fly(4.5)
        assert pilot.mode is Mode.HOLD
        pilot.fly(0.6)
    assert pilot.autopilot.mode_name == mode
    assert pilot.autopilot.armed is (act != 6)
    pilot.station = True
    pilot.fly(5.0)
    assert pilot.autopilot.mode_name == mode  # until the pilot changes the mode
    if act in (2, 3):
        assert pilot.order(176, 1.0, 4.0, 3.0) is Result.ACCEPTED
        pilot.fly(5.0)
        assert pilot.mode is Mode.HOLD
        assert pilot.autopilot.system_status == 4


def test_com_dl_loss_t_and_the_exceptions_count() -> None:
    pilot = Pilot(NAV_DLL_ACT=3, COM_DL_LOSS_T=20, COM_FAIL_ACT_T=0.0)
    pilot.fly(19.9)
    assert pilot.mode is Mode.HOLD
    pilot.fly(0.3)
    assert pilot.mode is Mode.LAND
    pilot = Pilot(NAV_DLL_ACT=3, COM_DLL_EXCEPT=4, COM_FAIL_ACT_T=0.0)
    pilot.offboard()
    pilot.fly(15.0)
    assert pilot.mode is Mode.OFFBOARD


# the battery


@pytest.mark.parametrize(
    ("act", "share", "mode", "text"),
    [
        (0, 0.14, Mode.OFFBOARD, "Low battery level, return advised"),
        (0, 0.06, Mode.OFFBOARD, "Critical battery level, land now"),
        (0, 0.04, Mode.OFFBOARD, "Emergency battery level, land immediately"),
        (3, 0.14, Mode.OFFBOARD, "Low battery level, return advised"),
        (3, 0.06, Mode.RETURN, "Failsafe: critical battery, returning"),
        (3, 0.04, Mode.LAND, "Failsafe: emergency battery, landing"),
        (2, 0.06, Mode.LAND, "Failsafe: critical battery, landing"),
    ],
)
def test_a_battery_that_runs_low(act: int, share: float, mode: Mode, text: str) -> None:
    pilot = Pilot(p=(3.0, 0.0, 1.5), COM_LOW_BAT_ACT=act, COM_FAIL_ACT_T=0.0)
    pilot.offboard()
    pilot.autopilot.battery(Reading(share))
    pilot.fly(0.2)
    assert pilot.mode is mode
    assert pilot.said(text) == 1
    pilot.fly(2.0)
    assert pilot.said(text) == 1


def test_a_falling_battery_goes_through_all_its_levels() -> None:
    pilot = Pilot(p=(3.0, 0.0, 1.5), COM_LOW_BAT_ACT=3)
    pilot.offboard()
    for tenth in range(200, 20, -1):
        pilot.autopilot.battery(Reading(tenth / 1000.0))
        pilot.fly(0.5)
    assert pilot.modes == ["HOLD", "OFFBOARD", "HOLD", "RETURN", "LAND"]
    warned, critical, *_ = [text.text for text in pilot.texts]
    assert warned == "Low battery level, return advised"
    assert critical == "Failsafe: critical battery, holding 5 s, then returning"
    assert pilot.autopilot.charge_state == 4


def test_a_pilot_may_fly_on_with_a_critical_battery_but_not_past_an_emergency() -> None:
    pilot = Pilot(p=(3.0, 0.0, 1.5), COM_LOW_BAT_ACT=3, COM_FAIL_ACT_T=0.0)
    pilot.autopilot.battery(Reading(0.06))
    pilot.fly(0.2)
    assert pilot.mode is Mode.RETURN
    assert pilot.order(176, 1.0, 3.0) is Result.ACCEPTED
    pilot.fly(2.0)
    assert pilot.mode is Mode.POSITION
    pilot.autopilot.battery(Reading(0.04))
    pilot.fly(0.2)
    assert pilot.mode is Mode.LAND


def test_what_is_as_low_as_at_arming_only_warns() -> None:
    pilot = Pilot(p=(0.0, 0.0, 0.2), COM_LOW_BAT_ACT=2, COM_FAIL_ACT_T=0.0)
    pilot.order(400, 0.0, 21196.0)
    pilot.autopilot.battery(Reading(0.06))
    assert pilot.order(400, 1.0, 21196.0) is Result.ACCEPTED
    pilot.fly(1.0)
    assert pilot.mode is Mode.HOLD
    assert pilot.said("Critical battery level, land now") == 1


# the geofence


@pytest.mark.parametrize(
    ("action", "mode"), [(0, "OFFBOARD"), (1, "OFFBOARD"), (2, "HOLD"), (3, "RETURN"), (4, "TERMINATION"), (5, "LAND")]
)
@pytest.mark.parametrize("where", [(6.0, 0.0, 1.5), (0.0, 0.0, 4.0)])
def test_a_geofence_does_what_gf_action_says(action: int, mode: str, where: Vec3) -> None:
    pilot = Pilot(GF_ACTION=action, GF_MAX_HOR_DIST=5.0, GF_MAX_VER_DIST=3.0, COM_FAIL_ACT_T=0.0)
    pilot.offboard()
    pilot.p = where
    pilot.fly(0.2)
    assert pilot.autopilot.mode_name == mode
    assert pilot.said("geofence breached") == (action > 0)
    if action == 2:
        goal = pilot.autopilot.target(pilot.state)
        assert isinstance(goal, PositionSetpoint)
        assert goal.p_enu == where
        assert pilot.order(176, 1.0, 6.0) is Result.ACCEPTED  # the pilot flies back
        pilot.fly(1.0)
        assert pilot.mode is Mode.OFFBOARD
        pilot.p = (0.0, 0.0, 1.5)
        pilot.fly(1.0)
        assert pilot.autopilot.system_status == 4
        pilot.p = where
        pilot.fly(0.2)
        assert pilot.mode is Mode.HOLD  # and again


def test_no_fence_no_breach_and_no_goto_beyond_one() -> None:
    pilot = Pilot(p=(900.0, 0.0, 50.0))
    pilot.offboard()
    pilot.fly(1.0)
    assert pilot.mode is Mode.OFFBOARD
    pilot = Pilot(GF_MAX_HOR_DIST=100.0)
    assert pilot.order(192, -1.0, 1.0, 0.0, NAN, 47.4, 8.545594, 490.0) is Result.DENIED  # 251 m north
    assert pilot.said("Reposition is outside geofence") == 1


# precedence


def test_the_worst_action_counts_and_a_new_one_ends_a_takeover() -> None:
    pilot = Pilot(p=(3.0, 0.0, 1.5), GF_ACTION=2, GF_MAX_HOR_DIST=2.0, NAV_DLL_ACT=3, COM_FAIL_ACT_T=0.0)
    pilot.station = True
    pilot.fly(0.2)
    assert pilot.mode is Mode.HOLD
    assert pilot.order(176, 1.0, 3.0) is Result.ACCEPTED  # takes over from the geofence
    pilot.station = False
    pilot.fly(9.0)
    assert pilot.mode is Mode.POSITION
    pilot.fly(2.0)
    assert pilot.mode is Mode.LAND  # worse than Hold


def test_a_landing_is_not_turned_into_a_return() -> None:
    pilot = Pilot(p=(3.0, 0.0, 1.5), COM_LOW_BAT_ACT=3, COM_FAIL_ACT_T=0.0)
    assert pilot.order(21) is Result.ACCEPTED
    pilot.autopilot.battery(Reading(0.06))
    pilot.fly(1.0)
    assert pilot.mode is Mode.LAND


def test_sticks_take_over_a_failsafe_only_after_its_hold() -> None:
    pilot = Pilot(p=(3.0, 0.0, 1.5), NAV_DLL_ACT=2)
    pilot.sticks = sticks()
    pilot.fly(10.2)
    assert pilot.mode is Mode.HOLD
    pilot.sticks = sticks(forward=1.0)
    pilot.fly(3.0)
    assert pilot.mode is Mode.HOLD
    pilot.fly(3.0)
    assert pilot.mode is Mode.POSITION
    assert pilot.said("Pilot took over using sticks") == 1


def test_a_lost_position_descends_level() -> None:
    pilot = Pilot()
    pilot.fly(1.0)
    pilot.p = (NAN, NAN, NAN)
    pilot.fly(0.2)
    assert pilot.mode is Mode.LAND
    assert pilot.said("position lost") == 1
    target = pilot.autopilot.target(pilot.state)
    assert isinstance(target, AccelerationSetpoint)
    assert target.a_enu[:2] == (0.0, 0.0)
    assert target.a_enu[2] < 0.0
    assert pilot.order(176, 1.0, 4.0, 3.0) is Result.TEMPORARILY_REJECTED


# kill


def test_termination_stops_the_motors_for_good() -> None:
    pilot = Pilot()
    pilot.fly(0.2)
    assert pilot.order(185, 0.0) is Result.DENIED
    assert pilot.order(185, 1.0) is Result.ACCEPTED
    assert isinstance(pilot.autopilot.target(pilot.state), MotorsOff)
    assert pilot.autopilot.custom_mode == 1 << 16
    assert pilot.autopilot.system_status == 8
    assert pilot.said("Flight termination") == 1
    assert pilot.order(176, 1.0, 4.0, 3.0) is Result.TEMPORARILY_REJECTED
    pilot.p = (0.0, 0.0, 0.2)
    pilot.fly(4.0)
    assert not pilot.autopilot.armed
    assert pilot.order(400, 1.0) is Result.TEMPORARILY_REJECTED
    assert pilot.said("Preflight Fail: Flight termination active") == 1
    assert pilot.order(185, 1.0) is Result.DENIED  # not armed
