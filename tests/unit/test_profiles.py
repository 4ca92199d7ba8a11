"""PX4 and ArduCopter as scripts, flown by the real service on a counted clock: profiles, engage, release, ground."""

from __future__ import annotations

import numpy as np
import pytest
from autopilot_peer import (
    AIR,
    BRAKE,
    GROUND,
    GUIDED,
    LOITER,
    PX4_HOLD,
    PX4_OFFBOARD,
    PX4_POSITION,
    TAKEOFF,
    ArduCopter,
    Px4,
    World,
    play,
)

from companion.config import config_hash, parse_config
from companion.profiles import BY_AUTOPILOT, PROFILES


def masks(world: World) -> set[int]:
    return {m.type_mask for _, _, m in world.peer.taken}


def active(world: World) -> bool:
    return world.state == "ACTIVE"


async def flown(world: World) -> None:
    """Engaged by whatever the profile wants."""
    await world.run(6.0, until=lambda: world.state == "READY")
    await world.run(1.0)
    world.engage()
    await world.run(3.0, until=lambda: active(world))
    assert active(world)


def test_auto_takes_px4_from_its_heartbeat() -> None:
    async def script(world: World) -> None:
        await world.run(2.5)
        assert world.state == "WAITING"
        assert world.peer.taken == []
        assert world.session.config.vehicle.profile == "auto"
        await world.run(2.0)
        assert world.state == "READY"
        assert world.session.config.vehicle.profile == "px4"
        assert world.session.config.engage_by == "mode_switch"
        assert world.service._thinker._pilot._delay_ns == 150_000_000
        assert world.zenoh.statuses[-1].profile == "px4"

    world = play(script, Px4())
    assert masks(world) == {0x0C3F}
    assert world.peer.said("profile px4") == 1


def test_auto_takes_ardupilot_from_its_heartbeat() -> None:
    async def script(world: World) -> None:
        await world.run(5.0)
        assert world.state == "READY"
        config = world.session.config
        assert (config.vehicle.profile, config.engage_by, config.limits.slew_m_s3) == ("ardupilot", "command", 3.5)
        pilot = world.service._thinker._pilot
        assert pilot._delay_ns == 210_000_000
        assert pilot._config.limits.slew_m_s3 == 3.5
        await flown(world)
        await world.run(1.0)

    world = play(script, ArduCopter())
    assert masks(world) == {0x043F}
    assert {m.yaw_rate for _, _, m in world.peer.taken} == {0.0}  # the nose stays


def test_auto_waits_where_there_is_no_profile() -> None:
    class Other(Px4):
        autopilot = 4

    async def script(world: World) -> None:
        await world.run(8.0)
        assert world.state == "WAITING"
        reason = world.session.situation.reason
        assert "OPENPILOT" in reason
        assert "set vehicle.profile" in reason
        world.engage()
        await world.run(1.0)
        assert world.state == "WAITING"

    world = play(script, Other())
    assert world.peer.taken == []
    assert world.peer.asked == []
    assert world.peer.said("set vehicle.profile") == 1


def test_auto_flies_as_if_the_profile_had_been_configured() -> None:
    """Bit for bit: the pilot that was built before the autopilot was known leaves nothing behind."""

    async def script(world: World) -> None:
        await flown(world)
        await world.run(3.0)

    sections = {"target": {"position": [3.0, 1.0, 3.0]}}
    auto = play(script, ArduCopter(), **sections)
    named = play(script, ArduCopter(), vehicle={"profile": "ardupilot"}, **sections)
    assert len(auto.peer.taken) > 100
    assert [(m.afx, m.afy, m.afz) for *_, m in auto.peer.taken] == [(m.afx, m.afy, m.afz) for *_, m in named.peer.taken]
    assert config_hash(auto.session.config) == config_hash(named.session.config)


def test_a_configured_profile_that_is_not_the_autopilots_is_told_once() -> None:
    async def script(world: World) -> None:
        await world.run(8.0)
        assert world.warnings == ("autopilot is PX4, vehicle.profile is ardupilot",)

    assert play(script, Px4(), vehicle={"profile": "ardupilot"}).peer.said("autopilot is PX4") == 1


