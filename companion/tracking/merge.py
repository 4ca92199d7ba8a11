"""One obstacle seen by two sources is one track: who is told apart, who agrees, and the union of the two.

Two tracks may be the same obstacle while no source has seen both at one stamp. They agree at an instant where

    |dp| + sigma / 2 <= r_1 + r_2                    two solid spheres never come closer than that,
    dx^T (P_1 + P_2)^-1 dx <= 16.81                  position and velocity, 99 % of chi-squared with 6 degrees,

sigma being the largest of P_1 + P_2 in position, and are merged when they have agreed at every check for `merge_s`:
where sensors are too coarse to tell that the two would touch, they stay two. Tracks of one obstacle share its process
noise, so their difference is smaller than P_1 + P_2 says and such a pair passes more often than in 99 %; what keeps
two obstacles two is that they do not touch, for long. Where one track agrees with two that are told apart, the nearer
gets it. Trusted and untrusted tracks are checked apart, each by frames of their own.
Everything here goes by the stamps of frames, so a replay decides the same.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from companion.tracking.bank import put
from companion.tracking.engine import Engine
from companion.tracking.imm import fuse, fuse_mean
from companion.tracking.tracks import BoolArray, IntArray, Keys, Rows, Tracks
from companion.types import NS_PER_S, FloatArray

CHECK_NS = NS_PER_S // 10  # between two checks at least
CHECKS_MIN = 5
RECENT_NS = 3 * NS_PER_S // 10  # a track without a measurement for longer is not judged
DISTANCE_MAX = 16.81
SLACK_M = 1.0  # what a straight line from the last measurement may be off; the test itself is exact


@dataclass(frozen=True, slots=True)
class Streak:
    """A pair that has agreed at every check since."""

    since_ns: int
    checks: int = 1


@dataclass(frozen=True, slots=True)
class Watch:
    """What merging remembers from frame to frame."""

    checked_ns: int | None = None
    streaks: dict[tuple[str, str], Streak] = field(default_factory=dict)  # by the ids of the pair


def tell_apart(tracks: Tracks, source: int, stamp_ns: int) -> Tracks:
    """Remember which tracks ``source`` has seen at one stamp: those are not one obstacle."""
    keys = tracks.keys
    rows = np.unique(keys.row[(keys.source == source) & (keys.seen_ns == stamp_ns)])
    pairs = np.ix_(rows, rows)
    if tracks.apart[pairs].all():
        return tracks
    apart = tracks.apart.copy()
    apart[pairs] = True
    return replace(tracks, apart=apart)


def merge_agreeing(
    tracks: Tracks, watch: Watch, stamp_ns: int, merge_s: float, engine: Engine, *, trusted: bool
) -> tuple[Tracks, Watch]:
    """Check the pairs of one trust if that is due, and merge those that have agreed for long enough."""
    if watch.checked_ns is not None and stamp_ns - watch.checked_ns < CHECK_NS:
        return tracks, watch
    recent = tracks.confirmed & (tracks.trusted == trusted) & (tracks.stamp_ns >= stamp_ns - RECENT_NS)
    row_of = {name: row for row, name in enumerate(tracks.ids)}
    streaks = {pair: streak for pair, streak in watch.streaks.items() if _waits(tracks, recent, row_of, pair)}
    merging: list[tuple[float, tuple[str, str]]] = []
    for i, j, distance in agreeing(tracks, recent, stamp_ns, engine):
        pair = (tracks.ids[i], tracks.ids[j])
        before = watch.streaks.get(pair)
        streaks[pair] = Streak(stamp_ns) if before is None else replace(before, checks=before.checks + 1)
        if streaks[pair].checks >= CHECKS_MIN and stamp_ns - streaks[pair].since_ns >= merge_s * NS_PER_S:
            merging.append((distance, pair))
    for _, pair in sorted(merging):
        if set(pair).issubset(tracks.ids):  # not yet merged with a third
            i, j = (tracks.ids.index(name) for name in pair)
            if not tracks.apart[i, j]:  # nor with one that is told apart from the other
                tracks = union(tracks, i, j, stamp_ns, engine)
    alive = set(tracks.ids)
    return tracks, Watch(stamp_ns, {pair: streak for pair, streak in streaks.items() if alive.issuperset(pair)})


def _waits(tracks: Tracks, recent: BoolArray, row_of: dict[str, int], pair: tuple[str, str]) -> bool:
    """Whether this check says nothing about ``pair``: a track that a slow source updates waits for its next."""
    i, j = (row_of.get(name, -1) for name in pair)
    return min(i, j) >= 0 and not (recent[i] and recent[j]) and not tracks.apart[i, j]


def agreeing(tracks: Tracks, recent: BoolArray, stamp_ns: int, engine: Engine) -> list[tuple[int, int, float]]:
    """Pairs of the ``recent`` tracks that may be one obstacle at ``stamp_ns``: rows i < j and their distance."""
    chosen = np.flatnonzero(recent)
    trusted, radius_m = tracks.trusted[chosen], tracks.radius_m()[chosen]
    bank = tracks.bank
    mean = fuse_mean(bank.x[chosen], bank.probabilities[chosen])
    p = mean[:, :3] + mean[:, 3:6] * _since(tracks.stamp_ns[chosen], stamp_ns)[:, None]
    reach = radius_m[:, None] + radius_m + SLACK_M
    squared = (p * p).sum(axis=1)
    near = squared[:, None] + squared - 2.0 * (p @ p.T) <= reach * reach
    near &= (trusted[:, None] == trusted) & ~tracks.apart[np.ix_(chosen, chosen)]
    first, second = np.nonzero(np.triu(near, 1))
    if not first.size:
        return []
    involved, place = np.unique(np.concatenate((first, second)), return_inverse=True)
    mean, spread = _carried(tracks, chosen[involved], stamp_ns, engine)
    i, j = place[: first.size], place[first.size :]
    dx, both = (mean[i] - mean[j])[:, :6], (spread[i] + spread[j])[:, :6, :6]
    distance = (dx * np.linalg.solve(both, dx[..., None])[..., 0]).sum(axis=1)
    sigma = np.sqrt(np.linalg.eigvalsh(both[:, :3, :3])[:, -1])
    touching = np.linalg.norm(dx[:, :3], axis=1) + 0.5 * sigma <= radius_m[first] + radius_m[second]
    agree = np.flatnonzero(touching & (distance <= DISTANCE_MAX))
    rows = chosen[first[agree]].tolist(), chosen[second[agree]].tolist()
    return list(zip(*rows, distance[agree].tolist(), strict=True))


def union(tracks: Tracks, i: int, j: int, stamp_ns: int, engine: Engine) -> Tracks:
    """Rows i and j as one: row and id of the older, the surer state, the keys of both."""
    keep, gone = sorted((i, j), key=lambda row: (int(tracks.born_ns[row]), tracks.ids[row]))
    _, spread = _carried(tracks, np.array([keep, gone]), stamp_ns, engine)
    trace = np.trace(spread[:, :3, :3], axis1=1, axis2=2)
    state_of = np.array([gone if trace[1] < trace[0] else keep])
    row = np.array([keep])
    stamps, unchecked, apart = tracks.stamp_ns.copy(), tracks.unchecked.copy(), tracks.apart.copy()
    stamps[keep] = tracks.stamp_ns[state_of[0]]
    unchecked[keep] &= unchecked[gone]
    settled = tracks.settled.copy()
    settled[keep] |= settled[gone]
    apart[keep] |= apart[gone]
    apart[:, keep] |= apart[:, gone]
    keys = tracks.keys
    rows = np.where(keys.row == gone, keep, keys.row)
    tracks = replace(
        tracks,
        bank=put(tracks.bank, row, tracks.bank.take(state_of)),
        stamp_ns=stamps,
        settled=settled,
        unchecked=unchecked,
        apart=apart,
        keys=_one_anonymous_each(replace(keys, row=rows), keep),
    )
    return tracks.take(np.delete(np.arange(len(tracks)), gone))


def _since(track_ns: IntArray, stamp_ns: int) -> FloatArray:
    return np.asarray((stamp_ns - track_ns) / NS_PER_S)


def _carried(tracks: Tracks, rows: Rows, stamp_ns: int, engine: Engine) -> tuple[FloatArray, FloatArray]:
    """Fused mean (R, 10) and covariance (R, 10, 10) of ``rows`` at ``stamp_ns``."""
    bank = tracks.bank
    dt = _since(tracks.stamp_ns[rows], stamp_ns)
    x, covariance = engine.propagate(bank.x[rows], bank.covariance[rows], dt)
    return fuse(x, covariance, bank.probabilities[rows])


def _one_anonymous_each(keys: Keys, row: int) -> Keys:
    """Of several anonymous keys of one source on ``row`` the one seen last stays."""
    newest: dict[str, int] = {}
    for k in np.flatnonzero(keys.row == row).tolist():
        source, name = keys.names[k]
        if name is None and (source not in newest or keys.seen_ns[k] >= keys.seen_ns[newest[source]]):
            newest[source] = k
    stay = [k for k, name in enumerate(keys.names) if name[1] is not None or keys.row[k] != row]
    return keys.take(np.array(sorted([*stay, *newest.values()]), dtype=np.intp))
