"""The encounter harness itself: motions by hand, the control that must be hit, one flight that must not."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from companion.config import Config
from companion.types import frozen
from policies.evaluation.campaign import run
from policies.evaluation.encounters import (
    Encounter,
    Obstacle,
    Sensor,
    fly,
    make_encounter,
    stand_in_reference,
)

CONFIG = Config()
REFERENCE = stand_in_reference(2.7, 6.0)


@pytest.mark.parametrize("motion", ["linear", "accelerating", "eight"])
def test_obstacles_cross_at_their_instant_with_their_velocity(motion: str) -> None:
    obstacle = Obstacle(
        motion, 2.0, frozen([1.0, 2.0, 3.0]), frozen([0.0, 1.5, 0.0]), frozen([1.0, 0.0, 0.0]), rate_rad_s=1.0
    )
    before, at, after = obstacle.position(np.array([2.0 - 1e-5, 2.0, 2.0 + 1e-5]))
    assert at == pytest.approx([1.0, 2.0, 3.0])
    assert (after - before) / 2e-5 == pytest.approx([0.0, 1.5, 0.0], abs=1e-4)


def test_an_eight_is_never_faster_than_at_its_crossing_and_closes() -> None:
    obstacle = Obstacle("eight", 0.0, frozen(np.zeros(3)), frozen([3.0, 0.0, 0.0]), frozen([0.0, 1.0, 0.0]), 0.8)
    t = np.linspace(0.0, 2.0 * math.pi / 0.8, 2001)
    path = obstacle.position(t)
    speed = np.linalg.norm(np.diff(path, axis=0), axis=-1) / (t[1] - t[0])
    assert speed.max() <= 3.0 + 1e-6
    assert path[-1] == pytest.approx(path[0], abs=1e-9)


def test_the_unobstructed_reference_arrives() -> None:
    free = Encounter(0, frozen([-4.0, 0.0, 3.0]), frozen([4.0, 0.0, 3.0]), ())
    flight = fly(free, CONFIG, REFERENCE, Sensor())
    assert flight.time_s is not None
    assert 2.0 * math.sqrt(8.0 / 2.7) < flight.time_s < 6.0
    assert flight.clearance_m == math.inf
    assert set(flight.verdicts) == {"nominal"}


def test_an_encounter_hits_without_the_filter_and_not_with_it() -> None:
    encounter = make_encounter(7, 1, CONFIG, REFERENCE)
    off = msgspec.structs.replace(CONFIG, safety=msgspec.structs.replace(CONFIG.safety, filter="none"))
    assert fly(encounter, off, REFERENCE, Sensor()).clearance_m < 0.0
    flight = fly(encounter, CONFIG, REFERENCE, Sensor())
    assert flight.clearance_m > 0.0
    assert flight.time_s is not None
    assert flight.verdicts["adjusted"] > 0


def test_a_run_is_reproducible_and_reports_itself() -> None:
    one, other = (run(range(7, 9), 2, CONFIG, REFERENCE, Sensor()) for _ in range(2))
    assert one == other
    values = one.to_json()
    assert values["flights"] == 2
    assert sum(values["verdict_shares"].values()) == pytest.approx(1.0)
