"""Known tracks by one measurement each: the bank's update, outliers, restarts, and keys that leave a shared track.

A detection farther than `jump_sigma` off is skipped once. A second time running the track restarts there, if the key
is its only one; else the key leaves it and begins its own track there, as it does after five detections running
outside `gate_sigma`, or when its detections are off on the mean: with w = L^-1 (z - p), S = L L^T, the whitened
innovations of one key against the fused track, and b their exponential mean with the gain 1 / `BIAS_DETECTIONS`,

    BIAS_DETECTIONS |b|^2 > 5^2      b ~ N(0, I / 19) where all keys see one obstacle.

Then the sources do not see the same obstacle, and the one track would fly between the two.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from companion.config import TrackingConfig
from companion.tracking.bank import Bank, birth, put
from companion.tracking.engine import Engine
from companion.tracking.identity import unbound, with_anonymous_keys
from companion.tracking.imm import fuse
from companion.tracking.tracks import BoolArray, IntArray, Rows, Sightings, Tracks
from companion.types import NS_PER_S, FloatArray

SPLIT_OUTSIDE = 5  # detections running
BIAS_DETECTIONS = 10
BIAS_GATE = 5.0**2

Column = TypeVar("Column", bound=npt.NDArray[np.generic])


@dataclass(frozen=True, slots=True)
class Judgement:
    """What becomes of D measurements."""

    skipped: BoolArray  # as an outlier
    restarted: BoolArray  # the track, at the measurement
    leaving: BoolArray  # the track, to begin another
    outside: IntArray  # running, of each key
    bias: FloatArray  # (D, 3)
    clean: bool  # nothing of all this


def advance(
    tracks: Tracks,
    sightings: Sightings,
    source: int,
    stamp_ns: int,
    config: TrackingConfig,
    engine: Engine,
    counts: Counter[str],
    *,
    foreign: bool,
) -> tuple[Tracks, Sightings | None, Rows]:
    """Tracks after the ``sightings`` that have a row; those that begin tracks, if any; and the rows updated."""
    placed, known = sightings, np.arange(len(sightings))
    if (sightings.rows < 0).any():
        known = np.flatnonzero(sightings.rows >= 0)
        placed = sightings.take(known)
    if not known.size:
        return tracks, sightings if len(sightings) else None, known
    tracks, key = with_anonymous_keys(tracks, placed, source, stamp_ns)
    parts = _parts(placed.measurements.full)
    unused, leaving = np.zeros(known.size, dtype=np.bool_), np.zeros(known.size, dtype=np.bool_)
    for part in parts:
        chosen = placed if len(parts) == 1 else placed.take(part)
        tracks, judged = _filter(tracks, chosen, key[part], stamp_ns, config, engine, foreign)
        if not judged.clean:
            unused[part], leaving[part] = judged.skipped | judged.leaving, judged.leaving
            counts["outlier"] += int(judged.skipped.sum())
    used = placed.rows[~unused]
    if leaving.any():
        tracks = unbound(tracks, key[leaving])
    elif known.size == len(sightings):
        return tracks, None, used
    fresh = np.delete(np.arange(len(sightings)), known[~leaving])
    return tracks, sightings.take(fresh), used


def _parts(full: BoolArray) -> list[Rows]:
    """The measurements of each dimension; the bank takes one dimension at a time."""
    if full.all() or not full.any():
        return [np.arange(full.size)]
    return [np.flatnonzero(~full), np.flatnonzero(full)]


def _filter(
    tracks: Tracks,
    found: Sightings,
    key: Rows,
    stamp_ns: int,
    config: TrackingConfig,
    engine: Engine,
    foreign: bool,
) -> tuple[Tracks, Judgement]:
    """One step of the bank for measurements of one dimension."""
    rows, measurements = found.rows, found.measurements
    everything = rows.tolist() == list(range(len(tracks)))  # as when a frame shows every track, the common case
    before = tracks.bank if everything else tracks.bank.take(rows)
    # a nanosecond stands for none, as between two sources of one stamp: no model may have probability zero
    dt = np.maximum(stamp_ns - tracks.stamp_ns[rows], 1) / NS_PER_S
    z, noise = measurements.parts(bool(measurements.full[0]))
    after, nis = engine.step(before, dt, z, noise, foreign=foreign)
    shared = tracks.keys_per_track()[rows] > 1
    bias = tracks.keys.bias[key]
    if shared.any():
        bias = _biased(bias, np.flatnonzero(shared), before, dt, z[:, :3], noise[:, :3, :3], engine)
    judged = _judge(tracks, key, nis.min(axis=1), shared, bias, config)
    radius_m, noted = measurements.radius_m, key
    if not judged.clean:
        again, used = np.flatnonzero(judged.restarted), np.flatnonzero(~(judged.skipped | judged.leaving))
        after = put(after, again, birth(z[again], noise[again], engine.constants)).take(used)
        rows, radius_m, noted = rows[used], radius_m[used], key[used]
        everything = False
    keys = tracks.keys
    keys = keys.with_columns(
        seen_ns=_written(keys.seen_ns, key, stamp_ns),
        radius_m=_written(keys.radius_m, noted, radius_m),
        outlier=_written(keys.outlier, key, judged.skipped),
        outside=_written(keys.outside, key, judged.outside),
        bias=_written(keys.bias, key, judged.bias),
    )
    bank = after if everything else put(tracks.bank, rows, after)
    return tracks.advanced(bank, _written(tracks.stamp_ns, rows, stamp_ns), keys), judged


def _judge(
    tracks: Tracks, key: Rows, nis: FloatArray, shared: BoolArray, bias: FloatArray, config: TrackingConfig
) -> Judgement:
    """What becomes of measurements with the normalised innovations squared ``nis`` (D,) of the nearest model.

    Args:
        shared: (D,) the track has several keys. bias: (D, 3) of each key, this detection included.
    """
    keys, gate, jump = tracks.keys, config.gate_sigma**2, config.jump_sigma**2
    off = shared & (BIAS_DETECTIONS * (bias * bias).sum(axis=1) > BIAS_GATE)
    if nis.max() <= min(gate, jump) and not off.any():
        none = np.zeros(len(nis), dtype=np.bool_)
        return Judgement(none, none, none, none.astype(np.int64), bias, clean=True)
    far = nis > jump
    outside = np.where(nis > gate, keys.outside[key] + 1, 0)
    again = far & keys.outlier[key]
    leaving = shared & (again | (outside >= SPLIT_OUTSIDE) | (off & ~far))
    return Judgement(far & ~again & ~leaving, again & ~shared, leaving, outside, bias, clean=False)


def _biased(
    bias: FloatArray, shared: Rows, before: Bank, dt: FloatArray, z: FloatArray, noise: FloatArray, engine: Engine
) -> FloatArray:
    """The biases (D, 3) with the innovations of the detections ``shared`` taken in."""
    bank = before.take(shared)
    x, covariance = engine.propagate(bank.x, bank.covariance, dt[shared])
    mean, spread = fuse(x, covariance, bank.probabilities)
    root = np.linalg.cholesky(spread[:, :3, :3] + noise[shared])
    whitened = np.linalg.solve(root, (z[shared] - mean[:, :3])[..., None])[..., 0]
    limit = np.sqrt(BIAS_GATE)  # one outlier does not make a bias
    size = np.linalg.norm(whitened, axis=1, keepdims=True)
    whitened *= np.minimum(1.0, limit / np.maximum(size, limit))
    bias = bias.copy()
    bias[shared] += (whitened - bias[shared]) / BIAS_DETECTIONS
    return bias


def _written(column: Column, rows: Rows, values: Column | int) -> Column:
    """A copy of ``column`` with ``rows`` replaced: what stands in a checkpoint is never written."""
    copy = column.copy()
    copy[rows] = values
    return copy
