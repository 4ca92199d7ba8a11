"""The autopilot on its two links: real loopback sockets, physics stepped by hand, no pacing."""

from __future__ import annotations

import math
import socket
import struct
from collections.abc import Iterator
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sim_bridge.flight import Flight
from sim_bridge.links import Router
from sim_bridge.messages import Mode
from sim_bridge.placement import resolve
from sim_bridge.scenario import parse_scenario
from sim_bridge.station import Station

AIRBORNE = {"vehicle": {"start": [0.0, 0.0, 1.5]}, "end": {"stop": False}}


class Peer:
    """A component that speaks to one of the links from a socket of its own."""

    def __init__(self, system: int, component: int) -> None:
        self.codec = dialect.MAVLink(None, system, component)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.port = self.socket.getsockname()[1]

    def send(self, link: Any, message: Any) -> None:
        self.socket.sendto(message.pack(self.codec), link.socket.getsockname())

    def received_all(self) -> list[Any]:
        """Everything that has come in since the last look."""
        self.socket.setblocking(False)
        messages: list[Any] = []
        while True:
            try:
                messages += self.codec.parse_buffer(self.socket.recv(65535)) or []
            except BlockingIOError:
                return messages

    def received(self, kind: str) -> list[Any]:
        """What of one kind has come in; the rest is dropped."""
        return [m for m in self.received_all() if m.get_type() == kind]


class Bench:
    """A flight whose time moves only when told to."""

    def __init__(self) -> None:
        self.companion, self.ground = Peer(1, 196), Peer(245, 190)
        self.flight = Flight(resolve("bench", parse_scenario(AIRBORNE, source="bench"), 0))
        self.craft = self.flight.crafts[0]
        self.router = Router(self.companion.port, self.ground.port)
        self.station = Station(self.craft, self.router, t_ns=self.t_ns, clock_ns=self.t_ns, lockstep=False)
        self.onboard_link, self.ground_link = self.router.links
        self.station.stream(*self.router.links)

    def t_ns(self) -> int:
        return self.flight.t_ns

    def serve(self) -> None:
        for link, packet in self.router.receive():
            self.router.forward(link, packet)
            self.station.handle(link, packet)

    def fly(self, seconds: float) -> None:
        for _ in range(round(seconds * 240)):
            self.flight.advance()
            if self.flight.at_tick:
                self.station.say(self.flight.control()[0])
                self.station.announce()
            self.station.stream(*self.router.links)

    def order(self, message: Any, *, ground: bool = True) -> int | None:
        """Send a command; the MAV_RESULT of its acknowledgement, None without one."""
        peer, link = (self.ground, self.ground_link) if ground else (self.companion, self.onboard_link)
        peer.send(link, message)
        self.serve()
        acks = peer.received("COMMAND_ACK")
        assert all(
            (a.target_system, a.target_component) == (peer.codec.srcSystem, peer.codec.srcComponent) for a in acks
        )
        return acks[-1].result if acks else None

    def close(self) -> None:
        self.flight.close()
        self.router.close()
        self.companion.socket.close()
        self.ground.socket.close()


@pytest.fixture
def bench() -> Iterator[Bench]:
    made = Bench()
    yield made
    made.close()


def long(command: int, *params: float, component: int = 1, system: int = 1) -> Any:
    return dialect.MAVLink_command_long_message(system, component, command, 0, *params, *[0.0] * (7 - len(params)))


def setpoint(north_m_s2: float, mask: int = 0x0C3F) -> Any:
    return dialect.MAVLink_set_position_target_local_ned_message(
        0, 1, 1, 1, mask, 0, 0, 0, 0, 0, 0, north_m_s2, 0, 0, 0, 0
    )


def stream(bench: Bench, seconds: float, north_m_s2: float = 0.0) -> None:
    for _ in range(round(seconds * 20)):
        bench.companion.send(bench.onboard_link, setpoint(north_m_s2))
        bench.serve()
        bench.fly(0.05)


def heartbeat(kind: int = 6) -> Any:
    return dialect.MAVLink_heartbeat_message(kind, 8, 0, 0, 4, 3)


def test_unknown_commands_are_unsupported_and_acknowledged_on_their_link_only(bench: Bench) -> None:
    assert bench.order(long(31000)) == 3
    assert bench.companion.received("COMMAND_ACK") == []


def test_commands_to_others_are_not_ours(bench: Bench) -> None:
    assert bench.order(long(400, 1.0, component=100)) is None
    assert bench.order(long(400, 1.0, system=9)) is None
    assert bench.order(long(31000, component=0)) == 3  # to the whole system: ours too


