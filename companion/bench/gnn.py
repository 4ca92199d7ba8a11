"""A plain tracker of anonymous detections around a rival's filter: gate, nearest neighbours, confirm, coast, drop.

The rules are those of ours, so that the filters are compared and not the book-keeping: the gate; confirmed tracks
choose first; two hits in three frames confirm; a track coasts

    min(max(0.3 s, 2 (t_last - t_born)), coast_s)

so that clutter that looked like an obstacle for two frames is soon gone. One obstacle after the other, in Python.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

from companion.bench.rivals import FilterpyImm, SingleModel
from companion.config import TrackingConfig
from companion.tracking.associate import Candidates, associate
from companion.tracking.tracks import COAST_MIN_NS
from companion.types import NS_PER_S, FloatArray

Rows: TypeAlias = npt.NDArray[np.intp]


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
    last: int = 0  # frame of the newest detection used


class GnnTracker:
    """``make`` builds the filter of a new track from its first position."""

    def __init__(self, make: Callable[[FloatArray], PointFilter], *, rate_hz: float, std_m: float) -> None:
        self._make = make
        self._rate_hz = rate_hz
        self._noise = np.eye(3) * std_m**2
        self._config = TrackingConfig()
        self._tracks: list[_Track] = []
        self._born = 0

    def frame(self, z: FloatArray, k: int) -> tuple[list[str], FloatArray]:
        """Use the positions (D, 3) of frame ``k``; ids and positions of the confirmed tracks."""
        self._tracks = [track for track in self._tracks if self._coasts(track, k)]
        for track in self._tracks:
            track.filter.predict(1.0 / self._rate_hz)
        births = self._used_by(False, z, self._used_by(True, z, np.arange(len(z)), k), k)
        self._tracks = [track for track in self._tracks if self._hopes(track, k)]
        for position in z[births]:
            self._born += 1
            self._tracks.append(_Track(f"#{self._born}", self._make(position), born=k, last=k))
        shown = [track for track in self._tracks if self._confirmed(track)]
        return [track.name for track in shown], np.array([t.filter.position()[0] for t in shown]).reshape(-1, 3)

    def _used_by(self, confirmed: bool, z: FloatArray, left: Rows, k: int) -> Rows:
        """Update the tracks that are, or are not, ``confirmed`` with detections ``left``; those that no track took."""
        tracks = [track for track in self._tracks if self._confirmed(track) == confirmed]
        states = [track.filter.position() for track in tracks]
        p = np.array([p for p, _ in states]).reshape(-1, 1, 3)
        spread = np.array([s for _, s in states]).reshape(-1, 1, 3, 3)
        noise = np.broadcast_to(self._noise, (len(left), 3, 3))
        candidates = Candidates(p, spread, np.ones((len(p), 1)), np.full(len(p), np.inf))
        rows = associate(z[left], noise, candidates, self._config.gate_sigma)
        for detection, row in zip(left.tolist(), rows.tolist(), strict=True):
            if row >= 0:
                tracks[row].filter.update(z[detection])
                tracks[row].hits, tracks[row].last = tracks[row].hits + 1, k
        return left[rows < 0]

    def _confirmed(self, track: _Track) -> bool:
        return track.hits >= self._config.confirm_hits

    def _hopes(self, track: _Track, k: int) -> bool:
        return self._confirmed(track) or k - track.born < self._config.confirm_frames

    def _coasts(self, track: _Track, k: int) -> bool:
        most = self._config.coast_s * self._rate_hz
        if self._confirmed(track):
            most = min(max(COAST_MIN_NS / NS_PER_S * self._rate_hz, 2.0 * (track.last - track.born)), most)
        return k - track.last <= most + 1e-9
