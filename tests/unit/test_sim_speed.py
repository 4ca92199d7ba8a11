"""`sim-bridge run --speed F`: vehicle time over wall time, against a clock that the test moves."""

from __future__ import annotations

import socket
from types import SimpleNamespace
from typing import Any

import pytest

from sim_bridge import runner
from sim_bridge.cli import main
from sim_bridge.flight import Flight
from sim_bridge.placement import resolve
from sim_bridge.runner import RealTime, Trace
from sim_bridge.scenario import load_scenario
from sim_bridge.testing import free_port

FLOWN_NS = 2_000_000_000


class Clockwork(runner.Wires):
    """Real links, and a wall clock that moves when the loop sleeps and by ``step_cost_ns`` at every look."""

    def __init__(self, resolved: Any, step_cost_ns: int) -> None:
        super().__init__(
            resolved,
            onboard_port=free_port(socket.SOCK_DGRAM),
            ground_port=free_port(socket.SOCK_DGRAM),
            endpoint=None,
            prefix="uav/uav1",
            lockstep=False,
        )
        self.wall_ns = 5_000_000_000
        self.step_cost_ns = step_cost_ns

    def wait(self, timeout_s: float) -> bool:
        self.wall_ns += round(timeout_s * 1e9) + 1
        return False

    def monotonic_ns(self) -> int:
        self.wall_ns += self.step_cost_ns
        return self.wall_ns


def fly(monkeypatch: pytest.MonkeyPatch, speed: float, step_cost_ns: int = 0) -> dict[str, Any]:
    resolved = resolve("empty", load_scenario("empty")[1], 0)
    wires, flight = Clockwork(resolved, step_cost_ns), Flight(resolved)
    monkeypatch.setattr(runner, "time", SimpleNamespace(monotonic_ns=wires.monotonic_ns))

    def stop_in_time(flight: Flight) -> None:
        if flight.t_ns >= FLOWN_NS:
            pacer.stop()

    pacer = RealTime(flight, wires, trace=Trace(None), progress=stop_in_time, speed=speed)
    try:
        return pacer.run()
    finally:
        flight.close()
        wires.close()


@pytest.mark.parametrize("speed", [0.5, 1.0, 4.0])
def test_wall_time_is_vehicle_time_over_the_factor(monkeypatch: pytest.MonkeyPatch, speed: float) -> None:
    summary = fly(monkeypatch, speed)
    assert summary["sim_s"] == FLOWN_NS / 1e9
    assert summary["wall_s"] == pytest.approx(summary["sim_s"] / speed, rel=1e-4)
    assert summary["late_s"] == 0.0


def test_what_the_machine_cannot_keep_is_reported_not_caught_up(monkeypatch: pytest.MonkeyPatch) -> None:
    summary = fly(monkeypatch, 50.0, step_cost_ns=1_000_000)  # 240 steps a second cost more than 1/50 s
    assert summary["late_s"] > 0.0
    assert summary["wall_s"] == pytest.approx(summary["sim_s"] / 50.0 + summary["late_s"], abs=0.26)


@pytest.mark.parametrize("text", ["0", "-1", "nan", "inf", "fast", "1000"])
def test_a_factor_out_of_range_is_wrong_usage(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["run", "--speed", text])
    assert stop.value.code == 2
    assert f"expected a factor, 0.01 to 100, got {text}" in capsys.readouterr().err


def test_lockstep_has_no_pace(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--lockstep", "--speed", "2"]) == 2
    assert "--speed" in capsys.readouterr().err
