"""`companion bench wire --load`: more than any vehicle will hear, and whether ticks, deadlines and memory stand it.

A sensor publishes 1000 frames of 20 obstacles a second, the link carries 2000 MAVLink messages a second beside 50 Hz
of the autopilot's state; the daemon is a process of its own on real sockets, flying. A tick is lost where a state
message of the autopilot got no setpoint.
"""

from __future__ import annotations

import json
import math
import resource
import select
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import zenoh
from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.bench.envelope import Figure
from companion.bench.wire import Daemon, beside_daemon
from companion.bench.wire_daemon import Notes
from companion.bench.wire_peer import Autopilot, Seen
from companion.clock import Clock, SystemClock
from companion.types import NS_PER_S

RATE_HZ = 50
FRAMES_HZ, MESSAGES_HZ, OBSTACLES = 1000, 2000, 20
LOAD_S, QUICK_LOAD_S = 60.0, 10.0
WARM_S = 2.0
LOST_SHARE = 0.01
GROWTH_MIB = 8.0
ENGAGE_S = 20.0


@dataclass(frozen=True, slots=True)
class Load:
    """What the daemon made of it."""

    seconds: float
    states: int
    lost: int  # states without a setpoint
    frames_sent: int
    messages_sent: int
    frames_used: int
    frames_thinned: int
    memory_mib: float  # resident, when the load began
    growth_mib: float  # until its end
    tick_ms: dict[str, float]

    @property
    def lost_share(self) -> float:
        return self.lost / max(self.states, 1)


def measure_load(seconds: float) -> Load:
    """Fly under load.

    Raises:
        CompanionError: the daemon did not come up or ended.
    """

    def live(port: int, endpoint: str, daemon: Daemon) -> _World:
        world = _World(port, endpoint, SystemClock(), daemon.pid)
        world.fly(seconds, alive=lambda: daemon.poll() is None)
        return world

    world, notes = beside_daemon(live, "--plain")
    return world.told(seconds, notes)


