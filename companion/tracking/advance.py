"""Known tracks by one measurement each: the bank's update, outliers, restarts, and keys that leave a shared track.

A detection farther than `jump_sigma` off is skipped once. A second time running the track restarts there, if the key
is its only one; else the key leaves it and begins its own track there, as it does after five detections running
outside `gate_sigma`: then the sources do not see the same obstacle.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from companion.config import TrackingConfig
from companion.tracking.bank import birth, put
from companion.tracking.engine import Engine
from companion.tracking.identity import unbound, with_anonymous_keys
from companion.tracking.tracks import BoolArray, IntArray, Rows, Sightings, Tracks
from companion.types import NS_PER_S, FloatArray

SPLIT_OUTSIDE = 5  # detections running

Column = TypeVar("Column", bound=npt.NDArray[np.generic])


@dataclass(frozen=True, slots=True)
class Judgement:
    """What becomes of D measurements."""

    skipped: BoolArray  # as an outlier
    restarted: BoolArray  # the track, at the measurement
    leaving: BoolArray  # the track, to begin another
    outside: IntArray  # running, of each key
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
    judged = _judge(tracks, rows, key, nis.min(axis=1), config)
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
    )
    bank = after if everything else put(tracks.bank, rows, after)
    return tracks.advanced(bank, _written(tracks.stamp_ns, rows, stamp_ns), keys), judged


def _judge(tracks: Tracks, rows: Rows, key: Rows, nis: FloatArray, config: TrackingConfig) -> Judgement:
    """What becomes of measurements with the normalised innovations squared ``nis`` (D,) of the nearest model."""
    keys, gate, jump = tracks.keys, config.gate_sigma**2, config.jump_sigma**2
    if nis.max() <= min(gate, jump):
        none = np.zeros(len(nis), dtype=np.bool_)
        return Judgement(none, none, none, none.astype(np.int64), clean=True)
    far = nis > jump
    outside = np.where(nis > gate, keys.outside[key] + 1, 0)
    shared = tracks.keys_per_track()[rows] > 1
    again = far & keys.outlier[key]
    leaving = shared & (again | (outside >= SPLIT_OUTSIDE))
    return Judgement(far & ~again & ~leaving, again & ~shared, leaving, outside, clean=False)


def _written(column: Column, rows: Rows, values: Column | int) -> Column:
    """A copy of ``column`` with ``rows`` replaced: what stands in a checkpoint is never written."""
    copy = column.copy()
    copy[rows] = values
    return copy
