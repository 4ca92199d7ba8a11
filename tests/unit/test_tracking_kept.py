"""What the tracker keeps from tick to tick changes nothing, to the bit: tracks of few different ages."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from companion.config import TrackingConfig
from companion.tracking import models, tracker
from companion.tracking.engine import make_engine
from companion.tracking.models import propagate
from companion.tracking.tracker import Tracker

AGES = (0.05, 0.1, 0.15, -0.05, 0.0)


@pytest.mark.parametrize("count", [2, 4, 9, 65])
@pytest.mark.parametrize("memory_s", [0.2, 0.0])
def test_propagation_over_few_different_times(count: int, memory_s: float, monkeypatch: pytest.MonkeyPatch) -> None:
    constants = make_engine(TrackingConfig(accel_memory_s=memory_s)).constants
    rng = np.random.default_rng(count)
    for different in (2, 3, 4, 5):
        dt = rng.choice(AGES[:different], size=count)
        x, root = rng.normal(size=(count, 3, 10)), rng.normal(size=(count, 3, 10, 10))
        args: Any = (x, root @ root.swapaxes(2, 3), dt, constants.models)
        kept = propagate(*args)
        monkeypatch.setattr(models, "FEW", 0)
        fresh = propagate(*args)
        monkeypatch.undo()
        assert all(np.array_equal(a, b) for a, b in zip(kept, fresh, strict=True))


@pytest.mark.parametrize("count", [2, 9, 65])
def test_horizons_of_few_different_ages(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(count)
    since_s = 0.08 + rng.choice(AGES[:3], size=count)
    kept = Tracker(TrackingConfig())._grid(since_s, 23, 0.05)
    monkeypatch.setattr(tracker, "FEW", 0)
    fresh = Tracker(TrackingConfig())._grid(since_s, 23, 0.05)
    for name in ("tau_s", "reach", "noise", "turn_noise"):
        assert np.array_equal(getattr(kept, name), getattr(fresh, name)), name
