"""What goes wrong between daemon and autopilot, played by scripted autopilots against the real service."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from autopilot_peer import AIR, GROUND, GUIDED, ArduCopter, Peer, Px4, World, play
from pymavlink.dialects.v20 import ardupilotmega as dialect

KINDS = pytest.mark.parametrize("kind", [Px4, ArduCopter])


async def flown(world: World) -> None:
    await world.run(6.0, until=lambda: world.state == "READY")
    await world.run(1.0)
    world.engage()
    await world.run(3.0, until=lambda: world.state == "ACTIVE")
    assert world.state == "ACTIVE"


# the echo


@KINDS
@pytest.mark.parametrize("setpoint", ["acceleration", "velocity+acceleration"])
def test_an_autopilot_that_follows_is_no_cause_for_complaint(kind: type[Peer], setpoint: str) -> None:
    async def script(world: World) -> None:
        await flown(world)
        for _ in range(10):
            await world.run(1.0)
            assert world.warnings == ()
        assert world.peer.asked.count(85) == 1

    sections: Any = {"target": {"position": [5.0, 3.0, 4.0]}, "vehicle": {"profile": "auto", "setpoint": setpoint}}
    world = play(script, kind(), **sections)
    assert world.counts["autopilot.echoes"] >= 36  # 4 Hz
    assert "autopilot.mask_mismatch" not in world.counts
    assert "autopilot.foreign_acceleration" not in world.counts


def test_the_echo_of_an_older_px4_marks_nothing() -> None:
    peer = Px4()
    peer.marks_mask = False

    async def script(world: World) -> None:
        await flown(world)
        await world.run(3.0)
        assert world.warnings == ()

    world = play(script, peer)
    assert world.counts["autopilot.echoes"] >= 8
    assert "mavlink.not_finite" not in world.counts


def test_the_echo_is_not_asked_for_before_setpoints_are_obeyed() -> None:
    async def script(world: World) -> None:
        await world.run(8.0)
        assert world.state == "READY"

    assert 85 not in play(script, Px4()).peer.asked


def test_a_silent_stop_of_ardupilot_is_told_once_and_does_not_end_the_flight() -> None:
    peer = ArduCopter()

    async def script(world: World) -> None:
        await flown(world)
        await world.run(2.0)
        peer.stops = True
        await world.run(3.0)
        assert world.warnings == ("autopilot does not follow: type_mask 0x0C07, sent 0x043F",)
        assert world.state == "ACTIVE"
        assert world.zenoh.statuses[-1].warnings == list(world.warnings)
        peer.stops = False
        await world.run(1.0)
        assert world.warnings == ()
        peer.stops = True  # again, soon after: it stands, and is not told once more
        await world.run(1.0)
        assert world.warnings

    world = play(script, peer)
    assert peer.said("does not follow") == 1
    assert world.counts["autopilot.not_followed"] == 2
    assert len(peer.taken) > 300


def test_with_velocities_ardupilots_silent_stop_shows_in_the_acceleration() -> None:
    peer = ArduCopter()

    async def script(world: World) -> None:
        await flown(world)
        await world.run(2.0)
        assert world.warnings == ()
        peer.stops = True
        await world.run(2.0)
        assert world.warnings == ("autopilot follows an acceleration that is not ours: a second sender?",)

    sections: Any = {"vehicle": {"profile": "ardupilot", "setpoint": "velocity+acceleration"}}
    play(script, peer, target={"position": [8.0, 8.0, 8.0]}, **sections)


def test_no_echo_at_all_is_told_after_a_second() -> None:
    peer = ArduCopter()
    peer.silent.add("POSITION_TARGET_LOCAL_NED")

    async def script(world: World) -> None:
        await flown(world)
        await world.run(0.9)
        assert world.warnings == ()
        await world.run(0.4)
        assert world.warnings == ("autopilot confirms no setpoint: no POSITION_TARGET_LOCAL_NED",)
        await world.run(5.0)
        assert peer.asked.count(85) >= 3
        peer.silent.clear()
        await world.run(1.0)
        assert world.warnings == ()
        peer.mode = 5
        peer.silent.add("POSITION_TARGET_LOCAL_NED")
        await world.run(3.0)
        assert world.warnings == ()  # nothing is sent, nothing need be confirmed

    play(script, peer)
    assert peer.said("confirms no setpoint") == 1


# a second sender


@pytest.mark.parametrize("name", ["local", "global", "attitude"])
def test_a_second_setpoint_sender_is_told_and_counted(name: str) -> None:
    other = dialect.MAVLink(None, 255, 190)
    packets = {
        "local": other.set_position_target_local_ned_encode(0, 1, 1, 1, 0x0DF8, *[0.0] * 11),
        "global": other.set_position_target_global_int_encode(0, 0, 0, 6, 0x0DF8, *[0] * 11),
        "attitude": other.set_attitude_target_encode(0, 1, 1, 0, [1.0, 0.0, 0.0, 0.0], 0, 0, 0, 0.5),
    }

    async def script(world: World) -> None:
        await world.run(6.0)
        world.give(packets[name].pack(other))
        await world.run(0.5)
        assert world.warnings == ()  # nobody is engaged: it may fly the vehicle
        await flown(world)
        for _ in range(20):
            world.give(packets[name].pack(other))
            await world.run(0.05)
        assert world.warnings == (f"second setpoint sender: 255/190 {packets[name].get_type()}",)
        assert world.state == "ACTIVE"
        await world.run(3.0)
        assert world.warnings == ()

    world = play(script, Px4())
    assert world.counts["autopilot.foreign_setpoints"] == 21
    assert world.peer.said("second setpoint sender") == 1


def test_setpoints_to_others_and_our_own_sent_back_are_nobodys_business() -> None:
    other, echoed = dialect.MAVLink(None, 255, 190), dialect.MAVLink(None, 1, 196)

    async def script(world: World) -> None:
        await flown(world)
        for _ in range(20):
            world.give(other.set_position_target_local_ned_encode(0, 7, 1, 1, 0x0DF8, *[0.0] * 11).pack(other))
            world.give(other.set_attitude_target_encode(0, 1, 154, 0, [1.0, 0, 0, 0], 0, 0, 0, 0.5).pack(other))
            world.give(echoed.set_position_target_local_ned_encode(0, 1, 1, 1, 0x0C3F, *[0.0] * 11).pack(echoed))
            await world.run(0.05)
        assert world.warnings == ()

    assert "autopilot.foreign_setpoints" not in play(script, Px4()).counts


def test_a_sender_that_cannot_be_heard_shows_in_the_echo() -> None:
    """On another link of the autopilot, which does not forward it."""
    peer = ArduCopter()

    async def script(world: World) -> None:
        await flown(world)
        await world.run(2.0)
        peer.target_acceleration = lambda: (2.5, -2.5, 0.0)  # type: ignore[method-assign]
        await world.run(1.5)
        assert world.warnings == ("autopilot follows an acceleration that is not ours: a second sender?",)

    assert play(script, peer).counts["autopilot.foreign_acceleration"] >= 3


# streams


@pytest.mark.parametrize("name", ["LOCAL_POSITION_NED", "ATTITUDE_QUATERNION", "EXTENDED_SYS_STATE"])
def test_a_stream_that_stops_is_told_and_asked_for_again(name: str) -> None:
    peer = ArduCopter()
    message = {"LOCAL_POSITION_NED": 32, "ATTITUDE_QUATERNION": 31, "EXTENDED_SYS_STATE": 245}[name]

    async def script(world: World) -> None:
        await flown(world)
        asked = peer.asked.count(message)
        del peer.intervals[name]  # another ground station on the same link turned it off
        await world.run(1.0, until=lambda: name in peer.intervals)
        assert name not in peer.intervals
        await world.run(2.0, until=lambda: name in peer.intervals)
        assert peer.asked.count(message) == asked + 1
        assert any(name in warning for warning in world.warnings)
        await world.run(1.0)
        assert world.warnings == ()
        assert world.state == "ACTIVE"

    play(script, peer)
    assert peer.said(f"{name} stopped") == 1


def test_a_lost_link_is_no_flood() -> None:
    peer = ArduCopter()

    async def script(world: World) -> None:
        await flown(world)
        texts = len(peer.texts)
        world.connected = False
        await world.run(12.0)
        assert world.state == "WAITING"
        assert world.session.situation.reason in ("heartbeat lost", "no vehicle state")
        world.connected = True
        await world.run(3.0)
        assert world.state == "ACTIVE"
        assert world.warnings == ()
        assert not any("stopped" in text for text in peer.texts[texts:])
        assert len(peer.texts) - texts <= 3
        assert not any(name.startswith("autopilot.lost") for name in world.counts)

    play(script, peer)


# reboot and clocks


def test_a_rebooted_ardupilot_comes_back_silent_and_is_asked_again() -> None:
    """facts: heartbeats return at once, intervals are gone, the first position is 41 s away."""
    peer = ArduCopter()

    async def script(world: World) -> None:
        await flown(world)
        asked = peer.asked.count(32)
        peer.silent.add("LOCAL_POSITION_NED")
        peer.reboot()
        taken = len(peer.taken)
        await world.run(2.0)
        assert not world.session.situation.engaged  # it is disarmed: what was engaged is no more
        assert world.state in ("READY", "WAITING")
        await world.run(41.0)
        assert world.state == "WAITING"
        assert peer.asked.count(32) - asked >= 15
        assert len(peer.taken) == taken
        peer.silent.clear()
        peer.armed, peer.landed = True, AIR
        await world.run(2.0)
        assert world.state == "READY"
        assert len(peer.taken) == taken
        await flown(world)
        await world.run(0.5)

    world = play(script, peer)
    assert peer.said("rebooted") == 1
    assert world.counts["timesync.reboots"] == 1
    assert peer.texts.count("companion ACTIVE: external mode entered") == 2


def test_a_rebooted_px4_streams_again_by_itself() -> None:
    peer = Px4()

    async def script(world: World) -> None:
        await flown(world)
        peer.reboot()
        await world.run(2.0)
        assert world.state in ("OVERRIDDEN", "READY")
        peer.armed, peer.landed = True, AIR
        await world.run(3.0)
        world.engage()
        await world.run(3.0)
        assert world.state == "ACTIVE"

    play(script, peer)
    assert peer.said("autopilot rebooted") == 1
    assert peer.asked.count(32) == 2


def obstacle(world: World, position: tuple[float, float, float], *, name: str = "ball") -> None:
    """One obstacle frame by Zenoh, stamped with the vehicle's clock."""
    frame = {"stamp_ns": world.peer.boot_ms * 1_000_000, "clock": "vehicle", "kind": "detection"}
    seen = {"id": name, "position": position, "radius": 0.2, "position_std": 0.05}
    world.service._inbox.push("camera", json.dumps({**frame, "obstacles": [seen]}).encode(), None)


