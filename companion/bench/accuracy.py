"""How well the motions of `motions` are tracked: errors now and ahead, and whether the stated covariance is true.

All filters see the same measurements. Every tick they are asked where the obstacle is now (the tick, not the stamp of
the measurement) and where it will be; ticks of the first `SETTLE_S` do not count.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

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
        return f"sigma {self.sigma_m:g} m, {self.rate_hz:g} Hz, {self.dropout:.0%} lost, {self.latency_s * 1e3:.0f} ms late"


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


@dataclass(slots=True)
class Errors:
    """Squared errors of M obstacles, summed over the ticks that counted, and what became of the tracks."""

    now: FloatArray  # (M, ...) [m^2]
    velocity: FloatArray  # [m^2/s^2]
    ahead: FloatArray  # (len(AHEAD_S), M, ...) [m^2]
    inside: FloatArray | None  # ticks at which the truth lay in the 95 % ellipsoid at +AHEAD_S[0]
    nees: FloatArray | None  # sum of the normalised estimation error squared there, divided by 3
    ticks: int
    lost: int = 0


Estimate = tuple[FloatArray, FloatArray, list[FloatArray], FloatArray | None]


def summed(trials: Trials, estimates: Iterable[Estimate]) -> Errors:
    """Errors from (position, velocity, positions ahead, covariance at +AHEAD_S[0]) at every tick."""
    errors: Errors | None = None
    for k, (p, v, ahead, covariance) in enumerate(estimates):
        if k < trials.first:
            continue
        grid = p.ndim - 2  # single-model filters carry a grid axis
        at = (slice(None), *[None] * grid)
        now = ((p - trials.now[k][at]) ** 2).sum(axis=-1)
        velocity = ((v - trials.velocity[k][at]) ** 2).sum(axis=-1)
        off = [q - truth[k][at] for q, truth in zip(ahead, trials.ahead, strict=True)]
        squared = np.array([(e**2).sum(axis=-1) for e in off])
        inside = nees = None
        if covariance is not None:
            weighed = np.linalg.solve(covariance, off[0][..., None])[..., 0]
            nees = (off[0] * weighed).sum(axis=-1)
            inside = (nees <= CHI2_95).astype(np.float64)
            nees = nees / 3.0
        if errors is None:
            errors = Errors(now, velocity, squared, inside, nees, 1)
            continue
        errors.now += now
        errors.velocity += velocity
        errors.ahead += squared
        errors.ticks += 1
        if inside is not None and errors.inside is not None and errors.nees is not None:
            errors.inside += inside
            errors.nees += nees
    if errors is None:
        raise ValueError("trials: expected more ticks than SETTLE_S takes")
    return errors


def track(trials: Trials, config: TrackingConfig) -> Errors:
    """Ours: the tracker as it flies, one named detection of every obstacle in each frame."""
    cell, count = trials.cell, trials.z.shape[1]
    tracker = Tracker(msgspec.structs.replace(config, max_tracks=1024))
    names = [f"{m:04d}" for m in range(count)]
    latency_ns = round(cell.latency_s * NS_PER_S)
    lost = 0

    def estimates() -> Iterator[Estimate]:
        nonlocal lost
        for k in range(trials.steps):
            stamp_ns = round(k * trials.dt_s * NS_PER_S)
            found = tuple(
                Detection(names[m], frozen(trials.z[k, m]), 0.2, cell.sigma_m)
                for m in range(count)
                if trials.seen[k, m]
            )
            now_ns = stamp_ns + latency_ns
            tracker.update([DetectionFrame(stamp_ns, "bench", k, DetectionKind.DETECTION, found)], now_ns)
            if len(tracker) < count:
                lost += count - len(tracker)
                raise RuntimeError("a track was lost: the bench's sensors are never silent for coast_s")
            table = tracker.table()
            p, entries = tracker.forecast(now_ns, np.array(AHEAD_S))
            yield table.p_enu, table.v_enu, [p[:, 0], p[:, 1]], _full(entries[..., 0])

    errors = summed(trials, estimates())
    errors.lost = lost
    return errors


def _full(entries: FloatArray) -> FloatArray:
    """Symmetric (M, 3, 3) from xx, yy, zz, yz, xz, xy (M, 6)."""
    return entries[:, [0, 5, 4, 5, 1, 3, 4, 3, 2]].reshape(-1, 3, 3)


def track_single(trials: Trials, order: int, densities: FloatArray) -> Errors:
    """CV (order 2) or CA (order 3) with each of ``densities``: errors carry a grid axis."""

    def estimates() -> Iterator[Estimate]:
        model = SingleModel(order, densities, trials.z[0], trials.cell.sigma_m)
        for k in range(trials.steps):
            if k:
                model.predict(trials.dt_s)
                model.update(trials.z[k], trials.seen[k])
            p, v = model.ahead(trials.cell.latency_s)
            yield p, v, [model.ahead(trials.cell.latency_s + tau)[0] for tau in AHEAD_S], None

    return summed(trials, estimates())


def track_filterpy(trials: Trials, *, accel_psd: float, jerk_psd: float, stay: float) -> Errors:
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

    return summed(trials, estimates())


def by_motion(trials: Trials, values: FloatArray, ticks: int) -> FloatArray:
    """Mean of per-obstacle sums over the trials of each motion: (M, ...) -> (len(MOTIONS), ...)."""
    return np.array([values[trials.motion == index].mean(axis=0) / ticks for index in range(len(MOTIONS))])
