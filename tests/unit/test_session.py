"""The conversation with autopilot and operator, driven by events and a counted clock."""

from __future__ import annotations

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.config import Config, parse_config
from companion.link.events import Attitude, Command, Heartbeat, LandedState, Position
from companion.link.geo import TangentPlane
from companion.link.mavlink import MavlinkCodec
from companion.session import VehicleSession
from companion.state import State
from companion.types import NS_PER_S, Vec3, frozen

OFFBOARD, HOLD = 6 << 16, 4 << 16 | 3 << 24
MS = 1_000_000


class Rig:
    """A session, an autopilot as events, and the messages that came out."""

    def __init__(self, config: Config) -> None:
        self.targets: list[Vec3] = []
        self.codec = MavlinkCodec(system=config.mavlink.system_id or 1)
        self.session = VehicleSession(config, self.codec, self._target)
        self.now_ns = 0
        self.mode = HOLD
        self.armed = True
        self.airborne = True
        self.systems = [1]
        self.sent: list[object] = []
        self._parser = dialect.MAVLink(None)

    def _target(self, position: Vec3) -> str | None:
        self.targets.append(position)
        return None

    def beat(self, seconds: float, *, state: bool = True, heartbeat: bool = True) -> None:
        """Let time pass at 10 Hz with heartbeats and states of the autopilot."""
        for _ in range(round(seconds * 10)):
            self.now_ns += 100 * MS
            for system in self.systems:
                if heartbeat:
                    self.session.handle(Heartbeat(system, 1, 12, 2, self.mode, self.armed, 4), self.now_ns)
                if state:
                    self.session.handle(LandedState(system, 1, self.airborne, False, False), self.now_ns)
                    self.session.handle(Attitude(system, 1, self.now_ns, frozen([1, 0, 0, 0])), self.now_ns)
                    position = Position(system, 1, self.now_ns, frozen([0, 0, 2]), frozen([0, 0, 0]))
                    if self.session.handle(position, self.now_ns) is not None:
                        self.session.heard_vehicle(self.now_ns)
            self.session.poll(self.now_ns)
            self.collect()

    def collect(self) -> None:
        for data in self.session.take_outgoing():
            self.sent.extend(self._parser.parse_buffer(data))

    def command(self, number: int, param1: float, *, is_int: bool = False, frame: int = 0) -> int:
        """Send a command as system 255; its MAV_RESULT."""
        params = (param1, 0.0, 0.0, 0.0, 10_000.0, 20_000.0, -3.0)
        self.session.handle(Command(number, params, is_int, frame, 10_000, 20_000, -3.0, 255, 190, 1, 196), self.now_ns)
        self.collect()
        ack = self.messages("COMMAND_ACK")[-1]
        assert (ack.target_system, ack.target_component) == (255, 190)
        return int(ack.result)

    def messages(self, kind: str) -> list:
        return [message for message in self.sent if message.get_type() == kind]

    def mode_requests(self) -> list[tuple[int, int]]:
        commands = [m for m in self.messages("COMMAND_LONG") if m.command == 176]
        return [(int(m.param2), int(m.param3)) for m in commands]

    @property
    def state(self) -> State:
        return self.session.situation.state


@pytest.fixture
def rig() -> Rig:
    return Rig(parse_config({"mavlink": {"system_id": 1}}))


def test_waits_for_heartbeat_and_state(rig: Rig) -> None:
    rig.session.poll(0)
    assert rig.state is State.WAITING
    rig.beat(0.2, state=False)
    assert rig.state is State.WAITING
    rig.beat(0.2)
    assert rig.state is State.READY


def test_a_configured_system_is_taken_at_once_others_are_ignored(rig: Rig) -> None:
    rig.systems = [7]
    rig.beat(5.0)
    assert rig.state is State.WAITING
    rig.systems = [1, 7]
    rig.beat(0.2)
    assert rig.state is State.READY
    assert rig.session.system == 1


def test_one_autopilot_is_latched_after_three_seconds() -> None:
    rig = Rig(parse_config({}))
    rig.systems = [5]
    rig.beat(2.9)
    assert rig.state is State.WAITING
    rig.beat(0.5)
    assert rig.state is State.READY
    assert rig.codec.system == 5


