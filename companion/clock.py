"""The only module that reads time or sleeps; everything else is told the time."""

from __future__ import annotations

import asyncio
import time
from typing import Protocol


class Clock(Protocol):
    """What the shell asks of time."""

    def monotonic_ns(self) -> int: ...

    def unix_ns(self) -> int: ...

    async def sleep(self, seconds: float) -> None: ...


class SystemClock:
    """The machine's clocks."""

    def monotonic_ns(self) -> int:
        return time.monotonic_ns()

    def unix_ns(self) -> int:
        return time.time_ns()

    async def sleep(self, seconds: float) -> None:
        await asyncio.sleep(seconds)


class ManualClock:
    """A clock that moves when told to, for tests. Sleepers wake when ``advance`` passes their time."""

    def __init__(self, *, monotonic_ns: int = 0, unix_ns: int = 1_700_000_000_000_000_000) -> None:
        self._monotonic_ns = monotonic_ns
        self._unix_offset_ns = unix_ns - monotonic_ns
        self._sleepers: list[tuple[int, asyncio.Event]] = []

    def monotonic_ns(self) -> int:
        return self._monotonic_ns

    def unix_ns(self) -> int:
        return self._monotonic_ns + self._unix_offset_ns

    def set_unix(self, seconds: float) -> None:
        """Step unix time, as NTP or an operator does; the monotonic clock goes on."""
        self._unix_offset_ns += int(seconds * 1e9)

    async def sleep(self, seconds: float) -> None:
        due = asyncio.Event()
        self._sleepers.append((self._monotonic_ns + int(seconds * 1e9), due))
        await due.wait()

    def advance(self, seconds: float) -> None:
        self._monotonic_ns += int(seconds * 1e9)
        for when, due in self._sleepers:
            if when <= self._monotonic_ns:
                due.set()
        self._sleepers = [(when, due) for when, due in self._sleepers if not due.is_set()]


def stopwatch_ns() -> int:
    """A reading for latency figures only; it never enters the brain."""
    return time.perf_counter_ns()


def processor_ns() -> int:
    """Processor time that this thread has used, for benches: unlike the stopwatch it does not run while others do."""
    return time.thread_time_ns()
