"""What Foxglove draws of a tick: vehicle, target, obstacles with their covariance, prediction and keep-out sphere.

Colours are those of Okabe and Ito, which colour-blind people tell apart.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import msgspec
import numpy as np

from companion import foxglove as fox
from companion.link.geo import TangentPlane
from companion.link.wire import MarginOut, SetpointRecord, TrackOut, TracksOut, Vec, VehicleOut
from companion.types import FloatArray, frozen

LIFETIME = fox.Duration(0, 500_000_000)  # of what is drawn anew ten times a second
SIGMAS = 2.0  # of the covariance ellipsoid
THIN_M = 0.02

BLUE, ORANGE, GREEN = (0.0, 0.447, 0.698), (0.902, 0.624, 0.0), (0.0, 0.62, 0.451)
VERMILION, SKY, GREY = (0.835, 0.369, 0.0), (0.337, 0.706, 0.914), (0.5, 0.5, 0.5)

_IDENTITY = fox.Quaternion(0.0, 0.0, 0.0, 1.0)
_ORIGIN = fox.Pose(fox.Vector3(0.0, 0.0, 0.0), _IDENTITY)


@dataclass(frozen=True, slots=True)
class Moment:
    """One tick as it is drawn."""

    vehicle: VehicleOut
    record: SetpointRecord
    tracks: TracksOut | None
    target: Vec | None
    drone_radius_m: float
    arena: tuple[Vec, Vec]  # two opposite corners
    origin: TangentPlane | None


def transform(moment: Moment) -> fox.FrameTransform:
    """Where the vehicle's body is."""
    w, x, y, z = moment.vehicle.attitude
    return fox.FrameTransform(
        timestamp=fox.time_of(moment.vehicle.stamp_ns),
        parent_frame_id=fox.WORLD,
        child_frame_id=fox.BODY,
        translation=fox.Vector3(*moment.vehicle.position),
        rotation=fox.Quaternion(x, y, z, w),
    )


def location(moment: Moment) -> fox.LocationFix | None:
    """Where on earth the vehicle is, where the origin of its local frame is known."""
    if moment.origin is None:
        return None
    latitude, longitude, altitude = moment.origin.geodetic(frozen(moment.vehicle.position))
    return fox.LocationFix(
        timestamp=fox.time_of(moment.vehicle.stamp_ns),
        frame_id=fox.BODY,
        latitude=latitude,
        longitude=longitude,
        altitude=altitude,
    )


def scene(moment: Moment) -> fox.SceneUpdate:
    """Everything but the vehicle's path."""
    entities = [_vehicle(moment), _arena(moment)]
    if moment.target is not None:
        entities.append(_target(moment, moment.target))
    if moment.tracks is not None:
        margins = {row.track: row.margin for row in moment.record.rows}
        entities += [_track(moment, track, margins.get(track.id)) for track in moment.tracks.tracks]
    return fox.SceneUpdate(entities=entities)


def ellipsoid(centre: Vec, covariance: FloatArray, sigmas: float) -> tuple[fox.Pose, fox.Vector3]:
    """Pose and diameters of {x : (x - c)' P^-1 (x - c) = sigmas^2}: its axes are the eigenvectors of P.

    Args:
        covariance: P, shape (3, 3) [m^2].
    """
    variances, axes = np.linalg.eigh(covariance)
    if np.linalg.det(axes) < 0.0:
        axes = axes * (1.0, 1.0, -1.0)  # a rotation, not a reflection
    a, b, c = (2.0 * sigmas * np.sqrt(np.maximum(variances, 1e-12))).tolist()
    return fox.Pose(fox.Vector3(*centre), _quaternion(axes)), fox.Vector3(a, b, c)