def test_two_autopilots_are_not_guessed_between() -> None:
    rig = Rig(parse_config({}))
    rig.systems = [5, 6]
    rig.beat(6.0)
    assert rig.state is State.WAITING
    assert any("system_id" in m.text for m in rig.messages("STATUSTEXT"))


def test_engage_streams_first_then_asks_for_offboard(rig: Rig) -> None:
    rig.beat(1.0)
    assert rig.session.streams
    assert rig.command(92, 1.0) == 0
    rig.beat(0.4)
    assert rig.mode_requests() == []
    rig.beat(0.3)
    assert rig.mode_requests() == [(6, 0)]
    rig.mode = OFFBOARD
    rig.beat(0.1)
    assert rig.state is State.ACTIVE


def test_engage_gives_up_after_three_seconds(rig: Rig) -> None:
    rig.beat(1.0)
    rig.command(92, 1.0)
    rig.beat(5.0)
    assert rig.state is State.READY
    assert not rig.session.situation.engaged
    assert set(rig.mode_requests()) == {(6, 0)}
    assert any("did not enter" in m.text for m in rig.messages("STATUSTEXT"))
    asked = len(rig.mode_requests())
    rig.beat(5.0)
    assert len(rig.mode_requests()) == asked


def test_engage_is_refused_without_a_vehicle(rig: Rig) -> None:
    rig.session.poll(0)
    assert rig.command(92, 1.0) == 1  # TEMPORARILY_REJECTED


def test_engaged_on_the_ground_waits_for_flight(rig: Rig) -> None:
    rig.airborne = False
    rig.beat(1.0)
    assert rig.command(92, 1.0) == 0
    rig.beat(3.0)
    assert rig.mode_requests() == []
    rig.airborne = True
    rig.beat(0.7)
    assert rig.mode_requests() == [(6, 0)]


def engaged(rig: Rig) -> None:
    rig.beat(1.0)
    rig.command(92, 1.0)
    rig.mode = OFFBOARD
    rig.beat(0.2)
    assert rig.state is State.ACTIVE


def test_release_asks_for_hold_and_streams_until_it_is_seen(rig: Rig) -> None:
    engaged(rig)
    assert rig.command(92, 0.0) == 0
    assert rig.mode_requests() == [(4, 3)]
    rig.beat(0.2)
    assert rig.state is State.ACTIVE
    assert rig.session.streams
    rig.mode = HOLD
    rig.beat(0.1)
    assert rig.state is State.READY
    assert not rig.session.situation.engaged


def test_a_takeover_is_not_fought(rig: Rig) -> None:
    engaged(rig)
    rig.mode = HOLD
    rig.beat(3.0)
    assert rig.state is State.OVERRIDDEN
    assert not rig.session.streams
    assert rig.mode_requests() == []
    rig.command(92, 1.0)
    rig.beat(0.1)
    assert rig.state is State.READY


def test_silence_of_the_vehicle_stops_the_stream(rig: Rig) -> None:
    engaged(rig)
    rig.beat(0.4, state=False)
    assert rig.state is State.ACTIVE
    rig.beat(0.3, state=False)
    assert rig.state is State.WAITING
    assert not rig.session.streams
    assert "no vehicle state" in rig.session.situation.reason


def test_missing_heartbeats_are_noticed(rig: Rig) -> None:
    rig.beat(1.0)
    rig.beat(5.2, heartbeat=False)
    assert rig.state is State.WAITING
    assert rig.session.situation.reason == "heartbeat lost"


def test_a_failed_brain_goes_quiet_and_asks_for_hold(rig: Rig) -> None:
    engaged(rig)
    rig.session.fail("brain failed: ValueError", rig.now_ns)
    rig.beat(0.1)
    assert rig.state is State.FAULT
    assert not rig.session.streams
    assert rig.mode_requests() == [(4, 3)]
    rig.mode = HOLD
    rig.beat(2.0)
    assert rig.mode_requests() == [(4, 3)]
    assert rig.command(92, 1.0) == 1


def test_reposition_takes_the_int_form_only(rig: Rig) -> None:
    rig.beat(1.0)
    assert rig.command(192, 0.0) == 8  # COMMAND_INT_ONLY
    assert rig.command(192, 0.0, is_int=True, frame=1) == 0
    np.testing.assert_allclose(rig.targets[-1], [2.0, 1.0, 3.0])  # NED (1, 2, -3) m in ENU


