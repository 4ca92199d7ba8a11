"""The table of tracks: rows of the filter bank, and the keys under which sources know them.

A key is (source, id) for what a source names, and (source, None) for the anonymous detections of a source that went
into one track. A track has at least one key; a named key is bound to one track. Values are frozen and no array is
written once it stands in a table, so a table is its own checkpoint: keeping it is keeping references.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from companion.config import TrackingConfig
from companion.tracking.bank import Bank, Constants, birth, join
from companion.tracking.measurement import Measurements
from companion.types import NS_PER_S, FloatArray

IntArray: TypeAlias = npt.NDArray[np.int64]
BoolArray: TypeAlias = npt.NDArray[np.bool_]
Rows: TypeAlias = npt.NDArray[np.intp]
Columns: TypeAlias = tuple[Any, ...]  # arrays of one length, in the order of their fields
Key: TypeAlias = tuple[str, str | None]

COAST_MIN_NS = 3 * NS_PER_S // 10
NEW = -1  # in place of a row: begins a track
OURSELVES = -2  # in place of a row: assigned to the vehicle's pseudo-track


@dataclass(frozen=True, slots=True, eq=False)
class Keys:
    """K keys of all tracks."""

    names: tuple[Key, ...]
    index: dict[Key, int]  # of the named ones; anonymous ones are found by source and row
    row: Rows  # (K,) the track
    source: Rows  # (K,) number of the source
    seen_ns: IntArray  # (K,) newest detection, used or not
    radius_m: FloatArray  # (K,) newest stated radius
    outlier: BoolArray  # (K,) the newest detection was skipped as an outlier
    outside: IntArray  # (K,) detections outside the gate without one inside since
    bias: FloatArray  # (K, 3) exponential mean of the whitened innovations, kept where a track has several keys

    def take(self, chosen: Rows) -> Keys:
        return _keys(tuple([self.names[k] for k in chosen]), *(column[chosen] for column in self.columns()))

    def with_columns(
        self, *, seen_ns: IntArray, radius_m: FloatArray, outlier: BoolArray, outside: IntArray, bias: FloatArray
    ) -> Keys:
        """The same keys after a frame."""
        return Keys(self.names, self.index, self.row, self.source, seen_ns, radius_m, outlier, outside, bias)

    def columns(self) -> Columns:
        return self.row, self.source, self.seen_ns, self.radius_m, self.outlier, self.outside, self.bias


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """M tracks in the order of their births."""

    ids: tuple[str, ...]
    bank: Bank  # each track at its own instant
    stamp_ns: IntArray  # (M,) that instant: of the last measurement used
    born_ns: IntArray  # (M,)
    home: Rows  # (M,) number of the source that began it
    hits: IntArray  # (M,) detections used, counted while tentative
    chances: IntArray  # (M,) frames of the home source in which a tentative track may still be confirmed
    trusted: BoolArray  # (M,)
    confirmed: BoolArray  # (M,)
    settled: BoolArray  # (M,) known by a name, or believed at birth: coasts for the whole time
    unchecked: BoolArray  # (M,) born while the vehicle's own path was unknown: may be the vehicle itself
    apart: BoolArray  # (M, M) some source has seen both at one stamp
    keys: Keys

    def __len__(self) -> int:
        return len(self.ids)

    def take(self, rows: Rows) -> Tracks:
        """The tracks ``rows`` with their keys."""
        place = self.places(rows)
        keys = self.keys.take(np.flatnonzero(place[self.keys.row] >= 0))
        ids, columns = tuple([self.ids[row] for row in rows]), tuple([column[rows] for column in self.columns()])
        apart, keys = self.apart[np.ix_(rows, rows)], replace(keys, row=place[keys.row])
        return _tracks(ids, self.bank.take(rows), columns, apart, keys)

    def places(self, rows: Rows) -> Rows:
        """(M,) where each track stands in ``take(rows)``, -1 where it does not."""
        place = np.full(len(self), -1, dtype=np.intp)
        place[rows] = np.arange(len(rows))
        return place

    def columns(self) -> Columns:
        who = self.stamp_ns, self.born_ns, self.home
        return *who, self.hits, self.chances, self.trusted, self.confirmed, self.settled, self.unchecked

    def advanced(self, bank: Bank, stamp_ns: IntArray, keys: Keys) -> Tracks:
        """The same tracks after a frame; many times faster than `dataclasses.replace`."""
        return _tracks(self.ids, bank, (stamp_ns, *self.columns()[1:]), self.apart, keys)

    def coast_ns(self, most_ns: int) -> IntArray:
        """(M,) how long after its last measurement each track is still one, by the stamps of frames.

        One that is not settled coasts no longer than twice the time over which it was seen, and `COAST_MIN_NS` at
        least: clutter that looked like an obstacle for two frames is soon gone.
        """
        seen_ns = np.maximum(2 * (self.stamp_ns - self.born_ns), COAST_MIN_NS)
        return np.where(self.settled | ~self.confirmed, most_ns, np.minimum(seen_ns, most_ns))

    def reach_m(self) -> FloatArray:
        """(M,) twice the radius of those that some source knows by an id, infinite for the others."""
        reach = np.full(len(self), np.inf)
        named = self.keys.row[list(self.keys.index.values())]
        reach[named] = 2.0 * self.radius_m()[named]
        return reach

    def radius_m(self) -> FloatArray:
        """(M,) the largest of the newest radii that each track's keys state."""
        radius = np.zeros(len(self))
        np.maximum.at(radius, self.keys.row, self.keys.radius_m)
        return radius

    def keys_per_track(self) -> IntArray:
        return np.bincount(self.keys.row, minlength=len(self))


