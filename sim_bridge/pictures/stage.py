"""The scene in PyBullet, drawn by its software renderer (TinyRenderer, no display and no graphics card needed).

Vehicles are a Crazyflie's shape enlarged to its collision sphere, so that the attitude is seen; obstacles are balls of
their true size; the ground is a board of 1 m squares.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any

import numpy as np
import pybullet
from numpy.typing import NDArray
from PIL import Image

from sim_bridge.crazyflie import Triple
from sim_bridge.pictures.camera import Camera
from sim_bridge.pictures.log import Instant

Color = tuple[float, float, float, float]
BALL_COLORS: tuple[Color, ...] = (
    (0.86, 0.26, 0.16, 1.0),
    (0.93, 0.55, 0.10, 1.0),
    (0.70, 0.20, 0.45, 1.0),
    (0.80, 0.42, 0.30, 1.0),
)
_SKY_HIGH, _SKY_LOW = np.array([150.0, 182.0, 214.0]), np.array([232.0, 240.0, 247.0])
_TILES = ((206, 212, 208), (190, 198, 194))
_BODY: Color = (0.13, 0.15, 0.18, 1.0)
_FRONT: Color = (0.95, 0.72, 0.08, 1.0)  # rotors at the nose
_REAR: Color = (0.10, 0.42, 0.75, 1.0)
TARGET: Color = (0.16, 0.62, 0.30, 1.0)
TARGET_RADIUS_M = 0.1  # as drawn
_AWAY: Triple = (0.0, 0.0, -1000.0)
_LEVEL = (0.0, 0.0, 0.0, 1.0)
_GROUND_M = 60  # squares a side, even


@dataclass(frozen=True, slots=True)
class Shot:
    """A rendered picture: colours, PyBullet's depth buffer, and the body at each pixel (-1: none)."""

    rgb: NDArray[np.uint8]  # (H, W, 3)
    depth: NDArray[np.float64]  # (H, W)
    body: NDArray[np.int64]  # (H, W)
    ground: int  # the number of the ground there


