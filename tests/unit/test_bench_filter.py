"""The bench of the filter measures what it says: active states, warm filters, honest rivals, turns that are counted."""

import json
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest

from companion.bench import cbfpy_rival, chatter, filter, filter_timing, programs
from companion.bench.cbfpy_rival import GAIN_HZ, cbfpy_filter, keep_out_m
from companion.bench.chatter import Encounter, FlightResult, free_s, measure_encounter, turns
from companion.bench.filter_tables import print_filter
from companion.bench.filter_timing import Condition, FilterTiming, measure_timing, timed_step
from companion.bench.programs import ProgramTiming, captured, measure_programs, recording, solve_quadprog
from companion.bench.scenes import NEAREST_M, Flight, Scene, scenes
from companion.bench.timing import Quantiles
from companion.config import LimitsConfig, SafetyConfig
from companion.safety import qp
from companion.safety.filter import SafetyFilter
from companion.types import Verdict

FEW = Condition(3, 5)


def first(count=3, horizon=5, seed=1):
    return next(scenes(seed, count, SafetyConfig(horizon=horizon)))


def lonely(*, obstacle_p=(4.0, 0.0, 5.0), obstacle_v=(0.0, 0.0, 0.0), v=(1.0, 0.0, 0.0), a_ref=(0.0, 0.0, 0.0)):
    """One obstacle, the vehicle at (0, 0, 5)."""
    return Scene(
        np.array([0.0, 0.0, 5.0]), np.array(v), np.array(a_ref), np.array([obstacle_p]), np.array([obstacle_v])
    )


def plain_quantiles(p50=1.0, p99=1.0):
    return Quantiles(p50, p99, None, 2.0)


def told_timing(condition, p50, p99, rivals=None):
    whole = plain_quantiles(p50, p99)
    return FilterTiming(
        condition=condition,
        states=10,
        verdicts={"adjusted": 0.9, "relaxed": 0.1, "braking": 0.0},
        programs=2.0,
        rows=whole,
        solve=whole,
        verify=whole,
        whole=whole,
        by_verdict={"adjusted": whole},
        solvers={"daqp": whole, "osqp": whole},
        solver_states=10,
        rivals=rivals or {},
    )


def test_scenes_are_the_same_for_a_seed_and_others_for_another():
    one, same, other = (first(seed=seed) for seed in (5, 5, 6))
    assert np.array_equal(one.obstacle_p, same.obstacle_p)
    assert np.array_equal(one.a_ref, same.a_ref)
    assert not np.array_equal(one.obstacle_p, other.obstacle_p)


def test_no_scene_begins_at_an_obstacle_and_the_first_comes_near():
    config = SafetyConfig(horizon=5)
    for scene in islice(scenes(2, 10, config), 30):
        assert np.linalg.norm(scene.obstacle_p - scene.p_enu, axis=1).min() > NEAREST_M
        assert np.linalg.norm(scene.v_enu) <= 3.5
        assert np.linalg.norm(scene.obstacle_v, axis=1).max() <= 3.0
        t_s = np.linspace(0.0, 0.5 + 7 * config.dt_s, 200)[:, None]
        apart = scene.obstacle_p[0] - scene.p_enu + (scene.obstacle_v[0] - scene.v_enu) * t_s
        assert np.linalg.norm(apart, axis=1).min() <= 0.5 * np.sqrt(3.0) + 1e-9


def test_a_flight_moves_as_a_double_integrator_and_predicts_its_obstacles():
    config = SafetyConfig(horizon=5)
    scene = lonely(obstacle_v=(-1.0, 0.5, 0.0))
    flight = Flight(scene, config)
    begin = flight.inputs()
    assert begin.elapsed_s is None
    for _ in range(4):
        flight.advance(np.array([0.0, 2.0, 0.0]))
    now = flight.inputs()
    assert now.elapsed_s == config.dt_s
    np.testing.assert_allclose(now.p_enu, [0.2, 0.04, 5.0])
    np.testing.assert_allclose(now.v_enu, [1.0, 0.4, 0.0])
    np.testing.assert_allclose(now.prediction.p_enu[:, 0], begin.prediction.p_enu[:, 4])
    noisy = flight.inputs(np.ones(3), error_m=np.full((1, 3), 0.1))
    np.testing.assert_allclose(noisy.prediction.p_enu - now.prediction.p_enu, 0.1)
    np.testing.assert_array_equal(noisy.a_ref, np.ones(3))


