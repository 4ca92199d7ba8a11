"""How tracks are confirmed and how they end: silence, chances used up, no room.

Each function returns the tracks that stay and adds what ended to ``counts``.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np

from companion.tracking.imm import fuse_mean
from companion.tracking.tracks import COAST_MIN_NS, BoolArray, Rows, Sightings, Tracks
from companion.types import Vec3


def expire(tracks: Tracks, now_ns: int, coast_ns: int, counts: Counter[str], *, spare_trusted: bool = False) -> Tracks:
    """Without the tracks that have coasted too long at ``now_ns``, and the keys without detection for ``coast_ns``.

    A key ends alone while others keep its track: an id seen again much later may be another obstacle.

    Args:
        spare_trusted: the frame that brings the time is of an untrusted source; it ends no trusted track.
    """
    gone = tracks.stamp_ns + tracks.coast_ns(coast_ns) < now_ns
    if gone.any():
        if spare_trusted:
            gone &= ~tracks.trusted
        tracks = _without(tracks, gone, counts, lost="lost")
    return _without_old_keys(tracks, now_ns - coast_ns, spare_trusted=spare_trusted)


def forget(tracks: Tracks, oldest_ns: int, counts: Counter[str]) -> Tracks:
    """Without the tracks and keys that were not seen since ``oldest_ns``, whatever the frames said."""
    gone = tracks.stamp_ns < oldest_ns
    if gone.any():
        tracks = _without(tracks, gone, counts, lost="lost")
    return _without_old_keys(tracks, oldest_ns, spare_trusted=False)


def _without_old_keys(tracks: Tracks, oldest_ns: int, *, spare_trusted: bool) -> Tracks:
    keys = tracks.keys
    if len(keys.names) == len(tracks) or keys.seen_ns.min() >= oldest_ns:
        return tracks
    fresh = keys.seen_ns >= oldest_ns
    if spare_trusted:
        fresh |= tracks.trusted[keys.row]
    return replace(tracks, keys=keys.take(np.flatnonzero(fresh)))


def confirm(
    tracks: Tracks, used: Rows, source: int, stamp_ns: int, confirm_hits: int, counts: Counter[str], *, new_look: bool
) -> Tracks:
    """Tentative tracks after a frame of ``source``: hits of those ``used``, and a chance less for its own.

    Hits are counted from new looks of the source that began the track, so that two sensors of one instant do not
    confirm it for each other; those of others count once it is `COAST_MIN_NS` old, should its own source fall silent.

    Args:
        new_look: the frame is the first of its source with this stamp; only then it takes a chance.
    """
    if tracks.confirmed.all():
        return tracks
    hits, chances = tracks.hits.copy(), tracks.chances.copy()
    counted = (tracks.home[used] == source) & new_look | (stamp_ns - tracks.born_ns[used] >= COAST_MIN_NS)
    hits[used[counted]] += 1
    confirmed = tracks.confirmed | (hits >= confirm_hits)
    if new_look:
        chances[(tracks.home == source) & (tracks.born_ns < stamp_ns)] -= 1
    tracks = replace(tracks, hits=hits, chances=chances, confirmed=confirmed)
    return _without(tracks, ~confirmed & (chances <= 0), counts, lost="unconfirmed")


def make_room(
    tracks: Tracks, births: Sightings, trusted: bool, most: int, p_own: Vec3 | None, counts: Counter[str]
) -> tuple[Tracks, Sightings]:
    """The tracks that stay and the births that get in, ``most`` together.

    Trusted ones first, then those nearest to the vehicle at ``p_own``; where that is unknown, the older.
    """
    over = len(tracks) + len(births) - most
    if over <= 0:
        return tracks, births
    p_enu = np.concatenate((fuse_mean(tracks.bank.x, tracks.bank.probabilities)[:, :3], births.measurements.z[:, :3]))
    distance = np.zeros(len(p_enu)) if p_own is None else np.linalg.norm(p_enu - p_own, axis=1)
    untrusted = np.append(~tracks.trusted, np.full(len(births), not trusted))
    stay = np.sort(np.lexsort((np.arange(len(p_enu)), distance, untrusted))[:most])
    counts["over_max_tracks"] += over
    kept = stay[stay < len(tracks)]
    return tracks.take(kept), births.take(stay[kept.size :] - len(tracks))


def _without(tracks: Tracks, gone: BoolArray, counts: Counter[str], *, lost: str) -> Tracks:
    """Tracks less those ``gone``, counted as ``lost``, a tentative one as unconfirmed."""
    if not gone.any():
        return tracks
    tentative = int((gone & ~tracks.confirmed).sum())
    counts["unconfirmed"] += tentative
    counts[lost] += int(gone.sum()) - tentative
    return tracks.take(np.flatnonzero(~gone))