def test_forwarding_between_the_links(bench: Bench) -> None:
    bench.ground.send(bench.ground_link, heartbeat())
    bench.companion.send(bench.onboard_link, heartbeat(18))
    bench.serve()
    assert [m.get_srcComponent() for m in bench.ground.received("HEARTBEAT")] == [1, 196]  # the autopilot's, then his
    assert [m.get_srcComponent() for m in bench.companion.received("HEARTBEAT")] == [1, 190]
    assert bench.order(long(92, 1.0, component=196)) is None  # the autopilot does not answer for it
    (command,) = bench.companion.received("COMMAND_LONG")
    assert (command.command, command.get_srcSystem()) == (92, 245)
    bench.companion.send(bench.onboard_link, dialect.MAVLink_command_ack_message(92, 0, 0, 0, 245, 190))
    bench.serve()
    (ack,) = bench.ground.received("COMMAND_ACK")
    assert (ack.command, ack.get_srcComponent()) == (92, 196)
    assert bench.companion.received("COMMAND_ACK") == []  # nothing goes back where it came from


def test_nobody_heard_nothing_forwarded(bench: Bench) -> None:
    bench.order(long(92, 1.0, component=196))
    assert bench.companion.received("COMMAND_LONG") == []


def test_setpoints_and_time_requests_stay_on_their_link(bench: Bench) -> None:
    bench.ground.send(bench.ground_link, heartbeat())
    bench.companion.send(bench.onboard_link, setpoint(1.0))
    bench.companion.send(bench.onboard_link, dialect.MAVLink_timesync_message(0, 4242))
    bench.fly(0.25)
    bench.serve()
    (answer,) = bench.companion.received("TIMESYNC")
    assert (answer.tc1, answer.ts1) == (250_000_000, 4242)
    assert bench.ground.received("TIMESYNC") == []
    assert bench.ground.received("SET_POSITION_TARGET_LOCAL_NED") == []
    bench.companion.send(bench.onboard_link, dialect.MAVLink_timesync_message(5, 4242))  # an answer, not a request
    bench.serve()
    assert bench.companion.received("TIMESYNC") == []


def test_heartbeat_at_once_on_a_mode_change(bench: Bench) -> None:
    bench.fly(0.1)
    bench.companion.received("HEARTBEAT")
    bench.ground.received("HEARTBEAT")
    assert bench.order(long(176, 1.0, 3.0)) == 0
    (on_ground,) = bench.companion.received("HEARTBEAT")
    assert on_ground.custom_mode == 3 << 16
    assert on_ground.base_mode & 128  # armed
    assert bench.order(long(176, 1.0, 3.0)) == 0  # no change, no heartbeat
    assert bench.companion.received("HEARTBEAT") == []


def test_default_rates_and_message_intervals(bench: Bench) -> None:
    bench.fly(2.0)
    states = bench.companion.received("LOCAL_POSITION_NED")
    assert [m.time_boot_ms for m in states] == list(range(0, 2001, 50))
    assert bench.order(long(511, 32, 20_000), ground=False) == 0  # 50 Hz
    bench.fly(1.0)
    assert len(bench.companion.received("LOCAL_POSITION_NED")) == pytest.approx(50, abs=1)
    assert bench.order(long(511, 32, -1), ground=False) == 0
    bench.fly(1.0)
    assert bench.companion.received("LOCAL_POSITION_NED") == []
    assert len(bench.ground.received("LOCAL_POSITION_NED")) == pytest.approx(40, abs=1)  # the other link's own
    assert bench.order(long(511, 32, 0), ground=False) == 0
    bench.fly(1.0)
    assert len(bench.companion.received("LOCAL_POSITION_NED")) == pytest.approx(20, abs=1)


@pytest.mark.parametrize("params", [(9999, 100_000), (math.nan, 100_000), (32, math.nan)])
def test_intervals_that_cannot_be_had_fail(bench: Bench, params: tuple[float, float]) -> None:
    assert bench.order(long(511, *params)) == 4  # MAV_RESULT_FAILED, as PX4 has it


def test_a_stream_faster_than_the_physics_is_denied(bench: Bench) -> None:
    assert bench.order(long(511, 30, 1000)) == 2
    bench.ground.send(bench.ground_link, long(510, 30))
    bench.serve()
    (told,) = bench.ground.received("MESSAGE_INTERVAL")
    assert told.interval_us == 100_000  # as before


def test_get_interval_and_request_message(bench: Bench) -> None:
    bench.ground.send(bench.ground_link, long(510, 32))
    bench.ground.send(bench.ground_link, long(512, 148))
    bench.serve()
    messages = bench.ground.received_all()
    assert [(m.message_id, m.interval_us) for m in messages if m.get_type() == "MESSAGE_INTERVAL"] == [(32, 100_000)]
    (version,) = [m for m in messages if m.get_type() == "AUTOPILOT_VERSION"]
    assert version.capabilities & 8192
    assert bench.order(long(512, 9999)) == 2


