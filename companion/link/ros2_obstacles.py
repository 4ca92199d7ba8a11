"""ROS 2 messages to the wire's `ObstacleFrame`: positions, velocities and covariances in the header's frame (ENU).

Conventions, and where they come from:

- ``Pose`` and the position block of its covariance are in the frame of the header, metres (geometry_msgs).
- Autoware's twist and its covariance are in the *object's* frame: v = R v_object, P_v = R P_object R^T with R the
  object's stated orientation (autoware_universe, issue 6192 and pull requests 8980 and 8996).
- A variance that is not positive is one that was not stated (ROS fills unknown covariances with 0 or -1). Where some
  axes state one, the others get the largest of these; where none does, the obstacle has no stated position error.
- The radius is that of the sphere about the stated position that holds the whole box, cylinder or polygon, whatever its
  orientation: half the spatial diagonal.

Bounds of the wire contract are checked in ``link/ingress.py``; here only what its types could not say.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from companion.errors import FrameRejected
from companion.link.wire import Obstacle, ObstacleFrame, Vec
from companion.types import NS_PER_S, FloatArray

CYLINDER, POLYGON = 1, 2  # autoware_perception_msgs/Shape.type, 0 is a bounding box
ORIENTATION_UNAVAILABLE = 0  # autoware_perception_msgs/TrackedObjectKinematics.orientation_availability
VARIANCE_MIN, VARIANCE_MAX = 1e-6, 1e6  # [m^2], [m^2/s^2]; Autoware writes 1e9 for "no information"
VARIANCE_UNKNOWN = 1e4  # of a velocity that a detection does not have
MAX_NUMBER = 1e12  # of what enters arithmetic here: nothing overflows on the way to the bounds of the wire contract
MAX_ID = 64

_UPPER = np.triu_indices(6)


def frame_from_detections(message: Any, frame_ids: Collection[str]) -> ObstacleFrame:
    """A detection frame from a vision_msgs/Detection3DArray.

    Position and size are those of ``bbox``; the covariance is that of the first result. The message has no velocity.

    Raises:
        FrameRejected: ``frame_id`` where the header, or that of a detection, names another frame; ``malformed``.
    """
    detections = message.detections
    for header in (message.header, *(d.header for d in detections if d.header.frame_id)):
        _check_frame_id(header.frame_id, frame_ids)
    stated = _linear([d.results[0].pose.covariance if d.results else _NOTHING for d in detections])
    uppers = _uppers(stated.blocks, np.eye(3) * VARIANCE_UNKNOWN)
    obstacles = [
        Obstacle(
            id=_checked_id(d.id),
            position=_vec(d.bbox.center.position),
            radius=_half_diagonal(d.bbox.size),
            covariance=None if std is None else upper,
        )
        for d, upper, std in zip(detections, uppers, stated.stds, strict=True)
    ]
    return ObstacleFrame(stamp_ns=_stamp_ns(message.header), clock="unix", kind="detection", obstacles=obstacles)


def frame_from_tracked_objects(message: Any, frame_ids: Collection[str]) -> ObstacleFrame:
    """A track frame from an autoware_perception_msgs/TrackedObjects.

    An object that says its orientation is unavailable, and leaves it empty, has no velocity here: nothing tells where
    its twist points.

    Raises:
        FrameRejected: ``frame_id``; ``malformed``; ``out_of_range`` for an orientation that is no rotation.
    """
    _check_frame_id(message.header.frame_id, frame_ids)
    motions = [o.kinematics for o in message.objects]
    oriented, rotations = _rotations(motions)
    twists = [m.twist_with_covariance for m in motions]
    v_object = _bounded("twist", np.array([_vec(twist.twist.linear) for twist in twists]).reshape(-1, 3))
    velocities = (rotations @ v_object[:, :, None])[..., 0].tolist()
    p_stated = _linear([m.pose_with_covariance.covariance for m in motions])
    v_stated = _linear([twist.covariance for twist in twists])
    uppers = _uppers(p_stated.blocks, rotations @ v_stated.blocks @ np.swapaxes(rotations, 1, 2))
    obstacles = []
    for k, item in enumerate(message.objects):
        p_std, v_std = p_stated.stds[k], v_stated.stds[k] if oriented[k] else None
        obstacles.append(
            Obstacle(
                id=_uuid(item.object_id.uuid),
                position=_vec(motions[k].pose_with_covariance.pose.position),
                radius=_shape_radius(item.shape),
                velocity=tuple(velocities[k]) if oriented[k] else None,
                covariance=None if p_std is None or v_std is None else uppers[k],
                position_std=p_std,
                velocity_std=v_std,
            )
        )
    return ObstacleFrame(stamp_ns=_stamp_ns(message.header), clock="unix", kind="track", obstacles=obstacles)


_NOTHING = np.zeros(36)


def _check_frame_id(frame_id: str, frame_ids: Collection[str]) -> None:
    if frame_id not in frame_ids:
        expected = " or ".join(frame_ids)
        raise FrameRejected("frame_id", f"header.frame_id: expected {expected}, got {frame_id[:64]!r}")


def _stamp_ns(header: Any) -> int:
    """Unix nanoseconds of a header."""
    nanosec = int(header.stamp.nanosec)
    if nanosec >= NS_PER_S:
        raise FrameRejected("malformed", f"header.stamp.nanosec: expected below {NS_PER_S}, got {nanosec}")
    return int(header.stamp.sec) * NS_PER_S + nanosec


def _bounded(name: str, values: FloatArray) -> FloatArray:
    if not (np.abs(values) <= MAX_NUMBER).all():  # false for what is not a number, too
        raise FrameRejected("out_of_range", f"{name}: expected finite numbers within +-{MAX_NUMBER:g}")
    return values


def _vec(v: Any) -> Vec:
    return (float(v.x), float(v.y), float(v.z))


def _checked_id(name: str) -> str | None:
    if len(name) > MAX_ID:
        raise FrameRejected("malformed", f"id: expected at most {MAX_ID} characters, got {len(name)}")
    return name or None


def _uuid(values: Any) -> str | None:
    """32 hexadecimal digits; the nil UUID names nothing."""
    data = bytes(values)
    return data.hex() if any(data) else None


def _half_diagonal(size: Any) -> float:
    return 0.5 * math.hypot(*_vec(size))


def _shape_radius(shape: Any) -> float:
    """Of the sphere about the object's origin that holds it; a cylinder's x and y are its diameter."""
    x, y, z = _vec(shape.dimensions)
    if shape.type == CYLINDER:
        return 0.5 * math.hypot(max(abs(x), abs(y)), z)
    radius = 0.5 * math.hypot(x, y, z)
    if shape.type == POLYGON:
        # footprint in the object's frame, dimensions.z its height (x and y may be left 0)
        for point in shape.footprint.points:
            radius = max(radius, math.hypot(float(point.x), float(point.y), abs(float(point.z)) + 0.5 * abs(z)))
    return radius


def _rotations(motions: Sequence[Any]) -> tuple[list[bool], FloatArray]:
    """Which objects state an orientation, and header_from_object of each as a matrix, (N, 3, 3)."""
    poses = [m.pose_with_covariance.pose.orientation for m in motions]
    q = _bounded("orientation", np.array([(o.w, o.x, o.y, o.z) for o in poses], dtype=np.float64).reshape(-1, 4))
    norm = np.sqrt(np.einsum("ni,ni->n", q, q))
    oriented = [
        not (m.orientation_availability == ORIENTATION_UNAVAILABLE and n == 0.0)
        for m, n in zip(motions, norm.tolist(), strict=True)
    ]
    for k, (has, n) in enumerate(zip(oriented, norm.tolist(), strict=True)):
        if has and not 0.9 < n < 1.1:
            raise FrameRejected("out_of_range", f"objects[{k}]: orientation: expected a unit quaternion, norm {n:g}")
    w, x, y, z = np.where(norm > 0.0, q.T / np.where(norm > 0.0, norm, 1.0), [[1.0], [0.0], [0.0], [0.0]])
    rows = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    return oriented, np.moveaxis(np.array(rows), 2, 0)


@dataclass(frozen=True, slots=True)
class _Linear:
    """Linear 3x3 blocks of N covariances, positive definite, and the deviation of the axis in which least is known.

    ``stds`` is None where no variance is stated; the block means nothing there.
    """

    blocks: FloatArray  # (N, 3, 3)
    stds: list[float | None]


def _linear(covariances: Sequence[Any]) -> _Linear:
    """The linear blocks of row-major 6x6 covariances.

    Raises:
        FrameRejected: a block that is not finite, or has a clearly negative eigenvalue.
    """
    blocks = _bounded("covariance", np.array(covariances, dtype=np.float64).reshape(-1, 6, 6)[:, :3, :3])
    diagonal = np.einsum("nii->ni", blocks)
    stated = diagonal > 0.0
    blocks = np.where(stated[:, :, None] & stated[:, None, :], 0.5 * (blocks + np.swapaxes(blocks, 1, 2)), 0.0)
    largest = diagonal.max(axis=1, initial=0.0)
    np.einsum("nii->ni", blocks)[:] = np.where(stated, diagonal, largest[:, None])
    values, vectors = np.linalg.eigh(blocks)
    if (values[:, :1] < -1e-6 * values[:, 2:]).any():
        raise FrameRejected("out_of_range", "covariance: expected no negative eigenvalue")
    values = np.clip(values, VARIANCE_MIN, VARIANCE_MAX)
    stds = np.sqrt(values[:, 2]).tolist()
    return _Linear(
        (vectors * values[:, None, :]) @ np.swapaxes(vectors, 1, 2),
        [std if known else None for std, known in zip(stds, stated.any(axis=1).tolist(), strict=True)],
    )


def _uppers(positions: FloatArray, velocities: FloatArray) -> list[list[float]]:
    """Upper triangles of 6x6 over (position, velocity) from their (N, 3, 3) blocks, nothing between the two."""
    matrices = np.zeros((len(positions), 6, 6))
    matrices[:, :3, :3], matrices[:, 3:, 3:] = positions, velocities
    found: list[list[float]] = matrices[:, _UPPER[0], _UPPER[1]].tolist()
    return found
