"""One frame in, the next picture out: gate, associate, recognise ourselves, update, split, begin, confirm, merge.

A pure function of the picture, the frame and the vehicle's path, so that frames can be consumed again from any
earlier picture.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from companion.config import TrackingConfig
from companion.tracking.advance import advance
from companion.tracking.engine import Engine
from companion.tracking.identity import Found, associated, disagreeing_names, sightings_by_key, usable
from companion.tracking.lifecycle import confirm, expire, make_room
from companion.tracking.merge import merge_agreeing, tell_apart
from companion.tracking.ownship import OwnPath, Suspects
from companion.tracking.picture import Picture, Source, hear
from companion.tracking.recognise import in_question, recognise
from companion.tracking.tracks import Origin, Sightings, Tracks, join_tracks, newborn, unique_id
from companion.types import DetectionFrame, DetectionKind

_NONE = np.zeros(0, dtype=np.intp)


@dataclass(frozen=True, slots=True, eq=False)
class Rules:
    """What consuming a frame needs besides the picture."""

    config: TrackingConfig
    engine: Engine
    vehicle_radius_m: float
    coast_ns: int


def consume(picture: Picture, frame: DetectionFrame, rules: Rules, path: OwnPath) -> Picture:
    """The picture after ``frame``."""
    config, stamp_ns = rules.config, frame.stamp_ns
    trusted = frame.source not in config.untrusted
    counts = picture.counts.copy()
    tracks = expire(picture.tracks, stamp_ns, rules.coast_ns, counts, spare_trusted=not trusted)
    source, new_look = hear(picture.sources.get(frame.source), len(picture.sources), stamp_ns)
    found = usable(frame, source.anonymous_ns, counts)
    suspects, fresh, used = picture.suspects, None, _NONE
    if found.names:
        tracks, sightings, suspects = _placed(tracks, suspects, found, frame, trusted, rules, path, counts)
        foreign = frame.kind is DetectionKind.TRACK
        tracks, fresh, used = advance(
            tracks, sightings, source.number, stamp_ns, config, rules.engine, counts, foreign=foreign
        )
        if found.named < len(found.names):
            source = replace(source, anonymous_ns=stamp_ns)
    tracks = confirm(tracks, used, source.number, stamp_ns, config.confirm_hits, counts, new_look=new_look)
    if fresh is not None:
        own = path.at(stamp_ns)
        p_own = path.newest if own is None else own.p_enu
        tracks, fresh = make_room(tracks, fresh, trusted, config.max_tracks, p_own, counts)
        origin = Origin(stamp_ns, source.number, trusted, unchecked=own is None)
        tracks, source = _begin(tracks, fresh, source, origin, rules)
    sources, watches = {**picture.sources, frame.source: source}, picture.watches
    if len(sources) > 1 and config.merge_s > 0.0:
        tracks = tell_apart(tracks, source.number, stamp_ns)
        tracks, watch = merge_agreeing(
            tracks, watches[trusted], stamp_ns, config.merge_s, rules.engine, trusted=trusted
        )
        watches = (watches[0], watch) if trusted else (watch, watches[1])
    return Picture(tracks, sources, suspects, watches, counts)


def _placed(
    tracks: Tracks,
    suspects: Suspects,
    found: Found,
    frame: DetectionFrame,
    trusted: bool,
    rules: Rules,
    path: OwnPath,
    counts: Counter[str],
) -> tuple[Tracks, Sightings, Suspects]:
    """What of a frame goes to tracks, each with its row or as a birth; our own detections taken out."""
    stamp_ns = frame.stamp_ns
    sightings = sightings_by_key(found, tracks, suspects, stamp_ns, rules.config, counts)
    tracks, sightings = disagreeing_names(tracks, sightings)
    named_only = found.named == len(found.names)
    if named_only and not in_question(tracks, sightings).size:  # all known by their names, the common case
        return tracks, sightings, suspects
    own = path.at(stamp_ns)
    if not named_only:
        evidence = suspects.get((frame.source, None))
        pseudo = own if evidence is not None and evidence.lives(stamp_ns) else None
        sightings = associated(tracks, sightings, stamp_ns, trusted, pseudo, rules.config, rules.engine)
    if own is None and not suspects:
        return tracks, sightings, suspects
    recognised = recognise(tracks, sightings, suspects, stamp_ns, own, rules.vehicle_radius_m)
    if recognised.own:
        counts["own_vehicle"] += recognised.own
    return recognised.tracks, recognised.sightings, recognised.suspects


def _begin(tracks: Tracks, fresh: Sightings, source: Source, origin: Origin, rules: Rules) -> tuple[Tracks, Source]:
    """Tracks with a new one for each of ``fresh``."""
    config, taken, born = rules.config, set(tracks.ids), source.born
    ids = []
    for name, identity in fresh.names:
        born += identity is None
        ids.append(unique_id(f"{name}/#{born}" if identity is None else f"{name}/{identity}", taken))
        taken.add(ids[-1])
    for full in (False, True):
        chosen = np.flatnonzero(fresh.measurements.full == full)
        if chosen.size:
            part = newborn(fresh.take(chosen), tuple([ids[k] for k in chosen]), origin, config, rules.engine.constants)
            tracks = join_tracks(tracks, part)
    return tracks, replace(source, born=born)