def test_clearance_is_the_least_within_the_tick():
    flight = Flight(lonely(obstacle_p=(0.05, 1.0, 5.0), v=(2.0, 0.0, 0.0)), SafetyConfig(horizon=5))
    assert flight.clearance_m(np.zeros(3), 10) == pytest.approx(1.0)


def test_a_timed_step_is_a_step():
    config = SafetyConfig(horizon=5)
    flight = Flight(first(), config)
    one, other = SafetyFilter(config, LimitsConfig()), SafetyFilter(config, LimitsConfig())
    for _ in range(6):
        inputs = flight.inputs()
        result, took_ns = timed_step(one, inputs)
        expected = other.step(inputs)
        assert np.array_equal(result.a_safe, expected.a_safe)
        assert (result.verdict, result.iterations) == (expected.verdict, expected.iterations)
        assert len(took_ns) == 3
        assert min(took_ns) > 0
        flight.advance(result.a_safe)


def test_every_counted_state_is_active_and_none_is_the_first_of_its_flight(monkeypatch):
    counted = []
    count = filter_timing._Bench._count

    def spied(bench, result, took, theirs):
        counted.append(result.verdict)
        count(bench, result, took, theirs)

    begun = []
    monkeypatch.setattr(filter_timing._Bench, "_count", spied)
    inputs = Flight.inputs
    monkeypatch.setattr(Flight, "inputs", lambda flight: begun.append(flight.ticks) or inputs(flight))
    timing = measure_timing(FEW, 30, backends=())
    assert Verdict.NOMINAL not in counted
    assert len(counted) >= timing.states == 30
    assert sum(timing.verdicts.values()) == pytest.approx(1.0)
    assert begun.count(0) >= filter_timing.WARM_FLIGHTS
    assert set(timing.solvers) == {"daqp", "osqp"}
    assert timing.solver_states == 30
    assert timing.rivals == {}
    assert timing.whole.p50 >= max(timing.rows.p50, timing.solve.p50, timing.verify.p50)


def test_the_other_solver_flies_in_some_flights_only_where_it_would_take_minutes(monkeypatch):
    monkeypatch.setattr(filter_timing, "OTHER_SOLVER_ROWS", 1)
    monkeypatch.setattr(filter_timing, "OTHER_SOLVER_STRIDE", 4)
    timing = measure_timing(FEW, 30, backends=())
    assert 0 < timing.solver_states < 30


def test_programs_are_recorded_as_the_filter_solves_them_and_the_backends_restored():
    before = dict(qp.BACKENDS)
    with recording() as seen:
        program = qp.Program(*np.array([[1.0], [-2.0], [-1.0], [1.0]]), np.array([[1.0]]), np.array([0.5]))
        x, name = qp.solve(program, ("daqp", "osqp"))
        program.linear[:] = 7.0  # a filter may reuse its arrays
    assert name == "daqp"
    np.testing.assert_allclose(x, 1.0)
    (copied,) = seen
    assert copied.linear.tolist() == [-2.0]
    assert before == qp.BACKENDS


def test_captured_programs_are_the_same_every_time():
    one, same = captured(FEW, 5), captured(FEW, 5)
    assert len(one) == 5
    for a, b in zip(one, same, strict=True):
        assert np.array_equal(a.rows, b.rows)
        assert np.array_equal(a.linear, b.linear)


def small_program(floor=1.0):
    """The nearest to (2, 0) with x + y >= floor and x <= 1; y has no bound below."""
    return qp.Program(
        weight=np.array([2.0, 2.0]),
        linear=np.array([-4.0, 0.0]),
        low=np.array([-1.0, -qp.UNBOUNDED]),
        high=np.array([1.0, qp.UNBOUNDED]),
        rows=np.array([[1.0, 1.0], [0.0, 0.0]]),
        floor=np.array([floor, -qp.UNBOUNDED]),
    )


def test_quadprog_solves_the_same_program():
    pytest.importorskip("quadprog")
    for floor, expected in ((1.0, [1.0, 0.0]), (3.0, [1.0, 2.0])):
        program = small_program(floor)
        np.testing.assert_allclose(solve_quadprog(program)(), expected, atol=1e-9)
        np.testing.assert_allclose(qp.solve_daqp(program), expected, atol=1e-6)


def test_all_solvers_agree_on_the_filters_programs():
    pytest.importorskip("quadprog")
    timing = measure_programs(FEW, 20)
    assert timing.programs + timing.infeasible == 20
    assert set(timing.solvers) == {"daqp", "osqp", "quadprog"}
    assert timing.apart["quadprog"] < 1e-6
    assert timing.apart["osqp"] < 1e-3
    assert timing.disputed == 0


