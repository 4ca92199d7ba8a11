"""The campaign of encounters: figures from outcomes by hand, any number of processes, the command line."""

from __future__ import annotations

import json
import os

import numpy as np
import pytest

from companion.config import Config, DisturbanceConfig
from companion.policy import load_policy
from policies.cli import main
from policies.evaluation.campaign import fly_all, report, shipped_reference
from policies.evaluation.encounters import Outcome, Sensor
from policies.evaluation.statistics import wilson


def outcome(seed: int, clearance_m: float, ratio: float | None, *, reached: bool = True, relaxed: int = 0) -> Outcome:
    verdicts = {"nominal": 90 - relaxed, "adjusted": 10} | ({"relaxed": relaxed} if relaxed else {})
    return Outcome(seed, clearance_m < 0.0, reached, clearance_m, ratio, verdicts, reversals=2, ticks=100)


HIT = outcome(5, -0.1, 1.4, relaxed=20)
STUCK = outcome(3, 0.5, None, reached=False)
CLEAR = outcome(4, 0.3, 1.2)
WITHOUT_RATIO = outcome(6, 0.4, None)  # it arrived, its unobstructed flight did not


def test_the_report_of_outcomes_by_hand() -> None:
    figures = report([HIT, STUCK, CLEAR, WITHOUT_RATIO])
    assert (figures.flights, figures.collisions, figures.deadlocks) == (4, 1, 1)
    assert figures.collision_rate_95 == wilson(1, 4)
    assert (figures.collided_seeds, figures.deadlocked_seeds) == ((5,), (3,))
    assert figures.time_ratio_mean == pytest.approx(1.3)
    assert figures.time_ratio_p95 == pytest.approx(1.39)
    assert figures.clearance_p1_p10_p50_m == pytest.approx((-0.088, 0.02, 0.35))
    assert figures.verdict_shares == pytest.approx({"adjusted": 0.1, "nominal": 0.85, "relaxed": 0.05})
    assert figures.relaxed_ticks_per_flight == 5.0
    assert figures.reversals_per_flight == 2.0
    assert report([WITHOUT_RATIO, CLEAR, STUCK, HIT]) == figures


def test_a_report_without_arrivals_is_still_json() -> None:
    values = json.loads(json.dumps(report([STUCK]).to_json(), allow_nan=False))
    assert values["time_ratio_mean"] is None
    assert values["time_ratio_p95"] is None
    assert values["deadlocked_seeds"] == [3]


def test_the_reference_keeps_the_disturbance_reserve() -> None:
    config = Config()
    limit = config.limits.acceleration_m_s2 - config.disturbance.bound_m_s2
    v, e = np.array([0.0, 0.0, 0.0]), np.array([6.0, -6.0, 0.5])
    policy = load_policy(config.policy, config.limits)
    assert np.abs(policy.act(v, e)).max() > limit
    np.testing.assert_array_equal(shipped_reference(config)(v, e), np.clip(policy.act(v, e), -limit, limit))
    unreserved = Config(disturbance=DisturbanceConfig(enabled=False))
    assert unreserved.reference_limit_m_s2 == config.limits.acceleration_m_s2


def test_one_process_and_two_fly_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    seen: list[Outcome] = []
    seeds = range(1, 3)
    one = fly_all(seeds, 1, Config(), Sensor(noise_std_m=0.2), jobs=1, on_outcome=seen.append)
    two = fly_all(seeds, 1, Config(), Sensor(noise_std_m=0.2), jobs=2)
    assert one == two
    assert [o.seed for o in one] == [1, 2]
    assert sorted(seen, key=lambda o: o.seed) == one
    assert all(o.ticks == sum(o.verdicts.values()) > 0 for o in one)
    assert os.environ["OMP_NUM_THREADS"] == "3"  # this process keeps its own
    assert "OPENBLAS_NUM_THREADS" not in os.environ


def test_the_command_prints_one_json_object(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["encounters", "--flights", "1", "--noise", "0", "--seed", "1", "--jobs", "1", "--json"]) == 0
    told = capsys.readouterr()
    assert json.loads(told.out)["flights"] == 1
    assert told.err == ""


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("--flights", "0"),
        ("--flights", "many"),
        ("--obstacles", "0"),
        ("--noise", "-1"),
        ("--noise", "nan"),
        ("--latency", "inf"),
        ("--dropout", "1.5"),
        ("--jobs", "0"),
        ("--seed", "-1"),
    ],
)
def test_wrong_usage_is_one_line_that_names_the_option(
    option: str, value: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as done:
        main(["encounters", option, value])
    assert done.value.code == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.count("\n") == 1
    assert option in told.err
    assert value in told.err


def test_a_missing_configuration_is_one_line_and_status_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["encounters", "--config", "/no/such.toml"]) == 2
    told = capsys.readouterr()
    assert told.err.count("\n") == 1
    assert "/no/such.toml" in told.err
    assert told.out == ""
