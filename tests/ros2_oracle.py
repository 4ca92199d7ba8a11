"""The two ROS 2 messages in a second CDR library (pycdr2, of Cyclone DDS): written here, read by the daemon's door.

Nothing of the door is used. `serialize(endianness=...)` puts the encapsulation header in front, as rmw_zenoh does.
No `from __future__ import annotations`: pycdr2 reads them as types.
"""

import math
from dataclasses import dataclass, field

from pycdr2 import Endianness, IdlStruct
from pycdr2.types import array, float32, float64, int32, sequence, uint8, uint32

ENDIAN = {"little": Endianness.Little, "big": Endianness.Big}
ZERO36 = [0.0] * 36


@dataclass
class Time(IdlStruct):
    sec: int32 = 0
    nanosec: uint32 = 0


@dataclass
class Header(IdlStruct):
    stamp: Time = field(default_factory=Time)
    frame_id: str = "map"


@dataclass
class Xyz(IdlStruct):
    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass
class Point32(IdlStruct):
    x: float32 = 0.0
    y: float32 = 0.0
    z: float32 = 0.0


@dataclass
class Quaternion(IdlStruct):
    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0
    w: float64 = 1.0


@dataclass
class Pose(IdlStruct):
    position: Xyz = field(default_factory=Xyz)
    orientation: Quaternion = field(default_factory=Quaternion)


@dataclass
class PoseWithCovariance(IdlStruct):
    pose: Pose = field(default_factory=Pose)
    covariance: array[float64, 36] = field(default_factory=lambda: list(ZERO36))


@dataclass
class Twist(IdlStruct):
    linear: Xyz = field(default_factory=Xyz)
    angular: Xyz = field(default_factory=Xyz)


@dataclass
class TwistWithCovariance(IdlStruct):
    twist: Twist = field(default_factory=Twist)
    covariance: array[float64, 36] = field(default_factory=lambda: list(ZERO36))


@dataclass
class ObjectHypothesis(IdlStruct):
    class_id: str = ""
    score: float64 = 0.0


@dataclass
class ObjectHypothesisWithPose(IdlStruct):
    hypothesis: ObjectHypothesis = field(default_factory=ObjectHypothesis)
    pose: PoseWithCovariance = field(default_factory=PoseWithCovariance)


@dataclass
class BoundingBox3D(IdlStruct):
    center: Pose = field(default_factory=Pose)
    size: Xyz = field(default_factory=Xyz)


@dataclass
class Detection3D(IdlStruct):
    header: Header = field(default_factory=Header)
    results: sequence[ObjectHypothesisWithPose] = field(default_factory=list)
    bbox: BoundingBox3D = field(default_factory=BoundingBox3D)
    id: str = ""


@dataclass
class Detection3DArray(IdlStruct):
    header: Header = field(default_factory=Header)
    detections: sequence[Detection3D] = field(default_factory=list)


@dataclass
class OldDetection3D(IdlStruct):
    """Without id, as before vision_msgs 4 (its point cloud left out: the point is that the length is another)."""

    header: Header = field(default_factory=Header)
    results: sequence[ObjectHypothesisWithPose] = field(default_factory=list)
    bbox: BoundingBox3D = field(default_factory=BoundingBox3D)


@dataclass
class OldDetection3DArray(IdlStruct):
    header: Header = field(default_factory=Header)
    detections: sequence[OldDetection3D] = field(default_factory=list)


@dataclass
class UUID(IdlStruct):
    uuid: array[uint8, 16] = field(default_factory=lambda: [0] * 16)


@dataclass
class ObjectClassification(IdlStruct):
    label: uint8 = 0
    probability: float32 = 0.0


@dataclass
class Kinematics(IdlStruct):
    pose_with_covariance: PoseWithCovariance = field(default_factory=PoseWithCovariance)
    twist_with_covariance: TwistWithCovariance = field(default_factory=TwistWithCovariance)
    acceleration_with_covariance: TwistWithCovariance = field(default_factory=TwistWithCovariance)  # same layout
    orientation_availability: uint8 = 2
    is_stationary: bool = False


@dataclass
class Polygon(IdlStruct):
    points: sequence[Point32] = field(default_factory=list)


@dataclass
class Shape(IdlStruct):
    type: uint8 = 0
    footprint: Polygon = field(default_factory=Polygon)
    dimensions: Xyz = field(default_factory=Xyz)


@dataclass
class TrackedObject(IdlStruct):
    object_id: UUID = field(default_factory=UUID)
    existence_probability: float32 = 0.0
    classification: sequence[ObjectClassification] = field(default_factory=list)
    kinematics: Kinematics = field(default_factory=Kinematics)
    shape: Shape = field(default_factory=Shape)


@dataclass
class TrackedObjects(IdlStruct):
    header: Header = field(default_factory=Header)
    objects: sequence[TrackedObject] = field(default_factory=list)


def cdr(message: IdlStruct, endianness: str = "little") -> bytes:
    return bytes(message.serialize(endianness=ENDIAN[endianness]))


def covariance36(rows: list[list[float]]) -> list[float]:
    """A 6x6 over (linear, angular) whose linear block is ``rows``; the angular one is 9 on the diagonal."""
    full = [[0.0] * 6 for _ in range(6)]
    for i in range(3):
        full[i][:3] = rows[i]
        full[i + 3][i + 3] = 9.0
    return [value for row in full for value in row]


def header(stamp_ns: int, frame_id: str = "map") -> Header:
    return Header(Time(stamp_ns // 10**9, stamp_ns % 10**9), frame_id)


def detection(x: float, y: float, z: float, *, name: str = "", size: float = 0.4, frame_id: str = "") -> Detection3D:
    result = ObjectHypothesisWithPose(ObjectHypothesis("drone", 0.9), PoseWithCovariance(Pose(Xyz(99.0, 99.0, 99.0))))
    result.pose.covariance = covariance36([[0.04, 0.01, 0.0], [0.01, 0.09, 0.0], [0.0, 0.0, 0.16]])
    box = BoundingBox3D(Pose(Xyz(x, y, z)), Xyz(size, size, size))
    return Detection3D(Header(Time(), frame_id), [result], box, name)


def yaw(angle: float) -> Quaternion:
    return Quaternion(0.0, 0.0, math.sin(angle / 2.0), math.cos(angle / 2.0))


def tracked(number: int, *, orientation: Quaternion | None = None) -> TrackedObject:
    """A car at (10, number, 0.75) that drives 5 m/s along its own x."""
    motion = Kinematics()
    motion.pose_with_covariance.pose = Pose(Xyz(10.0, float(number), 0.75), orientation or yaw(0.0))
    motion.pose_with_covariance.covariance = covariance36([[0.1, 0.0, 0.0], [0.0, 0.2, 0.0], [0.0, 0.0, 0.3]])
    motion.twist_with_covariance.twist.linear = Xyz(5.0, 0.0, 0.0)
    motion.twist_with_covariance.covariance = covariance36([[1.0, 0.0, 0.0], [0.0, 0.25, 0.0], [0.0, 0.0, 0.5]])
    return TrackedObject(
        UUID([number, *range(1, 16)]),
        0.75,
        [ObjectClassification(1, 0.5), ObjectClassification(2, 0.25)],
        motion,
        Shape(0, Polygon(), Xyz(4.0, 2.0, 1.5)),
    )
