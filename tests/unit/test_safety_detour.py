"""Out of hollows and round walls: when a detour begins, where it leads, and that it gives way to the policy again."""

from __future__ import annotations

import math

import numpy as np
import pytest
from safety_scenes import uniform_motion

from companion.config import Config, LimitsConfig, SafetyConfig
from companion.safety.barrier import Barrier
from companion.safety.detour import (
    ASKED_M_S2,
    FIRST_S,
    FREE_S,
    MOST,
    NEAR_M,
    SPEED_M_S,
    STAYED_S,
    Detour,
)
from companion.safety.filter import FilterInput, SafetyFilter
from companion.safety.limits import capability, vehicle_limits
from companion.safety.task import Task
from companion.types import FilterResult, Verdict, frozen
from policies.evaluation.encounters import Encounter, Flight, Sensor, fly, stand_in_reference
from policies.evaluation.obstacles import Obstacle

CONFIG = SafetyConfig(kappa=0.0, kappa_now=0.0, sigma_delay_s=0.0, cushion_m=0.1)  # D = 0.5 m for a radius of 0.2 m
HERE = np.array([0.0, 0.0, 5.0])
ASKED = np.array([1.0, 0.0, 0.0])
TICK_S = 0.25  # binary, so that sums are exact


def task_of(offsets: list[tuple[float, ...]], v: tuple[float, ...] = (0.0, 0.0, 0.0), limit: float = 3.0) -> Task:
    prediction = uniform_motion(HERE + np.reshape(offsets, (-1, 3)), [(0.0, 0.0, 0.0)] * len(offsets), radius_m=0.2)
    rows = Barrier(CONFIG).rows(HERE, np.array(v), prediction, 0.0)
    limits = LimitsConfig(acceleration_m_s2=limit)
    bounds = vehicle_limits(HERE, np.array(v), limits, capability(limits, shrink_m_s2=0.0, dt_s=0.05))
    return Task(rows, bounds, ASKED, np.zeros(len(rows)), np.zeros(len(rows)), CONFIG)


@pytest.mark.parametrize(
    ("offset", "along"),
    [
        ((1.0, 0.0, 0.0), (0.0, -1.0)),  # what is ahead stays on the left: to the right
        ((0.0, 1.0, 0.0), (1.0, 0.0)),
        ((-1.0, 0.0, 0.0), (0.0, 1.0)),
        ((0.6, 0.0, 0.8), (0.0, -1.0)),  # only where it is on the map counts
    ],
)
def test_a_detour_keeps_the_boundary_on_the_left_and_near(
    offset: tuple[float, ...], along: tuple[float, float]
) -> None:
    towards = np.array(offset[:2]) / math.hypot(*offset[:2])
    expected = 2.0 * (np.array(along) + 0.3 * towards)
    assert Detour().reference(task_of([offset])) == pytest.approx([*expected, 0.0])


def test_a_detour_brakes_what_leads_elsewhere_within_the_box() -> None:
    a = Detour().reference(task_of([(1.0, 0.0, 0.0)], v=(0.2, 3.0, 0.4), limit=1.5))
    assert a == pytest.approx([2.0 * (0.3 - 0.2), -1.5, -0.8])
    a = Detour().reference(task_of([(1.0, 0.0, 0.0)], v=(0.2, -3.0, 0.4), limit=1.5))
    assert a == pytest.approx([2.0 * (0.3 - 0.2), 1.5, -0.8])


def test_the_nearer_of_two_obstacles_decides_more_and_one_far_away_nothing() -> None:
    x, y, _ = Detour().reference(task_of([(0.75, 0.0, 0.0), (0.0, 1.0, 0.0)])) / 2.0
    weight = np.array([0.75**2, 0.5**2])  # D = 0.5, so gaps of 0.25 and 0.5 m of the boundary's 1 m
    n = -weight / math.hypot(*weight)
    assert (x, y) == pytest.approx((-n[1] - 0.3 * n[0], n[0] - 0.3 * n[1]))
    same = Detour().reference(task_of([(0.75, 0.0, 0.0), (0.0, 1.0, 0.0), (-1.5, 0.0, 0.0)]))
    assert same == pytest.approx(2.0 * np.array([x, y, 0.0]))


@pytest.mark.parametrize("offsets", [[], [(2.0, 0.0, 0.0)], [(0.0, 0.0, 0.8)]])
def test_without_a_boundary_on_the_map_the_reference_stays(offsets: list[tuple[float, ...]]) -> None:
    assert Detour().reference(task_of(offsets)).tolist() == ASKED.tolist()


def stay(detour: Detour, time_s: float, *, p: tuple[float, ...] = (0.0, 0.0, 5.0), in_the_way: bool = True) -> None:
    for _ in range(round(time_s / TICK_S)):
        detour.note(np.array(p), ASKED, TICK_S, in_the_way=in_the_way)


def test_a_detour_begins_after_no_progress_and_ends_after_its_time() -> None:
    detour = Detour()
    stay(detour, TICK_S + STAYED_S)
    assert not detour.active
    stay(detour, TICK_S)
    assert detour.active
    stay(detour, FIRST_S - TICK_S)
    assert detour.active
    stay(detour, TICK_S)
    assert not detour.active