def _quaternion(rotation: FloatArray) -> fox.Quaternion:
    """The unit quaternion of a rotation matrix, by its largest component (Shepperd 1978)."""
    r = rotation.tolist()
    squares = [
        1.0 + r[0][0] - r[1][1] - r[2][2],
        1.0 - r[0][0] + r[1][1] - r[2][2],
        1.0 - r[0][0] - r[1][1] + r[2][2],
        1.0 + r[0][0] + r[1][1] + r[2][2],
    ]
    xy, xz, yz = r[0][1] + r[1][0], r[0][2] + r[2][0], r[1][2] + r[2][1]
    wx, wy, wz = r[2][1] - r[1][2], r[0][2] - r[2][0], r[1][0] - r[0][1]
    columns = ((squares[0], xy, xz, wx), (xy, squares[1], yz, wy), (xz, yz, squares[2], wz), (wx, wy, wz, squares[3]))
    chosen = max(range(4), key=lambda index: squares[index])
    scale = 0.5 / float(np.sqrt(squares[chosen]))
    return fox.Quaternion(*(scale * part for part in columns[chosen]))


def _entity(moment: Moment, name: str, parts: dict[str, list[object]], **about: str) -> fox.SceneEntity:
    return fox.SceneEntity(
        timestamp=fox.time_of(moment.vehicle.stamp_ns),
        frame_id=fox.WORLD,
        id=name,
        lifetime=LIFETIME,
        metadata=[fox.KeyValuePair(key, value) for key, value in about.items()],
        **parts,  # type: ignore[arg-type]
    )


def _vehicle(moment: Moment) -> fox.SceneEntity:
    """Its sphere, and the reference and the safe acceleration as arrows of 1 m for 3 m/s^2."""
    vehicle, record = moment.vehicle, moment.record
    size = 2.0 * moment.drone_radius_m
    ball = fox.SpherePrimitive(pose=_at(vehicle.position), size=fox.Vector3(size, size, size), color=_color(BLUE, 0.9))
    arrows = [_arrow(vehicle.position, record.u_ref, GREY), _arrow(vehicle.position, record.u_safe, GREEN)]
    label = _text(vehicle.position, moment.drone_radius_m, f"{record.state} {record.verdict}")
    drawn: dict[str, list[object]] = {"spheres": [ball], "texts": [label]}
    drawn["arrows"] = [arrow for arrow in arrows if arrow is not None]
    return _entity(moment, "vehicle", drawn, state=record.state, verdict=record.verdict)


def _target(moment: Moment, target: Vec) -> fox.SceneEntity:
    cube = fox.CubePrimitive(pose=_at(target), size=fox.Vector3(0.2, 0.2, 0.2), color=_color(GREEN, 0.9))
    return _entity(moment, "target", {"cubes": [cube], "texts": [_text(target, 0.2, "target")]})


def _arena(moment: Moment) -> fox.SceneEntity:
    (x0, y0, z0), (x1, y1, z1) = moment.arena
    corners = [fox.Point3(x, y, z) for z in (z0, z1) for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]
    edges = [0, 1, 1, 2, 2, 3, 3, 0, 4, 5, 5, 6, 6, 7, 7, 4, 0, 4, 1, 5, 2, 6, 3, 7]
    box = fox.LinePrimitive(
        type=2,
        pose=_ORIGIN,
        thickness=1.0,
        scale_invariant=True,
        points=corners,
        color=_color(GREY, 0.6),
        indices=edges,
    )
    return _entity(moment, "arena", {"lines": [box]})


