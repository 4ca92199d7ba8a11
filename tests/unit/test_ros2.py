"""The ROS 2 door against messages that another CDR library wrote."""

from __future__ import annotations

import ast
import math
import re
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
import ros2_oracle as oracle
from scipy.spatial.transform import Rotation

from companion.config import parse_config
from companion.config_links import Ros2Config
from companion.errors import ConfigError, FrameRejected
from companion.frames import rotate
from companion.link.inbox import MAX_PAYLOAD_BYTES, ObstacleInbox
from companion.link.ros2 import source_name, subscriptions
from companion.link.ros2_obstacles import frame_from_detections, frame_from_tracked_objects
from companion.link.ros2_types import DETECTIONS, TRACKED_OBJECTS, UNHASHED, load_type
from companion.link.wire import ObstacleFrame
from companion.types import DetectionFrame, DetectionKind

S = 1_000_000_000
STAMP = 1_700_000_000 * S + 123_456_789
ENDS = pytest.mark.parametrize("end", ["little", "big"])

DETECTION_TYPE, TRACKED_TYPE = load_type(DETECTIONS), load_type(TRACKED_OBJECTS)


def detections(message: oracle.Detection3DArray, end: str = "little") -> ObstacleFrame:
    return frame_from_detections(DETECTION_TYPE.decode(oracle.cdr(message, end)), ("map",))


def tracks(message: oracle.TrackedObjects, end: str = "little") -> ObstacleFrame:
    return frame_from_tracked_objects(TRACKED_TYPE.decode(oracle.cdr(message, end)), ("map",))


def only_track(item: oracle.TrackedObject) -> object:
    (obstacle,) = tracks(oracle.TrackedObjects(oracle.header(STAMP), [item])).obstacles
    return obstacle


def six(upper: list[float] | None) -> np.ndarray:
    assert upper is not None
    matrix = np.zeros((6, 6))
    matrix[np.triu_indices(6)] = upper
    return np.triu(matrix) + np.triu(matrix, 1).T


class Door:
    """The door before an inbox whose vehicle's clock shows 1 s at ``STAMP``."""

    def __init__(self, **config: object) -> None:
        self.reports: list[str] = []
        self.inbox = ObstacleInbox(queue=64, max_age_s=0.5, on_report=self.reports.append)
        self.handlers = subscriptions(Ros2Config(**config), self.inbox)  # type: ignore[arg-type]

    def put(self, payload: bytes, *, type_hash: str = "", key: str | None = None) -> None:
        (expression,) = self.handlers if key is None else (key,)
        known = DETECTION_TYPE if "Detection3DArray" in expression else TRACKED_TYPE
        self.handlers[expression](expression.replace("*", type_hash or known.type_hash), payload, "")

    def drain(self) -> tuple[DetectionFrame, ...]:
        return self.inbox.drain(S, unix_minus_vehicle_ns=STAMP - S)


def test_type_hashes_are_those_of_ros() -> None:
    """RIHS01 of Detection3DArray as published in a ROS 2 implementation of another language (Elixir, 2026)."""
    assert DETECTION_TYPE.type_hash == "RIHS01_793f5eab9595ac1c0da07873cc859db42eae51f0ee76056db8562515d830e018"
    assert DETECTION_TYPE.dds_name == "vision_msgs::msg::dds_::Detection3DArray_"
    assert TRACKED_TYPE.dds_name == "autoware_perception_msgs::msg::dds_::TrackedObjects_"


@ENDS
def test_detections(end: str) -> None:
    near = oracle.detection(1.0, -2.0, 3.5, name="drone-7", frame_id="map")
    bare = oracle.Detection3D(bbox=oracle.BoundingBox3D(oracle.Pose(oracle.Xyz(4.0, 5.0, 6.0)), oracle.Xyz(2, 3, 6)))
    frame = detections(oracle.Detection3DArray(oracle.header(STAMP), [near, bare]), end)
    assert (frame.stamp_ns, frame.clock, frame.frame, frame.kind) == (STAMP, "unix", "local_enu", "detection")
    first, second = frame.obstacles
    assert (first.id, first.position, first.velocity) == ("drone-7", (1.0, -2.0, 3.5), None)
    assert first.radius == pytest.approx(0.2 * math.sqrt(3.0))
    matrix = six(first.covariance)
    np.testing.assert_allclose(matrix[:3, :3], [[0.04, 0.01, 0.0], [0.01, 0.09, 0.0], [0.0, 0.0, 0.16]], atol=1e-12)
    assert (second.id, second.position, second.radius, second.covariance) == (None, (4.0, 5.0, 6.0), 3.5, None)