def test_failures_are_told_from_proofs(monkeypatch):
    pytest.importorskip("quadprog")
    impossible = replace(small_program(), floor=np.array([3.0, -qp.UNBOUNDED]), high=np.array([1.0, 1.0]))
    monkeypatch.setattr(programs, "captured", lambda *args, **kwargs: [small_program(), impossible])
    monkeypatch.setattr(qp, "solve_osqp", lambda program: None)
    timing = measure_programs(FEW, 2)
    assert (timing.programs, timing.infeasible, timing.disputed, timing.failed) == (1, 1, 0, {"osqp": 1})
    assert "osqp" not in timing.solvers


def test_without_quadprog_its_column_is_left_out(monkeypatch):
    monkeypatch.setattr(programs, "available", lambda: False)
    assert set(measure_programs(FEW, 5).solvers) == {"daqp", "osqp"}


@pytest.mark.parametrize("backend", cbfpy_rival.backends())
def test_cbfpy_keeps_its_own_constraint_with_the_obstacles_motion_in_it(backend):
    """h'' + 2 k h' + k^2 h >= 0 of h = |r| - D, by hand: h' = r v / |r|, h'' = (a r + |v|^2 - h'^2) / |r|."""
    config, limits = SafetyConfig(horizon=5), LimitsConfig()
    scene = lonely(obstacle_p=(2.2, 0.2, 5.0), obstacle_v=(-1.5, 0.0, 0.0), a_ref=(1.0, 0.0, 0.0))
    inputs = Flight(scene, config).inputs()
    a = cbfpy_filter(backend, inputs, config, limits)(inputs)
    r, v = scene.p_enu - scene.obstacle_p[0], scene.v_enu - scene.obstacle_v[0]
    distance = np.linalg.norm(r)
    (keep_out,) = keep_out_m(inputs, config)
    rate = r @ v / distance

    def constraint(a):
        second = (a @ r + v @ v - rate**2) / distance
        return second + 2.0 * GAIN_HZ * rate + GAIN_HZ**2 * (distance - keep_out)

    assert constraint(scene.a_ref) < -0.1, "the reference is refused"
    assert constraint(a) == pytest.approx(0.0, abs=5e-3)
    assert np.abs(a).max() <= limits.acceleration_m_s2 - inputs.accel_shrink_m_s2 + 1e-3


@pytest.mark.parametrize("backend", cbfpy_rival.backends())
def test_cbfpy_is_timed_on_every_counted_state(backend):
    timing = measure_timing(FEW, 4, backends=(backend,))
    assert set(timing.rivals) == {backend}
    assert timing.rivals[backend].p50 > 0.0


def test_without_cbfpy_there_is_no_backend(monkeypatch):
    monkeypatch.setattr(cbfpy_rival.importlib.util, "find_spec", lambda name: None)
    assert cbfpy_rival.backends() == ()
    monkeypatch.setattr(cbfpy_rival.importlib.util, "find_spec", lambda name: None if name == "elastiqp" else object())
    assert cbfpy_rival.backends() == ("qpax",)


def test_the_rivals_keep_out_distance_is_that_of_the_present_instant():
    config = SafetyConfig(horizon=5, kappa=2.0, cushion_m=0.1, drone_radius_m=0.2)
    inputs = Flight(lonely(), config, sigma_m=0.03).inputs()
    np.testing.assert_allclose(keep_out_m(replace(inputs, p_std_m=0.04), config), 0.2 + 0.2 + 0.1 + 2.0 * 0.05)


@pytest.mark.parametrize(
    ("corrections", "expected"),
    [
        ([(1, 0, 0), (1, 0.1, 0), (0.9, -0.1, 0)], 0),
        ([(1, 0, 0), (-1, 0, 0), (1, 0, 0)], 2),
        ([(0, 1, 0), (0.1, -1, 0), (0.1, -1, 0), (0.1, 0.5, 0)], 2),
        ([(1, 0, 0), (0, 0, 0), (-1, 0, 0)], 0),  # a tick without correction lies between
        ([(1, 0, 0), (-0.04, 0, 0), (1, 0, 0)], 0),  # too small to have a side
        ([(1, 0, 0), (0, 1, 0)], 0),  # 90 degrees, not more
        ([(1, 0, 0)], 0),
    ],
)
def test_turns_of_the_correction(corrections, expected):
    assert turns(np.array(corrections, dtype=float)) == expected


