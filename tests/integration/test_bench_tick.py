"""`companion bench tick` and `memory` on the real daemon and simulator; the figures of time are not tested."""

from __future__ import annotations

import json

import pytest

from companion.bench import memory, tick, tick_brain, tick_flight, tick_start
from companion.cli import main

pytestmark = pytest.mark.integration


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tick, "QUICK_MINUTES", 1.5 / 60.0)
    monkeypatch.setattr(tick_flight, "WARM_S", 0.2)
    monkeypatch.setattr(tick_start, "QUICK_STARTS", 1)
    monkeypatch.setattr(tick_start, "SETTLE_S", 0.1)
    monkeypatch.setattr(tick_brain, "COUNTS", (1, 10))
    monkeypatch.setattr(tick_brain, "QUICK_TICKS", 20)


@pytest.mark.usefixtures("small")
def test_the_tick_is_measured_beside_the_simulator(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "tick", "--quick", "--rates", "100", "--obstacles", "10", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["bench"] == "tick"
    (flight,) = told["results"]["flights_ms"]
    assert (flight["rate_hz"], flight["obstacles"]) == (100, 10)
    assert flight["ticks"] + flight["overtaken"] > 75
    assert 0.0 < flight["to_setpoint"]["p50"] < flight["to_end"]["p50"]
    assert flight["processor"]["p50"] > 0.0
    assert flight["pauses"]["inside"] == 0, "garbage is collected between ticks"
    assert 50.0 < flight["memory_mib"] < 300.0
    assert flight["threads"] > 1
    assert [timing["obstacles"] for timing in told["results"]["brain_ms"]] == [1, 10]
    (ready_s,) = told["results"]["start"]["ready_s"]
    (used_s,) = told["results"]["start"]["processor_s"]
    assert 0.0 < used_s < ready_s + 1.0
    assert told["figures"][-1]["name"] == "start to READY, slowest of 1, s"


@pytest.mark.usefixtures("small")
def test_a_rate_that_no_physics_fits_is_told_before_anything_flies(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "tick", "--rates", "20,60"]) == 2
    assert capsys.readouterr().err.startswith("companion: bench: expected a rate that divides 1000")


def test_memory_is_read_over_a_flight_in_lockstep(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory, "_POLL_S", 0.02)
    assert main(["bench", "memory", "--minutes", "0.3"]) == 0
    out = capsys.readouterr().out
    for text in ("0.3 minutes of vehicle time", "times real time", "resident", "figures"):
        assert text in out


@pytest.mark.slow
@pytest.mark.timeout(3000)
def test_memory_is_flat_over_an_hour(capsys: pytest.CaptureFixture[str]) -> None:
    """72 000 ticks; what is resident neither grows after ten minutes nor passes 200 MiB."""
    assert main(["bench", "memory", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["results"]["ticks"] >= 72_000
    assert [figure for figure in told["figures"] if not figure["met"]] == []
