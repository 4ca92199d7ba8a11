"""Ten anonymous obstacles whose paths cross for a minute, with clutter: who is lost, who is taken for another.

Every frame is a set of positions without names. Counted as in the CLEAR MOT metrics: an obstacle keeps the track that
it had while that is within `MATCH_M` of it; the others are matched to the tracks left over (least total distance). One
without a track counts as lost for that tick, one whose track has another id than its last counts as a swap.

Source: Bernardin and Stiefelhagen, "Evaluating multiple object tracking performance", 2008.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import msgspec
import numpy as np
from scipy.optimize import linear_sum_assignment

from companion.config import TrackingConfig
from companion.tracking.tracker import Tracker
from companion.types import NS_PER_S, Detection, DetectionFrame, DetectionKind, FloatArray, frozen

OBSTACLES = 10
DURATION_S = 60.0
RATE_HZ = 20.0
SIGMA_M = 0.05
DROPOUT = 0.05
CLUTTER = 0.05  # false detections for each true one, uniform in the volume
MATCH_M = 0.5
SETTLE_S = 1.0
RADIUS_M = 0.2
LAYER_M = 2.0 * RADIUS_M  # of height between paths: spheres that pass above each other just do not touch
_HALF = np.array([4.0, 4.0, 0.5 * LAYER_M * OBSTACLES])  # of the volume, about its centre [m]
_CENTRE = np.array([0.0, 0.0, 3.0])

# positions of one frame (D, 3), its index -> ids and positions (M, 3) of the tracks after it
TrackFrame = Callable[[FloatArray, int], tuple[list[str], FloatArray]]


@dataclass(frozen=True, slots=True)
class Crossing:
    """Truth (K, OBSTACLES, 3) and the detections of every frame."""

    truth: FloatArray
    frames: tuple[FloatArray, ...]
    nearest_m: float  # least distance of two centres over the minute
    passes: int  # times that two came within 1 m of each other


def draw_crossing(seed: int) -> Crossing:
    """Eights and shuttles through a common middle, each at a height of its own; the same for the same seed."""
    rng = np.random.default_rng(seed)
    truth = _paths(rng)
    apart = np.linalg.norm(truth[:, :, None] - truth[:, None], axis=-1) + 1e9 * np.eye(OBSTACLES)
    near = apart < 1.0
    passes = int((near[1:] & ~near[:-1]).sum()) // 2
    frames = []
    for p in truth:
        seen = p[rng.random(OBSTACLES) >= DROPOUT]
        false = _CENTRE + rng.uniform(-1.0, 1.0, (rng.poisson(CLUTTER * OBSTACLES), 3)) * _HALF
        both = np.concatenate((seen + rng.normal(scale=SIGMA_M, size=seen.shape), false))
        frames.append(rng.permutation(both))
    return Crossing(truth, tuple(frames), float(apart.min()), passes)


def _paths(rng: np.random.Generator) -> FloatArray:
    """p = centre + A (sin(w t + phase) e1 + b sin(2 (w t + phase)) e2): b = 1/2 an eight, b = 0 a shuttle."""
    t = np.arange(round(DURATION_S * RATE_HZ)) / RATE_HZ
    paths = []
    heights = (rng.permutation(OBSTACLES) - 0.5 * (OBSTACLES - 1)) * LAYER_M
    for index in range(OBSTACLES):
        size, speed = rng.uniform(2.0, 3.5), rng.uniform(0.8, 2.0)
        bearing, phase = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(0.0, 2.0 * math.pi)
        bend = 0.5 if index % 2 else 0.0
        w = speed / (size * math.hypot(1.0, 2.0 * bend))
        angle = w * t + phase
        e1 = np.array([math.cos(bearing), math.sin(bearing), 0.0])
        e2 = np.array([-math.sin(bearing), math.cos(bearing), 0.0])
        offset = _CENTRE + np.array([*rng.uniform(-0.5, 0.5, 2), heights[index]])
        paths.append(offset + size * (np.sin(angle)[:, None] * e1 + bend * np.sin(2.0 * angle)[:, None] * e2))
    return np.stack(paths, axis=1)


@dataclass(frozen=True, slots=True)
class CrossingResult:
    """Counts over one minute of `OBSTACLES` obstacles."""

    swaps: int
    lost_share: float  # of obstacle ticks without a track
    false_share: float  # tracks that matched no obstacle, per tick


def judge(crossing: Crossing, track_frame: TrackFrame) -> CrossingResult:
    """Fly the minute through ``track_frame`` and count."""
    carried: dict[int, str] = {}
    swaps = lost = false = ticks = 0
    for k, (truth, frame) in enumerate(zip(crossing.truth, crossing.frames, strict=True)):
        ids, p = track_frame(frame, k)
        if k < SETTLE_S * RATE_HZ:
            continue
        ticks += 1
        distance = np.linalg.norm(truth[:, None] - p[None], axis=-1) if len(ids) else np.zeros((OBSTACLES, 0))
        matched = _matched(distance, ids, carried)
        lost += OBSTACLES - len(matched)
        false += len(ids) - len(matched)
        for obstacle, row in matched.items():
            swaps += carried.get(obstacle, ids[row]) != ids[row]
            carried[obstacle] = ids[row]
    return CrossingResult(swaps, lost / (ticks * OBSTACLES), false / ticks)


def _matched(distance: FloatArray, ids: list[str], carried: dict[int, str]) -> dict[int, int]:
    """Row of the track of each obstacle that has one."""
    row_of = {name: row for row, name in enumerate(ids)}
    kept = {obstacle: row_of[name] for obstacle, name in carried.items() if name in row_of}
    matched = {obstacle: row for obstacle, row in kept.items() if distance[obstacle, row] < MATCH_M}
    others = np.array([o for o in range(len(distance)) if o not in matched], dtype=np.intp)
    free = np.array([row for row in range(len(ids)) if row not in matched.values()], dtype=np.intp)
    left = np.minimum(distance[np.ix_(others, free)], MATCH_M)
    for o, f in zip(*linear_sum_assignment(left), strict=True):
        if left[o, f] < MATCH_M:
            matched[int(others[o])] = int(free[f])
    return matched


def with_tracker(config: TrackingConfig) -> TrackFrame:
    """Our tracker, anonymous detections at the configured deviation."""
    tracker = Tracker(msgspec.structs.replace(config, max_tracks=1024))

    def track_frame(frame: FloatArray, k: int) -> tuple[list[str], FloatArray]:
        stamp_ns = round(k / RATE_HZ * NS_PER_S)
        found = tuple(Detection(None, frozen(p), RADIUS_M, SIGMA_M) for p in frame)
        tracker.update([DetectionFrame(stamp_ns, "bench", k, DetectionKind.DETECTION, found)], stamp_ns)
        prediction = tracker.predict(stamp_ns, 1, 0.05)
        return list(prediction.ids), prediction.p_enu[:, 0]

    return track_frame