def test_a_global_target_waits_for_the_origin_and_asks_for_it(rig: Rig) -> None:
    rig.beat(1.0)
    assert rig.command(192, 0.0, is_int=True, frame=0) == 1  # TEMPORARILY_REJECTED
    asked = [(m.command, int(m.param1)) for m in rig.messages("COMMAND_LONG") if m.command == 512]
    assert asked == [(512, 49)]
    rig.session.origin = lambda: TangentPlane(0.0, 0.0, -10.0)
    assert rig.command(192, 0.0, is_int=True, frame=0) == 0


def test_unknown_commands_are_unsupported(rig: Rig) -> None:
    assert rig.command(31_000, 0.0) == 3


def test_intervals_are_asked_once_and_again_after_a_reboot(rig: Rig) -> None:
    rig.beat(5.0)
    asked = [int(m.param1) for m in rig.messages("COMMAND_LONG") if m.command == 511]
    assert sorted(set(asked)) == [31, 32, 245]
    assert len(asked) == 3
    rig.beat(6.0, state=False, heartbeat=False)
    rig.beat(3.0)
    again = [int(m.param1) for m in rig.messages("COMMAND_LONG") if m.command == 511]
    assert len(again) > 3


def test_state_changes_are_told_once(rig: Rig) -> None:
    rig.beat(10.0)
    texts = [m.text for m in rig.messages("STATUSTEXT")]
    assert len(texts) == len(set(texts))
    assert len(texts) <= 3


def test_degraded_inputs_hold_and_recover(rig: Rig) -> None:
    engaged(rig)
    rig.session.degraded("obstacle source radar silent")
    assert rig.state is State.HOLD
    assert rig.session.streams
    rig.session.degraded(None)
    assert rig.state is State.ACTIVE


def test_monitor_mode_never_streams_nor_asks() -> None:
    rig = Rig(parse_config({"mode": "monitor", "mavlink": {"system_id": 1}}))
    rig.beat(1.0)
    rig.command(92, 1.0)
    rig.beat(1.0)
    assert rig.mode_requests() == []
    rig.mode = OFFBOARD
    rig.beat(0.2)
    assert rig.state is State.ACTIVE
    assert not rig.session.streams


def test_ardupilot_is_silent_until_active() -> None:
    rig = Rig(parse_config({"vehicle": {"profile": "ardupilot"}, "mavlink": {"system_id": 1}}))
    rig.mode = 5  # LOITER
    rig.beat(1.0)
    assert rig.state is State.READY
    assert not rig.session.streams
    rig.command(92, 1.0)
    rig.beat(0.7)
    assert rig.mode_requests() == [(4, 0)]
    rig.mode = 4  # GUIDED
    rig.beat(0.1)
    assert rig.state is State.ACTIVE
    assert rig.session.streams
    assert rig.now_ns < 10 * NS_PER_S


def test_a_fault_asks_for_hold_only_of_a_vehicle_that_we_were_flying() -> None:
    rig = Rig(parse_config({"vehicle": {"profile": "ardupilot"}, "mavlink": {"system_id": 1}}))
    rig.mode = 4  # GUIDED, flown by a ground station
    rig.beat(1.0)
    rig.session.fail("brain failed", rig.now_ns)
    rig.beat(3.0)
    assert rig.state is State.FAULT
    assert rig.mode_requests() == []


def test_after_a_fault_the_pilot_is_not_fought(rig: Rig) -> None:
    engaged(rig)
    rig.session.fail("brain failed", rig.now_ns)
    rig.mode = HOLD
    rig.beat(0.5)
    asked = len(rig.mode_requests())
    rig.mode = OFFBOARD  # the pilot's own companion takes over
    rig.beat(5.0)
    assert len(rig.mode_requests()) == asked


def test_a_fault_on_the_ground_is_tried_again(rig: Rig) -> None:
    rig.armed, rig.airborne = False, False
    rig.beat(1.0)
    rig.session.fail("brain failed", rig.now_ns)
    rig.beat(3.0)
    assert rig.state is State.FAULT
    rig.beat(3.0)
    assert rig.state is State.READY


