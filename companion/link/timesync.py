"""TIMESYNC: how far the vehicle's clock is from ours, told from request and reply alone.

A request left at ts1 and its reply came at now (ours); the autopilot wrote tc1 (its own) in between:
``ours - vehicle = (ts1 + now) / 2 - tc1``, wrong by at most half the round trip. Of the last 16 samples the one with
the shortest round trip counts (the clock filter of NTP, RFC 5905 section 10). Source: MAVLink time synchronisation
protocol. No clock is read here; all instants are arguments, in ns.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass

MAX_ROUND_TRIP_NS = 100_000_000
OPEN_NS = 1_000_000_000  # an older request is forgotten
MAX_OPEN = 8
WINDOW = 16
SETTLED_SAMPLES = 5
JUMP_NS = 20_000_000  # beyond this and what the round trips explain, a sample contradicts the estimate
CONTRADICTIONS = 3  # in a row: a clock has jumped, start again
BACK_NS = 1_000_000_000  # a stamp this far behind the newest: the vehicle's clock began anew
AHEAD_NS = 3_000_000_000  # a stamp this much further ahead than the time that has passed: its clock jumped


@dataclass(frozen=True, slots=True)
class _Sample:
    round_trip_ns: int
    ours_minus_vehicle_ns: int


class TimeSync:
    """The offset of the clocks, from replies to our own requests only.

    ``counts``: accepted, foreign (no open request of ours, or answered before), slow (round trip above 100 ms),
    contradicting, reboots, jumps (both clocks go on, but not as before), jumps_ahead (of the vehicle's stamps).

    >>> sync = TimeSync()
    >>> for k in range(1, 6):
    ...     ts1 = sync.request(k * 10**9)
    ...     _ = sync.reply(tc1_ns=ts1 - 400, ts1_ns=ts1, now_ns=ts1 + 200, unix_ns=ts1 + 200 + 10**18)
    >>> sync.ours_minus_vehicle_ns, sync.unix_minus_vehicle_ns
    (500, 1000000000000000500)
    """

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._open: dict[int, None] = {}
        self._last_request_ns = 0
        self._unix_minus_ours_ns = 0
        self._last_vehicle_ns: int | None = None
        self._noted_ns: int | None = None  # our time at that stamp
        self.restart()

    def restart(self) -> None:
        """Forget the estimate: the autopilot rebooted or a clock jumped."""
        self._samples: deque[_Sample] = deque(maxlen=WINDOW)
        self._contradictions = 0
        self._last_vehicle_ns = None
        self._noted_ns = None

    @property
    def settled(self) -> bool:
        return len(self._samples) >= SETTLED_SAMPLES

    @property
    def ours_minus_vehicle_ns(self) -> int | None:
        """Our monotonic clock minus the vehicle's, None until settled."""
        return self._best.ours_minus_vehicle_ns if self.settled else None

    @property
    def unix_minus_vehicle_ns(self) -> int | None:
        """Unix time minus the vehicle's clock, None until settled."""
        if not self.settled:
            return None
        return self._best.ours_minus_vehicle_ns + self._unix_minus_ours_ns

    @property
    def round_trip_ns(self) -> int | None:
        """The shortest round trip of the window: twice the bound of the offset's error."""
        return self._best.round_trip_ns if self._samples else None

    def request(self, now_ns: int) -> int:
        """A new ts1 to send: ``now_ns`` of our monotonic clock, moved on where it would repeat or be 0."""
        ts1_ns = max(now_ns, self._last_request_ns + 1)
        self._last_request_ns = ts1_ns
        self._open = {ts1: None for ts1 in self._open if now_ns - ts1 <= OPEN_NS}
        self._open[ts1_ns] = None
        if len(self._open) > MAX_OPEN:
            del self._open[next(iter(self._open))]
        return ts1_ns

    def reply(self, *, tc1_ns: int, ts1_ns: int, now_ns: int, unix_ns: int) -> bool:
        """Take one reply.

        Args:
            tc1_ns, ts1_ns: of the message.
            now_ns, unix_ns: our monotonic clock and unix time at its arrival.
        Returns:
            True where it counted.
        """
        if ts1_ns not in self._open:
            self.counts["foreign"] += 1
            return False
        del self._open[ts1_ns]
        round_trip_ns = now_ns - ts1_ns
        if not 0 <= round_trip_ns <= MAX_ROUND_TRIP_NS or tc1_ns <= 0:
            self.counts["slow"] += 1
            return False
        if self._last_vehicle_ns is not None and tc1_ns < self._last_vehicle_ns - BACK_NS:
            self.vehicle_time(tc1_ns, now_ns)
        sample = _Sample(round_trip_ns, (ts1_ns + now_ns) // 2 - tc1_ns)
        if self._contradicts(sample):
            self.counts["contradicting"] += 1
            self._contradictions += 1
            if self._contradictions < CONTRADICTIONS:
                return False
            self.counts["jumps"] += 1
            self.counts["jumps_ahead"] += self._best.ours_minus_vehicle_ns - sample.ours_minus_vehicle_ns > AHEAD_NS
            self.restart()
        self._note(tc1_ns, now_ns)
        self._contradictions = 0
        self._samples.append(sample)
        self._unix_minus_ours_ns = unix_ns - now_ns
        self.counts["accepted"] += 1
        return True

    def vehicle_time(self, stamp_ns: int, now_ns: int | None = None) -> bool:
        """Note any stamp of the vehicle's clock; where it does not go on from the last, the estimate restarts.

        One second back means a reboot. Three seconds further ahead than our clock went on meanwhile means that the
        vehicle's jumped (or that ours stood still); what was dated before is worth nothing then either.

        Args:
            now_ns: our monotonic clock; None where it does not run beside the vehicle's (lockstep): only a step back
                is noticed.
        Returns:
            True where the vehicle's clock began anew or jumped.
        """
        last_ns, noted_ns = self._last_vehicle_ns, self._noted_ns
        broken = last_ns is not None and stamp_ns < last_ns - BACK_NS
        if broken:
            self.counts["reboots"] += 1
        elif last_ns is not None and noted_ns is not None and now_ns is not None:
            broken = stamp_ns - last_ns > now_ns - noted_ns + AHEAD_NS
            self.counts["jumps_ahead"] += broken
        if broken:
            self.restart()
        self._note(stamp_ns, now_ns)
        return broken

    def _note(self, stamp_ns: int, now_ns: int | None) -> None:
        if self._last_vehicle_ns is None or stamp_ns > self._last_vehicle_ns:
            self._last_vehicle_ns, self._noted_ns = stamp_ns, now_ns

    @property
    def _best(self) -> _Sample:
        return min(self._samples, key=lambda sample: sample.round_trip_ns)

    def _contradicts(self, sample: _Sample) -> bool:
        if not self._samples:
            return False
        best = self._best
        explained_ns = (best.round_trip_ns + sample.round_trip_ns) // 2 + JUMP_NS
        return abs(sample.ours_minus_vehicle_ns - best.ours_minus_vehicle_ns) > explained_ns
