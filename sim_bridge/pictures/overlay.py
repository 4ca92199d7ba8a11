"""What is drawn over a rendered picture: shadows, the paths flown, the ring of each collision sphere, a line of text.

Paths go behind what stands before them: a piece is drawn where its depth is less than the picture's. Shadows fall
straight down, so that they tell where on the ground something is; they are drawn where the picture shows the ground.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageChops, ImageDraw, ImageFont

from sim_bridge.crazyflie import Triple
from sim_bridge.pictures.camera import Array, Camera
from sim_bridge.pictures.log import Instant, Log
from sim_bridge.pictures.stage import BALL_COLORS, Shot

Ink = tuple[int, int, int, int]
PATH_INKS: tuple[Ink, ...] = ((20, 90, 200, 255), (120, 40, 160, 255), (0, 120, 110, 255), (90, 90, 20, 255))
RING_INK: Ink = (20, 110, 220, 230)
TOUCHED_INK: Ink = (215, 20, 20, 255)
NEAR_M = 0.3  # below this clearance the ring is amber
NEAR_INK: Ink = (225, 130, 0, 255)
BALL_TRAIL_S = 1.5
_RING_POINTS = 64
_DEPTH_SLACK = 2e-4


def overlay(
    shot: Shot, log: Log, instant: Instant, camera: Camera, *, since_s: float, ids: Sequence[str]
) -> Image.Image:
    """The picture with its paths since ``since_s``, rings and caption; ``ids`` in the order of their colours."""
    height, width = shot.depth.shape
    layer = Image.new("RGBA", (width, height), (0, 0, 0, 0))
    pen = ImageDraw.Draw(layer)
    stroke = max(1, round(height / 140))
    for name in ids:
        r, g, b, _ = BALL_COLORS[list(ids).index(name) % len(BALL_COLORS)]
        trail = _ball_trail(log, instant, name)
        _path(pen, trail, camera, shot.depth, (round(255 * r), round(255 * g), round(255 * b), 150), stroke)
    for index in range(len(instant.vehicles)):
        flown = [past.vehicles[index].position for past in log.until(instant.t_s, since_s)]
        path = np.array([*flown, instant.vehicles[index].position])
        _path(pen, path, camera, shot.depth, PATH_INKS[index % len(PATH_INKS)], stroke)
    for pose in instant.vehicles:
        _ring(pen, pose.position, pose.radius_m, camera, (width, height), _ring_ink(pose.clearance_m), stroke)
    shaded = Image.alpha_composite(Image.fromarray(shot.rgb).convert("RGBA"), _shadows(shot, instant, camera))
    picture = Image.alpha_composite(shaded, layer)
    _caption(picture, instant)
    return picture.convert("RGB")


def _shadows(shot: Shot, instant: Instant, camera: Camera) -> Image.Image:
    """A dark disc below every vehicle and ball, fainter with height."""
    height, width = shot.depth.shape
    alpha = Image.new("L", (width, height), 0)
    pen = ImageDraw.Draw(alpha)
    angles = np.linspace(0.0, 2.0 * np.pi, _RING_POINTS)
    things = [(pose.position, pose.radius_m) for pose in instant.vehicles]
    things += [(ball.p_enu, ball.radius_m) for ball in instant.balls]
    for (x, y, z), radius_m in things:
        disc = np.column_stack([x + radius_m * np.cos(angles), y + radius_m * np.sin(angles), np.zeros(_RING_POINTS)])
        seen = camera.project(disc, (width, height))[:, :2]
        if np.isfinite(seen).all() and z > 0.0:
            pen.polygon([tuple(point) for point in seen], fill=round(110 / (1.0 + 0.25 * z)))
    on_ground = Image.fromarray(np.where(shot.body == shot.ground, 255, 0).astype(np.uint8))
    black = Image.new("RGBA", (width, height), (20, 30, 40, 255))
    black.putalpha(ImageChops.multiply(alpha, on_ground))
    return black


def _ball_trail(log: Log, instant: Instant, name: str) -> Array:
    past = log.until(instant.t_s, instant.t_s - BALL_TRAIL_S)
    points = [ball.p_enu for seen in (*past, instant) for ball in seen.balls if ball.id == name]
    return np.array(points).reshape(-1, 3)


def _path(
    pen: ImageDraw.ImageDraw, points: Array, camera: Camera, depth: NDArray[np.float64], ink: Ink, stroke: int
) -> None:
    if len(points) < 2:
        return
    height, width = depth.shape
    fine = _densified(points)
    seen = camera.project(fine, (width, height))
    x, y, z = seen.T
    with np.errstate(invalid="ignore"):
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    column, row = (np.where(inside, v, 0.0).astype(int) for v in (x, y))
    shown = inside & (np.where(inside, z, 2.0) <= depth[row, column] + _DEPTH_SLACK)
    for i in range(len(fine) - 1):
        if shown[i] and shown[i + 1]:
            pen.line([tuple(seen[i, :2]), tuple(seen[i + 1, :2])], fill=ink, width=stroke)


def _densified(points: Array, step_m: float = 0.05) -> Array:
    """More points on the same line, so that it can end where it goes behind something."""
    pieces = []
    for a, b in itertools.pairwise(points):
        count = max(1, int(np.linalg.norm(b - a) / step_m))
        pieces.append(a + np.linspace(0.0, 1.0, count, endpoint=False)[:, None] * (b - a))
    return np.vstack([*pieces, points[-1:]])


def _ring(
    pen: ImageDraw.ImageDraw,
    center_enu: Triple,
    radius_m: float,
    camera: Camera,
    size: tuple[int, int],
    ink: Ink,
    stroke: int,
) -> None:
    """The outline of a sphere: a circle about its centre across the line of sight."""
    sight = np.array(center_enu) - camera.eye
    sight /= np.linalg.norm(sight)
    right = np.cross(sight, camera.up)
    right /= np.linalg.norm(right)
    angles = np.linspace(0.0, 2.0 * np.pi, _RING_POINTS + 1)[:, None]
    circle = center_enu + radius_m * (np.cos(angles) * right + np.sin(angles) * np.cross(right, sight))
    outline = camera.project(circle, size)[:, :2]
    if not np.isfinite(outline).all():
        return
    corners = [tuple(point) for point in outline]
    pen.polygon(corners, fill=(*ink[:3], 45))
    pen.line(corners, fill=ink, width=max(1, stroke // 2))


def _ring_ink(clearance_m: float | None) -> Ink:
    if clearance_m is None or clearance_m > NEAR_M:
        return RING_INK
    return NEAR_INK if clearance_m > 0.0 else TOUCHED_INK


def _caption(picture: Image.Image, instant: Instant) -> None:
    first = instant.vehicles[0]
    text = f"{instant.t_s:.2f} s   {first.mode}"
    if first.clearance_m is not None:
        text += f"   clearance {first.clearance_m:.2f} m"
    size = max(10, picture.height // 24)
    pen = ImageDraw.Draw(picture)
    pen.text((size // 2, size // 2), text, fill=(25, 30, 40, 255), font=ImageFont.load_default(size))
