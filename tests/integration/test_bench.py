"""`companion bench`: one JSON object or tables, the figures held on seeds that nothing was tuned on."""

from __future__ import annotations

import json

import pytest

from companion.bench import accuracy, cbfpy_rival, chatter, command, filter, timing, tracking, wire, wire_load
from companion.cli import main


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """The whole command on two seconds of one condition, two counts of obstacles and five seconds of crossing."""
    monkeypatch.setattr(tracking, "HEADLINE", tracking.HEADLINE[1:])
    monkeypatch.setattr(tracking, "CROSSING_SEEDS", (3,))
    monkeypatch.setattr(tracking, "COUNTS", (100, 1000))
    monkeypatch.setattr(accuracy, "DURATION_S", 2.0)
    monkeypatch.setattr(tracking.crossing, "DURATION_S", 5.0)
    monkeypatch.setattr(tracking, "measure_timing", lambda count, repeats, **kw: timing.measure_timing(count, 3, **kw))


@pytest.mark.usefixtures("small")
def test_json_is_one_object_and_nothing_else(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "tracking", "--quick", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["bench"], told["schema"]) == ("tracking", 1)
    (cell,) = told["results"]["accuracy"]
    assert set(cell["filters"]) == {"ours", "paper", "CV only", "CA only", "hindsight", "filterpy IMM"}
    assert all(len(scores["ahead_0.25_m"]) == 9 for scores in cell["filters"].values())
    assert set(told["results"]["crossing"]["3"]) == {"ours", "paper", "CV only", "CA only", "filterpy IMM"}
    assert [timing["obstacles"] for timing in told["results"]["timing_ms"]] == [100, 1000]
    assert all(timing["both"]["p99"] is None for timing in told["results"]["timing_ms"]), "three samples tell none"
    assert {figure["relation"] for figure in told["figures"]} == {"at most", "at least"}
    assert told["results"]["seeds"]["report"] != told["results"]["seeds"]["tuning"]


@pytest.mark.usefixtures("small")
def test_tables_for_people_and_no_filterpy(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command.importlib.util, "find_spec", lambda name: None)
    assert main(["bench", "tracking", "--quick"]) == 0
    out = capsys.readouterr().out
    for text in ("hindsight", "eight 3 m/s", "swaps, seed 3", "times faster", "figures"):
        assert text in out
    assert "filterpy IMM" not in out


def test_tuning_without_filterpy_is_wrong_usage(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command.importlib.util, "find_spec", lambda name: None)
    assert main(["bench", "tracking", "--tune-rivals"]) == 2
    assert "filterpy" in capsys.readouterr().err


