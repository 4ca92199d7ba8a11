"""From payloads to the brain's types: every bound of the wire contract is checked here, ENU comes out (design 3.2)."""

from __future__ import annotations

import math

import numpy as np

from companion.errors import FrameRejected
from companion.frames import enu_covariance_from_ned, enu_from_ned
from companion.link.wire import Obstacle, ObstacleFrame, Vec, VehicleStateIn
from companion.types import NS_PER_S, Detection, DetectionFrame, DetectionKind, FloatArray, VehicleState, frozen

MAX_OBSTACLES = 1024
MAX_POSITION_M = 1e4
MAX_RADIUS_M = 100.0
MAX_SPEED_M_S = 1e3
MAX_STD_M = 1e4
FUTURE_NS = NS_PER_S // 10
_UPPER = np.triu_indices(6)
_LOWER = _UPPER[::-1]


def detections_from_frame(
    payload: ObstacleFrame,
    *,
    source: str,
    sequence: int,
    now_ns: int,
    unix_minus_vehicle_ns: int | None,
    max_age_s: float,
    arrived_unix_ns: int | None = None,
) -> DetectionFrame:
    """Check every bound of the wire contract and convert to the internal type (ENU, vehicle clock).

    Args:
        now_ns: the present on the vehicle's clock.
        unix_minus_vehicle_ns: offset of the clocks, None while it is unknown.
        arrived_unix_ns: noted in the frame, and used for nothing.
    Raises:
        FrameRejected: the frame as a whole, with a short reason.
    """
    if len(payload.obstacles) > MAX_OBSTACLES:
        raise FrameRejected("too_many", f"obstacles: expected at most {MAX_OBSTACLES}, got {len(payload.obstacles)}")
    stamp_ns = payload.stamp_ns
    if payload.clock == "unix":
        if unix_minus_vehicle_ns is None:
            raise FrameRejected("no_time_base", "clock: unix stamps need a settled TIMESYNC with the autopilot")
        stamp_ns -= unix_minus_vehicle_ns
    if stamp_ns - now_ns > FUTURE_NS:
        raise FrameRejected("future", f"stamp_ns: {(stamp_ns - now_ns) / 1e9:.3f} s ahead, expected at most 0.1 s")
    if now_ns - stamp_ns > max_age_s * NS_PER_S:
        raise FrameRejected("stale", f"stamp_ns: {(now_ns - stamp_ns) / 1e9:.3f} s old, expected at most {max_age_s} s")
    named = [o.id for o in payload.obstacles if o.id is not None]
    if len(set(named)) != len(named):
        raise FrameRejected("duplicate_id", "obstacles: expected each id once in a frame")
    ned = payload.frame == "local_ned"
    detections = tuple(_detection(i, o, ned) for i, o in enumerate(payload.obstacles))
    return DetectionFrame(stamp_ns, source, sequence, DetectionKind(payload.kind), detections, arrived_unix_ns)


def vehicle_from_payload(payload: VehicleStateIn) -> VehicleState:
    """The vehicle's state in ENU.

    Raises:
        FrameRejected: a number that is not finite or out of range, an attitude that is no rotation.
    """
    _check_point("position", payload.position)
    if not all(math.isfinite(x) and abs(x) <= MAX_SPEED_M_S for x in payload.velocity):
        raise FrameRejected("out_of_range", f"velocity: expected finite within +-{MAX_SPEED_M_S:g} m/s")
    if payload.stamp_ns < 0:
        raise FrameRejected("out_of_range", f"stamp_ns: expected at least 0, got {payload.stamp_ns}")
    if payload.position_std is not None:
        _within("position_std", payload.position_std, 0.0, MAX_STD_M, "m")
    attitude = np.array(payload.attitude or (1.0, 0.0, 0.0, 0.0))
    if not (np.isfinite(attitude).all() and 0.9 < float(np.linalg.norm(attitude)) < 1.1):
        raise FrameRejected("out_of_range", "attitude: expected a unit quaternion (w, x, y, z)")
    convert = enu_from_ned if payload.frame == "local_ned" else np.asarray
    return VehicleState(
        stamp_ns=payload.stamp_ns,
        p_enu=frozen(convert(payload.position)),
        v_enu=frozen(convert(payload.velocity)),
        q_enu_from_flu=frozen(attitude / np.linalg.norm(attitude)),
        p_std_m=_position_std(payload),
    )


def _position_std(payload: VehicleStateIn) -> float:
    """1-sigma of the position along its worst axis [m]: the brain knows one number for the vehicle; 0 is unknown."""
    if payload.covariance is None:
        return payload.position_std or 0.0
    covariance = _covariance("", payload.covariance, ned=False)  # an eigenvalue has no frame
    return math.sqrt(float(np.linalg.eigvalsh(covariance[:3, :3])[-1]))


def _check_point(name: str, point: Vec) -> None:
    """Raise FrameRejected unless ``point`` is finite and within +-1e4 m."""
    if not all(math.isfinite(x) and abs(x) <= MAX_POSITION_M for x in point):
        raise FrameRejected("out_of_range", f"{name}: expected finite within +-{MAX_POSITION_M:g} m, got {list(point)}")


def _within(name: str, value: float, low: float, high: float, unit: str) -> float:
    if not (math.isfinite(value) and low < value <= high):
        raise FrameRejected("out_of_range", f"{name}: expected within ({low:g}, {high:g}] {unit}, got {value}")
    return value


def _detection(index: int, obstacle: Obstacle, ned: bool) -> Detection:
    at = f"obstacles[{index}]"
    _check_point(f"{at}.position", obstacle.position)
    _within(f"{at}.radius", obstacle.radius, 0.0, MAX_RADIUS_M, "m")
    if obstacle.position_std is not None:
        _within(f"{at}.position_std", obstacle.position_std, 0.0, MAX_STD_M, "m")
    if obstacle.velocity_std is not None:
        _within(f"{at}.velocity_std", obstacle.velocity_std, 0.0, MAX_STD_M, "m/s")
    velocity = obstacle.velocity
    if velocity is not None and not all(math.isfinite(x) and abs(x) <= MAX_SPEED_M_S for x in velocity):
        raise FrameRejected("out_of_range", f"{at}.velocity: expected finite within +-{MAX_SPEED_M_S:g} m/s")
    convert = enu_from_ned if ned else np.asarray
    return Detection(
        id=obstacle.id,
        p_enu=frozen(convert(obstacle.position)),
        radius_m=obstacle.radius,
        p_std_m=obstacle.position_std,
        v_enu=None if velocity is None else frozen(convert(velocity)),
        v_std_m_s=obstacle.velocity_std,
        covariance=None if obstacle.covariance is None else _covariance(f"{at}.", obstacle.covariance, ned),
    )


def _covariance(at: str, values: list[float], ned: bool) -> FloatArray:
    matrix = np.empty((6, 6))
    matrix[_UPPER] = matrix[_LOWER] = values
    # NaN fails the first, too
    if not np.abs(matrix).max() <= MAX_STD_M**2 or np.linalg.eigvalsh(matrix)[0] <= 0.0:
        raise FrameRejected("out_of_range", f"{at}covariance: expected a finite positive definite 6x6 upper triangle")
    return frozen(enu_covariance_from_ned(matrix) if ned else matrix)
