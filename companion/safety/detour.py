"""Round what would hold the vehicle for good: without progress for a while, the reference follows the boundary.

A filter that corrects as little as it can makes no plan. Sent into a hollow between obstacles, or at a wall of them,
the vehicle comes to rest, or circles, where every small step costs more than to stay. The rule of the bug algorithms
(Lumelsky and Stepanov, "Path-planning strategies for a point mobile automaton", Algorithmica 1987) leads out: with
nothing but obstacles near and no more than `NEAR_M` covered in `STAYED_S`, the reference becomes

    a = gain (speed t - v),     t = n turned left by 90 degrees - pull n, level

with n away from what is near, so that it stays on the left; then the policy may try again. The first detour takes
`FIRST_S`, each further one twice as long, and after `MOST` the vehicle waits for better times. `FREE_S` with nothing
in the way, and all of it is forgotten. The rows decide about a detour's acceleration as about any other.
"""

from __future__ import annotations

import math

import numpy as np

from companion.safety.task import Task
from companion.types import Vec3

STAYED_S = 2.0
NEAR_M = 1.5  # within this of where the time began the vehicle has stayed
ASKED_M_S2 = 0.3  # a reference shorter than this asks for nothing
FIRST_S = 1.5
MOST = 4  # detours in a row: of 1.5, 3, 6 and 12 s
FREE_S = 2.0
SPEED_M_S = 1.0
PULL = 0.3  # towards the boundary, so that corners are kept to
BOUNDARY_M = 1.0  # beyond its keep-out distance an obstacle is no boundary
GAIN_HZ = 2.0  # of the speed, as an acceleration


class Detour:
    """Counts how long the vehicle has stayed, and what is left of a detour."""

    def __init__(self) -> None:
        self._from: Vec3 | None = None
        self._stayed_s = self._left_s = self._free_s = 0.0
        self._taken = 0

    @property
    def active(self) -> bool:
        return self._left_s > 0.0

    def reference(self, task: Task) -> Vec3:
        """Along the boundary, each axis within the box; the task's own reference where there is none [m/s^2]."""
        r = task.rows.drift[:, :, 0]
        distance = np.maximum(np.sqrt(np.add.reduce(r * r)), 1e-9)
        weight = np.maximum(1.0 - (distance - task.rows.keep_out_m[:, 0]) / BOUNDARY_M, 0.0) ** 2
        x, y, _ = (r @ (weight / distance)).tolist()
        length = math.hypot(x, y)
        if length < 1e-6:
            return task.a_ref
        x, y = x / length, y / length
        speed = SPEED_M_S * np.array((-y - PULL * x, x - PULL * y, 0.0))
        box = task.limits.box_m_s2
        return np.clip(GAIN_HZ * (speed - task.limits.v_enu), -box, box)

    def note(self, p_enu: Vec3, a_ref: Vec3, elapsed_s: float, *, in_the_way: bool) -> None:
        """Where one tick's reference ``a_ref`` was asked for; ``in_the_way``: an obstacle refused it."""
        if self.active:
            self._left_s -= elapsed_s
            self._from = None
            return
        self._free_s = 0.0 if in_the_way else self._free_s + elapsed_s
        if self._free_s > FREE_S:
            self._taken = 0
        if (
            self._from is None
            or not in_the_way
            or math.hypot(*a_ref.tolist()) < ASKED_M_S2
            or math.dist(p_enu, self._from) > NEAR_M
        ):
            self._from, self._stayed_s = p_enu, 0.0
            return
        self._stayed_s += elapsed_s
        if self._stayed_s > STAYED_S and self._taken < MOST:
            self._left_s = FIRST_S * 2.0**self._taken
            self._taken += 1
