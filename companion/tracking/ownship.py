"""The vehicle itself among the detections: recognised by its own path, and where the data cannot tell, an obstacle.

A sensor that watches the scene, or a traffic message, reports the vehicle too; taken for an obstacle it would make
the filter flee from itself, which costs time. An obstacle taken for the vehicle costs the aircraft. With
r = z - p_own(t) at the stamp of the detection, S = R + (0.05 m)^2 its white error and b^2 = P_own - (0.05 m)^2 the
error of the own position, common to all detections and not averaged away,

    r ~ N(0, S + b^2)                      for the vehicle,
    |mean of r| >= r_obstacle + r_own      for an obstacle, else the two have collided.

One detection cannot tell them apart: at sigma 0.22 m three sigma are 0.66 m, farther than an obstacle may pass. So
evidence is summed up per key, with I = sum S^-1, m = I^-1 sum S^-1 r, C = I^-1 + b^2 and s^2 the largest eigenvalue
of C. The key may be us while

    m^T C^-1 m <= 5^2   or   |m| <= r_own + 2 s             m of all its detections, nothing forgotten;
    (m' - m)^T C'^-1 (m' - m) <= 5^2   or   |m'| <= r_own   m' of the last 20: what leaves us is told apart soon;
    s <= 0.3 m   and   |m| <= r_own + 0.3 m                 once 0.5 s or 10 detections are over.

A detection of r^T (S + b^2)^-1 r > 5^2, or of a sigma beyond 1 m, is skipped once and ends it if the next is no
better (the first of a key ends it at once). While the own position is vaguer than 0.3 m it counts as unknown: all is
an obstacle, and judged once when it is known.

Measured at 20 Hz, r_own 0.2 m:
    - the vehicle at sigma 0.05 to 0.4 m and an exact own position: no obstacle (1500 starts at 0.22 m, 8 flights of
      100 s); at 0.5 m in 2 %, at 0.9 m in half of all starts, and always beyond 1 m;
    - own position off by N(0, P_own): deviation up to 0.1 m never, 0.15 m in 2 %, 0.2 m in 8 to 13 % of starts, and
      from 0.3 m on always or nearly so;
    - a constant error of 0.15 m is us for good, one of r_own at sigma 0.22 m is an obstacle within 20 s in 2 of 10;
    - an obstacle 0.5 m beside us at sigma 0.22 m is told apart after 5 detections (median), 11 at most in 200; at
      0.4 m after 8 and 21, at 0.3 m after 15 and 85;
    - what remains: nearer than r_own + 0.3 m and an own position that may be that wrong. At 0.5 m, with an own
      position off by N(0, (0.1 m)^2), 15 % stay hidden.

A source of less than a hertz sums evidence too (it lasts four intervals of the key, 1 to 10 s). Its tracks end before
the next detection, so that a named key's verdict is kept as long. An anonymous one is judged anew.

Only a birth is judged: a key that no track knows, or an anonymous detection that no track takes. An obstacle that was
born elsewhere while the own position was known, and flies close past, is never touched; what failed once is an
obstacle as long as its track lives.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from companion.tracking.tracks import Key
from companion.types import NS_PER_S, FloatArray, Vec3, VehicleState

PATH_NS = 2 * NS_PER_S
REACH_NS = 3 * NS_PER_S // 10  # the path is known this far from a noted state
STATES_MAX = 1024  # of the path, whatever the rate
VARIANCE_MIN_M2 = 0.05**2  # of the own position: what its stamp and its estimate are good for at best
LIMIT_M = 0.3  # deviation of the mean residual up to which it tells, and how far beyond our hull it may lie
COARSE_M = 1.0  # a detection of a larger deviation says nothing
GRACE_NS, GRACE_COUNT = NS_PER_S // 2, 10  # a key may be us undecided for this time or these detections
PERIODS = 4  # evidence lasts so many intervals of its key without another detection,
MEMORY_NS = NS_PER_S  # at least this,
MEMORY_MAX_NS = 10 * NS_PER_S  # at most this, also where one detection tells no interval
GATE = 5.0**2
EDGE = 2.0  # deviations by which the mean may lie outside our hull
WINDOW = 20  # detections of the recent mean


@dataclass(frozen=True, slots=True)
class Fix:
    """Where the vehicle was: position [m] and variance of each of its axes [m^2]."""

    p_enu: Vec3
    variance_m2: float


class OwnPath:
    """Where the vehicle has been in the last two seconds."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        self._states: deque[VehicleState] = deque(maxlen=STATES_MAX)

    def note(self, state: VehicleState) -> None:
        """Append ``state``; one that is not newer than the last changes nothing."""
        if self._states and state.stamp_ns <= self._states[-1].stamp_ns:
            return
        self._states.append(state)
        while state.stamp_ns - self._states[0].stamp_ns > PATH_NS:
            self._states.popleft()

    def at(self, stamp_ns: int) -> Fix | None:
        """Interpolated, or carried on by the velocity beyond the newest state; None where too far or too vague."""
        later: VehicleState | None = None
        for state in reversed(self._states):
            if state.stamp_ns <= stamp_ns:
                fix = _between(state, later, stamp_ns)
                return None if fix is None or fix.variance_m2 > LIMIT_M**2 else fix
            later = state
        return None

    @property
    def newest(self) -> Vec3 | None:
        """The last known position."""
        return self._states[-1].p_enu if self._states else None


