"""ArduCopter's modes, arming, disarming, sticks and failsafes; what moves is flown in PyBullet."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import pytest
from ardupilot_rig import ARM, DISARM, GCS, POSITION, Rig, command, result, set_mode, setpoint, sticks, takeoff, texts

from sim_bridge.messages import Ack, Landed, Result, Sticks

GROUND = (0.0, 0.0, 0.2)


@dataclass(frozen=True)
class Battery:
    share: float
    voltage_v: float = 3.9
    current_a: float = 5.0
    consumed_mah: float = 100.0


@pytest.fixture
def rig() -> Iterator[Callable[..., Rig]]:
    made: list[Rig] = []

    def make(*args: object, **kwargs: object) -> Rig:
        made.append(Rig(*args, **kwargs))  # type: ignore[arg-type]
        return made[-1]

    yield make
    for each in made:
        each.close()


def hear(flown: Rig, seconds: float, held: Sticks) -> None:
    """Sticks at 5 Hz for some time."""
    for _ in range(round(seconds * 5)):
        flown.autopilot.manual(held, flown.t_ns)
        flown.fly(0.2)


@pytest.mark.parametrize("number", [0, 2, 4, 5, 6, 9, 17])
def test_modes_are_plain_numbers_by_command_and_by_set_mode(rig: Callable[..., Rig], number: int) -> None:
    flown = rig()
    assert result(flown.order(set_mode(number))) is Result.ACCEPTED
    assert flown.autopilot.custom_mode == number
    flown.order(set_mode(5))
    assert result(flown.order(command(176, 1.0, 0.0, custom_mode=number))) is Result.ACCEPTED  # SET_MODE's field
    assert flown.autopilot.custom_mode == number


@pytest.mark.parametrize(
    ("order", "refusal", "reason"),
    [
        (set_mode(3), Result.FAILED, ["Mode change to AUTO failed: init failed"]),
        (set_mode(99), Result.FAILED, ["No such mode 99"]),
        (command(176, 0.0, 4.0), Result.UNSUPPORTED, []),
        (command(31000), Result.UNSUPPORTED, []),
    ],
)
def test_refusals_name_their_reason_in_a_text_only(
    rig: Callable[..., Rig], order: object, refusal: Result, reason: list[str]
) -> None:
    replies = rig().order(order)  # type: ignore[arg-type]
    assert result(replies) is refusal
    assert texts(replies) == reason


def test_the_heartbeat_tells_arming_guided_and_state(rig: Callable[..., Rig]) -> None:
    autopilot = rig().autopilot
    assert (autopilot.kind, autopilot.base_mode, autopilot.system_status) == (3, 1 | 8 | 16 | 64 | 128, 4)
    grounded = rig(GROUND).autopilot
    assert (grounded.custom_mode, grounded.base_mode, grounded.system_status) == (0, 1 | 16 | 64, 3)


def test_guided_is_accepted_before_a_position_exists_but_arming_there_is_not(rig: Callable[..., Rig]) -> None:
    flown = rig(GROUND)
    flown.fly(1.0)
    assert not flown.autopilot.position_valid
    flown.guided()
    replies = flown.order(ARM)
    assert result(replies) is Result.FAILED
    assert texts(replies) == ["PreArm: Need Position Estimate"]
    flown.order(set_mode(0))
    assert result(flown.order(ARM)) is Result.ACCEPTED  # STABILIZE needs none
    assert texts(flown.order(set_mode(5))) == ["Mode change to LOITER failed: requires position"]
    flown.fly(1.5)
    assert flown.said == ["EKF3 IMU0 is using GPS"]
    assert result(flown.order(set_mode(5))) is Result.ACCEPTED


def test_the_ekf_takes_as_long_as_sim_ekf_ready_says(rig: Callable[..., Rig]) -> None:
    flown = rig(GROUND, SIM_EKF_READY=4.0)
    flown.fly(3.9)
    assert not flown.autopilot.position_valid
    flown.fly(0.2)
    assert flown.autopilot.position_valid


@pytest.mark.parametrize(("mode", "name"), [(6, "RTL"), (9, "LAND"), (17, "BRAKE")])
def test_only_some_modes_can_be_armed(rig: Callable[..., Rig], mode: int, name: str) -> None:
    flown = rig(GROUND)
    flown.fly(2.1)
    flown.order(set_mode(mode))
    replies = flown.order(ARM)
    assert result(replies) is Result.FAILED
    assert texts(replies) == [f"Arm: {name} mode not armable"]
    assert result(flown.order(command(400, 1.0, 2989.0))) is Result.ACCEPTED  # forced


def test_prearm_reasons_come_by_themselves_twice_a_minute(rig: Callable[..., Rig]) -> None:
    flown = rig(GROUND, SIM_EKF_READY=1000.0).guided()
    flown.fly(61.0)
    assert flown.said == ["PreArm: Need Position Estimate"] * 2


def test_arming_and_disarming_are_told_and_a_flying_vehicle_is_not_disarmed_but_by_force(
    rig: Callable[..., Rig],
) -> None:
    flown = rig(GROUND)
    assert texts(flown.order(ARM)) == ["Arming motors"]
    assert texts(flown.order(ARM)) == []
    assert texts(flown.order(DISARM)) == ["Disarming motors"]
    flying = rig()
    assert flying.order(DISARM) == (Ack(400, Result.FAILED, GCS),)
    assert result(flying.order(command(400, 0.0, 21196.0))) is Result.ACCEPTED
    flying.fly(0.5)
    assert flying.v[2] < -3.0


def test_armed_on_the_ground_it_disarms_after_disarm_delay_0_never(rig: Callable[..., Rig]) -> None:
    flown = rig(GROUND, DISARM_DELAY=4)
    flown.order(ARM)
    flown.fly(3.9)
    assert flown.autopilot.armed
    flown.fly(0.2)
    assert not flown.autopilot.armed
    assert flown.said[-1] == "Disarming motors"
    never = rig(GROUND, DISARM_DELAY=0)
    never.order(ARM)
    never.fly(15.0)
    assert never.autopilot.armed


@pytest.mark.parametrize(
    ("mode", "above_m", "reason"),
    [
        (0, 2.0, "Takeoff denied: STABILIZE"),
        (4, float("nan"), "Takeoff denied: needs an altitude (param7)"),
        (4, 0.1, "Takeoff denied: needs an altitude (param7)"),
    ],
)
def test_takeoffs_that_are_refused(rig: Callable[..., Rig], mode: int, above_m: float, reason: str) -> None:
    flown = rig(GROUND)
    flown.fly(2.1)
    flown.order(set_mode(mode))
    assert texts(flown.order(takeoff(2.0))) == ["Takeoff denied: not armed"]
    flown.order(ARM)
    assert texts(flown.order(takeoff(above_m))) == [reason]


def test_loiter_flies_the_sticks_of_the_one_ground_station_and_takes_off_by_throttle(rig: Callable[..., Rig]) -> None:
    flown = rig(GROUND, PILOT_TKOFF_ALT=150.0)
    flown.fly(2.1)
    flown.order(set_mode(5))
    flown.order(ARM)
    hear(flown, 0.6, sticks(up=0.5, system=254))  # not SYSID_MYGCS
    assert not flown.autopilot.airborne
    hear(flown, 0.6, sticks(up=0.5))
    hear(flown, 4.0, sticks())
    assert flown.p[2] == pytest.approx(1.5, abs=0.15)
    assert flown.autopilot.landed is Landed.IN_AIR
    hear(flown, 1.0, sticks(forward=0.5))
    assert flown.v[0] > 0.8
    hear(flown, 1.0, sticks(turn_left=1.0))
    flown.fly(3.2)  # the sticks went silent: centred
    flown.fly(2.5)
    assert flown.v == pytest.approx(0.0, abs=0.1)
    assert 60.0 < flown.heading_deg % 360.0 < 360.0


def test_alt_hold_leans_and_stabilize_climbs_with_the_throttle(rig: Callable[..., Rig]) -> None:
    flown = rig()
    flown.order(set_mode(2))
    hear(flown, 1.0, sticks(left=0.3))
    assert flown.v[1] > 0.9
    assert flown.p[2] == pytest.approx(20.0, abs=0.1)
    flown.order(set_mode(0))
    hear(flown, 1.0, sticks(up=0.4))
    assert flown.v[2] > 1.0


def test_sticks_do_nothing_in_guided_and_a_mode_change_takes_over(rig: Callable[..., Rig]) -> None:
    flown = rig().guided()
    hear(flown, 1.0, sticks(forward=1.0, up=1.0))
    assert flown.v == pytest.approx(0.0, abs=0.05)
    flown.order(set_mode(5))
    hear(flown, 1.0, sticks(forward=1.0))
    assert flown.v[0] > 0.8


def test_without_a_ground_station_ever_or_with_the_failsafe_off_nothing_happens(rig: Callable[..., Rig]) -> None:
    never = rig(FS_GCS_ENABLE=5).guided()
    never.fly(7.0)
    assert (never.said, never.autopilot.mode_name) == ([], "GUIDED")
    off = rig().guided()
    off.autopilot.heard_station(off.t_ns, 255)
    off.fly(7.0)
    assert (off.said, off.autopilot.mode_name) == ([], "GUIDED")


@pytest.mark.parametrize(("action", "mode"), [(1, "RTL"), (5, "LAND"), (7, "BRAKE")])
def test_a_lost_ground_station_leads_to_fs_gcs_enables_mode(rig: Callable[..., Rig], action: int, mode: str) -> None:
    flown = rig(FS_GCS_ENABLE=action, FS_GCS_TIMEOUT=2.0).guided()
    flown.autopilot.heard_station(flown.t_ns, 255)
    flown.fly(1.0)
    flown.autopilot.heard_station(flown.t_ns, 245)  # not SYSID_MYGCS
    flown.fly(0.9)
    assert flown.said == []
    flown.fly(0.3)
    assert flown.said == ["GCS Failsafe"]
    assert flown.autopilot.mode_name == mode
    assert flown.autopilot.system_status == 5
    flown.autopilot.heard_station(flown.t_ns, 255)
    flown.fly(0.2)
    assert flown.said == ["GCS Failsafe", "GCS Failsafe Cleared"]
    assert flown.autopilot.mode_name == mode


def test_fs_options_let_a_pilot_or_a_landing_go_on(rig: Callable[..., Rig]) -> None:
    for mode, options, told in ((5, 16, "GCS Failsafe - Continuing Pilot Control"), (9, 8, "Continuing Landing")):
        flown = rig(FS_GCS_ENABLE=1, FS_GCS_TIMEOUT=1.0, FS_OPTIONS=options)
        flown.autopilot.heard_station(flown.t_ns, 255)
        flown.order(set_mode(mode))
        flown.fly(1.3)
        assert told in flown.said[-1]
        assert flown.autopilot.custom_mode == mode
    flown = rig(FS_GCS_ENABLE=1, FS_GCS_TIMEOUT=1.0, FS_OPTIONS=0)
    flown.autopilot.heard_station(flown.t_ns, 255)
    flown.fly(1.3)
    assert flown.autopilot.mode_name == "RTL"  # out of LOITER


def look(flown: Rig, reading: Battery, later_s: float = 0.0) -> list[str]:
    """What one look of the autopilot at this battery makes it say."""
    flown.autopilot.battery(reading)
    return texts(flown.autopilot.step(flown.craft.state, flown.t_ns + round(later_s * 1e9)))


def test_a_low_battery_acts_and_forbids_arming(rig: Callable[..., Rig]) -> None:
    flown = rig(BATT_LOW_MAH=50.0, BATT_FS_LOW_ACT=2, BATT_CRT_MAH=20.0, BATT_FS_CRT_ACT=1).guided()
    assert look(flown, Battery(share=0.5)) == []
    assert look(flown, Battery(share=0.19)) == ["Battery 1 is low 3.90V used 100 mAh"]  # of 250 mAh
    assert flown.autopilot.mode_name == "RTL"
    assert look(flown, Battery(share=0.18)) == []
    assert look(flown, Battery(share=0.07)) == ["Battery 1 is critical 3.90V used 100 mAh"]
    assert flown.autopilot.mode_name == "LAND"
    grounded = rig(GROUND, BATT_LOW_MAH=50.0)
    grounded.autopilot.battery(Battery(share=0.1))
    assert texts(grounded.order(ARM)) == ["PreArm: Battery 1 low capacity failsafe"]


def test_a_low_voltage_counts_after_batt_low_timer(rig: Callable[..., Rig]) -> None:
    flown = rig(BATT_LOW_VOLT=3.5, BATT_LOW_TIMER=2, BATT_FS_LOW_ACT=1).guided()
    low = Battery(share=0.5, voltage_v=3.4)
    assert look(flown, low) == []
    assert look(flown, low, 1.9) == []
    assert look(flown, low, 2.0) != []
    assert flown.autopilot.mode_name == "LAND"


@pytest.mark.parametrize(("action", "mode"), [(0, "GUIDED"), (1, "RTL"), (4, "BRAKE")])
def test_the_fence_acts_and_keeps_targets_inside(rig: Callable[..., Rig], action: int, mode: str) -> None:
    flown = rig(FENCE_ENABLE=1, FENCE_RADIUS=2.0, FENCE_ALT_MAX=30.0, FENCE_ACTION=action).guided()
    flown.fly(1.0, setpoint(mask=POSITION, p=(5.0, 0.0, 20.0)))  # beyond: not flown
    assert flown.p[0] == pytest.approx(0.0, abs=0.05)
    flown.fly(3.0, setpoint((1.5, 0.0, 0.0)), until=lambda: bool(flown.said))
    assert flown.said == ["Circle fence breached"]
    assert flown.autopilot.mode_name == mode
    assert 2.0 < flown.p[0] < 2.3


def test_a_failsafe_on_the_ground_disarms(rig: Callable[..., Rig]) -> None:
    flown = rig(GROUND, FS_GCS_ENABLE=1, FS_GCS_TIMEOUT=1.0)
    flown.autopilot.heard_station(flown.t_ns, 255)
    flown.order(ARM)
    flown.fly(1.3)
    assert not flown.autopilot.armed
