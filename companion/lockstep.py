"""Lockstep's barrier and its one guard in wall time: whatever is missing for too long is named (design 3.3)."""

from __future__ import annotations

from companion.clock import Clock
from companion.config import Config
from companion.errors import LockstepStalled
from companion.link.inbox import ObstacleInbox
from companion.types import NS_PER_S

GONE_NS = 5 * NS_PER_S  # not even a heartbeat of the simulator
STALL_NS = NS_PER_S  # no progress for this much wall time ends the run


class LockstepBarrier:
    """Whether a tick's obstacle frames are all there; passes everything where the run is not in lockstep."""

    def __init__(self, config: Config, inbox: ObstacleInbox, clock: Clock) -> None:
        self._sources = config.lockstep_sources
        self._on = config.sync == "lockstep"
        self._inbox = inbox
        self._clock = clock
        self._pending_ns = 0
        self._heard_ns: int | None = None

    def heard(self) -> None:
        """Bytes from the vehicle's link."""
        self._heard_ns = self._clock.monotonic_ns()

    def pending(self) -> None:
        """A vehicle state waits for its frames from now on."""
        self._pending_ns = self._clock.monotonic_ns()

    def passes(self, stamp_ns: int) -> bool:
        """Whether every source's marker and frames for the tick of ``stamp_ns`` are there.

        Raises:
            LockstepStalled: they were not for a second.
        """
        if not self._on or self._inbox.ready(stamp_ns, self._sources):
            return True
        if self._clock.monotonic_ns() - self._pending_ns > STALL_NS:
            missing = self._inbox.missing(stamp_ns, self._sources)
            raise LockstepStalled(f"lockstep: no progress for 1 s at tick {stamp_ns}: missing {missing}")
        return False

    def check_simulator(self, vehicle_ns: int) -> None:
        """A simulator that holds time still sends heartbeats; raise LockstepStalled for one that is gone."""
        if self._heard_ns is not None and self._clock.monotonic_ns() - self._heard_ns > GONE_NS:
            raise LockstepStalled(f"lockstep: nothing from the vehicle for {GONE_NS / 1e9:g} s after {vehicle_ns} ns")
