"""Start to READY: `companion run` as a user starts it, beside an autopilot that streams already.

The time runs from the start of the process to the first setpoint: PX4 wants a stream before it grants its external
mode, so the daemon sends one as soon as it is READY. The autopilot's heartbeat comes once a second, as everywhere:
half a second of the mean is the wait for it. Resident memory is read two seconds later.
"""

from __future__ import annotations

import select
import socket
import tempfile
from dataclasses import dataclass
from pathlib import Path

from companion.bench.processes import Child, free_port, memory_mib, processor_s
from companion.bench.wire_peer import Autopilot, Seen
from companion.clock import SystemClock
from companion.types import NS_PER_S

RATE_HZ = 50
STARTS, QUICK_STARTS = 10, 3
LIMIT_S = 20.0
SETTLE_S = 2.0


@dataclass(frozen=True, slots=True)
class Starts:
    """Of each start: ``ready_s``, sorted, and what the process used of the processor until then, sorted."""

    ready_s: list[float]
    processor_s: list[float]
    memory_mib: float  # resident, the largest

    @property
    def median_s(self) -> float:
        return self.ready_s[len(self.ready_s) // 2]


def measure_starts(count: int) -> Starts:
    """Start the daemon ``count`` times, at other phases of the heartbeat.

    Raises:
        CompanionError: it did not become READY within 20 s.
    """
    told = [_start(number / count) for number in range(count)]
    ready_s, processor, memory = zip(*told, strict=True)
    return Starts(sorted(ready_s), sorted(processor), max(memory))


def _start(phase: float) -> tuple[float, float, float]:
    """Seconds to the first setpoint, of the processor too, and resident memory [MiB].

    A heartbeat is due ``phase`` of a second after the start.
    """
    port, clock, seen = free_port(socket.SOCK_DGRAM), SystemClock(), Seen()
    autopilot = Autopilot(port, clock, RATE_HZ)
    autopilot.engaged = True  # it asks for nothing: READY is enough
    with autopilot.socket, tempfile.TemporaryDirectory(prefix="companion-bench-") as name:
        config = Path(name) / "daemon.toml"
        config.write_text(
            f'[vehicle]\nprofile = "px4"\n[mavlink]\nurl = "udpin://127.0.0.1:{port}"\nsystem_id = 1\n',
            encoding="utf-8",
        )
        began_ns = clock.monotonic_ns()
        with Child(["companion.cli", "run", "-c", str(config)], Path(name) / "daemon.log") as daemon:
            number, next_ns = round((1.0 - phase) * RATE_HZ), began_ns
            ready_ns: int | None = None
            used_s = 0.0
            while ready_ns is None or clock.monotonic_ns() - ready_ns < SETTLE_S * NS_PER_S:
                now_ns = clock.monotonic_ns()
                if now_ns >= next_ns:
                    autopilot.tick(number, seen)
                    number, next_ns = number + 1, next_ns + NS_PER_S // RATE_HZ
                if select.select([autopilot.socket], [], [], max(0.0, (next_ns - now_ns) / NS_PER_S))[0]:
                    autopilot.receive(seen)
                if ready_ns is None and seen.setpoints:
                    ready_ns, used_s = min(seen.setpoints.values()), processor_s(daemon.process.pid)
                daemon.check()
                if ready_ns is None and now_ns - began_ns > LIMIT_S * NS_PER_S:
                    raise daemon.failed(f"was not READY after {LIMIT_S:g} s")
            memory = memory_mib(daemon.process.pid)["resident"]
            daemon.stop()
    return (ready_ns - began_ns) / NS_PER_S, used_s, memory