def test_progress_begins_the_time_anew() -> None:
    detour = Detour()
    stay(detour, STAYED_S)
    stay(detour, STAYED_S, p=(NEAR_M + 0.1, 0.0, 5.0))
    stay(detour, TICK_S, p=(NEAR_M, 0.0, 5.0))
    assert not detour.active
    stay(detour, TICK_S + TICK_S, p=(NEAR_M + 0.1, 0.0, 5.0))
    assert detour.active


@pytest.mark.parametrize("free", ["nothing in the way", "nothing asked"])
def test_nothing_begins_without_a_reference_that_is_refused(free: str) -> None:
    detour = Detour()
    a_ref = ASKED if free == "nothing in the way" else np.array([0.9 * ASKED_M_S2, 0.0, 0.0])
    for _ in range(round(4.0 * STAYED_S / TICK_S)):
        detour.note(HERE, a_ref, TICK_S, in_the_way=free == "nothing asked")
    assert not detour.active


def taken_s(detour: Detour) -> float:
    """Stay until a detour begins, and through it; how long it took, 0 where none came."""
    for _ in range(round(STAYED_S / TICK_S) + 2):
        stay(detour, TICK_S)
        if detour.active:
            break
    time_s = 0.0
    while detour.active:
        stay(detour, TICK_S)
        time_s += TICK_S
    return time_s


def test_each_detour_takes_twice_as_long_until_it_gives_up_and_a_free_flight_forgets() -> None:
    detour = Detour()
    assert [taken_s(detour) for _ in range(MOST + 1)] == [FIRST_S, 2 * FIRST_S, 4 * FIRST_S, 8 * FIRST_S, 0.0]
    stay(detour, FREE_S, in_the_way=False)
    assert taken_s(detour) == 0.0
    stay(detour, FREE_S + TICK_S, in_the_way=False)
    assert taken_s(detour) == FIRST_S


def held(filter_: SafetyFilter, ticks: int, *, detours: bool = True, x: float = 1.0) -> list[FilterResult]:
    """A vehicle that is kept at rest before a sphere, sent through it for ``ticks``."""
    prediction = uniform_motion([HERE + np.array([x, 0.0, 0.0])], [(0.0, 0.0, 0.0)], radius_m=0.2)
    inputs = FilterInput(HERE, np.zeros(3), np.array([0.5, 0.0, 0.0]), prediction, elapsed_s=TICK_S, detours=detours)
    return [filter_.step(inputs) for _ in range(ticks)]


def test_the_filter_answers_a_detour_as_an_adjustment_and_only_where_detours_are_wanted() -> None:
    ticks = round(STAYED_S / TICK_S) + 3
    flown, asked_to_stay = SafetyFilter(CONFIG, LimitsConfig()), SafetyFilter(CONFIG, LimitsConfig())
    held(flown, ticks, x=0.7)
    held(asked_to_stay, ticks, detours=False, x=0.7)
    far = 1.4  # there both references pass
    (result,) = held(flown, 1, x=far)
    assert (result.verdict, result.detour) == (Verdict.ADJUSTED, True)
    assert result.a_safe == pytest.approx([0.6, -2.0, 0.0])
    (result,) = held(asked_to_stay, 1, x=far)
    assert (result.verdict, result.detour) == (Verdict.NOMINAL, False)
    (at_the_wall,) = held(flown, 1, x=0.52)
    assert (at_the_wall.verdict, at_the_wall.detour) == (Verdict.ADJUSTED, True)
    flown.reset()
    (result,) = held(flown, 1, x=far)
    assert (result.verdict, result.detour) == (Verdict.NOMINAL, False)


def at_rest(p: tuple[float, ...], radius_m: float) -> Obstacle:
    return Obstacle("linear", 0.0, frozen(p), frozen(np.zeros(3)), frozen(np.zeros(3)), radius_m=radius_m)


def flown(obstacles: list[Obstacle]) -> Flight:
    encounter = Encounter(1, frozen([-4.0, 0.0, 3.0]), frozen([4.0, 0.0, 3.0]), tuple(obstacles))
    return fly(encounter, Config(), stand_in_reference(2.7, 6.0), Sensor(noise_std_m=0.0))


def test_a_vehicle_leaves_a_dimple_between_four_spheres() -> None:
    flight = flown([at_rest((0.0, y, 3.0 + z), 0.5) for y in (-0.45, 0.45) for z in (-0.45, 0.45)])
    assert flight.time_s is not None
    assert flight.clearance_m > 0.05


@pytest.mark.slow
def test_a_vehicle_flies_round_a_wall_of_spheres_with_wings() -> None:
    steps = np.arange(-1.6, 1.7, 0.8).tolist()
    wall = [at_rest((0.0, y, 3.0 + z), 0.4) for y in steps for z in steps]
    wings = [at_rest((-x, y, 3.0 + z), 0.4) for x in (0.8, 1.6) for y in (-1.6, 1.6) for z in steps]
    flight = flown(wall + wings)
    assert flight.time_s is not None
    assert flight.clearance_m > 0.05
    assert SPEED_M_S * flight.time_s > 8.0