def _between(state: VehicleState, later: VehicleState | None, stamp_ns: int) -> Fix | None:
    after_ns = stamp_ns - state.stamp_ns
    if later is None:
        if after_ns > REACH_NS:
            return None
        return Fix(state.p_enu + state.v_enu * (after_ns / NS_PER_S), _variance(state.p_std_m))
    if min(after_ns, later.stamp_ns - stamp_ns) > REACH_NS:
        return None
    share = after_ns / (later.stamp_ns - state.stamp_ns)
    p_enu = state.p_enu + (later.p_enu - state.p_enu) * share
    return Fix(p_enu, _variance(max(state.p_std_m, later.p_std_m)))


def _variance(std_m: float) -> float:
    return max(std_m**2, VARIANCE_MIN_M2)


@dataclass(frozen=True, slots=True, eq=False)
class Residual:
    """One detection as seen from the vehicle."""

    r: Vec3  # z - p_own [m]
    inverse: FloatArray  # S^-1 (3, 3) [1/m^2]
    squared: float  # r^T (S + b^2)^-1 r; infinite where the detection is too coarse to say anything
    bias_m: float  # b


def residuals(z: FloatArray, noise: FloatArray, own: Fix) -> list[Residual]:
    """Of positions ``z`` (D, 3) with ``noise`` (D, 3, 3)."""
    r, s = z - own.p_enu, noise + VARIANCE_MIN_M2 * np.eye(3)
    bias_m = math.sqrt(max(own.variance_m2 - VARIANCE_MIN_M2, 0.0))
    squared = (r * np.linalg.solve(s + bias_m**2 * np.eye(3), r[..., None])[..., 0]).sum(axis=1)
    squared[np.linalg.eigvalsh(noise)[:, -1] > COARSE_M**2] = np.inf
    inverse = np.linalg.inv(s)
    return [Residual(r[k], inverse[k], float(squared[k]), bias_m) for k in range(len(z))]


