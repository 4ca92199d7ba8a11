"""The tick meter: quantiles of the newest ticks, in memory that does not grow."""

from __future__ import annotations

import numpy as np
import pytest

from companion import metrics
from companion.metrics import TickMeter


def filled(count: int) -> TickMeter:
    meter = TickMeter(0.05)
    for number in range(count):
        meter.tick(float(number), 0.0, "nominal")
    return meter


def test_no_tick_no_quantiles() -> None:
    assert TickMeter(0.05).quantiles_ms() == {}


@pytest.mark.parametrize("count", [1, 7, 10, 11, 25])
def test_quantiles_are_of_the_newest_ticks(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics, "WINDOW", 10)
    meter = filled(count)
    for last in (None, 1, 4, 10):
        newest = np.arange(count, dtype=float)[-(last or 10) :]
        told = meter.quantiles_ms(last)
        assert told["max"] == newest.max()
        assert told["p50"] == pytest.approx(np.quantile(newest, 0.5))
        assert told["p99.9"] == pytest.approx(np.quantile(newest, 0.999), abs=1e-4)


def test_a_tick_longer_than_its_period_and_a_skipped_state_are_misses() -> None:
    meter = TickMeter(0.05)
    meter.tick(1.0, 49.0, "nominal")
    meter.tick(1.0, 51.0, "adjusted")
    meter.skip()
    assert (meter.ticks, meter.deadline_misses, meter.states_skipped) == (2, 2, 1)
