"""Properties of the tracker over generated flights: order of obstacles, finite and positive answers, determinism."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.config import TrackingConfig, parse_config
from companion.tracking.tracker import Tracker
from companion.types import Detection, DetectionFrame, DetectionKind, frozen

CONFIGS = {"default": TrackingConfig(), "paper": parse_config({"tracking": {"preset": "paper"}}).tracking}
coordinate = st.floats(-1e4, 1e4)
point = st.tuples(coordinate, coordinate, coordinate)
speed = st.floats(-1e3, 1e3)


@st.composite
def detections(draw):
    velocity = draw(st.none() | st.tuples(speed, speed, speed))
    return Detection(
        id=draw(st.sampled_from(["a", "b", "c", None])),
        p_enu=frozen(draw(point)),
        radius_m=draw(st.floats(0.01, 100.0)),
        p_std_m=draw(st.none() | st.floats(0.0, 1e4)),
        v_enu=None if velocity is None else frozen(velocity),
        v_std_m_s=draw(st.none() | st.floats(0.0, 1e3)),
    )


frames = st.lists(
    st.builds(
        lambda stamp, source, sequence, kind, found: DetectionFrame(stamp, source, sequence, kind, tuple(found)),
        st.integers(0, 2_000_000_000),
        st.sampled_from(["cam", "radar"]),
        st.integers(0, 100),
        st.sampled_from(DetectionKind),
        st.lists(detections(), max_size=4),
    ),
    max_size=12,
)


@settings(max_examples=60, deadline=None)
@given(frames=frames, preset=st.sampled_from(sorted(CONFIGS)))
def test_whatever_arrives_the_answers_are_finite_and_positive(frames, preset):
    tracker = Tracker(CONFIGS[preset])
    for first in range(0, len(frames), 3):
        tracker.update(frames[first : first + 3], 2_000_000_000)
        table, prediction = tracker.table(), tracker.predict(2_050_000_000, 23, 0.05)
        for array in (table.p_enu, table.v_enu, table.a_enu, table.covariance, prediction.p_enu, prediction.sigma_m):
            assert np.isfinite(array).all()
        assert (prediction.sigma_m > 0.0).all()
        scale = np.trace(table.covariance, axis1=1, axis2=2)
        assert (np.linalg.eigvalsh(table.covariance).min(axis=1, initial=0.0) >= -1e-9 * scale).all()
        np.testing.assert_allclose(table.mode_probabilities.sum(axis=1), 1.0, atol=1e-9)
        assert len(set(table.ids)) == len(table)


def flight(seed, count):
    rng = np.random.default_rng(seed)
    p, v = rng.uniform(-5.0, 5.0, (count, 3)), rng.uniform(-2.0, 2.0, (count, 3))
    for k in range(20):
        v = v + rng.normal(scale=0.2, size=v.shape)
        p = p + 0.05 * v
        seen = rng.random(count) < 0.8
        yield (
            k * 50_000_000,
            [
                Detection(f"o{m}", frozen(p[m] + rng.normal(scale=0.05, size=3)), 0.2, 0.05)
                for m in range(count)
                if seen[m]
            ],
        )


def tracked(seed, count, shuffle=None):
    tracker = Tracker(TrackingConfig())
    for stamp_ns, found in flight(seed, count):
        if shuffle is not None:
            shuffle.shuffle(found)
        tracker.update([DetectionFrame(stamp_ns, "cam", 0, DetectionKind.DETECTION, tuple(found))], stamp_ns)
    return tracker


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(1, 6), shuffle=st.randoms(use_true_random=False))
def test_the_order_of_obstacles_in_a_frame_changes_no_bit(seed, count, shuffle):
    one, other = tracked(seed, count), tracked(seed, count, shuffle)
    assert one.table().ids == other.table().ids
    assert np.array_equal(one.table().covariance, other.table().covariance)
    assert np.array_equal(one.predict(10**9, 23, 0.05).sigma_m, other.predict(10**9, 23, 0.05).sigma_m)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(2, 6))
def test_a_track_is_the_same_alone_and_among_others(seed, count):
    """The batch is an implementation detail: obstacle o0 is filtered as if it were the only one."""
    together, alone = tracked(seed, count), Tracker(TrackingConfig())
    for stamp_ns, found in flight(seed, count):
        mine = tuple(d for d in found if d.id == "o0")
        alone.update([DetectionFrame(stamp_ns, "cam", 0, DetectionKind.DETECTION, mine)], stamp_ns)
    if len(alone) == 0:
        return
    table, single = together.table(), alone.table()
    row = table.ids.index("cam/o0")
    np.testing.assert_allclose(table.p_enu[row], single.p_enu[0], atol=1e-10)
    np.testing.assert_allclose(table.covariance[row], single.covariance[0], atol=1e-10)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_the_same_frames_give_the_same_bits(seed):
    one, other = tracked(seed, 3), tracked(seed, 3)
    assert np.array_equal(one.table().covariance, other.table().covariance)
    assert np.array_equal(one.predict(10**9, 23, 0.05).p_enu, other.predict(10**9, 23, 0.05).p_enu)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), offset=point)
def test_a_shifted_world_gives_shifted_tracks(seed, offset):
    """Nothing depends on the origin: covariances are equal, positions shifted, to the digits that 1e4 m leave."""
    here, there = Tracker(TrackingConfig()), Tracker(TrackingConfig())
    for stamp_ns, found in flight(seed, 2):
        moved = [Detection(d.id, frozen(d.p_enu + np.array(offset)), d.radius_m, d.p_std_m) for d in found]
        here.update([DetectionFrame(stamp_ns, "cam", 0, DetectionKind.DETECTION, tuple(found))], stamp_ns)
        there.update([DetectionFrame(stamp_ns, "cam", 0, DetectionKind.DETECTION, tuple(moved))], stamp_ns)
    np.testing.assert_allclose(there.table().p_enu - np.array(offset), here.table().p_enu, atol=1e-7)
    np.testing.assert_allclose(there.table().covariance, here.table().covariance, atol=1e-6)
