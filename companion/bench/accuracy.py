"""How well the motions of `motions` are tracked: errors now and ahead, and whether the stated covariance is true.

All filters see the same measurements. Every tick they are asked where the obstacle is now (the tick, not the stamp of
the measurement) and where it will be; ticks of the first `SETTLE_S` do not count.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import numpy.typing as npt

from companion.bench.motions import DURATION_S, MOTIONS
from companion.bench.rivals import FilterpyImm, SingleModel
from companion.config import TrackingConfig
from companion.tracking.tracker import Tracker
from companion.types import NS_PER_S, Detection, DetectionFrame, DetectionKind, FloatArray, frozen

BoolArray = npt.NDArray[np.bool_]

SETTLE_S = 1.0
AHEAD_S = (0.25, 0.5)
CHI2_95 = 7.814727903251179  # 95 % point of chi-squared with three degrees of freedom
# Process noises of the hindsight filter: CV [m^2/s^3] and CA [m^2/s^5], half a decade apart.
CV_GRID = 10.0 ** np.arange(-4.0, 2.6, 0.5)
CA_GRID = 10.0 ** np.arange(-3.0, 4.1, 0.5)


@dataclass(frozen=True, slots=True)
class Cell:
    """Conditions of measurement."""

    sigma_m: float
    rate_hz: float
    dropout: float = 0.0
    latency_s: float = 0.0

    @property
    def name(self) -> str:
        lost, late = f"{self.dropout:.0%} lost", f"{self.latency_s * 1e3:.0f} ms late"
        return f"sigma {self.sigma_m:g} m, {self.rate_hz:g} Hz, {lost}, {late}"


@dataclass(frozen=True, slots=True)
class Trials:
    """Truth and measurements of M obstacles at K stamps; ``motion`` (M,) is the index into `MOTIONS`."""

    cell: Cell
    motion: npt.NDArray[np.intp]
    z: FloatArray  # (K, M, 3)
    seen: BoolArray  # (K, M)
    now: FloatArray  # (K, M, 3) true position at stamp + latency
    velocity: FloatArray  # (K, M, 3)
    ahead: FloatArray  # (len(AHEAD_S), K, M, 3)

    @property
    def steps(self) -> int:
        return len(self.z)

    @property
    def dt_s(self) -> float:
        return 1.0 / self.cell.rate_hz

    @property
    def first(self) -> int:
        """The first tick that counts."""
        return math.ceil(SETTLE_S * self.cell.rate_hz)


def draw_trials(cell: Cell, *, seed: int, trials: int) -> Trials:
    """``trials`` paths of every motion, and what a sensor under ``cell`` makes of them; the same for the same seed."""
    stamps = np.arange(round(DURATION_S * cell.rate_hz)) / cell.rate_hz
    now = stamps + cell.latency_s
    at_stamp, at_now, velocity, ahead = [], [], [], []
    for index, motion in enumerate(MOTIONS):
        for trial in range(trials):
            path = motion.draw(np.random.default_rng([seed, index, trial]))
            at_stamp.append(path(stamps)[0])
            p, v = path(now)
            at_now.append(p)
            velocity.append(v)
            ahead.append([path(now + tau)[0] for tau in AHEAD_S])
    rng = np.random.default_rng([seed, len(MOTIONS)])
    truth = np.stack(at_stamp, axis=1)
    seen = rng.random(truth.shape[:2]) >= cell.dropout
    seen[0] = True  # every filter is born from the first
    return Trials(
        cell=cell,
        motion=np.repeat(np.arange(len(MOTIONS)), trials),
        z=truth + rng.normal(scale=cell.sigma_m, size=truth.shape),
        seen=seen,
        now=np.stack(at_now, axis=1),
        velocity=np.stack(velocity, axis=1),
        ahead=np.array(ahead).transpose(1, 2, 0, 3),
    )


@dataclass(frozen=True, slots=True)
class Scores:
    """Of each motion, (len(MOTIONS), ...): root mean squares over trials and ticks; a trailing axis is a grid's."""

    now_m: FloatArray
    velocity_m_s: FloatArray
    ahead_m: FloatArray  # (len(AHEAD_S), len(MOTIONS), ...)
    coverage: FloatArray | None = None  # share of ticks with the truth in the 95 % ellipsoid at +AHEAD_S[0]
    nees: FloatArray | None = None  # mean normalised estimation error squared there, three degrees of freedom
    lost: int = 0  # tracks that ended
    restarted: int = 0  # detections taken for outliers


Estimate = tuple[FloatArray, FloatArray, list[FloatArray], FloatArray | None]


