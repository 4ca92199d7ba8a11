"""The autopilot on its links: commands and parameters in, acknowledgements, announcements and streams out."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Protocol

from sim_bridge.links import Link, Router
from sim_bridge.mavlink import Packet
from sim_bridge.messages import (
    Ack,
    AttitudeTarget,
    Cmd,
    Command,
    LocalSetpoint,
    MissionRequest,
    ParamRead,
    ParamWrite,
    Ping,
    Reply,
    Result,
    StationHeartbeat,
    Sticks,
    StreamRequest,
    Text,
    Timesync,
    Vec3,
)
from sim_bridge.personality import BatteryReading, Personality
from sim_bridge.physics import BodyState
from sim_bridge.reports import Moment
from sim_bridge.telemetry import (
    ATTITUDE_QUATERNION,
    AUTOPILOT_VERSION,
    BUILDERS,
    EXTENDED_SYS_STATE,
    HEARTBEAT,
    HOME_POSITION,
    LOCAL_POSITION_NED,
    Streams,
    build,
)

_HASH_CHECK = "_HASH_CHECK"
_LOCKSTEP_PINNED = frozenset({HEARTBEAT, ATTITUDE_QUATERNION, LOCAL_POSITION_NED})


class Vehicle(Protocol):
    """What a station needs of one vehicle of a flight."""

    @property
    def autopilot(self) -> Personality: ...

    @property
    def state(self) -> BodyState:
        """What its estimator believes."""

    @property
    def accuracy(self) -> tuple[float, float, float]:
        """Standard deviations of position [m], velocity [m/s] and attitude [rad]."""

    @property
    def battery(self) -> BatteryReading: ...

    @property
    def throttle(self) -> float:
        """Collective, share of full thrust."""


class Station:
    """What the two links see of one vehicle.

    Args:
        t_ns: the vehicle's time, that of its telemetry.
        clock_ns: the vehicle's clock now, for TIMESYNC (finer than physics steps in real time).
        lockstep: pins the heartbeat and the state messages to their default rates.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        router: Router,
        *,
        t_ns: Callable[[], int],
        clock_ns: Callable[[], int],
        lockstep: bool,
    ) -> None:
        self._vehicle = vehicle
        self._autopilot = vehicle.autopilot
        self._router = router
        self._t_ns = t_ns
        self._clock_ns = clock_ns
        self._autopilot.lockstep = lockstep
        self._boot_ns = self._autopilot.up_since_ns
        # UTC as a receiver of satellites would know it; in lockstep there is none
        self._unix_start_ns = 0 if lockstep else time.time_ns() - t_ns()
        self._streams = self._fresh_streams()
        self.clock_offset_ns = 0  # by which the vehicle's clock has jumped (faults)
        self.on_text: Callable[[Text], None] = lambda text: None
        self._announced = self._status()

    def _fresh_streams(self) -> dict[Link, Streams]:
        """As after boot: what was asked for is forgotten."""
        pinned = _LOCKSTEP_PINNED if self._autopilot.lockstep else frozenset()
        return {
            link: Streams(
                self._autopilot.rates_hz(link.name),
                max_hz=self._autopilot.max_rate_hz,
                pinned=pinned if link is self._router.onboard else frozenset(),
            )
            for link in self._router.links
        }

    def _up(self) -> bool:
        """Whether the autopilot runs; it does not while it boots."""
        autopilot = self._autopilot
        if self._boot_ns != autopilot.up_since_ns:
            self._boot_ns = autopilot.up_since_ns
            self._streams = self._fresh_streams()
            self._announced = self._status()
        return self._t_ns() >= self._boot_ns

    def handle(self, link: Link, packet: Packet) -> tuple[Reply, ...]:
        """Act on what is meant for the autopilot, answer on the link it came from; returns the answers."""
        content = packet.content
        if content is None or not self._up() or not self._router.for_autopilot(packet.target):
            return ()
        replies: tuple[Reply, ...] = ()
        if isinstance(content, LocalSetpoint):
            replies = self._autopilot.setpoint(content, self._t_ns())
        elif isinstance(content, AttitudeTarget):
            replies = self._autopilot.attitude_setpoint(content, self._t_ns())
        elif isinstance(content, Sticks):
            replies = self._autopilot.manual(content, self._t_ns())
        elif isinstance(content, StationHeartbeat):
            self._autopilot.heard_station(self._t_ns(), content.sender.system)
        elif isinstance(content, Command):
            replies = self._command(link, content)
        elif isinstance(content, Timesync):
            link.send(link.encoder.timesync(content, max(0, self._clock_ns() + self.clock_offset_ns - self._boot_ns)))
        elif isinstance(content, StreamRequest):
            for message_id in self._autopilot.stream_group(content.stream):
                interval_us = 1e6 / content.rate_hz if content.rate_hz else -1.0
                self._streams[link].request(message_id, interval_us, self._t_ns())
        elif isinstance(content, Ping):
            link.send(link.encoder.ping(content))
        elif isinstance(content, MissionRequest):
            link.send(link.encoder.no_mission(content))
        elif isinstance(content, ParamRead):
            self._read_parameters(link, content)
        else:
            self._write_parameter(content)
        self.say(replies, link)
        self.announce()
        return replies

    def say(self, replies: tuple[Reply, ...], link: Link | None = None) -> None:
        """Acknowledgements on ``link``, texts on both."""
        for reply in replies:
            if isinstance(reply, Text):
                self.on_text(reply)
                for each in self._router.links:
                    each.send(each.encoder.text(reply))
            elif link is not None:
                link.send(link.encoder.ack(reply))

    def announce(self) -> None:
        """At once what changed: HEARTBEAT (mode, arming), EXTENDED_SYS_STATE (landed), HOME_POSITION."""
        status = self._status()
        if not self._up() or status == self._announced:
            return
        if status[:2] != self._announced[:2]:
            self.send(HEARTBEAT)
        if status[2] != self._announced[2]:
            self._announce(EXTENDED_SYS_STATE)
        if status[3] != self._announced[3]:
            self._announce(HOME_POSITION)
        self._announced = status

    def _announce(self, message_id: int) -> None:
        """One message now, on the links on which it streams."""
        now = self._moment()
        for link in self._router.links:
            if self._streams[link].interval_us(message_id) > 0:
                self._send_one(link, message_id, now)

    def stream(self, *links: Link) -> None:
        """Send what is due on each of ``links``, one datagram a link."""
        if not self._up():
            return
        t_ns = self._t_ns()
        for link in links:
            due = self._streams[link].due(t_ns)
            if due:
                now = self._moment()
                link.send(b"".join(build(message_id, now, link.encoder) for message_id in due))

    def stay_alive(self, link: Link, message_ids: tuple[int, ...]) -> None:
        """Messages off their schedule, while time is held."""
        now = self._moment()
        for message_id in message_ids:
            self._send_one(link, message_id, now, timed=False)

    def send(self, message_id: int) -> None:
        """One message now, on both links."""
        now = self._moment()
        for link in self._router.links:
            self._send_one(link, message_id, now)

    def _send_one(self, link: Link, message_id: int, now: Moment, *, timed: bool = True) -> None:
        link.send(build(message_id, now, link.encoder), timed=timed)

    def _moment(self) -> Moment:
        vehicle = self._vehicle
        system = self._router.id.system
        t_ns = max(0, self._t_ns() + self.clock_offset_ns - self._boot_ns)
        unix_ns = self._unix_start_ns and self._unix_start_ns + t_ns
        return Moment(
            t_ns,
            vehicle.state,
            self._autopilot,
            vehicle.battery,
            vehicle.accuracy,
            system,
            vehicle.throttle,
            unix_ns,
        )

    def _status(self) -> tuple[int, bool, int, Vec3]:
        autopilot = self._autopilot
        return (autopilot.custom_mode, autopilot.armed, int(autopilot.landed), autopilot.home_enu)

    def _command(self, link: Link, command: Command) -> tuple[Reply, ...]:
        streams = self._streams[link]
        message_id = int(command.params[0]) if abs(command.params[0]) < 1 << 24 else -1
        if command.command == Cmd.SET_MESSAGE_INTERVAL:
            result = self._set_interval(streams, message_id, command.params[1])
            return (Ack(command.command, result, command.sender),)
        if command.command == Cmd.REQUEST_PROTOCOL_VERSION:
            link.send(link.encoder.protocol_version())
            granted = True
        elif command.command == Cmd.REQUEST_AUTOPILOT_CAPABILITIES:
            self._send_one(link, AUTOPILOT_VERSION, self._moment())
            granted = True
        elif command.command == Cmd.GET_MESSAGE_INTERVAL:
            link.send(link.encoder.message_interval(message_id & 0xFFFF, streams.interval_us(message_id)))
            granted = message_id in BUILDERS
        elif command.command == Cmd.REQUEST_MESSAGE:
            granted = message_id in BUILDERS
            if granted:
                self._send_one(link, message_id, self._moment())
        else:
            return self._autopilot.command(command, self._vehicle.state, self._t_ns())
        return (Ack(command.command, Result.ACCEPTED if granted else Result.DENIED, command.sender),)

    def _set_interval(self, streams: Streams, message_id: int, interval_us: float) -> Result:
        """Microseconds, -1 off, 0 the default; what is faster than the vehicle may be granted as fast as it goes."""
        if message_id not in BUILDERS or not math.isfinite(interval_us):
            return self._autopilot.unknown_stream
        if streams.too_fast(interval_us):
            if self._autopilot.too_fast_stream is not Result.ACCEPTED:
                return self._autopilot.too_fast_stream
            interval_us = streams.least_us
        streams.request(message_id, interval_us, self._t_ns())
        return Result.ACCEPTED

    def _read_parameters(self, link: Link, wanted: ParamRead) -> None:
        known = self._autopilot.parameters.names
        if wanted.name == _HASH_CHECK or (not wanted.name and wanted.index < 0):
            checksum = self._autopilot.parameters.checksum()
            if checksum is not None:
                link.send(link.encoder.param_checksum(checksum, len(known)))
        if wanted.name:
            names: tuple[str, ...] = (wanted.name,) if wanted.name in known else ()
        elif wanted.index >= 0:
            names = known[wanted.index : wanted.index + 1]
        else:
            names = known
        for name in names:
            link.send(self._param_value(link, name))

    def _write_parameter(self, wanted: ParamWrite) -> None:
        """The new value, or the unchanged one where it was refused, goes to everybody."""
        if wanted.name not in self._autopilot.parameters.names:
            return
        parameters = self._autopilot.parameters
        value = wanted.value if parameters.cast_to(wanted.name) is None else wanted.cast
        parameters.write(wanted.name, value, is_int=wanted.is_int)
        for link in self._router.links:
            link.send(self._param_value(link, wanted.name))

    def _param_value(self, link: Link, name: str) -> bytes:
        parameters = self._autopilot.parameters
        index, count = parameters.names.index(name), len(parameters.names)
        return link.encoder.param(name, parameters[name], index, count, cast_to=parameters.cast_to(name))
