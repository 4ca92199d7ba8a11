"""Does an obstacle keep to what its models assume? Every track's own predictions, looked back on.

Once in `LOOK_S` a track notes where it will be LOOK_S later and with which covariance; the measurement z that comes
then judges the note by its normalised innovation squared, three degrees of freedom:

    nis = nu^T S^-1 nu / 3,   nu = z - p(LOOK_S),   S = P(LOOK_S) + R,   E nis = 1,   E nis^2 = 5 / 3

One-step innovations cannot tell: at any usual sensor noise R drowns what a manoeuvre adds in one step. And a mean
hides that one note in ten is missed by far, so the root of the mean square over the last `nis_memory_s` (rising
three times as fast as it falls) is held against `nis_bound`, both relative to a filter whose models are true. What
exceeds the bound is put down to the part of S that grew since the note was taken, share = tr(P(LOOK_S) - P(0)) / tr(S):
from then on predictions grow faster by

    factor = 1 + (sqrt(mean nis^2 / (5 / 3)) - nis_bound) / mean share      within [1, inflation_max]

A straight flyer keeps its narrow tube, one that has been seen to jink gets a wide one. Notes of one track do not
overlap, so their errors are nearly independent. Arrays are batched over tracks; positions ENU [m].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from companion.config import TrackingConfig
from companion.tracking.models import MotionModels
from companion.tracking.predict import Horizon, horizon, predict_positions
from companion.types import FloatArray

BoolArray = npt.NDArray[np.bool_]

LOOK_S = 0.25
AGILE = 2.0  # a track whose predictions are widened so much breaks its assumed agility, and the status says so
NIS_CAP = 20.0  # of one note: a jump of the measurement itself says little about agility
NIS_SQUARE = 5.0 / 3.0  # expected square of a chi-squared of three degrees of freedom over three
RISE = 3.0  # what a track has shown is believed this much faster than forgotten
_SHARE_MIN = 0.1  # below it the sensor noise hides the motion, and the factor would be a guess
_SLACK_S = 1e-6  # stamps are rounded
AGE, P_LOOK, P_LATE, S_NOW, S_LOOK, S_LATE = 0, slice(1, 4), slice(4, 7), slice(7, 13), slice(13, 19), slice(19, 25)
NOTE = 25  # age [s], position after LOOK_S and 2 LOOK_S, position covariance (6 entries) after 0, LOOK_S, 2 LOOK_S
SQUARE, SHARE = 0, 1  # of the means: of nis^2 / (5 / 3), of the share
_SQUARE = np.array([0, 5, 4, 5, 1, 3, 4, 3, 2])  # xx, yy, zz, yz, xz, xy -> row-major 3x3


@dataclass(frozen=True, slots=True, eq=False)
class Watch:
    """Constants of the look back."""

    at: Horizon  # 0, LOOK_S, 2 LOOK_S
    gain: float  # of one note in the means
    bound: float
    factor_max: float


def build_watch(config: TrackingConfig, models: MotionModels) -> Watch:
    return Watch(
        at=horizon(np.array([0.0, LOOK_S, 2.0 * LOOK_S]), models),
        gain=min(1.0 / RISE, LOOK_S / config.nis_memory_s),
        bound=config.nis_bound,
        factor_max=config.inflation_max,
    )


def first_notes(count: int) -> tuple[FloatArray, FloatArray]:
    """Notes (M, 25) and means (M, 2) of new tracks: no note yet, no surprise yet."""
    notes = np.zeros((count, NOTE))
    notes[:, AGE] = np.inf
    return notes, np.ones((count, 2))


def look_back(
    notes: FloatArray, means: FloatArray, dt: FloatArray, z: FloatArray, noise: FloatArray, watch: Watch
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Judge the notes that are due by the positions ``z`` (M, 3) with ``noise`` (M, 3, 3).

    Returns:
        aged notes, means, and which rows (mask (M,)) want a new note.
    """
    notes = notes.copy()
    notes[:, AGE] += dt
    due = notes[:, AGE] >= LOOK_S - _SLACK_S
    judged = np.flatnonzero(due & (notes[:, AGE] <= 2.0 * LOOK_S + _SLACK_S))
    if judged.size:
        note = notes[judged]
        late = (note[:, AGE, None] - LOOK_S) / LOOK_S  # between the two instants of a note everything is linear
        nu = z[judged] - note[:, P_LOOK] - late * (note[:, P_LATE] - note[:, P_LOOK])
        spread = note[:, S_LOOK] + late * (note[:, S_LATE] - note[:, S_LOOK])
        s = spread[:, _SQUARE].reshape(-1, 3, 3) + noise[judged]
        nis = (nu * np.linalg.solve(s, nu[..., None])[..., 0]).sum(axis=-1) / 3.0
        share = (spread[:, :3] - note[:, S_NOW][:, :3]).sum(axis=1) / np.trace(s, axis1=1, axis2=2)
        latest = np.stack((np.minimum(nis, NIS_CAP) ** 2 / NIS_SQUARE, share), axis=1)
        means = means.copy()
        step = latest - means[judged]
        step[:, SQUARE] *= np.where(step[:, SQUARE] > 0.0, RISE, 1.0)
        means[judged] += watch.gain * step
    return notes, means, due


def take_notes(
    notes: FloatArray, due: BoolArray, x: FloatArray, covariance: FloatArray, probabilities: FloatArray, watch: Watch
) -> FloatArray:
    """``notes`` with new ones of the rows ``due``, from the bank as it now is; writes into ``notes``."""
    rows = np.flatnonzero(due)
    if rows.size:
        p, spread = predict_positions(x[rows], covariance[rows], probabilities[rows], watch.at)
        note = np.zeros((rows.size, NOTE))
        note[:, P_LOOK], note[:, P_LATE] = p[:, 1], p[:, 2]
        note[:, S_NOW], note[:, S_LOOK], note[:, S_LATE] = spread[..., 0], spread[..., 1], spread[..., 2]
        notes[rows] = note
    return notes


def surprise(means: FloatArray) -> FloatArray:
    """Root mean square of the innovations looked back on, (M,), 1 for a filter whose models are true."""
    return np.asarray(np.sqrt(means[:, SQUARE]))


def growth_factor(means: FloatArray, watch: Watch) -> FloatArray:
    """How much faster than its models say the predicted covariance of each track grows, (M,), 1 where they hold."""
    excess = (surprise(means) - watch.bound) / np.maximum(means[:, SHARE], _SHARE_MIN)
    return np.asarray(1.0 + np.minimum(np.maximum(excess, 0.0), watch.factor_max - 1.0))