def test_px4_is_streamed_to_on_the_ground_and_engaged_by_the_pilots_switch() -> None:
    peer = Px4()
    peer.landed, peer.armed = GROUND, False

    async def script(world: World) -> None:
        await world.run(5.0)
        assert world.state == "READY"
        assert peer.taken
        assert peer.requests == []
        np.testing.assert_allclose([[m.afx, m.afy, m.afz] for *_, m in peer.taken], 0.0, atol=1e-6)  # where it is
        peer.armed, peer.landed = True, AIR
        await world.run(1.0)
        assert world.state == "READY"
        assert peer.grant(6, 0)  # the pilot's switch: the stream has been running
        await world.run(1.0)
        assert world.state == "ACTIVE"
        peer.mode = PX4_POSITION  # and back
        await world.run(1.0)
        assert world.state == "OVERRIDDEN"
        taken = len(peer.taken)
        await world.run(1.0)
        assert len(peer.taken) == taken

    play(script, peer)
    assert peer.requests == []


def test_px4_grants_offboard_to_the_stream_and_is_handed_back_in_hold() -> None:
    peer = Px4()

    async def script(world: World) -> None:
        await flown(world)
        assert peer.mode == PX4_OFFBOARD
        assert peer.requests == [(6, 0)]  # streamed long enough: granted at the first request
        world.engage(False)
        await world.run(0.03)
        assert peer.requests[-1] == (4, 3)
        await world.run(1.0)
        assert peer.mode == PX4_HOLD
        assert world.state == "READY"

    play(script, peer)


def test_ardupilot_is_sent_nothing_before_it_is_in_the_air() -> None:
    peer = ArduCopter()
    peer.landed, peer.mode = GROUND, GUIDED  # the operator armed and takes off in GUIDED

    async def script(world: World) -> None:
        await world.run(5.0)
        world.engage()
        await world.run(2.0)
        peer.landed = TAKEOFF
        await world.run(4.0)
        assert world.state == "READY"
        assert peer.taken == []
        assert "airborne" in world.session.situation.reason
        peer.landed = AIR
        await world.run(2.0)
        assert world.state == "ACTIVE"

    play(script, peer)
    assert {landed for landed, *_ in peer.taken} == {AIR}
    assert not peer.takeoff_cancelled


def test_ardupilot_in_guided_is_not_engaged_by_the_mode() -> None:
    peer = ArduCopter()

    async def script(world: World) -> None:
        await world.run(5.0)
        peer.mode = GUIDED  # a ground station's goto
        await world.run(2.0)
        assert world.state == "READY"

    play(script, peer)
    assert peer.taken == []
    assert peer.requests == []


def test_ardupilot_is_asked_for_guided_by_command_and_for_brake_on_release() -> None:
    peer = ArduCopter()

    async def script(world: World) -> None:
        await flown(world)
        assert peer.requests == [(GUIDED, 0)]
        await world.run(1.0)
        world.engage(False)
        await world.run(0.03)
        assert peer.requests[-1] == (BRAKE, 0)
        await world.run(1.0)
        assert (peer.mode, world.state) == (BRAKE, "READY")
        taken = len(peer.taken)
        await world.run(1.0)
        assert len(peer.taken) == taken

    play(script, peer)
    assert {mode for _, mode, _ in peer.taken} == {GUIDED}


def test_a_takeover_on_ardupilot_is_not_fought() -> None:
    peer = ArduCopter()

    async def script(world: World) -> None:
        await flown(world)
        peer.mode = LOITER
        await world.run(2.0)
        assert world.state == "OVERRIDDEN"

    play(script, peer)
    assert peer.requests == [(GUIDED, 0)]


