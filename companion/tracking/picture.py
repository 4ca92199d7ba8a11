"""All that the tracker remembers, one frozen value: a frame turns it into the next, a rollback restores it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np

from companion.tracking.bank import Constants
from companion.tracking.merge import Watch
from companion.tracking.ownship import Suspects
from companion.tracking.tracks import BoolArray, Tracks, no_tracks


@dataclass(frozen=True, slots=True)
class Source:
    """What is remembered of one source."""

    number: int  # in the order of first frames
    newest_ns: int  # stamp of its newest frame, empty or not
    anonymous_ns: int | None = None  # of its newest frame with anonymous detections
    born: int = 0  # tracks that its anonymous detections began


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """The tracks after some frames; nothing in it is written again."""

    tracks: Tracks
    sources: dict[str, Source] = field(default_factory=dict)
    suspects: Suspects = field(default_factory=dict)
    watches: tuple[Watch, Watch] = field(default_factory=lambda: (Watch(), Watch()))  # of untrusted, of trusted tracks
    counts: Counter[str] = field(default_factory=Counter)  # detections not used and tracks ended, by reason


def empty_picture(constants: Constants) -> Picture:
    return Picture(no_tracks(constants))


def hear(source: Source | None, number: int, stamp_ns: int) -> tuple[Source, bool]:
    """The source after a frame of ``stamp_ns``, and whether that is a new look at the scene."""
    if source is None:
        return Source(number, stamp_ns), True
    if stamp_ns <= source.newest_ns:
        return source, False
    return replace(source, newest_ns=stamp_ns), True


def statuses(picture: Picture) -> tuple[str, ...]:
    """``tentative``, ``coasting`` (the newest frame of none of its sources shows the track) or ``confirmed``."""
    tracks = picture.tracks
    status = np.where(_shown(picture), "confirmed", "coasting")
    return tuple(np.where(tracks.confirmed, status, "tentative").tolist())


def source_names(picture: Picture) -> tuple[tuple[str, ...], ...]:
    """The sources of each track's keys, sorted."""
    names: list[set[str]] = [set() for _ in picture.tracks.ids]
    for (source, _), row in zip(picture.tracks.keys.names, picture.tracks.keys.row.tolist(), strict=True):
        names[row].add(source)
    return tuple([tuple(sorted(found)) for found in names])


def _shown(picture: Picture) -> BoolArray:
    keys = picture.tracks.keys
    newest_ns = np.array([source.newest_ns for source in picture.sources.values()], dtype=np.int64)
    shown = np.zeros(len(picture.tracks), dtype=np.bool_)
    shown[keys.row[keys.seen_ns == newest_ns[keys.source]]] = True
    return shown
