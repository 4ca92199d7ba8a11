"""Counts and latencies of a running daemon."""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

# upper bounds of the latency histogram; 5, 10, 20, 50 ms are the periods of 200, 100, 50 and 20 Hz
BUCKETS_MS = (0.25, 0.5, 1.0, 2.0, 3.0, 5.0, 7.5, 10.0, 15.0, 20.0, 30.0, 50.0)
WINDOW = 100_000  # ticks that the quantiles look back on: bounds the memory of a long flight


class TickMeter:
    """Latency of whole ticks (state received to setpoint sent), verdict counts, deadline misses."""

    def __init__(self, period_s: float) -> None:
        self.set_period(period_s)
        self.ticks = 0
        self._latencies_ms = np.full(WINDOW, np.nan)  # a ring: the status asks for quantiles five times a second
        self.verdicts: Counter[str] = Counter()
        self.bucket_counts = [0] * (len(BUCKETS_MS) + 1)  # ticks by latency, the last above every bound
        self.latency_sum_ms = 0.0
        self.deadline_misses = 0  # ticks whose work outlasted the period, and states skipped
        self.states_skipped = 0  # overtaken in the mailbox by a newer one

    def set_period(self, period_s: float) -> None:
        """The tick's deadline from now on."""
        self._period_ms = 1e3 * period_s

    def skip(self) -> None:
        """A vehicle state was overtaken by a newer one before it was answered: its deadline was missed."""
        self.states_skipped += 1
        self.deadline_misses += 1

    def tick(self, latency_ms: float, busy_ms: float, verdict: str) -> None:
        """One tick: state received to setpoint sent, and to the end of all its work."""
        self._latencies_ms[self.ticks % WINDOW] = latency_ms
        self.ticks += 1
        self.bucket_counts[bisect_left(BUCKETS_MS, latency_ms)] += 1
        self.latency_sum_ms += latency_ms
        self.verdicts[verdict] += 1
        if busy_ms > self._period_ms:
            self.deadline_misses += 1

    def quantiles_ms(self, last: int | None = None) -> dict[str, float]:
        """p50, p99, p99.9 and max over the ``last`` ticks (at most WINDOW); empty before the first tick."""
        count = min(self.ticks, last or WINDOW, WINDOW)
        if not count:
            return {}
        values = self._latencies_ms[np.arange(self.ticks - count, self.ticks) % WINDOW]
        p50, p99, p999 = np.quantile(values, [0.5, 0.99, 0.999])
        return {
            "p50": round(float(p50), 4),
            "p99": round(float(p99), 4),
            "p99.9": round(float(p999), 4),
            "max": round(float(values.max()), 4),
        }

    def counts(self, groups: Mapping[str, Mapping[str, int]]) -> dict[str, int]:
        """Everything counted, by kind: the verdicts, what ``groups`` hold, the deadlines."""
        kinds = {"verdict": self.verdicts, **groups}
        counted = {f"{kind}.{name}": count for kind, group in kinds.items() for name, count in sorted(group.items())}
        return {**counted, "deadline_misses": self.deadline_misses, "states_skipped": self.states_skipped}

    def summary(self, counts: dict[str, int], final_state: str, *, log: str | None, log_hash: str) -> Summary:
        """What the run amounted to."""
        return Summary(
            ticks=self.ticks,
            verdicts=dict(self.verdicts),
            tick_ms=self.quantiles_ms(),
            deadline_misses=self.deadline_misses,
            states_skipped=self.states_skipped,
            counts=counts,
            final_state=final_state,
            log=log,
            log_hash=log_hash,
        )


@dataclass(frozen=True, slots=True)
class Summary:
    """What a run amounted to; ``companion run --json`` prints it."""

    ticks: int
    verdicts: dict[str, int]
    tick_ms: dict[str, float]
    deadline_misses: int
    states_skipped: int
    counts: dict[str, int]
    final_state: str
    log: str | None
    log_hash: str
