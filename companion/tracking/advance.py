"""Known tracks by one measurement each: the bank's update, outliers, restarts, and keys that leave a shared track.

A detection farther than `jump_sigma` off is skipped once. A second time running the track restarts there, if the key
is its only one; else the key leaves it and begins its own track there, as it does after five detections running
outside `gate_sigma`: then the sources do not see the same obstacle.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from companion.config import TrackingConfig
from companion.tracking.identity import unbound, with_anonymous_keys
from companion.tracking.imm import Constants, birth, put, step
from companion.tracking.tracks import BoolArray, IntArray, Keys, Rows, Sightings, Tracks
from companion.types import NS_PER_S, FloatArray

SPLIT_OUTSIDE = 5  # detections running

Column = TypeVar("Column", bound=npt.NDArray[np.generic])


@dataclass(frozen=True, slots=True)
class Judgement:
    """What becomes of D measurements."""

    skipped: BoolArray
    restarted: BoolArray
    leaving: BoolArray
    outside: IntArray  # running, of each key


def advance(
    tracks: Tracks,
    sightings: Sightings,
    source: int,
    stamp_ns: int,
    config: TrackingConfig,
    constants: Constants,
    counts: Counter[str],
    *,
    foreign: bool,
) -> tuple[Tracks, Sightings, Rows]:
    """Tracks after the ``sightings`` that have a row; those that begin tracks; and the rows that were updated."""
    known = np.flatnonzero(sightings.rows >= 0)
    if not known.size:
        return tracks, sightings, known
    placed = sightings if known.size == len(sightings) else sightings.take(known)
    tracks, key = with_anonymous_keys(tracks, placed, source, stamp_ns)
    full = placed.measurements.full
    parts = [np.flatnonzero(full == part) for part in (False, True)] if full.any() else [np.arange(len(placed))]
    left, used = [], []
    for part in parts:
        if part.size:
            chosen = placed if part.size == len(placed) else placed.take(part)
            tracks, judged = _filter(tracks, chosen, key[part], stamp_ns, config, constants, foreign)
            counts["outlier"] += int(judged.skipped.sum())
            left.append(part[judged.leaving])
            used.append(placed.rows[part[~judged.skipped & ~judged.leaving]])
    leaving = np.concatenate(left)
    if leaving.size:
        tracks = unbound(tracks, key[leaving])
    fresh = np.sort(np.concatenate((np.flatnonzero(sightings.rows < 0), known[leaving])))
    return tracks, sightings.take(fresh), np.concatenate(used)


def _filter(
    tracks: Tracks,
    found: Sightings,
    key: Rows,
    stamp_ns: int,
    config: TrackingConfig,
    constants: Constants,
    foreign: bool,
) -> tuple[Tracks, Judgement]:
    """One step of the bank for measurements of one dimension."""
    rows, full = found.rows, bool(found.measurements.full[0])
    everything = rows.tolist() == list(range(len(tracks)))  # as when a frame shows every track, the common case
    before = tracks.bank if everything else tracks.bank.take(rows)
    # a nanosecond stands for none, as between two sources of one stamp: no model may have probability zero
    dt = np.maximum(stamp_ns - tracks.stamp_ns[rows], 1) / NS_PER_S
    z, noise = found.measurements.parts(full)
    after, nis = step(before, dt, z, noise, constants, foreign=foreign)
    judged = _judge(tracks, rows, key, nis.min(axis=1), config)
    if judged.restarted.any():
        again = np.flatnonzero(judged.restarted)
        after = put(after, again, birth(z[again], noise[again], constants))
    radius_m, keys = found.measurements.radius_m, _noted(tracks.keys, key, judged, stamp_ns)
    unused = judged.skipped | judged.leaving
    if unused.any():
        stays = np.flatnonzero(~unused)
        rows, after, everything = rows[stays], after.take(stays), False
        key, radius_m = key[stays], radius_m[stays]
    bank = after if everything else put(tracks.bank, rows, after)
    stamps = _written(tracks.stamp_ns, rows, stamp_ns)
    keys = replace(keys, radius_m=_written(keys.radius_m, key, radius_m))
    return replace(tracks, bank=bank, stamp_ns=stamps, keys=keys), judged


def _judge(tracks: Tracks, rows: Rows, key: Rows, nis: FloatArray, config: TrackingConfig) -> Judgement:
    """What becomes of measurements with the normalised innovations squared ``nis`` (D,) of the nearest model."""
    keys = tracks.keys
    off = nis > config.gate_sigma**2
    far = nis > config.jump_sigma**2
    outside = np.where(off, keys.outside[key] + 1, 0)
    if not off.any() and not far.any():
        return Judgement(far, far, far, outside)
    shared = tracks.keys_per_track()[rows] > 1
    again = far & keys.outlier[key]
    leaving = shared & (again | (outside >= SPLIT_OUTSIDE))
    return Judgement(far & ~again & ~leaving, again & ~shared, leaving, outside)


def _noted(keys: Keys, key: Rows, judged: Judgement, stamp_ns: int) -> Keys:
    return replace(
        keys,
        seen_ns=_written(keys.seen_ns, key, stamp_ns),
        outlier=_written(keys.outlier, key, judged.skipped),
        outside=_written(keys.outside, key, judged.outside),
    )


def _written(column: Column, rows: Rows, values: Column | int) -> Column:
    """A copy of ``column`` with ``rows`` replaced: what stands in a checkpoint is never written."""
    copy = column.copy()
    copy[rows] = values
    return copy
