"""The ardupilot personality on its links: real loopback sockets, plain pymavlink on the other side, no pacing."""

from __future__ import annotations

import itertools
import math
import socket
import struct
from collections.abc import Iterator
from typing import Any

import pytest
from ardupilot_rig import Rig
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sim_bridge.links import Router
from sim_bridge.station import Station

GROUND = (0.0, 0.0, 0.2)
BYTEWISE, C_CAST = 16, 131072  # MAV_PROTOCOL_CAPABILITY
INT8, INT16, REAL32 = 2, 4, 9


class Wired:
    """A flight whose time moves only when told to, with a peer on each link."""

    def __init__(self, *, lockstep: bool = False, **parameters: float) -> None:
        self.rig = Rig(GROUND, **parameters)
        self._peers = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
        for peer in self._peers:
            peer.bind(("127.0.0.1", 0))
            peer.setblocking(False)
        ports = [peer.getsockname()[1] for peer in self._peers]
        self.router = Router(*ports)
        t_ns = lambda: self.rig.t_ns  # noqa: E731
        self.station = Station(self.rig.craft, self.router, t_ns=t_ns, clock_ns=t_ns, lockstep=lockstep)
        self._codecs = [dialect.MAVLink(None, 1, 196), dialect.MAVLink(None, 255, 190)]
        self.boot_ms: list[int] = []

    def send(self, message: Any, link: int = 1) -> None:
        raw = message.pack(self._codecs[link])
        self._peers[link].sendto(raw, self.router.links[link].socket.getsockname())
        for each, packet in self.router.receive():
            self.station.handle(each, packet)

    def order(self, command: int, *params: float, link: int = 1) -> int:
        """The MAV_RESULT."""
        filled = [*params, *[0.0] * (7 - len(params))]
        self.send(dialect.MAVLink_command_long_message(1, 1, command, 0, *filled), link)
        (ack,) = [m for m in self.received(link) if m.get_type() == "COMMAND_ACK"]
        return int(ack.result)

    def fly(self, seconds: float) -> None:
        flight = self.rig.flight
        for _ in range(round(seconds * 240)):
            flight.advance()
            if flight.at_tick:
                for replies in flight.control():
                    self.station.say(replies)
                self.station.announce()
            self.station.stream(*self.router.links)

    def received(self, link: int = 1) -> list[Any]:
        """Everything that has come in since the last look."""
        messages: list[Any] = []
        while True:
            try:
                messages += self._codecs[link].parse_buffer(self._peers[link].recv(65535)) or []
            except BlockingIOError:
                return messages

    def kinds(self, link: int = 1) -> list[str]:
        return [m.get_type() for m in self.received(link)]

    def parameter(self, name: str) -> Any:
        """PARAM_VALUE of a name, None without an answer."""
        self.received()
        self.send(dialect.MAVLink_param_request_read_message(1, 1, name.encode(), -1))
        return next((m for m in self.received() if m.get_type() == "PARAM_VALUE"), None)

    def close(self) -> None:
        self.rig.close()
        self.router.close()
        for peer in self._peers:
            peer.close()


@pytest.fixture
def wired() -> Iterator[Wired]:
    made = Wired()
    yield made
    made.close()


def test_almost_nothing_streams_unasked(wired: Wired) -> None:
    wired.fly(5.0)
    for link in (0, 1):
        assert set(wired.kinds(link)) == {"HEARTBEAT", "STATUSTEXT"}


def test_intervals_are_per_link_50_hz_exact_400_hz_denied(wired: Wired) -> None:
    wired.fly(3.0)
    assert wired.order(511, 32, 20000.0, link=0) == 0
    assert wired.order(511, 32, 2500.0, link=0) == 2  # MAV_RESULT_DENIED
    wired.received(0)
    wired.fly(2.0)
    stamps = [m.time_boot_ms for m in wired.received(0) if m.get_type() == "LOCAL_POSITION_NED"]
    assert len(stamps) == 100
    assert {b - a for a, b in itertools.pairwise(stamps)} <= set(range(16, 25))  # the physics' own grid
    assert "LOCAL_POSITION_NED" not in wired.kinds(1)