@ENDS
def test_tracked_objects(end: str) -> None:
    frame = tracks(oracle.TrackedObjects(oracle.header(STAMP), [oracle.tracked(3), oracle.tracked(255)]), end)
    assert (frame.stamp_ns, frame.clock, frame.frame, frame.kind) == (STAMP, "unix", "local_enu", "track")
    first, second = frame.obstacles
    assert first.id == "030102030405060708090a0b0c0d0e0f"
    assert second.id == "ff0102030405060708090a0b0c0d0e0f"
    assert (first.position, first.velocity) == ((10.0, 3.0, 0.75), (5.0, 0.0, 0.0))
    assert first.radius == pytest.approx(math.sqrt(4.0**2 + 2.0**2 + 1.5**2) / 2.0)
    np.testing.assert_allclose(np.diag(six(first.covariance)), [0.1, 0.2, 0.3, 1.0, 0.25, 0.5])


def test_the_twist_is_in_the_objects_own_frame() -> None:
    """Facing north (yaw 90 degrees) and driving ahead is a velocity to the north; its along-track error turns along."""
    obstacle = only_track(oracle.tracked(1, orientation=oracle.yaw(math.pi / 2.0)))
    np.testing.assert_allclose(obstacle.velocity, [0.0, 5.0, 0.0], atol=1e-12)
    matrix = six(obstacle.covariance)
    np.testing.assert_allclose(matrix[3:, 3:], np.diag([0.25, 1.0, 0.5]), atol=1e-12)
    np.testing.assert_allclose(matrix[:3, :3], np.diag([0.1, 0.2, 0.3]), atol=1e-12)  # this one is in the map's


@pytest.mark.parametrize("seed", range(5))
def test_rotation_agrees_with_scipy_and_with_frames(seed: int) -> None:
    rng = np.random.default_rng(seed)
    turn = Rotation.from_quat(rng.normal(size=4))
    x, y, z, w = (float(v) for v in turn.as_quat())
    item, v = oracle.tracked(1, orientation=oracle.Quaternion(x, y, z, w)), rng.normal(size=3)
    root = rng.normal(size=(3, 3))
    spread = root @ root.T + np.eye(3)
    item.kinematics.twist_with_covariance.twist.linear = oracle.Xyz(*(float(part) for part in v))
    item.kinematics.twist_with_covariance.covariance = oracle.covariance36(spread.tolist())
    obstacle = only_track(item)
    np.testing.assert_allclose(obstacle.velocity, turn.apply(v), atol=1e-12)
    np.testing.assert_allclose(obstacle.velocity, rotate((w, x, y, z), v), atol=1e-12)
    expected = turn.as_matrix() @ spread @ turn.as_matrix().T
    np.testing.assert_allclose(six(obstacle.covariance)[3:, 3:], expected, atol=1e-10)


def test_an_object_without_orientation_has_no_velocity() -> None:
    item = oracle.tracked(1, orientation=oracle.Quaternion(0.0, 0.0, 0.0, 0.0))
    item.kinematics.orientation_availability = 0
    obstacle = only_track(item)
    assert (obstacle.velocity, obstacle.velocity_std, obstacle.covariance) == (None, None, None)
    assert obstacle.position_std == pytest.approx(math.sqrt(0.3))
    item.kinematics.orientation_availability = 2
    with pytest.raises(FrameRejected, match=r"out_of_range: objects\[0\]: orientation: expected a unit quaternion"):
        only_track(item)


def test_shapes() -> None:
    item = oracle.tracked(1)
    item.shape = oracle.Shape(1, oracle.Polygon(), oracle.Xyz(0.6, 0.6, 1.6))  # a pedestrian
    assert only_track(item).radius == pytest.approx(math.hypot(0.3, 0.8))
    corners = [oracle.Point32(3.0, 4.0, 0.0), oracle.Point32(-1.0, 0.0, 0.0), oracle.Point32(0.0, -1.0, 0.0)]
    item.shape = oracle.Shape(2, oracle.Polygon(corners), oracle.Xyz(0.0, 0.0, 24.0))
    assert only_track(item).radius == pytest.approx(13.0)


def test_a_nil_uuid_names_nothing() -> None:
    item = oracle.tracked(1)
    item.object_id = oracle.UUID()
    assert only_track(item).id is None