def test_a_release_during_the_engage_sequence_holds() -> None:
    rig = Rig(parse_config({"vehicle": {"profile": "px4"}, "mavlink": {"system_id": 1}}))
    rig.beat(1.0)
    rig.command(92, 1.0)
    rig.beat(0.8)
    assert rig.mode_requests()[-1] == (6, 0)
    assert rig.command(92, 0.0) == 0
    rig.mode = OFFBOARD  # the mode that was asked for arrives late
    rig.beat(0.6)
    assert rig.state is State.READY
    assert rig.mode_requests()[-1] == (4, 3)
    rig.mode = HOLD
    rig.beat(10.0)
    rig.mode = OFFBOARD  # later the pilot's own switch engages as ever
    rig.beat(0.2)
    assert rig.state is State.ACTIVE


def test_other_components_of_the_system_are_not_the_autopilot(rig: Rig) -> None:
    rig.beat(1.0)
    odometry = Position(1, 197, rig.now_ns + 1, frozen([50, 0, 2]), frozen([0, 0, 0]))
    assert rig.session.handle(odometry, rig.now_ns) is None
    rig.session.handle(LandedState(1, 240, False, False, False), rig.now_ns)
    rig.session.handle(Heartbeat(1, 42, 3, 2, OFFBOARD, False, 4), rig.now_ns)
    assert rig.session.situation.airborne
    assert rig.session.armed
    assert not rig.session.situation.external


def test_a_single_heartbeat_is_nobody_to_latch() -> None:
    rig = Rig(parse_config({}))
    rig.session.handle(Heartbeat(77, 1, 12, 2, HOLD, True, 4), 0)
    rig.systems = []
    rig.beat(5.0)
    rig.systems = [5]
    rig.beat(4.0)
    assert rig.session.system == 5


def test_messages_that_do_not_arrive_are_asked_for_again(rig: Rig) -> None:
    for _ in range(100):
        rig.now_ns += 100 * MS
        rig.session.handle(Heartbeat(1, 1, 12, 2, HOLD, True, 4), rig.now_ns)
        rig.session.handle(Attitude(1, 1, rig.now_ns, frozen([1, 0, 0, 0])), rig.now_ns)
        rig.session.handle(Position(1, 1, rig.now_ns, frozen([0, 0, 2]), frozen([0, 0, 0])), rig.now_ns)
        rig.session.heard_vehicle(rig.now_ns)
        rig.session.poll(rig.now_ns)
        rig.collect()
    asked = [int(m.param1) for m in rig.messages("COMMAND_LONG") if m.command == 511]
    assert asked.count(245) >= 4
    assert asked.count(31) == asked.count(32) == 1
    assert rig.command(92, 1.0) == 0
    rig.session.poll(rig.now_ns)
    assert "waiting to be airborne" in rig.session.situation.reason


def test_a_vehicle_by_zenoh_still_asks_whether_it_flies() -> None:
    rig = Rig(parse_config({"vehicle": {"source": "zenoh"}, "mavlink": {"system_id": 1}}))
    rig.beat(0.5)
    asked = [int(m.param1) for m in rig.messages("COMMAND_LONG") if m.command == 511]
    assert asked == [245]
    assert rig.session.situation.airborne


def test_a_command_of_another_module_is_answered_with_its_result(rig: Rig) -> None:
    rig.beat(1.0)
    rig.session.commands[31_005] = lambda command: 1 if command.params[0] > 0.0 else 2
    assert rig.command(31_005, 1.0) == 1
    assert rig.command(31_005, 0.0) == 2
    assert rig.command(31_006, 0.0) == 3


def test_the_same_text_is_not_said_twice_in_a_row(rig: Rig) -> None:
    rig.beat(1.0)
    rig.sent.clear()
    for _ in range(30):
        rig.session.say(4, "refused: something")
        rig.beat(0.1)
    assert [m.text for m in rig.messages("STATUSTEXT")] == ["refused: something"]
    assert rig.session.text_counts["repeated"] == 29


def test_time_outs_can_be_changed(rig: Rig) -> None:
    rig.beat(1.0)
    rig.session.retune(parse_config({"mavlink": {"system_id": 1}, "engage": {"stream_s": 2.0}}))
    rig.command(92, 1.0)
    rig.beat(1.8)
    assert rig.mode_requests() == []
    rig.beat(0.5)
    assert rig.mode_requests() == [(6, 0)]