def test_parameters_are_listed_read_and_written(bench: Bench) -> None:
    bench.ground.send(bench.ground_link, dialect.MAVLink_param_request_list_message(1, 1))
    bench.serve()
    check, *values = bench.ground.received("PARAM_VALUE")
    assert (check.param_id, check.param_index, check.param_type) == ("_HASH_CHECK", 65535, 5)
    assert [m.param_index for m in values] == list(range(values[0].param_count))
    crc = 0  # CRC-32 without inversions over names and values, bit by bit
    for m in values:
        for byte in m.param_id.encode() + struct.pack("<f", m.param_value):
            crc ^= byte
            for _ in range(8):
                crc = crc >> 1 ^ (0xEDB88320 if crc & 1 else 0)
    assert struct.unpack("<I", struct.pack("<f", check.param_value)) == (crc,)
    assert {"COM_OF_LOSS_T", "MIS_TAKEOFF_ALT", "COM_OBL_RC_ACT"} <= {m.param_id for m in values}
    write = dialect.MAVLink_param_set_message(1, 1, b"COM_OBL_RC_ACT", struct.unpack("<f", struct.pack("<i", 4))[0], 6)
    bench.ground.send(bench.ground_link, write)
    bench.serve()
    for peer in (bench.ground, bench.companion):  # told to everybody
        (told,) = peer.received("PARAM_VALUE")
        assert struct.unpack("<i", struct.pack("<f", told.param_value))[0] == 4
    bench.ground.send(bench.ground_link, dialect.MAVLink_param_request_read_message(1, 1, b"NO_SUCH", -1))
    bench.serve()
    assert bench.ground.received("PARAM_VALUE") == []


def test_a_setpoint_moves_the_vehicle_and_its_loss_stops_it(bench: Bench) -> None:
    assert bench.order(long(176, 1.0, 6.0), ground=False) == 1
    assert "no setpoint" in bench.ground.received("STATUSTEXT")[0].text
    stream(bench, 0.55)
    assert bench.order(long(176, 1.0, 6.0), ground=False) == 0
    stream(bench, 1.0, north_m_s2=2.0)
    before = bench.companion.received("LOCAL_POSITION_NED")[-1]
    assert before.vx == pytest.approx(2.0, abs=0.5)
    assert abs(before.vy) < 0.05
    assert abs(before.z + 1.5) < 0.1
    bench.companion.received("HEARTBEAT")
    bench.fly(0.95)
    assert bench.craft.autopilot.mode is Mode.OFFBOARD
    while bench.craft.autopilot.mode is Mode.OFFBOARD and bench.flight.t_ns < 4_000_000_000:
        bench.fly(1 / 240)
    assert bench.craft.autopilot.mode is Mode.HOLD
    held = bench.craft.state.p_enu
    (at_once,) = [m for m in bench.companion.received("HEARTBEAT") if m.custom_mode == 4 << 16 | 3 << 24]
    assert at_once.base_mode & 128
    lost = bench.ground.received("STATUSTEXT")[-1]
    assert lost.severity == 2
    assert "setpoints lost" in lost.text
    bench.fly(4.0)
    assert math.dist(bench.craft.state.p_enu, held) < 0.1  # comes back to where the failsafe caught it


def test_a_force_setpoint_is_refused_and_told(bench: Bench) -> None:
    for _ in range(20):
        bench.companion.send(bench.onboard_link, setpoint(1.0, mask=0x0E3F))
        bench.serve()
        bench.fly(0.05)
    assert bench.order(long(176, 1.0, 6.0), ground=False) == 1
    assert "FORCE" in bench.ground.received("STATUSTEXT")[0].text


def test_the_setpoint_is_echoed_on_request(bench: Bench) -> None:
    stream(bench, 0.55)
    assert bench.order(long(176, 1.0, 6.0), ground=False) == 0
    stream(bench, 0.1, north_m_s2=1.25)
    bench.companion.received_all()
    bench.companion.send(bench.onboard_link, long(512, 85))
    bench.serve()
    (echo,) = bench.companion.received("POSITION_TARGET_LOCAL_NED")
    assert (echo.type_mask, echo.afx, echo.coordinate_frame) == (0x003F, 1.25, 1)  # what is NaN is marked
    assert math.isnan(echo.x)
    assert math.isnan(echo.vy)
    assert echo.yaw == pytest.approx(math.pi / 2)  # the heading that is held: east


def test_landed_state_changes_are_sent_at_once(bench: Bench) -> None:
    bench.order(long(21))
    bench.companion.received("EXTENDED_SYS_STATE")
    bench.fly(0.06)
    assert bench.companion.received("EXTENDED_SYS_STATE")[-1].landed_state == 4
    bench.fly(6.0)
    assert bench.companion.received("EXTENDED_SYS_STATE")[-1].landed_state == 1
    assert not bench.craft.autopilot.armed