def test_the_reference_arrives_and_stays_inside_the_box():
    assert 4.0 < free_s() < 6.0
    a = chatter.reference(chatter.START, np.array([0.0, 3.0, 0.0]), 2.7)
    assert np.abs(a).max() == 2.7
    np.testing.assert_allclose(chatter.reference(chatter.TARGET, np.zeros(3), 2.7), 0.0)


def test_flights_are_the_same_for_a_seed_and_the_first_has_no_offset():
    one = measure_encounter("crossing", 0.05, 2)
    assert one == measure_encounter("crossing", 0.05, 2)
    assert one.flights[0] == measure_encounter("crossing", 0.05, 1).flights[0]
    assert one.flights[0] != measure_encounter("crossing", 0.05, 1, seed=3).flights[0]
    assert all(flight.arrival_s is not None for flight in one.flights)
    assert all(flight.adjusted > 0.0 for flight in one.flights)


def test_a_flight_through_nothing_touches_nothing_and_one_with_the_filter_off_does(monkeypatch):
    class Blind(SafetyFilter):
        def step(self, inputs):
            return replace(super().step(inputs), a_safe=inputs.a_ref, verdict=Verdict.NOMINAL)

    monkeypatch.setattr(chatter, "SafetyFilter", Blind)
    (flight,) = measure_encounter("static", 0.0, 1).flights
    assert flight.clearance_m < -0.35
    assert (flight.turns, flight.adjusted, flight.relaxed) == (0, 0.0, 0.0)
    assert flight.arrival_s == pytest.approx(free_s())


def test_figures_are_those_of_the_issue_and_need_enough_samples():
    rivals = {"qpax": plain_quantiles(0.5, 4.0)}
    times = [
        told_timing(Condition(10, 5), 0.2, 0.9),
        told_timing(Condition(20, 5), 1.0, 0.8, rivals),
        told_timing(Condition(10, 20), 0.6, 1.0),
        told_timing(Condition(100, 20), 1.9, None),
        told_timing(Condition(1, 5), 9.0, 9.0),
    ]
    found = {figure.name: (figure.value, figure.limit, figure.met) for figure in filter.figures(times)}
    assert found == {
        "10 obstacles, N = 5: p50 of the whole, ms": (0.2, 0.3, True),
        "10 obstacles, N = 5: p99 of the whole, ms": (0.9, 0.8, False),
        "20 obstacles, N = 5: p50 over that of cbfpy (qpax)": (2.0, 3.0, True),
        "20 obstacles, N = 5: p99 over that of cbfpy (qpax)": (0.2, 0.25, True),
        "10 obstacles, N = 20: p50 of the whole, ms": (0.6, 0.5, False),
        "100 obstacles, N = 20: p50 of the whole, ms": (1.9, 2.0, True),
    }
    assert len(filter.figures([told_timing(Condition(10, 5), 0.2, None)])) == 1
    assert set(filter.HEADLINE) <= set(filter.CONDITIONS)
    assert {(one.obstacles, one.horizon) for one in filter.CONDITIONS} == {
        (count, horizon) for count in (1, 10, 20, 100) for horizon in (5, 20)
    }


def test_everything_is_told_in_json_and_tables(capsys):
    quantiles = plain_quantiles()
    times = [told_timing(Condition(1, 5), 1.0, None, {"qpax": quantiles})]
    solved = [
        ProgramTiming(FEW, 3, 1, 0, 9, 30, {"daqp": quantiles, "quadprog": quantiles}, {"osqp": 3}, {"quadprog": 1e-9}),
        ProgramTiming(Condition(1, 5), 0, 0, 0, 0, 0, {}, {}, {}),
    ]
    lost = FlightResult(4, 0.5, 0.1, 0.0, None, -0.1)
    encounters = [Encounter("static", 0.05, (lost, replace(lost, arrival_s=5.0, turns=0)))]
    encounters.append(Encounter("crossing", 0.0, (lost,)))
    told = filter.as_json(times, solved, encounters, 4.65)
    again = json.loads(json.dumps(told))
    assert again["timing_ms"][0]["name"] == "1 obstacle, N = 5"
    assert again["timing_ms"][0]["rivals"]["qpax"]["p50"] == 1.0
    assert again["programs_ms"][0]["failed"] == {"osqp": 3}
    assert again["flights"][0]["flights"][0]["arrival_s"] is None
    assert again["rivals"]["daqp"] is not None
    assert filter._version("no-such-package") is None
    print_filter(times, solved, encounters, 4.65, filter.figures(times))
    out = capsys.readouterr().out
    for text in ("1 obstacle, N = 5", "[ms]", "cbfpy (qpax)", "1e-09", "none seen", "1/2", "0/1", "1 infeasible"):
        assert text in out