def _track(moment: Moment, track: TrackOut, margin: MarginOut | None) -> fox.SceneEntity:
    """The obstacle's sphere, its two-sigma ellipsoid, the prediction, and the keep-out of its worst row."""
    diameter = 2.0 * track.radius
    body = VERMILION if track.status == "confirmed" else ORANGE
    pose, size = ellipsoid(track.position, _position_covariance(track.covariance), SIGMAS)
    spheres = [
        fox.SpherePrimitive(
            pose=_at(track.position), size=fox.Vector3(diameter, diameter, diameter), color=_color(body, 0.9)
        ),
        fox.SpherePrimitive(pose=pose, size=size, color=_color(SKY, 0.3)),
    ]
    if margin is not None:
        keep_out = 2.0 * (margin.radii + margin.cushion + margin.sigma + margin.delay)
        around = fox.Vector3(keep_out, keep_out, keep_out)
        spheres.append(fox.SpherePrimitive(pose=_at(track.position), size=around, color=_color(ORANGE, 0.12)))
    drawn: dict[str, list[object]] = {"spheres": [*spheres], "texts": [_text(track.position, track.radius, track.id)]}
    if track.predicted:
        points = [fox.Point3(*point) for point in track.predicted]
        drawn["lines"] = [
            fox.LinePrimitive(
                type=0, pose=_ORIGIN, thickness=THIN_M, scale_invariant=False, points=points, color=_color(body, 0.9)
            )
        ]
    return _entity(moment, f"track {track.id}", drawn, status=track.status, sources=", ".join(track.sources))


def _position_covariance(upper: list[float]) -> FloatArray:
    """The position block (3, 3) of the upper triangle of 6x6."""
    xx, xy, xz, yy, yz, zz = upper[0], upper[1], upper[2], upper[6], upper[7], upper[11]
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _arrow(tail: Vec, a: Vec | None, colour: Vec) -> fox.ArrowPrimitive | None:
    length = 0.0 if a is None else float(np.linalg.norm(a)) / 3.0
    if a is None or length < 1e-3:
        return None
    head = min(0.15, 0.5 * length)
    return fox.ArrowPrimitive(
        pose=fox.Pose(fox.Vector3(*tail), _towards(a)),
        shaft_length=length - head,
        shaft_diameter=0.04,
        head_length=head,
        head_diameter=0.09,
        color=_color(colour, 1.0),
    )


def _towards(direction: Vec) -> fox.Quaternion:
    """The shortest rotation of +x into ``direction``."""
    x, y, z = (np.asarray(direction) / np.linalg.norm(direction)).tolist()
    if x < -1.0 + 1e-9:
        return fox.Quaternion(0.0, 0.0, 1.0, 0.0)
    norm = float(np.sqrt(2.0 + 2.0 * x))
    return fox.Quaternion(0.0, -z / norm, y / norm, 0.5 * norm)


def _text(position: Vec, above_m: float, text: str) -> fox.TextPrimitive:
    x, y, z = position
    return fox.TextPrimitive(
        pose=_at((x, y, z + above_m + 0.15)),
        billboard=True,
        font_size=14.0,
        scale_invariant=True,
        color=_color(GREY, 1.0),
        text=text,
    )


def _at(position: Vec) -> fox.Pose:
    return fox.Pose(fox.Vector3(*position), _IDENTITY)


def _color(rgb: Vec, alpha: float) -> fox.Color:
    return fox.Color(*rgb, alpha)


PATH_EVERY_NS, PATH_POINTS = 1_000_000_000, 300


class Artist:
    """Draws moments at a limited rate, and the path flown so far once a second. Used from the writer's thread alone."""

    def __init__(self) -> None:
        self._path: list[fox.Pose] = []
        self._path_ns = 0

    def draw(self, moment: Moment) -> Iterator[tuple[str, msgspec.Struct]]:
        """Topics and messages of one moment."""
        yield "/foxglove/tf", transform(moment)
        yield "/foxglove/scene", scene(moment)
        stamp_ns = moment.vehicle.stamp_ns
        w, x, y, z = moment.vehicle.attitude
        self._path.append(fox.Pose(fox.Vector3(*moment.vehicle.position), fox.Quaternion(x, y, z, w)))
        del self._path[:-PATH_POINTS]
        if not 0 <= stamp_ns - self._path_ns < PATH_EVERY_NS:
            self._path_ns = stamp_ns
            time = fox.time_of(stamp_ns)
            yield "/foxglove/path", fox.PosesInFrame(timestamp=time, frame_id=fox.WORLD, poses=list(self._path))
            if (fix := location(moment)) is not None:
                yield "/foxglove/location", fix
