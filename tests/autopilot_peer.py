"""Autopilots of the two kinds as scripts, speaking plain pymavlink, and the world that moves them beside the daemon.

They do what the sources of PX4 and ArduCopter do with the messages that the daemon sends: which modes they grant,
which setpoints they take, what POSITION_TARGET_LOCAL_NED then says. NED and milliseconds throughout, from the
specification; nothing of `companion` is used for it.
"""

from __future__ import annotations

import asyncio
import math
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.clock import ManualClock
from companion.config import parse_config
from companion.pilot import Pilot
from companion.publisher import Publisher
from companion.service import Service

GROUND, AIR, TAKEOFF = 1, 2, 3  # MAV_LANDED_STATE
PX4_OFFBOARD, PX4_HOLD, PX4_POSITION = 6 << 16, 4 << 16 | 3 << 24, 3 << 16
LOITER, GUIDED, BRAKE, STABILIZE = 5, 4, 17, 0
NAN = math.nan
STEP_MS = 10


class Peer:
    """An autopilot: ``bytes_of`` a step out, ``receive`` bytes in. Subclasses say what PX4 and ArduCopter do."""

    autopilot = 0
    start_mode = 0
    streams_unasked: dict[str, int] = {}  # noqa: RUF012  (message: interval [ms])

    def __init__(self, system: int = 1) -> None:
        self.mav = dialect.MAVLink(None, system, 1)
        self.system = system
        self.mode = self.start_mode
        self.armed = True
        self.landed = AIR
        self.boot_ms = 1000  # since its boot
        self.p = np.array([0.0, 0.0, -2.0])
        self.v = np.zeros(3)
        self.target: Any = None  # the setpoint that it follows
        self.target_ms = -(10**9)
        self.velocities: dict[int, Any] = {}  # by its clock [ms], as it was told
        self.taken: list[tuple[int, int, Any]] = []  # landed state, mode, setpoint as received
        self.requests: list[tuple[int, int]] = []  # modes asked for
        self.asked: list[int] = []  # intervals asked for
        self.texts: list[str] = []
        self.silent: set[str] = set()  # messages that are not sent, whatever was asked
        self.deaf = False  # takes no commands
        self.odometry = False
        self.reset_counter = 0
        self.intervals = dict(self.streams_unasked)

    def reboot(self, boot_ms: int = 500) -> None:
        """Up again: clock, mode and intervals begin anew."""
        self.boot_ms = boot_ms
        self.intervals = dict(self.streams_unasked)
        self.mode, self.armed, self.landed, self.target = self.start_mode, False, GROUND, None

    def step(self) -> bytes:
        """Ten milliseconds: what is due."""
        self.boot_ms += STEP_MS
        a = np.zeros(3) if self.target is None else np.array(self.target_acceleration())
        self.p = self.p + self.v * 0.01 + a * 5e-5
        self.v = self.v + a * 0.01
        due = [self.heartbeat()] if self.boot_ms % 500 == 0 else []
        for name, every_ms in self.intervals.items():
            if self.boot_ms % every_ms < STEP_MS and name not in self.silent:
                due += self.message(name)
        if self.odometry and self.boot_ms % 20 < STEP_MS:
            due.append(self.odometry_message())
        return b"".join(m.pack(self.mav) for m in due if m is not None)

    def heartbeat(self) -> Any:
        return self.mav.heartbeat_encode(2, self.autopilot, 1 | (128 if self.armed else 0), self.mode, 4)

    def message(self, name: str) -> list[Any]:
        match name:
            case "ATTITUDE_QUATERNION":
                return [self.mav.attitude_quaternion_encode(self.boot_ms, 1.0, 0, 0, 0, 0, 0, 0)]
            case "LOCAL_POSITION_NED":
                self.velocities[self.boot_ms] = self.v
                return [self.mav.local_position_ned_encode(self.boot_ms, *self.p, *self.v)]
            case "EXTENDED_SYS_STATE":
                return [self.mav.extended_sys_state_encode(0, self.landed)]
            case "POSITION_TARGET_LOCAL_NED":
                return [self.echo()]
        return []

    def odometry_message(self) -> Any:
        blank = [NAN] * 21
        return self.mav.odometry_encode(
            self.boot_ms * 1000 + 7, 1, 1, *self.p, (1.0, 0, 0, 0), *self.v, 0, 0, 0, blank, blank, self.reset_counter
        )

    def receive(self, data: bytes) -> bytes:
        out = []
        for m in self.mav.parse_buffer(data) or []:
            match m.get_type():
                case "STATUSTEXT":
                    if m.chunk_seq == 0:
                        self.texts.append("")
                    self.texts[-1] += m.text
                case "TIMESYNC" if m.tc1 == 0:
                    out.append(self.mav.timesync_encode(self.boot_ms * 1_000_000 + 1, m.ts1))
                case "SET_POSITION_TARGET_LOCAL_NED":
                    assert (m.target_system, m.target_component) == (self.system, 1)
                    self.taken.append((self.landed, self.mode, m))
                    self.take(m)
                case "COMMAND_LONG" if not self.deaf and m.target_component == 1:
                    out.append(self.mav.command_ack_encode(m.command, self.command(m)))
                    if m.command == 176:
                        out.append(self.heartbeat())
        return b"".join(m.pack(self.mav) for m in out)

    def command(self, m: Any) -> int:
        if m.command == 511:
            name = dialect.mavlink_map[int(m.param1)].msgname
            self.asked.append(int(m.param1))
            self.intervals[name] = max(round(m.param2 / 1000), STEP_MS)
            return 0
        if m.command == 176:
            self.requests.append((int(m.param2), int(m.param3)))
            return 0 if self.grant(int(m.param2), int(m.param3)) else 1
        return 3

    def target_acceleration(self) -> tuple[float, float, float]:
        return (self.target.afx, self.target.afy, self.target.afz)

    def grant(self, main: int, sub: int) -> bool:
        raise NotImplementedError

    def take(self, m: Any) -> None:
        raise NotImplementedError

    def echo(self) -> Any:
        raise NotImplementedError

    def said(self, text: str) -> int:
        return sum(text in line for line in self.texts)