@pytest.mark.parametrize(("peer", "hold", "left"), [(Px4(), (4, 3), PX4_HOLD), (ArduCopter(), (BRAKE, 0), BRAKE)])
def test_a_brain_that_fails_leaves_the_vehicle_in_its_hold_mode(
    peer: Px4 | ArduCopter, hold: tuple[int, int], left: int
) -> None:
    async def script(world: World) -> None:
        await flown(world)
        world.session.fail("on purpose", world.clock.monotonic_ns())
        taken = len(peer.taken)
        await world.run(1.0)
        assert world.state == "FAULT"
        assert (peer.requests[-1], peer.mode) == (hold, left)
        assert len(peer.taken) == taken

    play(script, peer)


def test_ardupilot_on_the_ground_again_is_sent_nothing() -> None:
    peer = ArduCopter()

    async def script(world: World) -> None:
        await flown(world)
        peer.landed = GROUND  # still armed, still in GUIDED
        await world.run(0.6)
        taken = len(peer.taken)
        assert world.state == "READY"
        await world.run(1.0)
        assert len(peer.taken) == taken

    play(script, peer)


def test_a_configured_system_is_settled_at_its_first_heartbeat() -> None:
    async def script(world: World) -> None:
        await world.run(1.0)
        assert world.state == "READY"
        assert world.session.config.vehicle.profile == "px4"

    play(script, Px4(system=7), mavlink={"system_id": 7})


def test_ardupilot_setpoints_keep_within_its_jerk_limit() -> None:
    peer = ArduCopter()

    async def script(world: World) -> None:
        await flown(world)
        await world.run(2.0)

    play(script, peer, target={"position": [8.0, 0.0, 2.0]}, disturbance={"enabled": False})
    a = np.array([[m.afx, m.afy, m.afz] for *_, m in peer.taken])
    assert np.abs(a).max() > 1.0
    assert np.abs(np.diff(a, axis=0)).max() <= 3.5 * 0.02 + 1e-6


@pytest.mark.parametrize(("peer", "mask"), [(Px4(), 0x0C07), (ArduCopter(), 0x0407)])
def test_velocity_goes_with_the_acceleration_where_asked(peer: Px4 | ArduCopter, mask: int) -> None:
    sections = {"target": {"position": [4.0, 0.0, 2.0]}, "disturbance": {"enabled": False}}
    sections["delay"] = {"actuation_s": 0.0}

    async def script(world: World) -> None:
        await flown(world)
        await world.run(2.0)
        assert world.warnings == ()
        for _, _, m in peer.taken[-100:]:  # its own velocity, one tick of the acceleration ahead
            ahead = peer.velocities[m.time_boot_ms] + 0.02 * np.array([m.afx, m.afy, m.afz])
            np.testing.assert_allclose([m.vx, m.vy, m.vz], ahead, atol=1e-5)

    play(script, peer, vehicle={"profile": "auto", "setpoint": "velocity+acceleration"}, **sections)
    assert {m.type_mask for *_, m in peer.taken} == {mask}
    assert np.abs([m.vy for *_, m in peer.taken]).max() > 0.5  # east, where the target is


def test_profile_defaults_give_way_to_the_file() -> None:
    config = parse_config({"vehicle": {"profile": "ardupilot"}, "limits": {"slew_m_s3": 9.0}, "tick_hz": 25})
    assert (config.limits.slew_m_s3, config.rate_hz) == (9.0, 25)
    assert parse_config({"vehicle": {"profile": "ardupilot"}}).limits.slew_m_s3 == 3.5
    assert parse_config({"vehicle": {"profile": "px4"}}).limits.slew_m_s3 is None
    auto = parse_config({"vehicle": {"profile": "auto"}})
    assert auto.limits.slew_m_s3 is None
    assert auto.flown_as("ardupilot") == parse_config({"vehicle": {"profile": "ardupilot"}})


def test_the_table() -> None:
    assert {number: profile.name for number, profile in BY_AUTOPILOT.items()} == {12: "px4", 3: "ardupilot"}
    assert [PROFILES[name].tick_hz for name in ("crazyflie-sim", "px4", "ardupilot")] == [20, 50, 50]
    assert {p.hold.custom_mode for p in PROFILES.values()} == {PX4_HOLD, BRAKE}
    assert {p.external.custom_mode for p in PROFILES.values()} == {PX4_OFFBOARD, GUIDED}