async def watching(world: World, seconds: float) -> None:
    for _ in range(round(seconds * 20)):
        obstacle(world, (4.0, 4.0, 3.0))
        await world.run(0.05)


@pytest.mark.parametrize("jump_s", [180.0, -180.0])
def test_a_vehicle_clock_that_jumps_restarts_what_was_dated(jump_s: float) -> None:
    peer = Px4()
    peer.boot_ms = 600_000

    async def script(world: World) -> None:
        await flown(world)
        await watching(world, 1.0)
        assert len(world.service._thinker.tracks()) == 1
        assert world.service._time.unix_minus_vehicle_ns is not None
        peer.boot_ms += round(jump_s * 1000)
        await world.run(0.05)
        assert len(world.service._thinker.tracks()) == 0
        assert world.service._time.unix_minus_vehicle_ns is None
        assert world.state == "ACTIVE"  # the vehicle flies on, and so does the stream
        taken = len(peer.taken)
        await watching(world, 2.0)
        assert world.state == "ACTIVE"
        assert len(peer.taken) - taken >= 95
        assert len(world.service._thinker.tracks()) == 1
        offset_ns = world.service._time.unix_minus_vehicle_ns
        assert offset_ns is not None
        assert abs(world.clock.unix_ns() - offset_ns - peer.boot_ms * 1_000_000) < 50_000_000

    world = play(script, peer)
    kind = "jumps_ahead" if jump_s > 0 else "reboots"
    assert world.counts[f"timesync.{kind}"] == 1
    assert world.counts["autopilot.clock_restarts"] == 1
    assert peer.said("start anew") == 1


