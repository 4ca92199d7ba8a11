"""What `companion bench tick` and `memory` make of what they have seen: deadlines, jitter, growth; no process."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest

from companion.bench import memory, processes, tick, tick_brain
from companion.bench.tick_brain import BrainTiming, _World, brain_config, growth_exponent
from companion.bench.tick_command import _positive, _whole_numbers
from companion.bench.tick_daemon import Pauses, Tick, TickNotes
from companion.bench.tick_flight import WARM_S, evaluate
from companion.bench.tick_start import Starts
from companion.bench.timing import Quantiles
from companion.errors import CompanionError, ConfigError
from sim_bridge.scenario import parse_scenario

MS = 1_000_000


def notes(arrived_ms: list[float], took_ms: list[float], skipped_ms: tuple[float, ...] = ()) -> TickNotes:
    """Ticks that sent a millisecond after they began and were done after ``took_ms``; before them, one to warm up."""
    begin_ms = 1e3 * WARM_S
    ticks = [Tick(0, 1, 2, 3)]
    for at, took in zip(arrived_ms, took_ms, strict=True):
        arrived = round((begin_ms + at) * MS)
        ticks.append(Tick(arrived, arrived + MS, arrived + round(took * MS), MS // 2))
    return TickNotes(ticks, [round((begin_ms + at) * MS) for at in skipped_ms], Pauses(), {}, 9, {})


def run_of(told: TickNotes, rate_hz: int = 50) -> tick.TickRun:
    return evaluate(told, rate_hz, 4, 1.0, memory=100.0, simulator={})


def test_a_tick_longer_than_a_period_and_an_overtaken_state_are_misses() -> None:
    run = run_of(notes([0.0, 20.0, 40.0, 60.0], [5.0, 20.0, 20.001, 21.0], skipped_ms=(45.0,)))
    assert (run.ticks, run.misses, run.overtaken) == (4, 3, 1)
    assert run.to_setpoint.max == 1.0
    assert run.to_end.max == 21.0
    assert run.processor.p50 == 0.5


def test_jitter_is_how_far_the_spacing_is_off_the_period() -> None:
    run = run_of(notes([0.0, 20.0, 43.0, 60.0], [1.0] * 4))
    assert run.state_jitter.max == run.interval_jitter.max == 3.0
    assert run.state_jitter.p50 == 3.0


def test_only_what_lies_between_the_warm_time_and_the_end_counts() -> None:
    run = run_of(notes([-30.0, 0.0, 20.0, 999.0, 1000.0], [90.0, 1.0, 1.0, 1.0, 90.0], skipped_ms=(-1.0, 1000.0)))
    assert (run.ticks, run.misses) == (3, 0)
    with pytest.raises(CompanionError, match="flew 1 ticks at 50 Hz"):
        run_of(notes([0.0], [1.0]))


@pytest.mark.parametrize("rate_hz", [20, 50, 100])
@pytest.mark.parametrize("obstacles", [1, 4, 10])
def test_the_simulator_reads_the_scenario(rate_hz: int, obstacles: int) -> None:
    for seconds in (None, 3600.0):
        text = processes.scenario_text(rate_hz, obstacles, seconds)
        scenario = parse_scenario(tomllib.loads(text), source="bench.toml")
        assert (scenario.control_hz, len(scenario.obstacles)) == (rate_hz, obstacles)
        assert scenario.end.stop == (seconds is not None)
        assert seconds is None or scenario.end.timeout_s == seconds


@pytest.mark.parametrize(("rate_hz", "physics_hz"), [(20, 240), (50, 300), (100, 500), (40, 240), (250, 1000)])
def test_the_first_rate_of_physics_that_fits(rate_hz: int, physics_hz: int) -> None:
    assert processes.physics_hz(rate_hz) == physics_hz


def test_a_rate_that_nothing_fits_is_a_mistake() -> None:
    with pytest.raises(ConfigError, match=r"expected a rate that divides 1000 .*, got 60 Hz"):
        processes.physics_hz(60)


@pytest.mark.parametrize("text", ["", "x", "0", "20,,50", "401", "20.5"])
def test_rates_are_whole_and_in_range(text: str) -> None:
    with pytest.raises(Exception, match=r"expected whole rates of 1 to 400 Hz"):
        _whole_numbers(text)
    assert _whole_numbers("20,50") == (20, 50)


@pytest.mark.parametrize("text", ["x", "0", "-1", "nan", "1441"])
def test_minutes_are_positive(text: str) -> None:
    with pytest.raises(Exception, match=r"expected minutes"):
        _positive(text)
    assert _positive("0.5") == 0.5


def timing(count: int, p50: float) -> BrainTiming:
    quantiles = Quantiles(p50, 2.0 * p50, 3.0 * p50, 4.0 * p50)
    return BrainTiming(count, 20, 1000, quantiles, quantiles, quantiles, 0.1)


def test_the_exponent_is_the_slope_between_ten_and_a_thousand() -> None:
    times = [timing(10, 2.0), timing(1000, 2.0 * 100.0**0.7)]
    assert growth_exponent(times) == pytest.approx(0.7)
    assert growth_exponent(times[:1]) is None


def test_figures_name_what_is_missed() -> None:
    run = run_of(notes([0.0, 20.0, 40.0, 60.0], [5.0, 5.0, 5.0, 21.0]))
    starts = Starts([0.8, 1.9], [0.5, 0.6], 130.0)
    told = tick.figures([run], [timing(1, 0.6), timing(10, 0.9), timing(100, 4.0), timing(1000, 40.0)], starts)
    missed = {figure.name for figure in told if not figure.met}
    assert missed == {"50 Hz, 4 obstacles: share of deadlines missed", "brain, 1 obstacles: p50, ms"}
    assert {figure.limit for figure in told} == {0.0, 0.5, 1.0, 2.0, 5.0, 20.0}


def test_the_brain_flies_among_what_it_is_asked_for() -> None:
    timed = tick_brain.measure_brain(10, 20)
    assert (timed.obstacles, timed.horizon, timed.ticks) == (10, 20, 20)
    assert 0.0 < timed.brain.p50 <= timed.whole.p50
    world = _World(200, brain_config(200))
    for k in (0, 37, 4000):
        (frame,) = world.inputs(k).frames
        p = np.array([seen.p_enu for seen in frame.detections])
        off = 5.0 * tick_brain.SIGMA_M
        assert len(p) == 200
        assert (p >= world._low - off).all()
        assert (p <= world._high + off).all()


def test_growth_is_from_a_sixth_of_the_flight_on() -> None:
    samples = [(600.0 * k, 100.0 + (20.0 if k >= 1 else 0.0) + 0.1 * k) for k in range(7)]
    measured = memory.evaluate(samples, 60.0, 121.0, 12.0, 72_000)
    assert (measured.start_mib, measured.settled_mib, measured.end_mib) == (100.0, 120.1, 120.6)
    assert measured.growth_mib == pytest.approx(0.5)
    assert all(figure.met for figure in memory.figures(measured))
    leaky = memory.evaluate([*samples[:-1], (3600.0, 125.0)], 60.0, 201.0, 12.0, 72_000)
    assert not any(figure.met for figure in memory.figures(leaky))


@pytest.mark.parametrize("samples", [[], [(0.1, 100.0), (3000.0, 100.0)]])
def test_a_flight_that_ended_early_tells_nothing(samples: list[tuple[float, float]]) -> None:
    with pytest.raises(CompanionError, match="ended early"):
        memory.evaluate(samples, 60.0, 100.0, 12.0, 1)
