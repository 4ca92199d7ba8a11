"""`sim-bridge bench` end to end, on a flight of two seconds: the real brain, the real daemon, real sockets."""

from __future__ import annotations

import json

import pytest

from sim_bridge import bench
from sim_bridge.cli import main

pytestmark = pytest.mark.integration


@pytest.mark.slow
def test_the_three_cases_and_where_their_time_goes(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench, "QUICK_SECONDS", 2.0)
    assert main(["bench", "--quick", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert {"machine", "commit", "versions", "cases"} <= set(told)
    assert told["versions"]["pybullet"] == "3.2.7"
    plain, brain, lockstep = told["cases"]
    assert [case["demand"] for case in (plain, brain, lockstep)] == [60.0, 30.0, 20.0]
    for case in told["cases"]:
        assert case["n"] == pytest.approx(40, abs=1)
        assert 0.0 < case["p50"] <= case["max"]
        assert case["p99"] is None, "forty ticks tell none"
        # the factor is of the same ticks: vehicle time over their sum
        assert 25.0 / case["max"] < case["factor"] < 50.0 / (0.4 * case["p50"])
        assert case["met"] == (case["factor"] >= case["demand"])
        assert {"PyBullet", "controller"} <= set(case["sections"])
    assert "law" in plain["sections"]
    assert plain["acting"] is None
    assert all(0.0 <= case["acting"] <= 1.0 for case in (brain, lockstep))
    assert {"brain: tracking", "brain: filter", "brain: policy"} <= set(brain["sections"])
    assert {"waiting for the daemon", "Zenoh", "encode", "telemetry", "daemon: brain"} <= set(lockstep["sections"])


def test_a_bench_whose_brain_does_not_start_says_so(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench, "QUICK_SECONDS", 0.2)
    monkeypatch.setattr(bench, "_BRAIN", "policies.evaluation.nothing")
    assert main(["bench", "--quick"]) == 1
    assert "policies.evaluation.nothing" in capsys.readouterr().err