def test_a_clock_that_jumps_while_only_timesync_is_heard() -> None:
    peer = ArduCopter()
    peer.silent.add("LOCAL_POSITION_NED")  # no position before the EKF is ready

    async def script(world: World) -> None:
        await world.run(8.0)
        assert world.service._time.unix_minus_vehicle_ns is not None
        peer.boot_ms += 120_000
        await world.run(12.0)
        offset_ns = world.service._time.unix_minus_vehicle_ns
        assert offset_ns is not None
        assert abs(world.clock.unix_ns() - offset_ns - peer.boot_ms * 1_000_000) < 50_000_000

    assert play(script, peer).counts["timesync.jumps_ahead"] == 1


def test_a_step_of_unix_time_is_followed_at_once_and_told() -> None:
    def frame(world: World, late_s: float = 0.0) -> None:
        stamp_ns = world.clock.unix_ns() - round(late_s * 1e9)
        payload = {"stamp_ns": stamp_ns, "clock": "unix", "kind": "detection", "obstacles": []}
        world.service._inbox.push("camera", json.dumps(payload).encode(), None)

    async def script(world: World) -> None:
        await flown(world)
        for k in range(40):
            if k == 20:
                world.clock.set_unix(-3600.0)
            frame(world)
            await world.run(0.05)
        assert world.state == "ACTIVE"

    world = play(script, Px4())
    assert world.counts["obstacles.frames"] == 40
    assert "obstacles.future" not in world.counts
    assert "obstacles.stale" not in world.counts
    assert world.peer.said("companion's clock stepped by -3600.0 s") == 1