@dataclass(frozen=True, slots=True)
class Sightings:
    """D detections of one frame on their way to tracks."""

    names: tuple[Key, ...]
    measurements: Measurements
    rows: Rows  # (D,) the track, or NEW, or OURSELVES
    hits: IntArray  # (D,) detections behind it: 1, or more where a suspected sight of ourselves turned out not to be

    def __len__(self) -> int:
        return len(self.names)

    def take(self, chosen: Rows) -> Sightings:
        names = tuple([self.names[k] for k in chosen])
        return Sightings(names, self.measurements.take(chosen), self.rows[chosen], self.hits[chosen])


@dataclass(frozen=True, slots=True)
class Origin:
    """What all tracks that begin in one frame share."""

    stamp_ns: int
    source: int  # number
    trusted: bool
    unchecked: bool


def no_tracks(constants: Constants) -> Tracks:
    ints, flags = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.bool_)
    rows = np.zeros(0, dtype=np.intp)
    keys = Keys((), {}, rows, rows, ints, np.zeros(0), flags, ints, np.zeros((0, 3)))
    bank = birth(np.zeros((0, 3)), np.zeros((0, 3, 3)), constants)
    columns = ints, ints, rows, ints, ints, flags, flags, flags, flags
    return _tracks((), bank, columns, np.zeros((0, 0), dtype=np.bool_), keys)


def newborn(
    found: Sightings, ids: tuple[str, ...], origin: Origin, config: TrackingConfig, constants: Constants
) -> Tracks:
    """One new track from each of ``found``, all or none of which state a velocity.

    A named one is confirmed at birth, an anonymous one is tentative until it has `confirm_hits`.
    """
    count = len(found)
    full = bool(found.measurements.full[0])
    believed = np.array([name[1] is not None for name in found.names]) | (found.hits >= config.confirm_hits)
    stamp_ns = np.full(count, origin.stamp_ns, dtype=np.int64)
    home = np.full(count, origin.source, dtype=np.intp)
    return Tracks(
        ids=ids,
        bank=birth(*found.measurements.parts(full), constants),
        stamp_ns=stamp_ns,
        born_ns=stamp_ns,
        home=home,
        hits=found.hits,
        chances=np.full(count, config.confirm_frames, dtype=np.int64),
        trusted=np.full(count, origin.trusted),
        confirmed=believed,
        settled=believed,
        unchecked=np.full(count, origin.unchecked),
        apart=np.zeros((count, count), dtype=np.bool_),
        keys=first_keys(found, np.arange(count), origin.source, origin.stamp_ns),
    )


def first_keys(found: Sightings, rows: Rows, source: int, stamp_ns: int) -> Keys:
    """A new key for each of ``found`` on the tracks ``rows``."""
    count = len(found)
    return _keys(
        found.names,
        rows,
        np.full(count, source, dtype=np.intp),
        np.full(count, stamp_ns, dtype=np.int64),
        found.measurements.radius_m,
        np.zeros(count, dtype=np.bool_),
        np.zeros(count, dtype=np.int64),
        np.zeros((count, 3)),
    )


def join_tracks(first: Tracks, second: Tracks) -> Tracks:
    """The tracks of both, those of ``second`` behind."""
    m, n = len(first), len(second)
    apart = np.zeros((m + n, m + n), dtype=np.bool_)
    apart[:m, :m], apart[m:, m:] = first.apart, second.apart
    keys = join_keys(first.keys, replace(second.keys, row=second.keys.row + m))
    columns = _stacked(first.columns(), second.columns())
    return _tracks(first.ids + second.ids, join(first.bank, second.bank), columns, apart, keys)


def join_keys(first: Keys, second: Keys) -> Keys:
    return _keys(first.names + second.names, *_stacked(first.columns(), second.columns()))


def unique_id(wanted: str, taken: Collection[str]) -> str:
    """``wanted``, or ``wanted~2`` and so on where another track is still called so."""
    name, number = wanted, 1
    while name in taken:
        number += 1
        name = f"{wanted}~{number}"
    return name


def _tracks(ids: tuple[str, ...], bank: Bank, columns: Columns, apart: BoolArray, keys: Keys) -> Tracks:
    parts: Columns = (ids, bank, *columns, apart, keys)
    return Tracks(*parts)


def _keys(names: tuple[Key, ...], *columns: Any) -> Keys:
    index = {name: k for k, name in enumerate(names) if name[1] is not None}
    return Keys(names, index, *columns)


def _stacked(first: Columns, second: Columns) -> Columns:
    return tuple([np.concatenate(pair) for pair in zip(first, second, strict=True)])