def test_no_position_before_the_ekf_is_ready(wired: Wired) -> None:
    wired.order(511, 32, 100000.0)
    wired.order(511, 31, 100000.0)
    wired.fly(1.9)
    kinds = wired.kinds()
    assert "ATTITUDE_QUATERNION" in kinds
    assert "LOCAL_POSITION_NED" not in kinds
    wired.fly(0.5)
    assert "LOCAL_POSITION_NED" in wired.kinds()


def test_a_reboot_forgets_the_intervals_and_restarts_clock_and_estimate(wired: Wired) -> None:
    wired.fly(3.0)
    wired.order(511, 32, 100000.0)
    assert wired.order(246, 1.0) == 0
    wired.received()
    wired.fly(1.1)
    assert wired.kinds() == []  # silent, and deaf
    wired.send(dialect.MAVLink_timesync_message(0, 77))
    assert wired.kinds() == []
    wired.fly(0.2)
    assert wired.kinds() == ["HEARTBEAT"]  # after 1.2 s
    wired.fly(0.9)
    wired.send(dialect.MAVLink_timesync_message(0, 77))
    (answer,) = [m for m in wired.received() if m.get_type() == "TIMESYNC"]
    assert answer.tc1 == pytest.approx(1.0e9, abs=1e7)  # since boot
    wired.order(511, 32, 100000.0)
    wired.fly(0.5)
    assert "LOCAL_POSITION_NED" not in wired.kinds()
    wired.fly(0.7)
    positions = [m for m in wired.received() if m.get_type() == "LOCAL_POSITION_NED"]
    assert positions[0].time_boot_ms == pytest.approx(2000, abs=120)


def test_timesync_is_on_the_clock_of_time_boot_ms(wired: Wired) -> None:
    wired.fly(3.0)
    wired.order(511, 31, 50000.0)
    wired.fly(0.1)
    stamp = [m.time_boot_ms for m in wired.received() if m.get_type() == "ATTITUDE_QUATERNION"][-1]
    wired.send(dialect.MAVLink_timesync_message(0, 99))
    (answer,) = [m for m in wired.received() if m.get_type() == "TIMESYNC"]
    assert answer.ts1 == 99
    assert answer.tc1 / 1e6 == pytest.approx(stamp, abs=60.0)


def test_an_armed_vehicle_does_not_reboot(wired: Wired) -> None:
    assert wired.order(400, 1.0) == 0
    assert wired.order(246, 1.0) == 4


def test_request_data_stream(wired: Wired) -> None:
    wired.fly(3.0)
    wired.received()
    wired.send(dialect.MAVLink_request_data_stream_message(1, 1, 6, 4, 1))
    wired.fly(1.0)
    kinds = wired.kinds()
    assert kinds.count("LOCAL_POSITION_NED") == kinds.count("GLOBAL_POSITION_INT") == 4
    wired.send(dialect.MAVLink_request_data_stream_message(1, 1, 6, 4, 0))
    wired.fly(1.0)
    assert "LOCAL_POSITION_NED" not in wired.kinds()


def test_a_mode_change_is_told_at_once_by_a_heartbeat(wired: Wired) -> None:
    wired.send(dialect.MAVLink_set_mode_message(1, 1, 4))
    modes = [m.custom_mode for m in wired.received(0) if m.get_type() == "HEARTBEAT"]
    assert modes[-1] == 4


