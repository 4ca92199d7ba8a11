"""Time of an update and of a prediction with covariance, beside filterpy's update loop in the same run."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from companion.bench.rivals import BIRTH_ACCEL_M_S2, BIRTH_SPEED_M_S, chain_of_axes
from companion.clock import stopwatch_ns
from companion.config import TrackingConfig
from companion.tracking.tracker import Tracker
from companion.types import NS_PER_S, Detection, DetectionFrame, DetectionKind, FloatArray, frozen

COUNTS = (1, 10, 100, 1000)
INSTANTS = 22  # of the prediction
DT_S = 0.05
SIGMA_M = 0.05
FILTERPY_UPDATES, FILTERPY_TICKS = 1000, 20  # of filterpy: an obstacle's updates in all, but no fewer ticks


@dataclass(frozen=True, slots=True)
class Quantiles:
    """Milliseconds; None where fewer than one sample is expected beyond the quantile."""

    p50: float
    p99: float | None  # of 100 samples and more
    p999: float | None  # of 1000 and more
    max: float


def quantiles(samples_ns: list[int]) -> Quantiles:
    """p50, p99, p99.9 and the largest."""
    p50, p99, p999 = (round(float(value) / 1e6, 4) for value in np.quantile(samples_ns, (0.5, 0.99, 0.999)))
    count = len(samples_ns)
    return Quantiles(
        p50, p99 if count >= 100 else None, p999 if count >= 1000 else None, round(max(samples_ns) / 1e6, 4)
    )


@dataclass(frozen=True, slots=True)
class Timing:
    """Of ``obstacles`` at once; ``filterpy`` None where it is not installed or would take minutes."""

    obstacles: int
    update: Quantiles  # from a frame of named detections to updated tracks
    predict: Quantiles
    both: Quantiles
    filterpy: Quantiles | None  # predict() and update() of three models, an estimator an obstacle, nothing predicted

    @property
    def speed_up(self) -> float | None:
        """filterpy's update over our update and prediction, medians."""
        return None if self.filterpy is None else self.filterpy.p50 / self.both.p50


def measure_timing(count: int, repeats: int, *, filterpy: bool) -> Timing:
    """``repeats`` ticks of ``count`` named obstacles that fly straight; ours and filterpy's taken in turn.

    filterpy's loop runs in some of the ticks only, evenly spread, or it would take most of the time of the bench.
    """
    rng = np.random.default_rng(count)
    p, v = rng.uniform(-10.0, 10.0, (count, 3)), rng.uniform(-2.0, 2.0, (count, 3))
    tracker = Tracker(TrackingConfig(max_tracks=max(count, 1)))
    estimators = _estimators(p) if filterpy else []
    ours: list[tuple[int, int]] = []
    theirs: list[int] = []
    warm, stride = 5, max(repeats // max(FILTERPY_UPDATES // max(count, 1), FILTERPY_TICKS), 1)
    for k in range(repeats + warm):
        z = p + v * DT_S * k + rng.normal(scale=SIGMA_M, size=p.shape)
        stamp_ns = round(k * DT_S * NS_PER_S)
        found = tuple(Detection(f"{m:04d}", frozen(z[m]), 0.2, SIGMA_M) for m in range(count))
        frame = DetectionFrame(stamp_ns, "bench", k, DetectionKind.DETECTION, found)
        began = stopwatch_ns()
        tracker.update((frame,), stamp_ns)
        updated = stopwatch_ns()
        tracker.predict(stamp_ns, INSTANTS, DT_S)
        done = stopwatch_ns()
        if k >= warm:
            ours.append((updated - began, done - updated))
        if filterpy and (k < warm or (k - warm) % stride == 0):
            took_ns = _loop_ns(estimators, z)
            theirs += [took_ns] if k >= warm else []
    return Timing(
        obstacles=count,
        update=quantiles([a for a, _ in ours]),
        predict=quantiles([b for _, b in ours]),
        both=quantiles([a + b for a, b in ours]),
        filterpy=quantiles(theirs) if filterpy else None,
    )


def _loop_ns(estimators: list[Any], z: FloatArray) -> int:
    began = stopwatch_ns()
    for estimator, position in zip(estimators, z, strict=True):
        estimator.predict()
        estimator.update(position)
    return stopwatch_ns() - began


def _estimators(p: FloatArray) -> list[Any]:
    """filterpy's `IMMEstimator` with three nine-state filters (it wants equal sizes), one estimator an obstacle."""
    from filterpy.kalman import IMMEstimator, KalmanFilter

    markov = np.full((3, 3), 0.0025) + 0.9925 * np.eye(3)
    estimators = []
    for position in p:
        filters = []
        for order, density in ((2, 0.6), (3, 55.0), (2, 0.01)):
            kalman = KalmanFilter(dim_x=9, dim_z=3)
            kalman.x[:3, 0] = position
            kalman.P = np.diag([SIGMA_M**2] * 3 + [BIRTH_SPEED_M_S**2] * 3 + [BIRTH_ACCEL_M_S2**2] * 3)
            kalman.F, kalman.Q = chain_of_axes(order, DT_S, density)
            kalman.H, kalman.R = np.eye(3, 9), np.eye(3) * SIGMA_M**2
            filters.append(kalman)
        estimators.append(IMMEstimator(filters, [1.0 / 3.0] * 3, markov))
    return estimators


def growth_exponent(few: Timing, many: Timing) -> float:
    """log(time ratio) / log(ratio of obstacles), medians of update and prediction."""
    return math.log(many.both.p50 / few.both.p50) / math.log(many.obstacles / few.obstacles)
