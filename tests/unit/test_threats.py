"""Threats of encounters that can be worked out by hand."""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np
import pytest

from companion.threats import HIGH, LOW, threats
from companion.types import FilterResult, Margin, Prediction, RowRecord, VehicleState, Verdict, frozen

DT_S, INSTANTS = 0.05, 23


def prediction(*paths: tuple[str, Any, Any, float], start_ns: int = 0) -> Prediction:
    """Obstacles on straight lines: (name, position at the start, velocity, radius)."""
    t = DT_S * np.arange(INSTANTS)[:, None]
    count = len(paths)
    return Prediction(
        start_ns=start_ns,
        dt_s=DT_S,
        ids=tuple(name for name, *_ in paths),
        p_enu=np.array([np.asarray(p, float) + t * np.asarray(v, float) for _, p, v, _ in paths]).reshape(
            count, INSTANTS, 3
        ),
        sigma_m=np.zeros((count, INSTANTS)),
        v_enu=np.array([v for _, _, v, _ in paths], dtype=float).reshape(count, 3),
        a_enu=np.zeros((count, 3)),
        radius_m=np.array([radius for *_, radius in paths]),
    )


def result(verdict: Verdict = Verdict.NOMINAL, **margins: float) -> FilterResult:
    rows = tuple(RowRecord(name, 0, 0.0, Margin(total, 0.0, 0.0, 0.0), 0.0, 0.0) for name, total in margins.items())
    return FilterResult(frozen([0, 0, 0]), verdict, rows[0] if rows else None, rows, 0, "none")


def vehicle(p: Any, v: Any, stamp_ns: int = 0) -> VehicleState:
    return VehicleState(stamp_ns, frozen(p), frozen(v))


def find(state: VehicleState, ahead: Prediction, answer: FilterResult) -> list[Any]:
    return threats(state, ahead, answer, drone_radius_m=0.2, cushion_m=0.1)


def test_head_on_with_an_offset() -> None:
    """4 m apart, closing at 5 m/s, 0.3 m aside and 0.4 m above: 0.8 s to a miss of 0.5 m."""
    ahead = prediction(("x", (4.0, 0.3, 2.4), (-3.0, 0.0, 0.0), 0.4))
    (threat,) = find(vehicle((0, 0, 2), (2, 0, 0)), ahead, result(x=0.8))
    assert threat.track == "x"
    assert threat.number == zlib.crc32(b"x")
    assert threat.time_s == pytest.approx(0.8)
    assert threat.altitude_m == pytest.approx(0.4)
    assert threat.horizontal_m == pytest.approx(0.3)
    assert threat.level == HIGH  # 0.5 m < 0.4 m + 0.2 m: the bodies touch


def test_between_two_instants_of_the_grid() -> None:
    """1 m at 8 m/s: 0.125 s, half way between two instants; nearer than either of them."""
    ahead = prediction(("x", (0.0, 1.0, 2.0), (0.0, -8.0, 0.0), 0.1))
    (threat,) = find(vehicle((0, 0, 2), (0, 0, 0)), ahead, result(x=0.3))
    assert threat.time_s == pytest.approx(0.125)
    assert threat.horizontal_m == pytest.approx(0.0, abs=1e-9)


def test_the_margin_decides_and_low_is_a_near_miss() -> None:
    ahead = prediction(("x", (1.0, 0.7, 2.0), (-2.0, 0.0, 0.0), 0.2))
    here = vehicle((0, 0, 2), (0, 0, 0))
    assert find(here, ahead, result(x=0.69)) == []
    (threat,) = find(here, ahead, result(x=0.71))
    assert threat.level == LOW
    assert find(here, ahead, result(Verdict.ADJUSTED, x=0.71))[0].level == HIGH  # the filter acts because of it
    assert find(here, ahead, result(Verdict.ADJUSTED, y=1.0, x=0.71))[0].level == LOW  # because of another


def test_without_rows_radii_and_cushion_count() -> None:
    here = vehicle((0, 0, 2), (0, 0, 0))
    assert len(find(here, prediction(("x", (0.49, 0, 2), (0, 0, 0), 0.2)), result())) == 1  # 0.2 + 0.2 + 0.1
    assert find(here, prediction(("x", (0.51, 0, 2), (0, 0, 0), 0.2)), result()) == []


def test_beyond_the_horizon_and_behind_is_no_threat() -> None:
    here = vehicle((0, 0, 2), (1, 0, 0))
    assert find(here, prediction(("x", (3.0, 0, 2), (0, 0, 0), 0.2)), result(x=1.0)) == []  # 3 s away, horizon 1.1 s
    assert find(here, prediction(("x", (-2.0, 0, 2), (0.5, 0, 0), 0.2)), result(x=1.0)) == []


def test_the_delay_counts() -> None:
    """The grid starts 0.2 s after the stamp; the vehicle has moved on by then."""
    ahead = prediction(("x", (2.0, 0, 2), (0, 0, 0), 0.2), start_ns=1_200_000_000)
    (threat,) = find(vehicle((0, 0, 2), (4, 0, 0), 1_000_000_000), ahead, result(x=0.5))
    assert threat.time_s == pytest.approx(0.5)


def test_soonest_first_and_nothing_from_nothing() -> None:
    ahead = prediction(("late", (2.0, 0, 2), (-2, 0, 0), 0.2), ("soon", (0, 1.0, 2), (0, -2, 0), 0.2))
    assert [t.track for t in find(vehicle((0, 0, 2), (0, 0, 0)), ahead, result())] == ["soon", "late"]
    assert find(vehicle((0, 0, 2), (0, 0, 0)), prediction(), result()) == []