def test_integers_travel_as_plain_floats_and_bytewise_is_not_declared(wired: Wired) -> None:
    wired.order(512, 148.0)
    wired.send(dialect.MAVLink_command_long_message(1, 1, 512, 0, 148.0, 0, 0, 0, 0, 0, 0))
    (version,) = [m for m in wired.received() if m.get_type() == "AUTOPILOT_VERSION"]
    assert not version.capabilities & BYTEWISE
    assert version.capabilities & C_CAST
    delay = wired.parameter("DISARM_DELAY")
    assert (delay.param_value, delay.param_type) == (10.0, INT8)
    assert wired.parameter("LAND_SPEED").param_type == INT16
    timeout = wired.parameter("GUID_TIMEOUT")
    assert (timeout.param_value, timeout.param_type) == (3.0, REAL32)
    assert wired.parameter("PSC_JERK_XY").param_value == 5.0
    assert wired.parameter("GUID_OPTIONS").param_value == 0.0


@pytest.mark.parametrize("kind", [INT8, REAL32])  # whatever type the sender declares
def test_writing_an_integer_by_cast(wired: Wired, kind: int) -> None:
    wired.send(dialect.MAVLink_param_set_message(1, 1, b"DISARM_DELAY", 7.0, kind))
    for link in (0, 1):  # broadcast
        (value,) = [m for m in wired.received(link) if m.get_type() == "PARAM_VALUE"]
        assert (value.param_value, value.param_type) == (7.0, INT8)
    assert wired.rig.autopilot.parameters["DISARM_DELAY"] == 7


def test_bytewise_writes_are_misread_as_the_real_one_does(wired: Wired) -> None:
    wire = struct.unpack("<f", struct.pack("<i", 7))[0]
    wired.send(dialect.MAVLink_param_set_message(1, 1, b"DISARM_DELAY", wire, 6))
    assert wired.rig.autopilot.parameters["DISARM_DELAY"] == 0


def test_unknown_names_get_no_reply_and_nan_changes_nothing(wired: Wired) -> None:
    assert wired.parameter("COM_OF_LOSS_T") is None
    wired.send(dialect.MAVLink_param_set_message(1, 1, b"NO_SUCH_NAME", 1.0, 9))
    assert wired.received() == []
    wired.send(dialect.MAVLink_param_set_message(1, 1, b"GUID_TIMEOUT", math.nan, 9))
    assert wired.parameter("GUID_TIMEOUT").param_value == 3.0


def test_the_whole_list_is_numbered(wired: Wired) -> None:
    wired.send(dialect.MAVLink_param_request_list_message(1, 1))
    values = [m for m in wired.received() if m.get_type() == "PARAM_VALUE"]
    assert [m.param_index for m in values] == list(range(values[0].param_count))
    assert all(len(m.param_id) <= 16 for m in values)


def test_the_echo_tells_the_submode_with_yaw_ignored(wired: Wired) -> None:
    wired.fly(2.5)
    wired.order(511, 85, 100000.0, link=0)
    wired.fly(0.3)
    assert "POSITION_TARGET_LOCAL_NED" not in wired.kinds(0)  # not in GUIDED
    wired.order(176, 1.0, 4.0)
    wired.received(0)
    wired.send(
        dialect.MAVLink_set_position_target_local_ned_message(0, 1, 1, 1, 0x043F, *[0.0] * 6, 1.0, 2.0, -0.5, 0.3, 0.1),
        link=0,
    )
    wired.fly(0.2)
    echo = [m for m in wired.received(0) if m.get_type() == "POSITION_TARGET_LOCAL_NED"][-1]
    assert (echo.type_mask, echo.coordinate_frame) == (0x0C3F, 1)
    assert (echo.afx, echo.afy, echo.afz) == (1.0, 2.0, -0.5)
    assert (echo.yaw, echo.yaw_rate) == (0.0, 0.0)


def test_lockstep_has_the_state_from_the_start() -> None:
    wired = Wired(lockstep=True)
    wired.fly(0.5)
    kinds = wired.kinds(0)
    assert kinds.count("LOCAL_POSITION_NED") == kinds.count("ATTITUDE_QUATERNION") == 11
    assert wired.order(246, 1.0) == 2  # its clock is the pair's
    wired.close()