@pytest.mark.parametrize(
    ("stated", "expected"),
    [
        ([0.0, 0.0, 0.0], None),
        ([-1.0, 0.0, 0.0], None),
        ([4.0, 1.0, 0.0], [4.0, 1.0, 4.0]),  # a planar tracker: what is not stated is taken for the worst stated
        ([1e9, 1.0, 1e9], [1e6, 1.0, 1e6]),  # Autoware's "no information"
    ],
)
def test_variances_that_are_not_stated_are_not_believed(stated: list[float], expected: list[float] | None) -> None:
    item = oracle.detection(0.0, 0.0, 1.0)
    item.results[0].pose.covariance = oracle.covariance36(np.diag(stated).tolist())
    (obstacle,) = detections(oracle.Detection3DArray(oracle.header(STAMP), [item])).obstacles
    if expected is None:
        assert obstacle.covariance is None
    else:
        np.testing.assert_allclose(six(obstacle.covariance)[:3, :3], np.diag(expected))


def test_half_stated_covariances_become_deviations() -> None:
    item = oracle.tracked(1)
    item.kinematics.twist_with_covariance.covariance = oracle.ZERO36
    obstacle = only_track(item)
    assert (obstacle.covariance, obstacle.velocity_std) == (None, None)
    assert obstacle.position_std == pytest.approx(math.sqrt(0.3))
    item = oracle.tracked(1)
    item.kinematics.pose_with_covariance.covariance = oracle.ZERO36
    obstacle = only_track(item)
    assert (obstacle.covariance, obstacle.position_std) == (None, None)
    assert obstacle.velocity_std == pytest.approx(1.0)


