"""Which autopilot is ours: the configured system at once, else the one that alone was heard for three seconds."""

from __future__ import annotations

from companion.link.events import Heartbeat
from companion.types import NS_PER_S

LATCH_NS = 3 * NS_PER_S
CANDIDATE_NS = 2 * NS_PER_S  # an autopilot not heard for this long is none to choose from


class AutopilotLatch:
    """Feed it the heartbeats of autopilots until ``choose`` names one."""

    def __init__(self, wanted: int | None) -> None:
        self._wanted = wanted
        # system -> first heard, last heard, component, MAV_AUTOPILOT
        self._candidates: dict[int, tuple[int, int, int, int]] = {}

    @property
    def systems(self) -> list[int]:
        """Those heard of late."""
        return sorted(self._candidates)

    def heard(self, beat: Heartbeat, now_ns: int) -> None:
        first_ns, last_ns, *_ = self._candidates.get(beat.system, (now_ns, now_ns, 0, 0))
        if now_ns - last_ns > CANDIDATE_NS:
            first_ns = now_ns
        self._candidates[beat.system] = (first_ns, now_ns, beat.component, beat.autopilot)

    def choose(self, now_ns: int) -> tuple[int, int, int] | None:
        """(system, component, MAV_AUTOPILOT) of the autopilot to fly, None while that is open."""
        self._candidates = {k: heard for k, heard in self._candidates.items() if now_ns - heard[1] <= CANDIDATE_NS}
        if self._wanted is not None:
            heard = self._candidates.get(self._wanted)
            return None if heard is None else (self._wanted, *heard[2:])
        if len(self._candidates) != 1:
            return None
        [(system, (first_ns, _, component, autopilot))] = self._candidates.items()
        return (system, component, autopilot) if now_ns - first_ns >= LATCH_NS else None
