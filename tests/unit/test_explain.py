"""What is said about a moment of a flight: true, and readable."""

from __future__ import annotations

import importlib.util
import json
import math
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from companion.cli import main
from companion.explain.cost import estimate
from companion.explain.moment import Outline, intervention, moments
from companion.explain.refusal import refusals
from companion.logbook.reader import open_log
from companion.pilot import Task
from companion.replay.moments import engaged_ns

LOGS = Path(__file__).parents[1] / "logs"


def load_make() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make_logs", LOGS / "make.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


MAKE = load_make()


def explain(capsys: pytest.CaptureFixture[str], log: str, *words: str) -> dict:
    assert main(["explain", str(LOGS / f"{log}.mcap"), *words, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def recorded(log: str, topic: str, stamp_ns: int) -> dict:
    """The message of that tick, straight from the file."""
    return next(
        message.json
        for message in open_log(LOGS / f"{log}.mcap").messages(f"/companion/{topic}")
        if message.json.get("stamp_ns") == stamp_ns and message.json.get("call", "step") == "step"
    )


@pytest.mark.parametrize("words", MAKE.EXPLAINED, ids=" ".join)
def test_the_words_are_those_that_were_read(words: tuple[str, ...]) -> None:
    golden = MAKE.GOLDEN.read_text(encoding="utf-8")
    said = MAKE.explained(words)
    assert said in golden, f"after a deliberate change: make logs, and read {MAKE.GOLDEN.name}; now it says\n{said}"


@pytest.mark.parametrize("log", ["demo", "ardupilot"])
def test_the_rows_built_again_decide_as_the_filter_did(log: str) -> None:
    """At every tick: the reference passed exactly if nothing refuses it, and margins hold exactly if none is broken."""
    changed = 0
    for moment in moments(open_log(LOGS / f"{log}.mcap")):
        found, verdict = refusals(moment), moment.record.verdict
        limited = any(row.margin is None for row in moment.record.rows)
        slewed = moment.config.limits.slew_m_s3 is not None
        if verdict == "nominal":
            assert not any(one.refused for one in found)
        elif any(one.refused for one in found):
            changed += 1
        else:
            assert limited or slewed, moment.record.stamp_ns
        if verdict == "adjusted":
            assert not any(one.broken for one in found)
        assert [one.refused for one in found] == sorted((one.refused for one in found), reverse=True)
    assert changed > 50


def test_the_numbers_are_those_of_the_log(capsys: pytest.CaptureFixture[str]) -> None:
    said = explain(capsys, "demo", "--at", "0.5")
    origin_ns = engaged_ns(open_log(LOGS / "demo.mcap"))
    assert said["stamp_ns"] == origin_ns + 500_000_000
    setpoint, step = (recorded("demo", topic, said["stamp_ns"]) for topic in ("setpoint", "brain"))
    tracks = {track["id"]: track for track in recorded("demo", "tracks", said["stamp_ns"])["tracks"]}
    u_ref, u_safe = np.array(setpoint["u_ref"]), np.array(setpoint["u_safe"])
    p, v, target = (np.array(step[name]) for name in ("p", "v", "target"))
    assert said["change"]["norm"] == pytest.approx(np.linalg.norm(u_safe - u_ref))
    cosine = u_ref @ u_safe / np.linalg.norm(u_ref) / np.linalg.norm(u_safe)
    assert said["turned_deg"] == pytest.approx(math.degrees(math.acos(cosine)))
    assert said["target_m"] == pytest.approx(np.linalg.norm(target - p))
    assert said["speed_m_s"] == pytest.approx(np.linalg.norm(v))
    ahead = np.append((target - p)[:2], 0.0) / np.linalg.norm((target - p)[:2])
    assert said["cost"]["ahead_m_s2"] == pytest.approx((u_ref - u_safe) @ ahead)
    assert said["change"]["left"] == pytest.approx((u_safe - u_ref) @ np.cross([0.0, 0.0, 1.0], ahead))
    assert [row["track"] for row in said["rows"]] == ["sim/eight-1", "sim/eight-2"]
    for row, one in zip(said["rows"], said["obstacles"], strict=False):
        track = tracks[row["track"]]
        r, w = np.array(track["position"]) - p, np.array(track["velocity"]) - v
        radii = track["radius"] + 0.2
        assert one["track"] == row["track"]
        assert one["distance_m"] == pytest.approx(np.linalg.norm(r) - radii)
        assert one["closing_m_s"] == pytest.approx(-(r @ w) / np.linalg.norm(r))
        times = np.linspace(0.0, 20.0, 20001)
        flown = np.linalg.norm(r + times[:, None] * w, axis=1)
        assert one["cpa_s"] == pytest.approx(times[flown.argmin()], abs=1e-3)
        assert one["cpa_m"] == pytest.approx(flown.min() - radii, abs=1e-5)
        logged = next(found for found in setpoint["rows"] if found["track"] == row["track"])
        assert row["keep_out_m"] == pytest.approx(sum(logged["margin"].values()))
        assert (row["step"], row["epsilon"]) == (logged["step"], logged["epsilon"])
        assert row["decay_share"] == pytest.approx(0.5 * logged["epsilon"])


def test_the_predicted_miss_is_that_of_a_vehicle_that_is_integrated(capsys: pytest.CaptureFixture[str]) -> None:
    """Semi-implicit steps of 0.05 s from where the setpoint acts, which a finer integration of the commands gives."""
    said = explain(capsys, "demo", "--at", "0.5")
    log = open_log(LOGS / "demo.mcap")
    setpoints = {m.json["stamp_ns"]: m.json for m in log.messages("/companion/setpoint")}
    step = recorded("demo", "brain", said["stamp_ns"])
    delay_ns = round(said["delay_s"] * 1e9)
    p, v, t_ns = np.array(step["p"]), np.array(step["v"]), said["stamp_ns"]
    while t_ns < said["stamp_ns"] + delay_ns:  # 1 ms at a time, under the command that acts then
        acting = max((s for s in setpoints if s + delay_ns <= t_ns), default=None)
        a = np.array(setpoints[acting]["u_safe"]) if acting is not None and setpoints[acting]["sent"] else np.zeros(3)
        p, v, t_ns = p + 1e-3 * v + 0.5e-6 * a, v + 1e-3 * a, t_ns + 1_000_000
    setpoint = setpoints[said["stamp_ns"]]
    for one in said["obstacles"][:2]:
        track = next(t for t in recorded("demo", "tracks", said["stamp_ns"])["tracks"] if t["id"] == one["track"])
        for name, u in (("miss_reference_m", setpoint["u_ref"]), ("miss_answer_m", setpoint["u_safe"])):
            q, w, least = p.copy(), v.copy(), math.inf
            for k, place in enumerate(track["predicted"]):
                least = min(least, math.dist(q, place))
                q, w = q + 0.05 * w, w + 0.05 * np.array(u)
                assert k < 23
            assert one[name] == pytest.approx(least - track["radius"] - 0.2, abs=2e-3), name


def test_a_degraded_hold_says_why_and_how_old_the_data_are(capsys: pytest.CaptureFixture[str]) -> None:
    said = explain(capsys, "hold", "--at", "2")
    assert (said["state"], said["task"], said["reason"]) == ("HOLD", "hold", "obstacle source sim silent")
    assert said["sources_s"]["sim"] > 1.0
    assert said["cost"]["behind_s"] is None


def test_the_worst_tick_is_the_flown_one_of_least_slack(capsys: pytest.CaptureFixture[str]) -> None:
    said = explain(capsys, "demo", "--worst", "--around", "0.2")
    log = open_log(LOGS / "demo.mcap")
    flown = [m.json for m in log.messages("/companion/setpoint") if m.json["sent"] and m.json["state"] == "ACTIVE"]
    worst = min(flown, key=lambda record: record["worst"]["slack"])
    assert said["stamp_ns"] == worst["stamp_ns"]
    assert len(said["around"]) == 9
    assert said["around"][4]["slack_m_s2"] == worst["worst"]["slack"]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--at", "9e3"], "--at: expected a moment between"),
        (["--at", "noon"], "--at noon: expected seconds"),
        (["--worst", "--around", "0"], "--around: expected seconds > 0, got 0"),
    ],
)
def test_what_cannot_be_is_one_line(capsys: pytest.CaptureFixture[str], words: list[str], expected: str) -> None:
    assert main(["explain", str(LOGS / "demo.mcap"), *words]) == 2
    error = capsys.readouterr().err
    assert expected in error
    assert error.count("\n") == 1