def test_a_pause_of_the_link_is_no_jump() -> None:
    async def script(world: World) -> None:
        await flown(world)
        world.connected = False
        await world.run(30.0)
        world.connected = True
        await world.run(2.0)

    counts = play(script, Px4()).counts
    assert "timesync.jumps_ahead" not in counts
    assert "timesync.reboots" not in counts
    assert "autopilot.clock_restarts" not in counts


# resets of the estimator


@pytest.mark.parametrize("counted", [True, False])
def test_a_reset_of_the_estimator_keeps_the_tracks_and_is_told(counted: bool) -> None:
    peer = Px4()
    peer.odometry = counted

    async def script(world: World) -> None:
        await flown(world)
        await watching(world, 1.0)
        peer.p = peer.p + np.array([3.0, 4.0, 0.0])
        peer.reset_counter += counted
        await world.run(0.05)
        assert world.state == "ACTIVE"
        assert len(world.service._thinker.tracks()) == 1
        path = world.service._thinker._pilot._tracker._path
        assert all(np.linalg.norm(state.p_enu[:2] - [4.0, 3.0]) < 0.5 for state in path._states)
        await watching(world, 2.0)
        assert world.state == "ACTIVE"
        anchor = world.service._thinker._pilot._anchor
        np.testing.assert_allclose(anchor[:2], [4.0, 3.0], atol=0.5)  # it holds where it is, not where it was
        a = np.array([[m.afx, m.afy, m.afz] for *_, m in peer.taken[-50:]])
        assert np.abs(a).max() < 0.5  # and is not sent 5 m back

    world = play(script, peer)
    assert world.counts["autopilot.origin_resets"] == 1
    assert peer.said("the origin moved by 5.0 m") == 1


def test_a_reset_too_small_to_see_is_told_by_its_counter() -> None:
    peer = Px4()
    peer.odometry = True

    async def script(world: World) -> None:
        await flown(world)
        peer.reset_counter = 255
        await world.run(0.5)
        peer.reset_counter = 0  # one byte: it wraps
        await world.run(0.5)

    assert play(script, peer).counts["autopilot.origin_resets"] == 2


def test_a_vehicle_that_flies_fast_and_loses_states_has_not_jumped() -> None:
    peer = ArduCopter()

    async def script(world: World) -> None:
        await flown(world)
        for _ in range(12):
            await world.run(0.3)
            world.connected = False
            await world.run(0.3)
            world.connected = True

    world = play(script, peer, target={"position": [9.0, 9.0, 9.0]}, limits={"slew_m_s3": 40.0})
    assert np.linalg.norm(peer.v) > 0.5 or np.linalg.norm(peer.p - [0, 0, -2]) > 5.0
    assert "autopilot.origin_resets" not in world.counts


@KINDS
def test_whatever_is_told_is_told_in_few_words(kind: type[Peer]) -> None:
    """Half a minute of flight without trouble: a handful of texts."""

    async def script(world: World) -> None:
        await flown(world)
        await world.run(20.0)
        assert world.warnings == ()

    peer = kind()
    play(script, peer)
    assert len(peer.texts) <= 6
    assert GROUND != peer.landed == AIR
    assert peer.mode in (GUIDED, 6 << 16)
