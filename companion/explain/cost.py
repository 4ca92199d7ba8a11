"""What an intervention cost: acceleration given up, and an estimate of the way and the time lost."""

from __future__ import annotations

from msgspec import Struct

from companion.explain.moment import Outline
from companion.pilot import Task
from companion.types import NS_PER_S

SPAN_NS = NS_PER_S // 5  # over which a speed towards the target is measured
LEAST_M_S = 0.3  # slower than this nobody flies to the target


class Cost(Struct, frozen=True, kw_only=True):
    """What the change cost. The last three are an estimate, see `estimate`."""

    ahead_m_s2: float  # acceleration towards the target given up, < 0: gained
    began_ns: int | None  # of the run of changed ticks about this one
    ended_ns: int | None
    behind_m: float | None  # at its end, of a vehicle that flew the reference
    behind_s: float | None
    slower_m_s: float | None


def estimate(ticks: list[Outline], run: tuple[int, int] | None, ahead_m_s2: float) -> Cost:
    """The cost of the ``run`` of changed ticks (first, last).

    It is compared with a vehicle that from the run's beginning on would have accelerated towards the target as the
    first reference asked, up to the greatest speed towards it that this flight shows within five seconds, in the
    estimate's own straight line: s(t) = sum of min(v + a t, v_max) dt. What this one covered less is ``behind_m``, over
    the other's speed ``behind_s``. No estimate without a target, or where the reference did not lead to it.
    """
    if run is None:
        return Cost(ahead_m_s2=ahead_m_s2, began_ns=None, ended_ns=None, behind_m=None, behind_s=None, slower_m_s=None)
    first, last = run
    behind = _behind(ticks, first, last)
    return Cost(
        ahead_m_s2=ahead_m_s2,
        began_ns=ticks[first].stamp_ns,
        ended_ns=ticks[last].stamp_ns,
        behind_m=None if behind is None else behind[0],
        behind_s=None if behind is None else behind[1],
        slower_m_s=None if behind is None else behind[2],
    )


def _behind(ticks: list[Outline], first: int, last: int) -> tuple[float, float, float] | None:
    """Way [m] and time [s] behind the other vehicle at the end of the run, and how much slower [m/s]."""
    began, ended = ticks[first].distance_m, ticks[last].distance_m
    if ticks[first].task is not Task.FLY:
        return None
    if began is None or ended is None or ticks[first].target != ticks[last].target:
        return None
    duration_s = (ticks[last].stamp_ns - ticks[first].stamp_ns) / NS_PER_S
    near_ns = 5 * NS_PER_S
    seen = [
        approach_m_s(ticks, number)
        for number, tick in enumerate(ticks)
        if abs(tick.stamp_ns - ticks[last].stamp_ns) < near_ns and tick.target == ticks[last].target
    ]
    fastest, speed = max(seen), max(approach_m_s(ticks, first), 0.0)
    accelerates = ticks[first].asked_ahead_m_s2
    if fastest < LEAST_M_S or accelerates < 0.0 or duration_s <= 0.0:
        return None
    rising_s = 0.0 if accelerates < 1e-6 else max(0.0, min(duration_s, (fastest - speed) / accelerates))
    end = speed + accelerates * rising_s
    covered = speed * rising_s + 0.5 * accelerates * rising_s**2 + end * (duration_s - rising_s)
    covered = min(covered, began)
    way = max(0.0, covered - (began - ended))
    return way, way / max(end, LEAST_M_S), max(0.0, end - approach_m_s(ticks, last))


def approach_m_s(ticks: list[Outline], number: int) -> float:
    """Speed towards the target, over the tenth of a second before a tick, or after it where there is none before."""
    target, here = ticks[number].target, ticks[number]
    for step in (-1, 1):
        other = number
        while 0 <= other + step < len(ticks) and abs(ticks[other].stamp_ns - here.stamp_ns) < SPAN_NS // 2:
            other += step
        one, two = sorted((number, other))
        elapsed_s = (ticks[two].stamp_ns - ticks[one].stamp_ns) / NS_PER_S
        start, end = ticks[one].distance_m, ticks[two].distance_m
        known = start is not None and end is not None and ticks[one].target == target == ticks[two].target
        if known and 0.0 < elapsed_s < 1.0 and start is not None and end is not None:
            return (start - end) / elapsed_s
    return 0.0
