"""Which births of a frame are the vehicle itself; the rule and its reason stand in `ownship`."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from companion.tracking.ownship import GATE, MEMORY_NS, Fix, Residual, Suspects, residuals, weigh
from companion.tracking.tracks import NEW, OURSELVES, Key, Rows, Sightings, Tracks


@dataclass(frozen=True, slots=True)
class Recognised:
    """What is left of a frame for tracks, and who may be the vehicle; ``own`` counts the detections of it."""

    tracks: Tracks
    sightings: Sightings
    suspects: Suspects
    own: int


def in_question(tracks: Tracks, sightings: Sightings) -> Rows:
    """Sightings that may be the vehicle: births, and those of tracks born while its path was unknown."""
    rows = sightings.rows
    question = rows < 0
    if len(tracks):
        question |= tracks.unchecked[np.maximum(rows, 0)]  # of a birth it does not matter which
    return np.flatnonzero(question)


def recognise(
    tracks: Tracks, sightings: Sightings, suspects: Suspects, stamp_ns: int, own: Fix | None, radius_m: float
) -> Recognised:
    """Take the vehicle's detections out of ``sightings``, and its tracks out of ``tracks``.

    Args:
        own: the vehicle at ``stamp_ns``; None where unknown: what was the vehicle within a second still is.
        radius_m: of the vehicle.
    """
    question = in_question(tracks, sightings)
    living = {name: evidence for name, evidence in suspects.items() if evidence.sums(stamp_ns)}
    if own is None:
        ours = [n for n in question.tolist() if _just_seen(living, sightings.names[n], stamp_ns)]
        rows, hits = sightings.rows, sightings.hits
    else:
        ours, hits, living = _judge(sightings, question, living, stamp_ns, own, radius_m)
        unchecked = tracks.unchecked.copy()
        unchecked[sightings.rows[question][sightings.rows[question] >= 0]] = False
        tracks = replace(tracks, unchecked=unchecked)
        rows = np.where(sightings.rows == OURSELVES, NEW, sightings.rows)
    sightings = replace(sightings, rows=rows, hits=hits)
    if ours:
        tracks, sightings = _without(tracks, sightings, ours)
    return Recognised(tracks, sightings, living, len(ours))


def _just_seen(suspects: Suspects, name: Key, stamp_ns: int) -> bool:
    evidence = suspects.get(name)
    if name[1] is None or evidence is None:
        return False
    return evidence.lives(stamp_ns) and abs(stamp_ns - evidence.seen_ns) <= MEMORY_NS


def _judge(
    sightings: Sightings, question: Rows, suspects: Suspects, stamp_ns: int, own: Fix, radius_m: float
) -> tuple[list[int], Rows, Suspects]:
    """The sightings that are the vehicle, the hits behind each sighting, and the suspects after them."""
    measurements = sightings.measurements
    z, noise = measurements.z[question, :3], measurements.noise[question, :3, :3]
    seen = residuals(z, noise, own)
    hits, after, ours = sightings.hits.copy(), dict(suspects), []
    for k in _candidates(sightings, question, seen):
        n = int(question[k])
        name = sightings.names[n]
        before = after.pop(name, None)
        evidence = weigh(before, seen[k], stamp_ns, radius_m)
        if evidence is None and before is not None:
            hits[n] += 0 if before.obstacle else before.count
            if name[1] is not None:  # at less than a hertz its track ends before the next detection; the verdict stays
                after[name] = replace(before, seen_ns=stamp_ns, obstacle=True)
        elif evidence is not None:
            after[name] = evidence
            ours.append(n)
    return ours, hits, after


def _candidates(sightings: Sightings, question: Rows, seen: list[Residual]) -> list[int]:
    """Places in ``question``: every named sighting, and of the anonymous ones the likeliest."""
    named, anonymous = [], []
    for k, n in enumerate(question.tolist()):
        if sightings.names[n][1] is not None:
            named.append(k)
        elif seen[k].squared <= GATE:
            anonymous.append((sightings.rows[n] != OURSELVES, seen[k].squared, k))
    return [*named, *[k for _, _, k in sorted(anonymous)[:1]]]


def _without(tracks: Tracks, sightings: Sightings, ours: list[int]) -> tuple[Tracks, Sightings]:
    mine = sightings.rows[ours]
    sightings = sightings.take(np.delete(np.arange(len(sightings)), ours))
    mine = mine[mine >= 0]
    if not mine.size:
        return tracks, sightings
    stay = np.delete(np.arange(len(tracks)), mine)
    place = np.append(tracks.places(stay), NEW)  # a row of -1 stays one
    return tracks.take(stay), replace(sightings, rows=place[sightings.rows])
