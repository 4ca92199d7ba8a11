"""The daemon of `companion bench tick`: the real service on real sockets, with notes of every tick.

    python -m companion.bench.tick_daemon CONFIG.toml [KEY=VALUE ...]

Ends on SIGTERM with one JSON object on stdout. Nothing differs from `companion run` but the notes: a few numbers a
tick, written into arrays that are made beforehand.
"""

from __future__ import annotations

import asyncio
import gc
import signal
import sys
from array import array
from pathlib import Path
from typing import Any

import msgspec

from companion import realtime
from companion.clock import SystemClock, processor_ns, stopwatch_ns
from companion.config import load_config
from companion.service import Service
from companion.state import State


class Tick(msgspec.Struct, frozen=True, array_like=True):
    """One tick: when its state arrived, then until the setpoint left, then until the end of its work [ns]."""

    arrived_ns: int
    sent_ns: int
    done_ns: int
    processor_ns: int  # what the loop's thread used from the tick's begin to its end


class Pauses(msgspec.Struct, frozen=True):
    """The garbage collector during the flight; inside: while a tick was being answered."""

    collections: int = 0
    inside: int = 0
    total_ms: float = 0.0
    max_ms: float = 0.0


class TickNotes(msgspec.Struct, frozen=True):
    ticks: list[Tick]  # flown ones, from the first in ACTIVE on
    skipped: list[int]  # states that were overtaken by a newer one, when
    pauses: Pauses
    verdicts: dict[str, int]
    threads: int
    counts: dict[str, int]


class Tap:
    """Notes what the meter of a service is told, and the pauses of the garbage collector."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self.arrived, self.sent, self.done, self.used, self.skipped = (array("q") for _ in range(5))
        self._used_ns = 0
        self._busy = False
        self._began_ns = 0
        self._pauses: list[tuple[int, bool]] = []
        meter, tick = service._meter, service._tick
        told, skip = meter.tick, meter.skip

        def noted(latency_ms: float, busy_ms: float, verdict: str) -> None:
            told(latency_ms, busy_ms, verdict)
            if self._flying:
                arrived_ns = service._arrived_ns
                self.arrived.append(arrived_ns)
                self.sent.append(arrived_ns + round(1e6 * latency_ms))
                self.done.append(stopwatch_ns())
                self.used.append(processor_ns() - self._used_ns)

        def skipped() -> None:
            skip()
            if self._flying:
                self.skipped.append(stopwatch_ns())

        def ticked(vehicle: Any) -> None:
            self._busy, self._used_ns = True, processor_ns()
            tick(vehicle)
            self._busy = False

        meter.tick, meter.skip, service._tick = noted, skipped, ticked  # type: ignore[method-assign]
        gc.callbacks.append(self._collected)

    @property
    def _flying(self) -> bool:
        return bool(self.arrived) or self._service._session.situation.state is State.ACTIVE

    def _collected(self, phase: str, info: dict[str, int]) -> None:
        if phase == "start":
            self._began_ns = stopwatch_ns()
        elif self.arrived:
            self._pauses.append((stopwatch_ns() - self._began_ns, self._busy))

    def notes(self, verdicts: dict[str, int], counts: dict[str, int], threads: int) -> TickNotes:
        took_ms = [took_ns / 1e6 for took_ns, _ in self._pauses]
        pauses = Pauses(len(took_ms), sum(busy for _, busy in self._pauses), sum(took_ms), max(took_ms, default=0.0))
        ticks = [Tick(*each) for each in zip(self.arrived, self.sent, self.done, self.used, strict=True)]
        return TickNotes(ticks, list(self.skipped), pauses, verdicts, threads, counts)


async def serve(path: Path, settings: tuple[str, ...]) -> TickNotes:
    """Fly until SIGTERM."""
    service = Service(load_config(path, settings), SystemClock())
    tap, threads = Tap(service), 0

    def stop() -> None:
        nonlocal threads
        threads = thread_count()
        service.stop()

    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, stop)
    summary = await service.run()
    return tap.notes(summary.verdicts, summary.counts, threads)


def thread_count() -> int:
    """Threads of this process, 0 where that cannot be told."""
    tasks = Path("/proc/self/task")
    return len(list(tasks.iterdir())) if tasks.is_dir() else 0


if __name__ == "__main__":
    realtime.single_threads()
    sys.stdout.buffer.write(msgspec.json.encode(asyncio.run(serve(Path(sys.argv[1]), tuple(sys.argv[2:])))))
