"""Where a picture is taken from: a fixed overview, a chase behind the vehicle, and from above.

A camera is an eye, a point that it looks at, and a vertical field of view. Its matrices are PyBullet's, so that what
is drawn over a picture falls on what PyBullet has drawn.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pybullet
from numpy.typing import NDArray

from sim_bridge.crazyflie import Triple
from sim_bridge.pictures.log import Log

CameraName = Literal["overview", "chase", "top"]
FOV_DEG = 40.0
NEAR_M, FAR_M = 0.1, 200.0
_MARGIN = 0.9  # of the picture that the flight fills
_BALL_REACH_M = 2.5  # of the vehicles' paths: obstacles farther away need not be in the overview
_CHASE_BACK_M, _CHASE_UP_M, _CHASE_AHEAD_M = 3.2, 1.1, 1.5
_CHASE_WINDOW_S = 1.0  # of the path that tells where the vehicle is heading

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Camera:
    """One view; ``up`` must not be parallel to the line of sight."""

    eye: Triple
    at: Triple
    up: Triple = (0.0, 0.0, 1.0)
    fov_deg: float = FOV_DEG  # vertical

    def matrices(self, aspect: float) -> tuple[Any, Any]:
        """View and projection as PyBullet takes them: 16 floats each, by columns."""
        view = pybullet.computeViewMatrix(self.eye, self.at, self.up)
        return view, pybullet.computeProjectionMatrixFOV(self.fov_deg, aspect, NEAR_M, FAR_M)

    def project(self, points_enu: Array, size: tuple[int, int]) -> Array:
        """Pixel x, y and depth of ``points_enu`` (N, 3), as in PyBullet's depth buffer; NaN behind the eye.

        Returns:
            (N, 3): x to the right, y down [pixels], depth 0 (near) to 1 (far).
        """
        width, height = size
        view, projection = (np.array(m).reshape(4, 4).T for m in self.matrices(width / height))
        clip = np.column_stack([points_enu, np.ones(len(points_enu))]) @ (projection @ view).T
        w = np.where(clip[:, 3] > NEAR_M, clip[:, 3], np.nan)
        x, y, z = clip[:, 0] / w, clip[:, 1] / w, clip[:, 2] / w
        return np.column_stack([(0.5 + 0.5 * x) * width, (0.5 - 0.5 * y) * height, 0.5 + 0.5 * z])

    def scale_px_per_m(self, p_enu: Triple, height: int) -> float:
        """How many pixels a metre across the line of sight takes at ``p_enu``."""
        distance_m = max(NEAR_M, math.dist(self.eye, p_enu))
        return height / (2.0 * distance_m * math.tan(0.5 * math.radians(self.fov_deg)))


def make_camera(name: CameraName, log: Log, since_s: float, until_s: float, aspect: float) -> Callable[[float], Camera]:
    """The camera at each time of a film from ``since_s`` to ``until_s``."""
    if name == "chase":
        return lambda t_s: chase(log, t_s)
    points = _stage(log, since_s, until_s)
    fixed = top(points, aspect) if name == "top" else overview(points, aspect)
    return lambda t_s: fixed


def overview(points: Array, aspect: float) -> Camera:
    """From the side of the longest extent and above, as near as ``points`` (N, 3) allow."""
    spread = points[:, :2] - points[:, :2].mean(axis=0)
    _, _, axes = np.linalg.svd(spread, full_matrices=False)
    along = axes[0] if axes[0] @ (1.0, 0.2) >= 0.0 else -axes[0]
    side = np.array([along[1], -along[0]])  # to the right of it
    return _fitted(points, np.array([*(side - 0.45 * along), 0.55]), (0.0, 0.0, 1.0), aspect)


def top(points: Array, aspect: float) -> Camera:
    """From above, north up."""
    return _fitted(points, np.array([0.0, 0.0, 1.0]), (0.0, 1.0, 0.0), aspect)


def chase(log: Log, t_s: float) -> Camera:
    """Behind the first vehicle and above it, looking along its path about ``t_s``."""
    x, y, z = log.at(t_s).vehicles[0].position
    ax, ay = _heading(log, t_s)
    eye = (x - _CHASE_BACK_M * ax, y - _CHASE_BACK_M * ay, z + _CHASE_UP_M)
    at = (x + _CHASE_AHEAD_M * ax, y + _CHASE_AHEAD_M * ay, z)
    return Camera(eye, at, fov_deg=55.0)


def _heading(log: Log, t_s: float) -> tuple[float, float]:
    """Unit vector from where the vehicle was to where it will be, weighed with that to its target."""
    before, after = (log.at(t_s + shift).vehicles[0] for shift in (-_CHASE_WINDOW_S, _CHASE_WINDOW_S))
    dx, dy = (after.position[i] - before.position[i] for i in range(2))
    start, goal = log.instants[0].vehicles[0], log.instants[-1].vehicles[0].target
    if goal is not None:
        # far from moving, the line from start to target leads; it never turns about as the target is passed
        gx, gy = (goal[i] - start.position[i] for i in range(2))
        length = math.hypot(gx, gy)
        if length > 0.0:
            dx, dy = dx + 1.5 * gx / length, dy + 1.5 * gy / length
    length = math.hypot(dx, dy)
    return (dx / length, dy / length) if length > 1e-6 else (1.0, 0.0)


def _stage(log: Log, since_s: float, until_s: float) -> Array:
    """Points that the fixed cameras keep in view: the paths, their targets, and the obstacles that come near."""
    shown = log.until(until_s, since_s) or (log.at(since_s),)
    paths = np.array([pose.position for instant in shown for pose in instant.vehicles])
    goals = [pose.target for pose in shown[0].vehicles if pose.target is not None]
    points: list[Sequence[float]] = [*paths.tolist(), *goals]
    balls = [ball.p_enu for instant in shown[:: max(1, len(shown) // 100)] for ball in instant.balls]
    points += [p_enu for p_enu in balls if float(np.linalg.norm(paths - p_enu, axis=1).min()) < _BALL_REACH_M]
    points += [(x, y, 0.0) for x, y, _ in points]  # and the ground below
    return np.array(points)


def _fitted(points: Array, direction: Array, up: Triple, aspect: float) -> Camera:
    """As near as the picture allows, looking at the middle from ``direction``."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    direction = direction / np.linalg.norm(direction)
    size = (round(1000 * aspect), 1000)
    near, far = 0.5, FAR_M / 2.0
    at = _triple(middle)
    for _ in range(30):
        distance = 0.5 * (near + far)
        seen = Camera(_triple(middle + distance * direction), at, up).project(points, size)[:, :2]
        inside = np.abs(seen / size - 0.5) <= 0.5 * _MARGIN
        near, far = (near, distance) if inside.all() else (distance, far)
    return Camera(_triple(middle + far * direction), at, up)


def _triple(v: Array) -> Triple:
    x, y, z = v.tolist()
    return (x, y, z)