class _World:
    """Autopilot, sensor and a talkative neighbour, in one loop of a millisecond."""

    def __init__(self, port: int, endpoint: str, clock: Clock, pid: int) -> None:
        self._clock, self._pid = clock, pid
        self._autopilot = Autopilot(port, clock, RATE_HZ)
        self._address = ("127.0.0.1", port)
        settings = zenoh.Config()
        settings.insert_json5("connect/endpoints", json.dumps([endpoint]))
        settings.insert_json5("scouting/multicast/enabled", "false")
        self._settings = settings
        self._seen = Seen()
        self._counted = {"frames": 0, "messages": 0}
        self._memory_mib = [0.0, 0.0]
        self._first_ms, self._last_ms = math.inf, 0
        neighbour = dialect.MAVLink(None, 7, 1)
        self._chatter = [
            dialect.MAVLink_attitude_message(t, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0).pack(neighbour) for t in range(250)
        ]

    def fly(self, seconds: float, *, alive: Callable[[], bool]) -> None:
        clock, autopilot = self._clock, self._autopilot
        began_ns = clock.monotonic_ns()
        engaged_ns: int | None = None
        number, next_state_ns = 0, began_ns
        frames_due_ns = messages_due_ns = 0
        with autopilot.socket, zenoh.open(self._settings) as session:
            publisher = session.declare_publisher("uav/uav1/obstacles/bench", express=True)
            while True:
                now_ns = clock.monotonic_ns()
                if engaged_ns is None and autopilot.engaged:
                    engaged_ns = frames_due_ns = messages_due_ns = now_ns
                if not alive() or (engaged_ns is None and now_ns - began_ns > ENGAGE_S * NS_PER_S):
                    raise TimeoutError("bench wire: the daemon was not engaged within 20 s, or has ended")
                flown_s = 0.0 if engaged_ns is None else (now_ns - engaged_ns) / NS_PER_S
                if flown_s > WARM_S + seconds:
                    break
                if now_ns >= next_state_ns:
                    autopilot.tick(number, self._seen)
                    number, next_state_ns = number + 1, next_state_ns + NS_PER_S // RATE_HZ
                    self._note(flown_s, seconds)
                if engaged_ns is not None:
                    while frames_due_ns <= now_ns:
                        publisher.put(_frame(frames_due_ns / NS_PER_S, clock.unix_ns()))
                        frames_due_ns += NS_PER_S // FRAMES_HZ
                        self._counted["frames"] += 1
                    while messages_due_ns <= now_ns:
                        count = self._counted["messages"]
                        autopilot.socket.sendto(self._chatter[count % len(self._chatter)], self._address)
                        messages_due_ns += NS_PER_S // MESSAGES_HZ
                        self._counted["messages"] += 1
                due_ns = min(next_state_ns, frames_due_ns or next_state_ns) - clock.monotonic_ns()
                if select.select([autopilot.socket], [], [], max(0.0, due_ns / NS_PER_S))[0]:
                    autopilot.receive(self._seen)

    def _note(self, flown_s: float, seconds: float) -> None:
        """Memory and the span of states that count: from the warm time's end to half a second before the last."""
        newest_ms = max(self._seen.states)
        if flown_s > WARM_S:
            if math.isinf(self._first_ms):
                self._first_ms = newest_ms
                self._memory_mib[0] = resident_mib(self._pid)
            if flown_s < WARM_S + seconds - 0.5:
                self._last_ms = newest_ms
                self._memory_mib[1] = resident_mib(self._pid)

    def told(self, seconds: float, notes: Notes) -> Load:
        counted = [t for t in self._seen.states if self._first_ms <= t <= self._last_ms]
        lost = sum(t not in self._seen.setpoints for t in counted)
        memory, end = self._memory_mib
        return Load(
            seconds,
            len(counted),
            lost,
            self._counted["frames"],
            self._counted["messages"],
            notes.counts.get("obstacles.frames", 0),
            notes.counts.get("obstacles.thinned", 0),
            memory,
            end - memory,
            notes.tick_ms,
        )


def figures(load: Load) -> list[Figure]:
    """What the daemon is held to under load."""
    return [
        Figure("load: share of ticks lost", load.lost_share, "at most", LOST_SHARE),
        Figure("load: growth of resident memory, MiB", load.growth_mib, "at most", GROWTH_MIB),
    ]


def print_load(load: Load) -> None:
    """For people."""
    print(
        f"load: {load.frames_sent} frames of {OBSTACLES} obstacles and {load.messages_sent} messages in"
        f" {load.seconds + WARM_S:g} s: {load.frames_used} frames used, {load.frames_thinned} thinned,"
        f" {load.lost} of {load.states} ticks lost, resident {load.memory_mib:.0f} MiB, {load.growth_mib:+.1f}"
    )
    tick = load.tick_ms
    print(f"      the daemon's own ticks: p50 {tick['p50']:.2f}, p99 {tick['p99']:.2f}, max {tick['max']:.2f} ms\n")


def resident_mib(pid: int) -> float:
    """Resident memory of a process (/proc/PID/statm)."""
    pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    return pages * resource.getpagesize() / 2**20


def _frame(t_s: float, stamp_ns: int) -> str:
    """Twenty obstacles on circles of 2 to 6 m about the vehicle, unix stamp."""
    parts = []
    for m in range(OBSTACLES):
        angle, radius = 0.314 * m + 0.2 * t_s, 2.0 + 0.2 * m
        x, y = radius * math.cos(angle), radius * math.sin(angle)
        parts.append(f'{{"id":"o{m}","position":[{x:.4f},{y:.4f},2.0],"radius":0.2,"position_std":0.05}}')
    return f'{{"stamp_ns":{stamp_ns},"clock":"unix","obstacles":[{",".join(parts)}]}}'