class Stage:
    """A PyBullet client with the bodies of a flight.

    Args:
        first: an instant of the flight, for the number and size of the vehicles.
        balls: id and radius of every obstacle that will ever be seen [m].
        middle_enu: about which the ground lies.
    """

    def __init__(self, first: Instant, balls: Sequence[tuple[str, float]], middle_enu: Triple) -> None:
        self._client = pybullet.connect(pybullet.DIRECT)
        with TemporaryDirectory(prefix="sim-bridge-render-") as folder:
            ball = Path(folder, "ball.obj")
            ball.write_text(_ball_mesh(), encoding="utf-8")
            self.ground = self._build_ground(Path(folder), middle_enu)
            self.vehicles = [self._build_vehicle(pose.radius_m) for pose in first.vehicles]
            self.balls = {
                name: self._build_ball(ball, radius_m, BALL_COLORS[i % len(BALL_COLORS)])
                for i, (name, radius_m) in enumerate(balls)
            }
            self._targets = [self._build_ball(ball, TARGET_RADIUS_M, TARGET) for _ in first.vehicles]

    def show(self, instant: Instant) -> None:
        """Put every body where it is at ``instant``."""
        for body, target, pose in zip(self.vehicles, self._targets, instant.vehicles, strict=True):
            w, x, y, z = pose.attitude
            self._place(body, pose.position, (x, y, z, w))
            self._place(target, _AWAY if pose.target is None else pose.target)
        here = {ball.id: ball.p_enu for ball in instant.balls}
        for name, body in self.balls.items():
            self._place(body, here.get(name, _AWAY))

    def take(self, camera: Camera, size: tuple[int, int]) -> Shot:
        """The picture of ``size`` pixels that ``camera`` sees."""
        width, height = size
        view, projection = camera.matrices(width / height)
        _, _, rgba, depth, body = pybullet.getCameraImage(
            width,
            height,
            view,
            projection,
            lightDirection=(-3.0, -4.0, 9.0),
            lightColor=(1.0, 1.0, 1.0),
            lightAmbientCoeff=0.62,
            lightDiffuseCoeff=0.45,
            lightSpecularCoeff=0.05,
            shadow=0,  # the renderer's darkens half of a wide ground: `overlay` draws them
            renderer=pybullet.ER_TINY_RENDERER,
            physicsClientId=self._client,
        )
        rgb = np.reshape(rgba, (height, width, 4))[..., :3].astype(np.uint8)
        bodies = np.reshape(body, (height, width)).astype(np.int64)
        sky = np.linspace(0.0, 1.0, height)[:, None]
        fill = ((1.0 - sky) * _SKY_HIGH + sky * _SKY_LOW).astype(np.uint8)[:, None, :]
        rgb = np.where((bodies < 0)[..., None], fill, rgb).astype(np.uint8)
        return Shot(rgb, np.reshape(depth, (height, width)).astype(np.float64), bodies, self.ground)

    def close(self) -> None:
        pybullet.disconnect(self._client)

    def __enter__(self) -> Stage:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _place(self, body: int, p_enu: Triple, q_xyzw: tuple[float, float, float, float] = _LEVEL) -> None:
        pybullet.resetBasePositionAndOrientation(body, p_enu, q_xyzw, physicsClientId=self._client)

    def _build_ball(self, mesh: Path, radius_m: float, color: Color) -> int:
        shape = pybullet.createVisualShape(
            pybullet.GEOM_MESH,
            fileName=str(mesh),
            meshScale=[radius_m] * 3,
            rgbaColor=color,
            physicsClientId=self._client,
        )
        return self._body(shape)

    def _build_vehicle(self, radius_m: float) -> int:
        """Two arms, four rotors and a battery that fill the collision sphere; yellow rotors at the nose."""
        reach, rotor = 0.62 * radius_m, 0.36 * radius_m
        d = reach / math.sqrt(2.0)
        eighth = math.sin(math.pi / 8.0), math.cos(math.pi / 8.0)
        cylinder, box = pybullet.GEOM_CYLINDER, pybullet.GEOM_BOX
        corners = ((d, d), (-d, d), (-d, -d), (d, -d))
        motors: Any = {"lengths": 0.10 * radius_m, "radii": 0.09 * radius_m}
        thin = [0.08 * radius_m, 0.05 * radius_m]
        shape = pybullet.createVisualShapeArray(
            shapeTypes=[box] * 3 + [cylinder] * 8,
            halfExtents=[[reach, *thin], [reach, *thin], [0.22 * radius_m, 0.15 * radius_m, 0.12 * radius_m]]
            + [[0.0] * 3] * 8,
            radii=[0.0] * 3 + [rotor] * 4 + [motors["radii"]] * 4,
            lengths=[0.0] * 3 + [0.03 * radius_m] * 4 + [motors["lengths"]] * 4,
            visualFramePositions=[[0.0] * 3, [0.0] * 3, [0.0, 0.0, 0.10 * radius_m]]
            + [[x, y, 0.16 * radius_m] for x, y in corners]
            + [[x, y, 0.08 * radius_m] for x, y in corners],
            visualFrameOrientations=[[0.0, 0.0, eighth[0], eighth[1]], [0.0, 0.0, -eighth[0], eighth[1]]]
            + [list(_LEVEL)] * 9,
            rgbaColors=[_BODY, _BODY, _BODY, _FRONT, _REAR, _REAR, _FRONT] + [_BODY] * 4,
            physicsClientId=self._client,
        )
        return self._body(shape)

    def _build_ground(self, folder: Path, middle_enu: Triple) -> int:
        half = _GROUND_M // 2
        x0, y0 = math.floor(middle_enu[0]), math.floor(middle_enu[1])
        cells = 8  # pixels a square: the renderer takes the nearest one
        board = np.array([[_TILES[(i + j) % 2] for j in range(_GROUND_M)] for i in range(_GROUND_M)], np.uint8)
        texture = folder / "ground.png"
        Image.fromarray(np.kron(board, np.ones((cells, cells, 1), np.uint8))).save(texture)
        mesh = folder / "ground.obj"
        corners = [(-half, -half), (half, -half), (half, half), (-half, half)]
        lines = [f"v {x0 + x} {y0 + y} 0" for x, y in corners]
        lines += ["vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1", "vn 0 0 1", "f 1/1/1 2/2/1 3/3/1", "f 1/1/1 3/3/1 4/4/1"]
        mesh.write_text("\n".join(lines) + "\n", encoding="utf-8")
        client = self._client
        shape = pybullet.createVisualShape(pybullet.GEOM_MESH, fileName=str(mesh), physicsClientId=client)
        body = self._body(shape)
        number = pybullet.loadTexture(str(texture), physicsClientId=client)
        pybullet.changeVisualShape(body, -1, textureUniqueId=number, physicsClientId=client)
        return body

    def _body(self, shape: int) -> int:
        number: int = pybullet.createMultiBody(0.0, -1, shape, physicsClientId=self._client)
        return number


def _ball_mesh(rings: int = 16, sectors: int = 32) -> str:
    """A unit ball as Wavefront OBJ: rounder than the renderer's own."""
    points = [
        (math.sin(a) * math.cos(b), math.sin(a) * math.sin(b), math.cos(a))
        for a in (math.pi * i / rings for i in range(rings + 1))
        for b in (math.tau * j / sectors for j in range(sectors))
    ]
    lines = [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in points]
    lines += [f"vn {x:.5f} {y:.5f} {z:.5f}" for x, y, z in points]
    for i in range(rings):
        for j in range(sectors):
            a, b = i * sectors + j + 1, i * sectors + (j + 1) % sectors + 1
            c, d = a + sectors, b + sectors
            lines += [f"f {a}//{a} {c}//{c} {d}//{d}", f"f {a}//{a} {d}//{d} {b}//{b}"]
    return "\n".join(lines) + "\n"
