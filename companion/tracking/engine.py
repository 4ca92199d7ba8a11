"""The two filters that a tracker can run on: the batched bank, and the plain one on filterpy that it must equal.

``tracking.backend = "batched"`` flies; ``"reference"`` is for comparisons and needs filterpy (the ``dev`` extra).
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from companion.config import TrackingConfig
from companion.tracking import imm, predict
from companion.tracking.bank import Bank, Constants, build_constants
from companion.tracking.models import MODELS, propagate
from companion.types import FloatArray

BLOCK = 128  # tracks; their covariances are 0.3 MB


class Engine(Protocol):
    """An IMM filter over a `Bank` of tracks; pure functions of their arguments."""

    constants: Constants

    def step(
        self, bank: Bank, dt: FloatArray, z: FloatArray, noise: FloatArray, *, foreign: bool = False
    ) -> tuple[Bank, FloatArray]:
        """`imm.step`."""

    def propagate(self, x: FloatArray, covariance: FloatArray, dt: FloatArray) -> tuple[FloatArray, FloatArray]:
        """`models.propagate`."""

    def predict(
        self, x: FloatArray, covariance: FloatArray, probabilities: FloatArray, at: predict.Horizon
    ) -> tuple[FloatArray, FloatArray]:
        """`predict.predict_positions`."""


class BatchedEngine:
    """All tracks at once in numpy, in blocks of `BLOCK` rows, so that the intermediate arrays stay in the cache."""

    def __init__(self, config: TrackingConfig) -> None:
        self.constants = build_constants(config)

    def step(
        self, bank: Bank, dt: FloatArray, z: FloatArray, noise: FloatArray, *, foreign: bool = False
    ) -> tuple[Bank, FloatArray]:
        if len(bank) <= BLOCK:
            return imm.step(bank, dt, z, noise, self.constants, foreign=foreign)
        after, nis = Bank(*(np.empty_like(part) for part in bank.parts())), np.empty((len(bank), MODELS))
        for rows in _blocks(len(bank)):
            block = Bank(*(part[rows] for part in bank.parts()))
            stepped, nis[rows] = imm.step(block, dt[rows], z[rows], noise[rows], self.constants, foreign=foreign)
            for whole, part in zip(after.parts(), stepped.parts(), strict=True):
                whole[rows] = part
        return after, nis

    def propagate(self, x: FloatArray, covariance: FloatArray, dt: FloatArray) -> tuple[FloatArray, FloatArray]:
        if len(x) <= BLOCK:
            return propagate(x, covariance, dt, self.constants.models)
        moved, spread = np.empty_like(x), np.empty_like(covariance)
        for rows in _blocks(len(x)):
            moved[rows], spread[rows] = propagate(x[rows], covariance[rows], dt[rows], self.constants.models)
        return moved, spread

    def predict(
        self, x: FloatArray, covariance: FloatArray, probabilities: FloatArray, at: predict.Horizon
    ) -> tuple[FloatArray, FloatArray]:
        if len(x) <= BLOCK:
            return predict.predict_positions(x, covariance, probabilities, at)
        steps = at.tau_s.shape[1]
        p_enu, spread = np.empty((len(x), steps, 3)), np.empty((len(x), 6, steps))
        for rows in _blocks(len(x)):
            block = (x[rows], covariance[rows], probabilities[rows])
            p_enu[rows], spread[rows] = predict.predict_positions(*block, at.of(rows))
        return p_enu, spread


def _blocks(count: int) -> list[slice]:
    return [slice(first, min(first + BLOCK, count)) for first in range(0, count, BLOCK)]


def make_engine(config: TrackingConfig) -> Engine:
    """The filter of ``tracking.backend``.

    Raises:
        ConfigError: the reference is asked for and filterpy is not installed.
    """
    if config.backend == "batched":
        return BatchedEngine(config)
    from companion.tracking.reference_engine import ReferenceEngine

    return ReferenceEngine(config)