def test_tuning_runs_under_the_progress_bar_and_prints_one_object(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    jobs: list[str] = []
    run = command._run
    monkeypatch.setattr(command, "_run", lambda told: (jobs.extend(name for name, _ in told), run(told)))
    monkeypatch.setattr(command.importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(tracking, "tune_rivals", lambda trials: {"CV_PSD": 1.0})
    assert main(["bench", "tracking", "--tune-rivals"]) == 0
    assert json.loads(capsys.readouterr().out) == {"CV_PSD": 1.0}
    assert jobs == ["the rivals' process noises"]


def test_help_shows_an_example(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(["bench", "tracking", "--help"])
    assert stopped.value.code == 0
    assert "companion bench tracking --json > tracking.json" in capsys.readouterr().out


@pytest.fixture
def small_filter(monkeypatch: pytest.MonkeyPatch) -> None:
    """The whole command on two conditions, a few states and two encounters."""
    monkeypatch.setattr(filter, "HEADLINE", (filter.Condition(10, 5), filter.BESIDE_CBFPY))
    monkeypatch.setattr(filter, "QUICK_STATES", 20)
    monkeypatch.setattr(filter, "QUICK_PROGRAMS", 5)
    monkeypatch.setattr(filter, "QUICK_FLIGHTS", 1)
    flown = {name: chatter.ENCOUNTERS[name] for name in ("static", "crossing")}
    monkeypatch.setattr(chatter, "ENCOUNTERS", flown)


@pytest.mark.usefixtures("small_filter")
def test_filter_json_is_one_object_and_nothing_else(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "filter", "--quick", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["bench"], told["schema"]) == ("filter", 1)
    results = told["results"]
    assert [one["condition"]["obstacles"] for one in results["timing_ms"]] == [10, 20]
    for one in results["timing_ms"]:
        assert one["states"] == 20
        assert set(one["solvers"]) == {"daqp", "osqp"}
        assert set(one["rivals"]) == set(cbfpy_rival.backends())
        assert sum(one["verdicts"].values()) == pytest.approx(1.0)
        assert one["whole"]["p99"] is None, "20 samples tell none"
    assert [one["sigma_m"] for one in results["flights"]] == [0.0, 0.0, 0.05, 0.05]
    assert all(one["flights"][0]["clearance_m"] > 0.0 for one in results["flights"])
    assert results["seeds"] == {"states": 90210, "flights": 7321}
    assert told["figures"][0]["name"] == "10 obstacles, N = 5: p50 of the whole, ms"


@pytest.mark.usefixtures("small_filter")
def test_filter_without_rivals_says_how_to_get_them(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command.importlib.util, "find_spec", lambda name: None)
    assert main(["bench", "filter", "--quick"]) == 0
    told = capsys.readouterr()
    for name in ("cbfpy", "quadprog"):
        assert f"without {name}: pip install 'companion-safety[bench]'" in told.err
        assert name not in told.out.replace("and cbfpy [ms]", "")
    for text in ("whole", "ours (osqp)", "sign changes", "crossing", "figures"):
        assert text in told.out


@pytest.mark.parametrize("form", ["--json", "--quick"])
def test_the_wire_is_measured_on_real_sockets(
    form: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One and a half seconds of flight; the figures depend on the machine and are not tested."""
    for name, value in (("WARM_S", 0.2), ("MEASURED_S", 1.5), ("QUICK_MEASURED_S", 1.5)):
        monkeypatch.setattr(wire, name, value)
    for name in ("ROUNDS", "QUICK_ROUNDS"):
        monkeypatch.setattr(wire, name, 2)
    for name, value in (("WARM_S", 0.2), ("LOAD_S", 1.5), ("QUICK_LOAD_S", 1.5)):
        monkeypatch.setattr(wire_load, name, value)
    assert main(["bench", "wire", form]) == 0
    out = capsys.readouterr().out
    if form == "--quick":
        for text in ("beyond the wait", "mavutil recv_match", "ticks lost", "figures"):
            assert text in out
        return
    told = json.loads(out)
    assert told["bench"] == "wire"
    latency, parsing = told["results"]["latency_ms"], told["results"]["parsing"]
    assert latency["frames"] > 5
    assert latency["lost"] <= latency["frames"]
    assert 0.0 < latency["delivery"]["p50"] <= latency["beyond"]["p50"] <= latency["whole"]["p50"]
    assert parsing["ours_per_s"] > 0
    assert parsing["mavutil_per_s"] > 0
    assert told["figures"][0]["limit"] == 2.0
    load = told["results"]["load"]
    assert load["states"] > 40
    assert load["frames_sent"] > 1500
    assert load["messages_sent"] > 3000
    assert load["frames_used"] + load["frames_thinned"] > 1000
    assert load["frames_thinned"] > load["frames_used"] > 0
    assert load["memory_mib"] > 50.0


@pytest.mark.slow
def test_the_figures_of_accuracy_and_identity_are_met() -> None:
    """Those of time depend on the machine and are not tested."""
    cells = [
        tracking.measure_cell(cell, seed=tracking.REPORT_SEED, trials=tracking.TRIALS, filterpy=False)
        for cell in tracking.HEADLINE
    ]
    crossings = {seed: tracking.measure_crossing(seed, filterpy=False) for seed in tracking.CROSSING_SEEDS}
    missed = [figure for figure in tracking.figures(cells, crossings, []) if not figure.met]
    assert not missed
