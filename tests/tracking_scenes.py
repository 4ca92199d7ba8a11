"""What the tracking tests share: detections, frames and the comparison of two trackers to the bit."""

import numpy as np

from companion.tracking.tracker import Tracker
from companion.types import Detection, DetectionFrame, DetectionKind, VehicleState, frozen

S = 1_000_000_000


def seen(identity, p, *, std=0.05, radius=0.2, v=None, v_std=None, covariance=None):
    return Detection(
        id=identity,
        p_enu=frozen(p),
        radius_m=radius,
        p_std_m=std,
        v_enu=None if v is None else frozen(v),
        v_std_m_s=v_std,
        covariance=None if covariance is None else frozen(covariance),
    )


def frame(t_s, *detections, source="cam", sequence=0, kind=DetectionKind.DETECTION):
    return DetectionFrame(round(t_s * S), source, sequence, kind, tuple(detections))


def beside(p, x=0.0, y=0.0, z=0.0):
    """The place that is (x, y, z) from ``p``."""
    return np.asarray(p) + np.array([x, y, z])


def vehicle(t_s, p, v=(0.0, 0.0, 0.0), p_std_m=0.0):
    return VehicleState(round(t_s * S), frozen(p), frozen(v), p_std_m=p_std_m)


def give(tracker: Tracker, *frames, now_s=None):
    """One update with ``frames``, at the newest of their stamps unless ``now_s`` says otherwise."""
    now_ns = max(one.stamp_ns for one in frames) if now_s is None else round(now_s * S)
    tracker.update(frames, now_ns)


def assert_same_bits(one: Tracker, other: Tracker, start_ns: int):
    """Tables and predictions are equal bit for bit."""
    first, second = one.table(), other.table()
    for name in ("ids", "status", "sources", "stamp_ns"):
        assert getattr(first, name) == getattr(second, name), name
    for name in ("p_enu", "v_enu", "a_enu", "covariance", "mode_probabilities", "radius_m", "age_s"):
        assert np.array_equal(getattr(first, name), getattr(second, name)), name
    ahead, too = one.predict(start_ns, 23, 0.05), other.predict(start_ns, 23, 0.05)
    assert ahead.ids == too.ids
    for name in ("p_enu", "sigma_m", "v_enu", "a_enu", "radius_m"):
        assert np.array_equal(getattr(ahead, name), getattr(too, name)), name
