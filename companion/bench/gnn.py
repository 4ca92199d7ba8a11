"""A plain tracker of anonymous detections around a rival's filter: gate, nearest neighbours, confirm, coast, drop.

The rules are those of ours (gate, two hits in three frames, a second of coasting), so that the filters are compared
and not the book-keeping. One obstacle after the other, in Python.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from companion.bench.rivals import FilterpyImm, SingleModel
from companion.config import TrackingConfig
from companion.tracking.associate import Candidates, associate
from companion.types import FloatArray


class PointFilter(Protocol):
    """A filter of one obstacle."""

    def predict(self, dt_s: float) -> None: ...

    def update(self, z: FloatArray) -> None: ...

    def position(self) -> tuple[FloatArray, FloatArray]:
        """(3,) [m] and its covariance (3, 3)."""


class OneModel:
    """CV or CA of one obstacle."""

    def __init__(self, order: int, density: float, z: FloatArray, std_m: float) -> None:
        self._model = SingleModel(order, np.array([density]), z[None], std_m)

    def predict(self, dt_s: float) -> None:
        self._model.predict(dt_s)

    def update(self, z: FloatArray) -> None:
        self._model.update(z[None], np.array([True]))

    def position(self) -> tuple[FloatArray, FloatArray]:
        return self._model.x[0, 0, 0], np.eye(3) * self._model.covariance[0, 0, 0, 0]


class FilterpyOne:
    """filterpy's IMM of one obstacle."""

    def __init__(self, imm: FilterpyImm) -> None:
        self._imm = imm

    def predict(self, dt_s: float) -> None:
        self._imm.step(dt_s, None)

    def update(self, z: FloatArray) -> None:
        self._imm.use(z)

    def position(self) -> tuple[FloatArray, FloatArray]:
        return self._imm.position()


@dataclass(slots=True)
class _Track:
    name: str
    filter: PointFilter
    hits: int = 1
    born: int = 0  # frame
    missed: int = 0  # frames in a row


class GnnTracker:
    """``make`` builds the filter of a new track from its first position."""

    def __init__(self, make: Callable[[FloatArray], PointFilter], *, rate_hz: float, std_m: float) -> None:
        self._make = make
        self._dt_s = 1.0 / rate_hz
        self._noise = np.eye(3) * std_m**2
        self._config = TrackingConfig()
        self._coast = round(self._config.coast_s * rate_hz)
        self._tracks: list[_Track] = []
        self._born = 0

    def frame(self, z: FloatArray, k: int) -> tuple[list[str], FloatArray]:
        """Use the positions (D, 3) of frame ``k``; ids and positions of the confirmed tracks."""
        for track in self._tracks:
            track.filter.predict(self._dt_s)
            track.missed += 1
        states = [track.filter.position() for track in self._tracks]
        p = np.array([p for p, _ in states]).reshape(-1, 1, 3)
        spread = np.array([s for _, s in states]).reshape(-1, 1, 3, 3)
        candidates = Candidates(p, spread, np.ones((len(p), 1)), np.full(len(p), np.inf))
        noise = np.broadcast_to(self._noise, (len(z), 3, 3))
        for detection, row in enumerate(associate(z, noise, candidates, self._config.gate_sigma).tolist()):
            if row < 0:
                self._born += 1
                self._tracks.append(_Track(f"#{self._born}", self._make(z[detection]), born=k))
                continue
            track = self._tracks[row]
            track.filter.update(z[detection])
            track.hits, track.missed = track.hits + 1, 0
        self._tracks = [track for track in self._tracks if self._lives(track, k)]
        shown = [track for track in self._tracks if track.hits >= self._config.confirm_hits]
        return [track.name for track in shown], np.array([t.filter.position()[0] for t in shown]).reshape(-1, 3)

    def _lives(self, track: _Track, k: int) -> bool:
        if track.hits < self._config.confirm_hits:
            return k - track.born < self._config.confirm_frames
        return track.missed <= self._coast
