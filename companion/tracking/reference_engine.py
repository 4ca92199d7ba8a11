"""`reference.ReferenceImm` behind the interface of the batched bank: a Python loop over tracks.

Rows of a `Bank` are unpacked into filterpy's filters, stepped and packed again, so that the tracker, its replay and
its merging run unchanged on the plain filter. Looking back on predictions (`agility`) is written out here once more.
"""

from __future__ import annotations

import math

import numpy as np

from companion.config import TrackingConfig
from companion.errors import ConfigError
from companion.tracking import agility
from companion.tracking.bank import Bank, build_constants
from companion.tracking.predict import Horizon
from companion.tracking.reference import SLOTS, ReferenceImm
from companion.types import FloatArray

_UPPER = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))  # xx, yy, zz, yz, xz, xy


class ReferenceEngine:
    """One filterpy filter after the other."""

    def __init__(self, config: TrackingConfig) -> None:
        try:
            import filterpy  # noqa: F401
        except ModuleNotFoundError:
            raise ConfigError('tracking.backend: "reference" needs filterpy (the dev extra)') from None
        self._config = config
        self.constants = build_constants(config)

    def step(
        self, bank: Bank, dt: FloatArray, z: FloatArray, noise: FloatArray, *, foreign: bool = False
    ) -> tuple[Bank, FloatArray]:
        parts = tuple(part.copy() for part in bank.parts())
        nis = np.zeros((len(bank), 3))
        after = Bank(*parts)
        for row in range(len(bank)):
            track = self._unpack(bank, row)
            nis[row] = track.update(z[row].tolist(), noise[row], float(dt[row]), foreign=foreign)
            self._pack(track, after, row)
            self._look_back(track, after, row, float(dt[row]), z[row, :3], noise[row, :3, :3])
        return after, nis

    def propagate(self, x: FloatArray, covariance: FloatArray, dt: FloatArray) -> tuple[FloatArray, FloatArray]:
        moved, spread = np.zeros_like(x), np.zeros_like(covariance)
        for row in range(len(x)):
            track = self._load(x[row], covariance[row], np.full(3, 1.0 / 3.0))
            for model, state in enumerate(track.carried(float(dt[row]))):
                moved[row, model, SLOTS[model]], spread[row, model][np.ix_(SLOTS[model], SLOTS[model])] = state
        return moved, spread

    def predict(
        self, x: FloatArray, covariance: FloatArray, probabilities: FloatArray, at: Horizon
    ) -> tuple[FloatArray, FloatArray]:
        count, steps = len(x), at.tau_s.shape[1]
        p_enu, spread = np.zeros((count, steps, 3)), np.zeros((count, 6, steps))
        for row in range(count):
            track = self._load(x[row], covariance[row], probabilities[row])
            for k, tau_s in enumerate(np.broadcast_to(at.tau_s, (count, steps))[row].tolist()):
                p_enu[row, k], whole = track.forecast(tau_s)
                spread[row, :, k] = [whole[entry] for entry in _UPPER]
        return p_enu, spread

    def _load(self, x: FloatArray, covariance: FloatArray, probabilities: FloatArray) -> ReferenceImm:
        track = ReferenceImm(self._config, [0.0, 0.0, 0.0], np.eye(3))
        track.probabilities = probabilities.tolist()
        for model, (kalman, slots) in enumerate(zip(track.filters, SLOTS, strict=True)):
            kalman.x = x[model, slots].reshape(-1, 1)
            kalman.P = covariance[model][np.ix_(slots, slots)]
        return track

    def _unpack(self, bank: Bank, row: int) -> ReferenceImm:
        track = self._load(bank.x[row], bank.covariance[row], bank.probabilities[row])
        track.scores = [scores for scores in bank.history[row].tolist() if math.isfinite(scores[0])]
        track.headings = [(angle, taken) for angle, taken in bank.headings[row].tolist()]
        return track

    def _pack(self, track: ReferenceImm, bank: Bank, row: int) -> None:
        """Write ``track`` into the arrays of ``bank``, which are ours."""
        for model, (kalman, slots) in enumerate(zip(track.filters, SLOTS, strict=True)):
            bank.x[row, model, slots] = kalman.x[:, 0]
            bank.covariance[row, model][np.ix_(slots, slots)] = 0.5 * (kalman.P + kalman.P.T)
        bank.probabilities[row] = track.probabilities
        kept = bank.history.shape[1]
        scores = track.scores[-kept:] if kept else []
        bank.history[row] = [[-math.inf] * 3] * (kept - len(scores)) + scores if kept else bank.history[row]
        if bank.headings.shape[1]:
            bank.headings[row] = track.headings[-bank.headings.shape[1] :]

    def _look_back(
        self, track: ReferenceImm, bank: Bank, row: int, dt: float, z: FloatArray, noise: FloatArray
    ) -> None:
        """Judge the note of one track and take a new one when it is due."""
        note, look_s = bank.notes[row], agility.LOOK_S
        note[agility.AGE] += dt
        age = float(note[agility.AGE])
        if age < look_s - 1e-6:
            return
        if age <= 2.0 * look_s + 1e-6:
            late = (age - look_s) / look_s
            predicted = (1.0 - late) * note[agility.P_LOOK] + late * note[agility.P_LATE]
            entries = (1.0 - late) * note[agility.S_LOOK] + late * note[agility.S_LATE]
            s = noise.copy()
            for (i, j), entry in zip(_UPPER, entries.tolist(), strict=True):
                s[i, j] += entry
                s[j, i] += entry if i != j else 0.0
            nu = z - predicted
            nis = min(float(nu @ np.linalg.solve(s, nu)) / 3.0, agility.NIS_CAP)
            grown = float(sum(entries[:3]) - sum(note[agility.S_NOW][:3]))
            weight = min(1.0 / agility.RISE, look_s / self._config.nis_memory_s)
            square, share = bank.means[row].tolist()
            surprise = nis * nis / agility.NIS_SQUARE - square
            square += weight * (agility.RISE if surprise > 0.0 else 1.0) * surprise
            bank.means[row] = square, share + weight * (grown / float(np.trace(s)) - share)
        whole = [track.forecast(tau) for tau in (0.0, look_s, 2.0 * look_s)]
        note[agility.AGE] = 0.0
        note[agility.P_LOOK], note[agility.P_LATE] = whole[1][0], whole[2][0]
        for part, (_, spread) in zip((agility.S_NOW, agility.S_LOOK, agility.S_LATE), whole, strict=True):
            note[part] = [spread[entry] for entry in _UPPER]
