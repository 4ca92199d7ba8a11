"""`policies paper`: the cases are what the paper's words say, every method flies, and the files are whole."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from companion.config import Config
from companion.policy import load_policy
from policies.baselines.pid import PositionPid
from policies.cli import main
from policies.evaluation.bullet import PERIOD_S, Arrival, BulletVehicle
from policies.evaluation.paper import (
    CASE_NAMES,
    METHODS,
    Cell,
    Flown,
    Method,
    fly_case,
    load_case,
    preset,
    retimed,
    table,
)
from sim_bridge.placement import resolve

POLICY = load_policy(Config().policy, Config().limits)
OURS = Method("RL+ACBF", Config(), reference=lambda: POLICY)


def test_an_arrival_needs_a_passage_and_then_to_stay() -> None:
    arrival = Arrival(np.zeros(3), 0.1, stay_s=0.2)
    positions = [(1.0, 0.0), (-1.0, 0.05), (-0.2, 0.0), (0.05, 0.0), (0.2, 0.0), (0.2, 0.0), (0.1, 0.0), (0.1, 0.0)]
    told = []
    for step, (x, y) in enumerate(positions):
        arrival.note(step * 0.1, np.array([x, y, 0.0]))
        told.append((arrival.passed_s, arrival.arrived_s, arrival.reached))
    assert told[0] == (None, None, False)
    assert told[1] == (0.1, None, False)  # flown through: within the threshold on the way, far away at the end
    assert told[3] == (0.1, pytest.approx(0.3), False)
    assert told[4][2] is False
    assert told[5] == (0.1, pytest.approx(0.3), True)


def test_flying_through_counts_where_nothing_has_to_last() -> None:
    arrival = Arrival(np.zeros(3), 0.1, stay_s=0.0)
    arrival.note(0.0, np.array([1.0, 0.0, 0.0]))
    arrival.note(0.1, np.array([-1.0, 0.0, 0.0]))
    assert (arrival.arrived_s, arrival.reached) == (0.1, True)


def test_the_vehicle_hovers_and_answers_an_acceleration() -> None:
    with BulletVehicle(np.array([0.0, 0.0, 2.0])) as vehicle:
        state = vehicle.state
        assert state.stamp_ns == 0
        assert np.linalg.norm(state.p_enu - [0.0, 0.0, 2.0]) < 0.05
        assert np.linalg.norm(state.v_enu) < 0.05
        for _ in range(20):
            vehicle.advance(np.array([1.0, 0.0, 0.0]))
        assert vehicle.state.stamp_ns == 1_000_000_000
        assert vehicle.state.v_enu[0] == pytest.approx(0.85, abs=0.15)  # less lag and rotor drag


@pytest.mark.parametrize("case", CASE_NAMES)
def test_each_case_has_one_obstacle_of_its_motion_that_hits_the_unfiltered_vehicle(case: str) -> None:
    scenario = load_case(case)
    (obstacle,) = resolve(case, scenario, 0).obstacles
    kind = type(obstacle.motion).__name__
    assert kind == {"case1": "Linear", "case2": "Accelerated", "case3": "FigureEight"}[case]
    assert scenario.target is not None
    chosen = preset("default")
    unfiltered = Method("raw", chosen.config, end_to_end=lambda v, e, r, w: np.clip(POLICY.act(v, e), -2.7, 2.7))
    raw = fly_case(retimed(scenario, chosen, unfiltered), chosen, unfiltered)
    assert raw.collided
    assert raw.clearance_m == 0.0
    assert raw.arrival_s is None


def test_our_method_clears_the_first_case_and_is_reproducible() -> None:
    chosen = preset("default")
    timed = retimed(load_case("case1"), chosen, OURS)
    one, two = (fly_case(timed, chosen, OURS, seed=3) for _ in range(2))
    other, exact = fly_case(timed, chosen, OURS, seed=4), fly_case(timed, chosen, OURS, exact=True)
    assert len({flight.clearance_m for flight in (one, other, exact)}) == 3
    assert not one.collided
    assert one.arrival_s is not None
    assert one.clearance_m > 0.16
    assert one.p_enu.tolist() == two.p_enu.tolist()
    assert sum(one.verdicts.values()) == len(one.t_s)
    assert one.verdicts["adjusted"] > 0
    reach = np.linalg.norm(one.p_enu - one.obstacle_enu, axis=1) - 0.4
    np.testing.assert_allclose(one.distance_m, reach, atol=1e-9)


def test_pid_flies_behind_the_same_filter() -> None:
    chosen = preset("default")
    method = Method("PID", chosen.config, reference=lambda: PositionPid(PERIOD_S))
    flight = fly_case(load_case("case1"), chosen, method, obstacles=False)
    assert flight.arrival_s is not None
    assert np.isnan(flight.obstacle_enu).all()
    assert np.abs(flight.a_enu).max() <= 3.0 + 1e-9


def test_the_literal_preset_is_the_papers() -> None:
    chosen = preset("paper")
    assert chosen.k_ma_m_s2 == 1.0
    safety, tracking = chosen.config.safety, chosen.config.tracking
    assert (safety.horizon, safety.form, safety.alpha1, safety.alpha2) == (5, "paper", 0.8, 0.5)
    assert (safety.lambda_epsilon, safety.lambda_delta, safety.kappa) == (10.0, 1e4, 0.0)
    assert tracking.stay_probability == (0.6, 0.6, 0.6)
    assert chosen.config.policy.capture_radius_m == 0.0


def cell(clearance_m: float, collisions: int = 0, flights: int = 10) -> Cell:
    empty = np.zeros((1, 3))

    def flown(collided: bool) -> Flown:
        least_m = 0.0 if collided else clearance_m
        return Flown(np.zeros(1), empty, empty, empty, empty, np.zeros(1), least_m, collided, None, {}, 0.0)

    return Cell(flown(False), tuple(flown(k < collisions) for k in range(flights)))


def test_the_table_stands_beside_the_papers() -> None:
    cases = {
        case: {method: cell(0.25, flights=0 if method.startswith("Pure") else 10) for method in METHODS}
        for case in CASE_NAMES
    }
    cases["case3"]["PID+ACBF"] = cell(0.25, 4)
    told = table("default", cases, {"RL+ACBF": 27.6}).splitlines()
    rows = {line.split(" | ")[0].removeprefix("| "): line.rstrip(" |").split(" | ")[1:] for line in told}
    ours = ["28 s", "0.25 m / 0.25 m / 0.25 m", "0.25 m / 0.25 m / 0.25 m", "0 of 10 / 0 of 10 / 0 of 10"]
    assert rows["RL+ACBF"] == [*ours, "136 s", "0.32 m / 0.44 m / 0.16 m"]
    assert rows["PID+ACBF"][2:4] == ["0.25 m / 0.25 m / 0.00 m", "0 of 10 / 0 of 10 / 4 of 10"]
    assert rows["Pure RL (Case 2)"] == ["N/A", ours[1], "-", "-", "160 s", "0.84 m / 0.93 m / 0 m"]


@pytest.mark.slow
def test_the_command_writes_table_figures_and_json_and_takes_networks_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("policies.paper.STARTS", 3)  # of networks that have hardly been trained
    monkeypatch.setattr("policies.evaluation.paper.TIMEOUT_S", 3.0)
    arguments = ["paper", "--preset", "default", "--steps", "4096", "--flights", "1", "--out", str(tmp_path), "--json"]
    assert main(arguments) == 0
    told = json.loads(capsys.readouterr().out)["presets"]["default"]
    assert set(told["cases"]) == set(CASE_NAMES)
    assert all(set(row) == set(METHODS) for row in told["cases"].values())
    assert sorted(Path(path).name for path in told["figures"]) == sorted(
        path.name for path in (tmp_path / "default").glob("figure*.png")
    )
    assert len(told["figures"]) == 9
    assert json.loads((tmp_path / "paper.json").read_text())["presets"]["default"] == told
    assert "| RL+ACBF |" in (tmp_path / "table3.md").read_text()
    assert main(arguments) == 0
    again = json.loads(capsys.readouterr().out)["presets"]["default"]
    assert again["training"] == told["training"]  # not trained anew: the seconds are the same
    assert again["cases"] == told["cases"]
    assert math.isfinite(again["training"]["RL+ACBF"]["seconds"])


def test_evaluating_on_the_bullet_vehicle(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "builtin:default", "--plant", "pybullet", "--starts", "2", "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert (figures["reached"], figures["left_arena"], figures["plant"]) == (2, 0, "pybullet")


@pytest.mark.slow
def test_the_bullet_vehicle_reaches_a_hundred_targets(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "builtin:default", "--plant", "pybullet", "--starts", "100", "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["reached"] == 100
    assert figures["left_arena"] == 0


def test_the_bench_times_both_backends_on_the_same_states(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "--calls", "100", "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert set(figures["milliseconds"]) == {
        f"{name}: {what}" for name in ("onnx", "torch") for what in ("network", "as flown")
    }
    assert all(0.0 < values["p50"] <= values["p99"] <= values["max"] for values in figures["milliseconds"].values())
    assert figures["greatest_difference"] <= 1e-6
    assert main(["bench", "--calls", "100"]) == 0
    assert "greatest difference of the backends" in capsys.readouterr().out
