"""The vehicle itself among the detections: recognised by its own path, never mistaken for long.

A sensor that watches the scene, or a traffic message, reports the vehicle too; taken for an obstacle it would make
the filter flee from itself. With r = z - p_own(t) at the stamp of the detection and S = R + P_own,

    r ~ N(0, S)                            for the vehicle,
    |mean of r| >= r_obstacle + r_own      for an obstacle, else the two have collided.

One detection cannot tell them apart: at sigma 0.22 m three sigma are 0.66 m, farther than an obstacle may pass. Nor
does "within three sigma every time" keep the vehicle out: of the vehicle's own detections 2.9 % lie outside in three
dimensions, one in two seconds at 20 Hz. So evidence is summed up. With I = sum S^-1 and m = I^-1 sum S^-1 r over the
detections of one key, all of the first 20, later ones with exponential forgetting,

    the key may be us while    m^T I m <= 5^2   or   |m| <= r_own,

and a detection of r^T S^-1 r > 5^2 is skipped once and ends it if the next is no better (the first of a key ends it
at once). At sigma 0.22 m the vehicle fails this once in 20 000 starts, and an obstacle that stands 0.5 m beside it
is told apart after 5 detections (median), 11 in 99.5 % of cases.

Only a birth is judged: a key that no track knows, or an anonymous detection that no track takes. An obstacle that was
born elsewhere and flies close past is never touched, and what failed once is an obstacle as long as its track lives.
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
MEMORY_NS = NS_PER_S  # evidence lasts this long without another detection
GATE = 5.0**2
WINDOW = 20  # detections


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
        """Interpolated, or carried on by the velocity beyond the newest state; None where that is too far."""
        later: VehicleState | None = None
        for state in reversed(self._states):
            if state.stamp_ns <= stamp_ns:
                return _between(state, later, stamp_ns)
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
class Evidence:
    """What speaks for one key being the vehicle itself."""

    information: FloatArray  # I (3, 3) [1/m^2]
    weighted: Vec3  # sum S^-1 r [1/m]
    count: int  # detections
    seen_ns: int
    skipped: bool = False  # the newest detection lay outside the gate

    def lives(self, stamp_ns: int) -> bool:
        return abs(stamp_ns - self.seen_ns) <= MEMORY_NS


Suspects = dict[Key, Evidence]  # keys that may be the vehicle; (source, None): the anonymous one of a source


def residuals(z: FloatArray, noise: FloatArray, own: Fix) -> tuple[FloatArray, FloatArray, FloatArray]:
    """r (D, 3), S^-1 (D, 3, 3) and r^T S^-1 r (D,) of positions ``z`` (D, 3) with ``noise`` (D, 3, 3)."""
    r = z - own.p_enu
    inverse: FloatArray = np.asarray(np.linalg.inv(noise + own.variance_m2 * np.eye(3)), dtype=np.float64)
    return r, inverse, (r[:, None] @ inverse @ r[..., None])[:, 0, 0]


def weigh(
    evidence: Evidence | None, r: Vec3, inverse: FloatArray, squared: float, stamp_ns: int, radius_m: float
) -> Evidence | None:
    """The evidence with one more detection, None where it is no longer, or not at all, the vehicle.

    Args:
        r, inverse, squared: one row of `residuals`. radius_m: of the vehicle.
    """
    if evidence is not None and not evidence.lives(stamp_ns):
        evidence = None
    if squared > GATE:
        if evidence is None or evidence.skipped:
            return None
        return replace(evidence, seen_ns=stamp_ns, skipped=True)
    information, weighted, count = inverse, inverse @ r, 1
    if evidence is not None:
        keep = 1.0 if evidence.count < WINDOW else 1.0 - 1.0 / WINDOW
        information = keep * evidence.information + information
        weighted = keep * evidence.weighted + weighted
        count += evidence.count
    mean = np.linalg.solve(information, weighted)
    if float(mean @ weighted) > GATE and math.hypot(*mean.tolist()) > radius_m:
        return None
    return Evidence(information, weighted, count, stamp_ns)