def outline(k: int, x: float, *, verdict: str = "nominal", asked: float = 0.0, task: Task = Task.FLY) -> Outline:
    return Outline(k * 50_000_000, "ACTIVE", verdict, task, (x, 0.0, 0.0), (10.0, 0.0, 0.0), None, 1.0, 0.0, asked)


def test_a_stop_at_cruise_costs_its_duration() -> None:
    """At 2 m/s, the most it flies, stopped at once for a second: a second, two metres, two metres a second."""
    xs = [0.1 * k for k in range(20)] + [1.9] * 20 + [1.9 + 0.1 * k for k in range(1, 20)]
    ticks = [outline(k, x, verdict="adjusted" if 19 <= k < 40 else "nominal") for k, x in enumerate(xs)]
    run = intervention(ticks, 30)
    assert run == (19, 39)
    cost = estimate(ticks, run, 0.5)
    assert cost.behind_m == pytest.approx(2.0)
    assert cost.behind_s == pytest.approx(1.0)
    assert cost.slower_m_s == pytest.approx(2.0)
    assert (cost.began_ns, cost.ended_ns, cost.ahead_m_s2) == (950_000_000, 1_950_000_000, 0.5)


def test_an_intervention_ends_with_its_task_and_a_tenth_of_a_second_apart() -> None:
    verdicts = ["nominal", "adjusted", "nominal", "relaxed", "nominal", "nominal", "adjusted"]
    ticks = [outline(k, 0.0, verdict=verdict) for k, verdict in enumerate(verdicts)]
    assert intervention(ticks, 1) == (1, 3)
    assert intervention(ticks, 2) is None
    assert intervention(ticks, 6) == (6, 6)
    ticks[3] = outline(3, 0.0, verdict="relaxed", task=Task.HOLD)
    assert intervention(ticks, 1) == (1, 1)