@pytest.mark.parametrize(
    "block",
    [
        [[math.nan, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        [[math.inf, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        [[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
    ],
)
def test_what_is_no_covariance_is_refused(block: list[list[float]]) -> None:
    item = oracle.detection(0.0, 0.0, 1.0)
    item.results[0].pose.covariance = oracle.covariance36(block)
    with pytest.raises(FrameRejected, match="out_of_range: covariance"):
        detections(oracle.Detection3DArray(oracle.header(STAMP), [item]))


@ENDS
def test_through_the_inbox_as_detection_frames(end: str) -> None:
    door = Door(detections=("/lidar/boxes",), tracked_objects=("/perception/objects",))
    boxes, objects = door.handlers
    assert boxes == "0/lidar/boxes/vision_msgs::msg::dds_::Detection3DArray_/*"
    assert objects == "0/perception/objects/autoware_perception_msgs::msg::dds_::TrackedObjects_/*"
    found = oracle.Detection3DArray(oracle.header(STAMP - S // 10), [oracle.detection(1.0, 2.0, 3.0, name="a")])
    followed = oracle.TrackedObjects(oracle.header(STAMP), [oracle.tracked(1)])
    door.put(oracle.cdr(found, end), key=boxes)
    door.put(oracle.cdr(followed, end), key=objects)
    seen, known = door.drain()
    assert (seen.source, seen.kind, seen.stamp_ns) == ("ros2-lidar-boxes", DetectionKind.DETECTION, 9 * S // 10)
    assert seen.detections[0].p_enu.tolist() == [1.0, 2.0, 3.0]
    assert seen.detections[0].v_enu is None
    assert (known.source, known.kind, known.stamp_ns) == ("ros2-perception-objects", DetectionKind.TRACK, S)
    assert known.detections[0].v_enu.tolist() == [5.0, 0.0, 0.0]
    assert known.detections[0].covariance.shape == (6, 6)
    assert door.inbox.counts == {"frames": 2}


def test_an_empty_message_says_that_nothing_is_there() -> None:
    door = Door(detections=("d",))
    door.put(oracle.cdr(oracle.Detection3DArray(oracle.header(STAMP))))
    (frame,) = door.drain()
    assert frame.detections == ()


def test_a_frame_of_another_name_is_refused_and_told() -> None:
    door = Door(detections=("d",))
    door.put(oracle.cdr(oracle.Detection3DArray(oracle.header(STAMP, "base_link"))))
    inner = oracle.detection(0.0, 0.0, 1.0, frame_id="lidar")
    door.put(oracle.cdr(oracle.Detection3DArray(oracle.header(STAMP), [inner])))
    assert door.drain() == ()
    assert door.inbox.counts == {"frame_id": 2}
    assert door.reports == [
        "rejected 2 payloads, the last of ros2-d: frame_id: header.frame_id: expected map, got 'lidar'"
    ]
    door = Door(detections=("d",), other_frame_ids=("odom",))
    door.put(oracle.cdr(oracle.Detection3DArray(oracle.header(STAMP, "odom"))))
    assert len(door.drain()) == 1


def test_another_layout_is_told_by_its_hash_and_another_hash_can_be_vouched_for() -> None:
    other = "RIHS01_" + "0" * 64
    payload = oracle.cdr(oracle.Detection3DArray(oracle.header(STAMP), [oracle.detection(0.0, 0.0, 1.0)]))
    door = Door(detections=("d",))
    door.put(payload, type_hash=other)
    assert door.drain() == ()
    assert door.inbox.counts == {"type_hash": 1}
    assert DETECTION_TYPE.type_hash in door.reports[0]
    assert other in door.reports[0]
    door = Door(detections=("d",), type_hashes=(other,))
    door.put(payload, type_hash=other)
    assert len(door.drain()) == 1


def test_without_a_hash_the_layout_is_told_by_its_length() -> None:
    """ROS 2 Humble has no type hashes."""
    item = oracle.detection(0.0, 0.0, 1.0)
    door = Door(detections=("d",))
    door.put(oracle.cdr(oracle.Detection3DArray(oracle.header(STAMP), [item])), type_hash=UNHASHED)
    assert len(door.drain()) == 1
    old = oracle.OldDetection3D(item.header, item.results, item.bbox)
    for count in (1, 2, 5):
        door.put(oracle.cdr(oracle.OldDetection3DArray(oracle.header(STAMP), [old] * count)), type_hash=UNHASHED)
    assert door.drain() == ()
    assert door.inbox.counts["malformed"] == 3


def test_bounds() -> None:
    door = Door(detections=("d",))
    small = oracle.Detection3D(bbox=oracle.BoundingBox3D(oracle.Pose(), oracle.Xyz(1.0, 1.0, 1.0)))
    door.put(oracle.cdr(oracle.Detection3DArray(oracle.header(STAMP), [small] * 1024)))
    assert len(door.drain()[0].detections) == 1024
    bad = {
        "malformed": [
            oracle.Detection3DArray(oracle.header(STAMP), [small] * 1025),
            oracle.Detection3DArray(oracle.Header(oracle.Time(STAMP // S, S)), []),
            oracle.Detection3DArray(oracle.header(STAMP), [oracle.detection(0.0, 0.0, 0.0, name="x" * 65)]),
        ],
        "out_of_range": [
            oracle.Detection3DArray(oracle.header(STAMP), [oracle.detection(math.nan, 0.0, 0.0)]),
            oracle.Detection3DArray(oracle.header(STAMP), [oracle.detection(2e4, 0.0, 0.0)]),
            oracle.Detection3DArray(oracle.header(STAMP), [oracle.detection(0.0, 0.0, 0.0, size=0.0)]),
            oracle.Detection3DArray(oracle.header(STAMP), [oracle.detection(0.0, 0.0, 0.0, size=math.inf)]),
        ],
        "duplicate_id": [
            oracle.Detection3DArray(oracle.header(STAMP), [oracle.detection(0.0, 0.0, 0.0, name="a")] * 2),
        ],
        "stale": [oracle.Detection3DArray(oracle.header(STAMP - S)), oracle.Detection3DArray(oracle.header(0))],
        "future": [oracle.Detection3DArray(oracle.header(STAMP + S))],
    }
    for reason, messages in bad.items():
        before = door.inbox.counts[reason]
        for message in messages:
            door.put(oracle.cdr(message))
        assert door.drain() == ()
        assert door.inbox.counts[reason] - before == len(messages), reason
    door.put(bytes(MAX_PAYLOAD_BYTES + 1))
    assert door.inbox.counts["too_large"] == 1


@ENDS
@pytest.mark.parametrize("kind", [DETECTIONS, TRACKED_OBJECTS])
def test_cut_off_anywhere_it_is_refused(kind: str, end: str) -> None:
    corners = [oracle.Point32(1.0, 0.0, 0.0), oracle.Point32(0.0, 1.0, 0.0)]
    polygon = oracle.tracked(2)
    polygon.shape = oracle.Shape(2, oracle.Polygon(corners), oracle.Xyz(0.0, 0.0, 1.0))
    if kind == DETECTIONS:
        door = Door(detections=("d",))
        whole = oracle.cdr(
            oracle.Detection3DArray(oracle.header(STAMP), [oracle.detection(0.0, 0.0, 1.0, name=n) for n in "ab"]), end
        )
    else:
        door = Door(tracked_objects=("t",))
        whole = oracle.cdr(oracle.TrackedObjects(oracle.header(STAMP), [oracle.tracked(1), polygon]), end)
    for length in range(len(whole)):
        door.put(whole[:length])
        assert door.drain() == ()
    assert door.inbox.counts == {"malformed": len(whole)}
    door.put(whole)
    assert len(door.drain()) == 1
    door.put(whole + bytes(4))
    assert door.drain() == ()


def test_an_absurd_count_is_refused_at_once() -> None:
    whole = bytearray(oracle.cdr(oracle.Detection3DArray(oracle.header(STAMP), [oracle.detection(0.0, 0.0, 1.0)])))
    at = 4 + 8 + 4 + len("map\0")  # encapsulation, stamp, length of the frame's name, the name
    assert whole[at : at + 4] == b"\x01\x00\x00\x00"
    whole[at : at + 4] = b"\xff\xff\xff\xff"
    with pytest.raises(FrameRejected, match="malformed"):
        DETECTION_TYPE.decode(bytes(whole))


def test_xcdr2_and_parameter_lists_are_refused() -> None:
    whole = oracle.cdr(oracle.Detection3DArray(oracle.header(STAMP)))
    for encapsulation in (b"\x00\x02", b"\x00\x03", b"\x00\x06", b"\x00\x07", b"\x01\x00"):
        with pytest.raises(FrameRejected, match="malformed"):
            DETECTION_TYPE.decode(encapsulation + whole[2:])


def test_off_by_default_and_without_rosbags_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("rosbags", "rosbags.serde", "rosbags.typesys", "rosbags.typesys.store"):
        monkeypatch.setitem(sys.modules, name, None)
    inbox = ObstacleInbox(queue=1, max_age_s=0.5)
    assert subscriptions(Ros2Config(), inbox) == {}
    with pytest.raises(ConfigError, match=r"^ros2: expected rosbags, install companion-safety\[ros2\]$"):
        subscriptions(Ros2Config(detections=("d",)), inbox)


@pytest.mark.parametrize(
    ("ros2", "expectation"),
    [
        ({"detections": ["a b"]}, r"ros2\.detections\[0\]: .*regex"),
        ({"detections": ["/a/*"]}, r"ros2\.detections\[0\]: .*regex"),
        ({"detections": ["/a"], "tracked_objects": ["a"]}, "ros2: expected each topic once, got /a 2 times"),
        ({"type_hashes": ["RIHS01_12"]}, r"ros2\.type_hashes\[0\]: .*regex"),
        ({"key_prefix": "/x"}, r"ros2\.key_prefix: .*regex"),
        ({"domain_id": 233}, r"ros2\.domain_id: .*232"),
        ({"frame_id": ""}, r"ros2\.frame_id: .*>= 1"),
    ],
)
def test_configuration_mistakes_are_pointed_at(ros2: dict[str, object], expectation: str) -> None:
    with pytest.raises(ConfigError, match=expectation):
        parse_config({"ros2": ros2})


def test_no_ros_in_lockstep() -> None:
    with pytest.raises(ConfigError, match='ros2: expected no topics with sync = "lockstep"'):
        parse_config({"sync": "lockstep", "ros2": {"detections": ["a"]}})


def test_a_source_can_be_required_and_untrusted() -> None:
    name = source_name("/perception/object_recognition/tracking/objects")
    config = parse_config({"obstacles": {"required": [name]}, "tracking": {"untrusted": [name]}})
    assert config.tracking.untrusted == ("ros2-perception-object_recognition-tracking-objects",)


def test_the_documentation_agrees_with_the_code() -> None:
    docs = Path(__file__).parents[2] / "docs"
    pages = (docs / "tutorials" / "ros2.md", docs / "reference" / "ros2.md")
    text = "".join(page.read_text(encoding="utf-8") for page in pages)
    config = parse_config(tomllib.loads(re.search(r"```toml\n(.*?)```", text, re.S)[1]))
    assert config.ros2.detections == ("/lidar/boxes",)
    assert config.obstacles.required == (source_name(config.ros2.detections[0]),)
    ast.parse(re.search(r"```python\n(.*?)```", text, re.S)[1])
    for kind in (DETECTION_TYPE, TRACKED_TYPE):
        assert f"| `{kind.dds_name}` | `{kind.type_hash}` |" in text
