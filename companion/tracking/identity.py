"""Which track a detection belongs to: a named one by its key, anonymous ones by the cheapest assignment of all.

Where the frame's source has reported the vehicle itself lately, the vehicle takes part in the
assignment as a pseudo-track, so that its detection cannot pull an obstacle's track.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from companion.config import TrackingConfig
from companion.tracking.associate import Candidates, associate
from companion.tracking.engine import Engine
from companion.tracking.measurement import finite, measure
from companion.tracking.ownship import Fix, Suspects
from companion.tracking.tracks import NEW, OURSELVES, Key, Rows, Sightings, Tracks, first_keys, join_keys
from companion.types import NS_PER_S, Detection, DetectionFrame


@dataclass(frozen=True, slots=True)
class Found:
    """The usable detections of one frame: the named ones in the order of their keys, then the anonymous ones."""

    names: tuple[Key, ...]
    detections: tuple[Detection, ...]
    named: int


def usable(frame: DetectionFrame, last_anonymous_ns: int | None, counts: Counter[str]) -> Found:
    """Finite detections; of each id the first; the anonymous ones by position, none where their stamp is not new."""
    named: dict[str, Detection] = {}
    anonymous: list[Detection] = []
    for detection, is_finite in zip(frame.detections, finite(frame.detections), strict=True):
        if not is_finite:
            counts["not_finite"] += 1
        elif detection.id is None:
            anonymous.append(detection)
        elif detection.id in named:
            counts["duplicate"] += 1
        else:
            named[detection.id] = detection
    if anonymous and last_anonymous_ns is not None and frame.stamp_ns <= last_anonymous_ns:
        counts["duplicate" if frame.stamp_ns == last_anonymous_ns else "late"] += len(anonymous)
        anonymous = []
    anonymous.sort(key=lambda detection: tuple(detection.p_enu.tolist()))
    ids: list[str | None] = [*sorted(named), *[None] * len(anonymous)]
    names = tuple([(frame.source, name) for name in ids])
    return Found(names, (*[named[name] for name in sorted(named)], *anonymous), len(named))


def sightings_by_key(
    found: Found, tracks: Tracks, suspects: Suspects, stamp_ns: int, config: TrackingConfig, counts: Counter[str]
) -> Sightings:
    """Named detections with their tracks, less those seen before or older than their track; anonymous ones NEW."""
    keys = tracks.keys
    key = np.array([keys.index.get(name, -1) for name in found.names], dtype=np.intp)
    rows = np.where(key >= 0, keys.row[key], NEW) if keys.names else key
    sightings = Sightings(found.names, measure(found.detections, config), rows, np.ones(len(key), dtype=np.int64))
    if not suspects and (not keys.names or keys.seen_ns.max() < stamp_ns):
        return sightings  # newer than everything, the common case
    known = rows >= 0
    again = np.array([name[1] is not None and _seen_at(suspects, name, stamp_ns) for name in found.names])
    late = np.zeros_like(known)
    if known.any():
        again |= known & (keys.seen_ns[key] == stamp_ns)
        late = known & ~again & (tracks.stamp_ns[rows] > stamp_ns)
    counts["duplicate"] += int(again.sum())
    counts["late"] += int(late.sum())
    return sightings.take(np.flatnonzero(~again & ~late))


def _seen_at(suspects: Suspects, name: Key, stamp_ns: int) -> bool:
    evidence = suspects.get(name)
    return evidence is not None and evidence.seen_ns == stamp_ns


def disagreeing_names(tracks: Tracks, sightings: Sightings) -> tuple[Tracks, Sightings]:
    """Two ids of one source on one track in one frame: two obstacles after all. The one seen last keeps the track."""
    keys, rows = tracks.keys, sightings.rows
    if len(keys.names) == len(tracks):
        return tracks, sightings
    known = np.flatnonzero(rows >= 0)
    if np.unique(rows[known]).size == known.size:
        return tracks, sightings
    seen = {int(n): int(keys.seen_ns[keys.index[sightings.names[n]]]) for n in known}
    keeper: dict[int, int] = {}
    for n in sorted(seen, key=lambda n: -seen[n]):
        keeper.setdefault(int(rows[n]), n)
    leaving = np.array([n for n in seen if keeper[int(rows[n])] != n], dtype=np.intp)
    rows = rows.copy()
    rows[leaving] = NEW
    gone = np.array([keys.index[sightings.names[n]] for n in leaving], dtype=np.intp)
    return unbound(tracks, gone), replace(sightings, rows=rows)


def unbound(tracks: Tracks, gone: Rows) -> Tracks:
    """Tracks without the keys ``gone``."""
    return replace(tracks, keys=tracks.keys.take(np.delete(np.arange(len(tracks.keys.names)), gone)))


def associated(
    tracks: Tracks,
    sightings: Sightings,
    stamp_ns: int,
    trusted: bool,
    own: Fix | None,
    config: TrackingConfig,
    engine: Engine,
) -> Sightings:
    """Anonymous sightings with their tracks: of the same trust, and not named by the frame itself.

    Confirmed tracks choose first, so that one born of clutter takes no detection from them.

    Args:
        own: the vehicle as a pseudo-track; None: it takes no part.
    """
    anonymous = np.flatnonzero([name[1] is None for name in sightings.names])
    free = np.setdiff1d(np.flatnonzero((tracks.trusted == trusted) & (tracks.stamp_ns <= stamp_ns)), sightings.rows)
    rows, measurements = sightings.rows.copy(), sightings.measurements
    for confirmed in (True, False):
        chosen = free[tracks.confirmed[free] == confirmed]
        left = anonymous[rows[anonymous] == NEW]
        candidates = _predicted(tracks, chosen, stamp_ns, engine)
        if own is not None and confirmed:
            chosen, candidates = np.append(chosen, OURSELVES), _with_ourselves(candidates, own)
        z, noise = measurements.z[left, :3], measurements.noise[left, :3, :3]
        column = associate(z, noise, candidates, config.gate_sigma)
        rows[left] = np.append(chosen, NEW)[column]  # column -1 is none
    return replace(sightings, rows=rows)


def _predicted(tracks: Tracks, rows: Rows, stamp_ns: int, engine: Engine) -> Candidates:
    bank = tracks.bank.take(rows)
    dt = (stamp_ns - tracks.stamp_ns[rows]) / NS_PER_S
    x, covariance = engine.propagate(bank.x, bank.covariance, dt)
    return Candidates(x[..., :3], covariance[..., :3, :3], bank.probabilities, tracks.reach_m()[rows])


def _with_ourselves(candidates: Candidates, own: Fix) -> Candidates:
    """The vehicle behind ``candidates``, a mixture of one."""
    models = candidates.probabilities.shape[1]
    p_enu = np.broadcast_to(own.p_enu, (1, models, 3))
    covariance = np.broadcast_to(own.variance_m2 * np.eye(3), (1, models, 3, 3))
    return Candidates(
        np.concatenate((candidates.p_enu, p_enu)),
        np.concatenate((candidates.covariance, covariance)),
        np.concatenate((candidates.probabilities, np.full((1, models), 1.0 / models))),
        np.append(candidates.reach_m, np.inf),
    )


def with_anonymous_keys(tracks: Tracks, sightings: Sightings, source: int, stamp_ns: int) -> tuple[Tracks, Rows]:
    """The key of every sighting, which all have a track; where an anonymous one is the first there, a new key."""
    keys = tracks.keys
    key = np.array([keys.index.get(name, -1) for name in sightings.names], dtype=np.intp)
    anonymous = np.flatnonzero(key < 0)
    if not anonymous.size:
        return tracks, key
    own = np.flatnonzero([name == (sightings.names[anonymous[0]][0], None) for name in keys.names])
    key_at = np.full(len(tracks), -1, dtype=np.intp)
    key_at[keys.row[own]] = own
    key[anonymous] = key_at[sightings.rows[anonymous]]
    first = np.flatnonzero(key < 0)
    if first.size:
        fresh = first_keys(sightings.take(first), sightings.rows[first], source, stamp_ns)
        key[first] = len(keys.names) + np.arange(first.size)
        tracks = replace(tracks, keys=join_keys(keys, fresh))
    return tracks, key