class Px4(Peer):
    """Streams by itself, grants offboard to a running stream only, marks what is not finite in its echo."""

    autopilot = 12
    start_mode = PX4_POSITION
    streams_unasked = {"ATTITUDE_QUATERNION": 20, "LOCAL_POSITION_NED": 20, "EXTENDED_SYS_STATE": 200}  # noqa: RUF012

    def __init__(self, system: int = 1) -> None:
        super().__init__(system)
        self.stream_since_ms = self.boot_ms
        self.marks_mask = True  # the releases that write a mask; older ones leave it at 0

    def grant(self, main: int, sub: int) -> bool:
        if main == 6:
            fresh = self.boot_ms - self.target_ms <= 500
            if not fresh or self.boot_ms - self.stream_since_ms < 400:
                return False
        self.mode = main << 16 | sub << 24
        return True

    def take(self, m: Any) -> None:
        if self.boot_ms - self.target_ms > 500:
            self.stream_since_ms = self.boot_ms
        self.target_ms, self.heard = self.boot_ms, m
        self.target = m if self.mode == PX4_OFFBOARD else None

    def echo(self) -> Any:
        if self.target is None:
            return None
        m = self.target
        v = (NAN,) * 3 if m.type_mask & 0x38 else (m.vx, m.vy, m.vz)
        a = self.target_acceleration()
        if not m.type_mask & 0x38:
            a = tuple(np.array(a) + 1.8 * (np.array(v) - self.v))  # its velocity loop
        mask = sum(1 << i for i, x in enumerate((NAN, NAN, NAN, *v, *a)) if math.isnan(x)) if self.marks_mask else 0
        return self.mav.position_target_local_ned_encode(self.boot_ms, 1, mask, NAN, NAN, NAN, *v, *a, 0.3, 0.0)


