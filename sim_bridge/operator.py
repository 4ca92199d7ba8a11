"""The operator of a check: a MAVLink ground station in this process, at the vehicles' ground links over real UDP.

It keeps in touch (a heartbeat a second of vehicle time), and plays the scenario's steps: a command that nobody
acknowledges is sent again, as ground stations do.
"""

from __future__ import annotations

import math
import socket
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from sim_bridge.flight import Flight
from sim_bridge.lockstep import step_due
from sim_bridge.messages import NS_PER_S, Cmd
from sim_bridge.placement import step_command
from sim_bridge.scenario import OperatorStep, Vehicle
from sim_bridge.seat import steps_of
from sim_bridge.wires import Wires

SYSTEM, COMPONENT = 255, 190  # what ground stations use, and ArduPilot's SYSID_MYGCS
_RESEND_NS = NS_PER_S // 2
_GCS, _NO_AUTOPILOT, _ACTIVE = 6, 8, 4  # MAV_TYPE, MAV_AUTOPILOT, MAV_STATE
_CUSTOM_MODE = 1.0  # MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
_GUIDED, _BRAKE = 4.0, 17.0  # of ArduCopter
_ACCEPTED = 0


@dataclass(slots=True)
class _Sent:
    """The command of the step at hand."""

    step: OperatorStep
    at_ns: int
    acknowledged: int | None = None  # its MAV_RESULT


class GroundStation:
    """One UDP endpoint at a vehicle's ground link. ``port`` 0: any free one."""

    def __init__(self, port: int = 0, host: str = "127.0.0.1") -> None:
        self._codec = dialect.MAVLink(None, SYSTEM, COMPONENT)
        self._codec.robust_parsing = True
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.bind((host, port))
        self.peer: tuple[str, int] | None = None  # the vehicle's end of the link

    @property
    def port(self) -> int:
        return int(self._socket.getsockname()[1])

    def receive(self) -> list[Any]:
        """Messages that have arrived, without waiting."""
        messages: list[Any] = []
        while True:
            try:
                data = self._socket.recv(65535)
            except BlockingIOError:
                return messages
            except ConnectionRefusedError:
                continue
            messages += self._codec.parse_buffer(data) or []

    def send(self, message: Any) -> None:
        if self.peer is not None:
            data = message.pack(self._codec)
            self._codec.seq = (self._codec.seq + 1) & 0xFF
            self._socket.sendto(data, self.peer)

    def close(self) -> None:
        self._socket.close()


@dataclass(slots=True)
class _Post:
    """One vehicle's ground station and where its steps have come to."""

    vehicle: Vehicle
    station: GroundStation
    steps: tuple[OperatorStep, ...]
    next: int = 0  # in real time: which step is at hand
    sent: _Sent | None = None
    beat_ns: int | None = field(default=None)


class ScriptedOperator:
    """All vehicles' operator.

    Args:
        stations: one for each vehicle, in the scenario's order.
        plays: real time: it looks by itself which step is due; in lockstep it is told.
    """

    def __init__(self, flight: Flight, wires: Wires, stations: Sequence[GroundStation], *, plays: bool) -> None:
        self._flight = flight
        self._plays = plays
        steps = flight.resolved.scenario.operator
        self._posts = []
        for own, station in zip(wires.crafts, stations, strict=True):
            station.peer = own.router.ground.socket.getsockname()
            self._posts.append(_Post(own.vehicle, station, steps_of(steps, own.vehicle.name)))

    def tick(self, t_ns: int) -> None:
        """Read what came, send the heartbeat; in real time also the step that is due."""
        for index, post in enumerate(self._posts):
            for message in post.station.receive():
                self._acknowledged(post, message)
            if post.beat_ns is None or t_ns - post.beat_ns >= NS_PER_S:
                post.beat_ns = t_ns
                post.station.send(dialect.MAVLink_heartbeat_message(_GCS, _NO_AUTOPILOT, 0, 0, _ACTIVE, 3))
            if self._plays:
                self._play(index, post, t_ns)

    def give(self, vehicle: int, step: OperatorStep, t_ns: int) -> None:
        """The command of ``step``, unless it was sent within the last half second."""
        post = self._posts[vehicle]
        sent = post.sent
        if sent is not None and sent.step is step and t_ns - sent.at_ns < _RESEND_NS:
            return
        post.sent = _Sent(step, t_ns)
        for number, component, params in commands(step, post.vehicle):
            system = post.vehicle.system_id
            post.station.send(dialect.MAVLink_command_long_message(system, component, number, 0, *params))

    def _play(self, index: int, post: _Post, t_ns: int) -> None:
        if post.next >= len(post.steps):
            return
        step, sent = post.steps[post.next], post.sent
        if sent is not None and sent.step is step and sent.acknowledged == _ACCEPTED:
            post.next += 1
            return
        flight = self._flight
        if step_due(step, flight.crafts[index], flight.resolved.period_ns, ended=flight.ended is not None):
            self.give(index, step, t_ns)

    @staticmethod
    def _acknowledged(post: _Post, message: Any) -> None:
        if post.sent is None or message.get_type() != "COMMAND_ACK":
            return
        number, component, _ = step_command(post.sent.step)
        if (message.command, message.get_srcComponent()) == (number, component):
            post.sent.acknowledged = message.result


Params = tuple[float, float, float, float, float, float, float]


def commands(step: OperatorStep, vehicle: Vehicle) -> list[tuple[int, int, Params]]:
    """The MAV_CMDs of a step: number, component and parameters.

    ArduCopter takes off from GUIDED, and wants the altitude with the command; its hold is BRAKE. PX4 takes off to
    MIS_TAKEOFF_ALT where the command says NaN.
    """
    number, component, param1 = step_command(step)
    copter = vehicle.personality == "ardupilot"
    first = 0.0 if param1 is None else param1
    params: Params = (first, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    if number == Cmd.NAV_TAKEOFF:
        blank, altitude = (0.0, vehicle.takeoff_altitude_m) if copter else (math.nan, math.nan)
        params = (blank, blank, blank, blank, blank, blank, altitude)
    elif number == Cmd.DO_SET_MODE:
        main, sub = (_BRAKE, 0.0) if copter else (4.0, 3.0)
        params = (_CUSTOM_MODE, main, sub, 0.0, 0.0, 0.0, 0.0)
    sequence = [(number, component, params)]
    if copter and step.do == "arm":
        guided: Params = (_CUSTOM_MODE, _GUIDED, 0.0, 0.0, 0.0, 0.0, 0.0)
        sequence.insert(0, (int(Cmd.DO_SET_MODE), 1, guided))
    return sequence
