"""The aircraft of one door: where each said it was, carried on along its velocity until it speaks again.

Traffic reports come about once a second, and some are late or lost, while the tracker drops what it has not seen for
its `coast_s`; so each aircraft is shown several times a second at

    p + v dt,   P = F diag(s_p^2, s_v^2) F^T + a^2 [dt^2/2, dt] [dt^2/2, dt]^T,   F = [1 dt; 0 1] per axis

with ``a`` = `MANOEUVRE_M_S2` for what it may have done meanwhile. What is carried on is no new measurement: the frames
are of the kind "track", which the tracker takes in by covariance intersection.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.link.ingress import MAX_POSITION_M
from companion.link.wire import Obstacle, ObstacleFrame
from companion.types import NS_PER_S, FloatArray, Vec3

MAX_HELD = 64  # aircraft of a door; beyond, the farthest goes
SHOW_NS = NS_PER_S // 5
MANOEUVRE_M_S2 = 2.0  # 1 sigma of each axis
_UPPER = np.triu_indices(6)


@dataclass(frozen=True, slots=True, eq=False)
class Report:
    """One aircraft at ``stamp_ns`` of the vehicle's clock, ENU."""

    stamp_ns: int
    p_enu: Vec3
    p_std_m: Vec3  # (3,)
    v_enu: Vec3 | None
    v_std_m_s: Vec3  # (3,)
    radius_m: float

    def at(self, stamp_ns: int) -> tuple[Vec3, FloatArray]:
        """Position [m] and covariance (6, 6) at an instant not before the report."""
        dt = max(stamp_ns - self.stamp_ns, 0) / NS_PER_S
        if self.v_enu is None:
            return self.p_enu, np.diag(np.concatenate((self.p_std_m, self.v_std_m_s)) ** 2)
        s_v, a = self.v_std_m_s**2, MANOEUVRE_M_S2**2
        covariance = np.diag(np.concatenate((self.p_std_m**2 + s_v * dt**2 + a * dt**4 / 4.0, s_v + a * dt**2)))
        across = np.diag(s_v * dt + a * dt**3 / 2.0)
        covariance[:3, 3:], covariance[3:, :3] = across, across
        return self.p_enu + self.v_enu * dt, covariance


class Reports:
    """The newest report of every aircraft of one door.

    Args:
        prefix: of the ids on the wire. max_range_m: from the vehicle; what is farther is not shown.
        carry_s: for how long an aircraft is carried on; one without a velocity is shown once.
    """

    def __init__(self, prefix: str, *, max_range_m: float, carry_s: float) -> None:
        self._prefix = prefix
        self._max_range_m = max_range_m
        self._carry_ns = round(carry_s * NS_PER_S)
        self.clear()

    def clear(self) -> None:
        self._held: dict[str, Report] = {}
        self._distance_m: dict[str, float] = {}  # of each, when it was taken
        self._fresh: set[str] = set()  # not shown yet
        self._shown_ns: int | None = None

    def note(self, name: str, report: Report, own_enu: Vec3) -> str | None:
        """Take a report; why it is not used, or None.

        Reasons: ``traffic_far``, ``traffic_many`` (the farthest of too many).
        """
        distance_m = math.dist(report.p_enu, own_enu)
        if distance_m > self._max_range_m or float(np.abs(report.p_enu).max()) > MAX_POSITION_M:
            self._forget(name)
            return "traffic_far"
        if name not in self._held and len(self._held) >= MAX_HELD:
            farthest = max(self._distance_m, key=self._distance_m.__getitem__)
            if self._distance_m[farthest] <= distance_m:
                return "traffic_many"
            self._forget(farthest)
        self._held[name], self._distance_m[name] = report, distance_m
        self._fresh.add(name)
        return None

    def frame(self, stamp_ns: int, own_enu: Vec3) -> ObstacleFrame | None:
        """What is to be shown at ``stamp_ns``: a new report at once, all that is in the air five times a second."""
        if not self._held:
            return None
        due = self._shown_ns is None or not 0 <= stamp_ns - self._shown_ns < SHOW_NS
        if not self._fresh and not due:
            return None
        shown = []
        for name in list(self._held) if due else sorted(self._fresh):
            report = self._held[name]
            silent = report.v_enu is None or stamp_ns - report.stamp_ns > self._carry_ns
            if silent and name not in self._fresh:
                self._forget(name)
                continue
            p_enu, covariance = report.at(stamp_ns)
            if math.dist(p_enu, own_enu) <= self._max_range_m and float(np.abs(p_enu).max()) <= MAX_POSITION_M:
                shown.append(self._obstacle(name, report, p_enu, covariance))
        self._fresh.clear()
        self._shown_ns = stamp_ns if due else self._shown_ns
        if not shown:
            return None
        return ObstacleFrame(stamp_ns=stamp_ns, clock="vehicle", kind="track", obstacles=shown)

    def _forget(self, name: str) -> None:
        self._held.pop(name, None)
        self._distance_m.pop(name, None)
        self._fresh.discard(name)

    def _obstacle(self, name: str, report: Report, p_enu: Vec3, covariance: FloatArray) -> Obstacle:
        x, y, z = p_enu.tolist()
        velocity = None
        if report.v_enu is not None:
            vx, vy, vz = report.v_enu.tolist()
            velocity = (vx, vy, vz)
        return Obstacle(
            id=f"{self._prefix}-{name}",
            position=(x, y, z),
            radius=report.radius_m,
            velocity=velocity,
            covariance=covariance[_UPPER].tolist(),
        )