class ArduCopter(Peer):
    """Streams what it is asked for only, grants GUIDED always, stops silently on masks it dislikes."""

    autopilot = 3
    start_mode = LOITER

    def __init__(self, system: int = 1) -> None:
        super().__init__(system)
        self.stops = False  # dislikes whatever comes
        self.takeoff_cancelled = False

    def grant(self, main: int, sub: int) -> bool:
        self.mode = main
        return True

    def take(self, m: Any) -> None:
        if self.mode != GUIDED:
            return
        self.takeoff_cancelled |= self.landed == TAKEOFF
        force, frame_ok = m.type_mask & 0x200, m.coordinate_frame in (1, 7, 8, 9)
        accepted = frame_ok and not force and m.type_mask & 0x1C7 == 7 and m.type_mask & 0x38 in (0, 0x38)
        self.target = m if accepted and not self.stops else None

    def echo(self) -> Any:
        if self.mode != GUIDED:
            return None
        if self.target is None:  # its stop is the guided submode of velocity and acceleration, both zero
            return self.mav.position_target_local_ned_encode(self.boot_ms, 1, 0x0C07, *[0.0] * 11)
        m = self.target
        v = (0.0,) * 3 if m.type_mask & 0x38 else (m.vx, m.vy, m.vz)
        mask = 0x0C3F if m.type_mask & 0x38 else 0x0C07  # of its submode, yaw always ignored
        a = self.target_acceleration()
        return self.mav.position_target_local_ned_encode(self.boot_ms, 1, mask, 0, 0, 0, *v, *a, 0, 0)


class _Nobody:
    """A Zenoh link without subscribers."""

    def __init__(self) -> None:
        self.statuses: list[Any] = []

    def wanted(self, key: str) -> bool:
        return False

    def put_encoded(self, key: str, payload: bytes) -> None:
        pass

    def put(self, key: str, payload: Any) -> None:
        self.statuses.append(payload)


class _Wire:
    """A transport that keeps what is sent until the world delivers it."""

    def __init__(self) -> None:
        self.sent = bytearray()
        self.counts: Counter[str] = Counter()

    def send(self, data: bytes) -> None:
        self.sent += data


class World:
    """The real Service on a counted clock, its bytes carried to a peer and back without sockets."""

    def __init__(self, peer: Peer, **sections: Any) -> None:
        self.peer = peer
        self.clock = ManualClock(monotonic_ns=10**12)
        self.config = parse_config({"vehicle": {"profile": "auto"}, **sections})
        self.service = Service(self.config, self.clock, pilot=Pilot(self.config))
        self.wire, self.zenoh = _Wire(), _Nobody()
        self.service._transport._links = (self.wire,)  # type: ignore[assignment]
        self.service._publisher = Publisher(self.zenoh, None)  # type: ignore[arg-type]
        self.gcs = dialect.MAVLink(None, 255, 190)
        self.connected = True

    @property
    def session(self) -> Any:
        return self.service._session

    @property
    def state(self) -> str:
        return str(self.session.situation.state)

    @property
    def counts(self) -> dict[str, int]:
        return self.service._counts()

    @property
    def warnings(self) -> tuple[str, ...]:
        return tuple(self.session.watch.notices.standing)

    def give(self, data: bytes) -> None:
        """Bytes on the vehicle's link, from whoever made them."""
        if data and self.connected:
            self.service._transport._on_bytes(0, data)

    def engage(self, on: bool = True) -> None:
        """An operator's MAV_CMD_NAV_GUIDED_ENABLE to component 196."""
        command = self.gcs.command_long_encode(self.peer.system, 196, 92, 0, float(on), 0, 0, 0, 0, 0, 0)
        self.give(command.pack(self.gcs))

    async def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        """Let vehicle and daemon live on, in steps of ten milliseconds."""
        for _ in range(round(seconds * 100)):
            self.clock.advance(0.01)
            self.give(self.peer.step())
            if round(self.clock.monotonic_ns() / 1e7) % 20 == 0:
                self.service._wake.set()  # as its own waker does, every 0.2 s
            await asyncio.sleep(0)
            await asyncio.sleep(0)
            sent, self.wire.sent = bytes(self.wire.sent), bytearray()
            if sent and self.connected:
                self.give(self.peer.receive(sent))
            if until():
                return


def play(script: Callable[[World], Any], peer: Peer, **sections: Any) -> World:
    """Run a script beside the daemon's control task; an error of the daemon ends it."""

    async def both() -> World:
        world = World(peer, **sections)
        control = asyncio.create_task(world.service._control())
        await asyncio.sleep(0)
        try:
            await script(world)
            assert not control.done(), control.exception()
        finally:
            control.cancel()
            await asyncio.gather(control, return_exceptions=True)
        return world

    return asyncio.run(both())