def scored(trials: Trials, estimates: Iterable[Estimate]) -> Scores:
    """Scores of (position, velocity, positions ahead, covariance at +AHEAD_S[0]) at every tick."""
    sums: list[FloatArray] = []
    for k, (p, v, ahead, covariance) in enumerate(estimates):
        if k < trials.first:
            continue
        at = (slice(None), *[None] * (p.ndim - 2))  # single-model filters carry a grid axis
        off = [q - truth[k][at] for q, truth in zip(ahead, trials.ahead, strict=True)]
        errors = [p - trials.now[k][at], v - trials.velocity[k][at], *off]
        terms = [(error**2).sum(axis=-1) for error in errors]
        if covariance is not None:
            nees = (off[0] * np.linalg.solve(covariance, off[0][..., None])[..., 0]).sum(axis=-1)
            terms += [(nees <= CHI2_95).astype(np.float64), nees]
        sums = terms if not sums else [total + term for total, term in zip(sums, terms, strict=True)]
    ticks = trials.steps - trials.first
    means = [
        np.array([total[trials.motion == index].mean(axis=0) for index in range(len(MOTIONS))]) / ticks
        for total in sums
    ]
    instants = len(AHEAD_S)
    roots = [np.sqrt(mean) for mean in means[: 2 + instants]]
    stated = means[2 + instants :]
    coverage, nees = stated if stated else (None, None)
    return Scores(roots[0], roots[1], np.array(roots[2:]), coverage, nees)


def track(trials: Trials, config: TrackingConfig) -> Scores:
    """Ours: the tracker as it flies, one named detection of every obstacle in each frame."""
    cell, count = trials.cell, trials.z.shape[1]
    tracker = Tracker(msgspec.structs.replace(config, max_tracks=count))
    names = [f"{m:04d}" for m in range(count)]
    latency_ns = round(cell.latency_s * NS_PER_S)

    def estimates() -> Iterator[Estimate]:
        for k in range(trials.steps):
            stamp_ns = round(k * trials.dt_s * NS_PER_S)
            found = tuple(
                Detection(names[m], frozen(trials.z[k, m]), 0.2, cell.sigma_m)
                for m in np.flatnonzero(trials.seen[k]).tolist()
            )
            now_ns = stamp_ns + latency_ns
            tracker.update([DetectionFrame(stamp_ns, "bench", k, DetectionKind.DETECTION, found)], now_ns)
            table = tracker.table()
            if len(table) != count:
                raise ValueError(f"{cell.name}: a track was lost; the bench expects gaps below coast_s")
            p, entries = tracker.forecast(now_ns, np.array(AHEAD_S))
            yield table.p_enu, table.v_enu, [p[:, 0], p[:, 1]], _full(entries[..., 0])

    scores = scored(trials, estimates())
    return replace(scores, lost=tracker.dropped["lost"], restarted=tracker.dropped["outlier"])


def _full(entries: FloatArray) -> FloatArray:
    """Symmetric (M, 3, 3) from xx, yy, zz, yz, xz, xy (M, 6)."""
    return entries[:, [0, 5, 4, 5, 1, 3, 4, 3, 2]].reshape(-1, 3, 3)


def track_single(trials: Trials, order: int, densities: FloatArray) -> Scores:
    """CV (order 2) or CA (order 3) with each of ``densities``: scores carry a grid axis."""

    def estimates() -> Iterator[Estimate]:
        model = SingleModel(order, densities, trials.z[0], trials.cell.sigma_m)
        for k in range(trials.steps):
            if k:
                model.predict(trials.dt_s)
                model.update(trials.z[k], trials.seen[k])
            p, v = model.ahead(trials.cell.latency_s)
            yield p, v, [model.ahead(trials.cell.latency_s + tau)[0] for tau in AHEAD_S], None

    return scored(trials, estimates())


def track_filterpy(trials: Trials, *, accel_psd: float, jerk_psd: float, stay: float) -> Scores:
    """filterpy's IMM, one estimator an obstacle, in a Python loop: that is how it is used."""
    late = trials.cell.latency_s

    def estimates() -> Iterator[Estimate]:
        imms = [
            FilterpyImm(z, trials.cell.sigma_m, accel_psd=accel_psd, jerk_psd=jerk_psd, stay=stay) for z in trials.z[0]
        ]
        for k in range(trials.steps):
            if k:
                for m, imm in enumerate(imms):
                    imm.step(trials.dt_s, trials.z[k, m] if trials.seen[k, m] else None)
            now = [imm.ahead(late) for imm in imms]
            ahead = [np.array([imm.ahead(late + tau)[0] for imm in imms]) for tau in AHEAD_S]
            yield np.array([p for p, _ in now]), np.array([v for _, v in now]), ahead, None

    return scored(trials, estimates())


def hindsight(trials: Trials) -> Scores:
    """Per motion and figure the best of CV and CA over their grids: what one could have known afterwards."""
    both = track_single(trials, 2, CV_GRID), track_single(trials, 3, CA_GRID)

    def best(of: Callable[[Scores], FloatArray]) -> FloatArray:
        return np.asarray(np.minimum(*(of(scores).min(axis=-1) for scores in both)))

    return Scores(best(lambda s: s.now_m), best(lambda s: s.velocity_m_s), best(lambda s: s.ahead_m))