@dataclass(frozen=True, slots=True, eq=False)
class Mean:
    """Weighted mean of residuals."""

    information: FloatArray  # I = sum S^-1 (3, 3) [1/m^2]
    weighted: Vec3  # sum S^-1 r [1/m]
    biased: float  # sum tr(S^-1) b [1/m]

    @classmethod
    def of(cls, one: Residual) -> Mean:
        return cls(one.inverse, one.inverse @ one.r, float(np.trace(one.inverse)) * one.bias_m)

    def plus(self, other: Mean, keep: float = 1.0) -> Mean:
        """Both, this one counted ``keep`` times."""
        return Mean(
            keep * self.information + other.information,
            keep * self.weighted + other.weighted,
            keep * self.biased + other.biased,
        )

    def moments(self) -> tuple[Vec3, FloatArray]:
        """m [m] and C = I^-1 + b^2 [m^2], with the weighted mean of b."""
        spread: FloatArray = np.asarray(np.linalg.inv(self.information), dtype=np.float64)
        bias_m = self.biased / float(np.trace(self.information))
        return spread @ self.weighted, spread + bias_m**2 * np.eye(3)


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What speaks for one key being the vehicle itself."""

    whole: Mean  # of all its detections
    recent: Mean  # of the last WINDOW, exponentially
    count: int  # detections
    since_ns: int
    seen_ns: int
    skipped: bool = False  # the newest detection lay outside the gate
    obstacle: bool = False  # judged: it is not the vehicle

    def lives(self, stamp_ns: int) -> bool:
        """The key is us, and still seen: within some of its intervals."""
        return not self.obstacle and abs(stamp_ns - self.seen_ns) <= self._memory_ns()

    def sums(self, stamp_ns: int) -> bool:
        """A detection at ``stamp_ns`` adds to this; what was seen once has no interval yet, and waits longest."""
        return abs(stamp_ns - self.seen_ns) <= (self._memory_ns() if self.count > 1 else MEMORY_MAX_NS)

    def _memory_ns(self) -> int:
        interval_ns = (self.seen_ns - self.since_ns) // max(self.count - 1, 1)
        return min(max(PERIODS * interval_ns, MEMORY_NS), MEMORY_MAX_NS)

    def may_be_us(self, radius_m: float) -> bool:
        """The gates on both means, and after the grace whether the mean of all tells."""
        mean, spread = self.whole.moments()
        distance, deviation = _length(mean), math.sqrt(float(np.linalg.eigvalsh(spread)[-1]))
        if distance > radius_m + EDGE * deviation and _squared(mean, spread) > GATE:
            return False
        recent, spread = self.recent.moments()
        if _length(recent) > radius_m and _squared(recent - mean, spread) > GATE:
            return False
        if self.count < GRACE_COUNT and self.seen_ns - self.since_ns < GRACE_NS:
            return True
        return deviation <= LIMIT_M and distance <= radius_m + LIMIT_M


def _length(r: Vec3) -> float:
    return math.hypot(*r.tolist())


def _squared(r: Vec3, spread: FloatArray) -> float:
    return float(r @ np.linalg.solve(spread, r))


Suspects = dict[Key, Evidence]  # keys that may be the vehicle; (source, None): the anonymous one of a source


def weigh(evidence: Evidence | None, one: Residual, stamp_ns: int, radius_m: float) -> Evidence | None:
    """The evidence with one more detection, None where it is no longer, or not at all, the vehicle.

    Args:
        radius_m: of the vehicle.
    """
    if evidence is not None and not evidence.sums(stamp_ns):
        evidence = None
    if evidence is not None and evidence.obstacle:
        return None
    if one.squared > GATE:
        if evidence is None or evidence.skipped:
            return None
        return replace(evidence, seen_ns=stamp_ns, skipped=True)
    mean = Mean.of(one)
    if evidence is None:
        after = Evidence(mean, mean, 1, stamp_ns, stamp_ns)
    else:
        keep = 1.0 if evidence.count < WINDOW else 1.0 - 1.0 / WINDOW
        whole, recent = evidence.whole.plus(mean), evidence.recent.plus(mean, keep)
        after = Evidence(whole, recent, evidence.count + 1, evidence.since_ns, stamp_ns)
    return after if after.may_be_us(radius_m) else None
