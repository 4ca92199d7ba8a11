"""The metrics of a daemon as Prometheus reads them: parsed by its own parser, named by its own rules."""

from __future__ import annotations

import re
import socket
from dataclasses import replace
from pathlib import Path

import pytest
from prometheus_client.metrics_core import Metric
from prometheus_client.parser import text_string_to_metric_families

from companion.cli import main
from companion.clock import ManualClock
from companion.config import parse_config
from companion.health import problems, report
from companion.instruments import METRICS
from companion.link import wire
from companion.prometheus import LATENCY, Exposition, metrics_page
from companion.sdnotify import Notifier
from companion.service import Service
from companion.state import Situation, State

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "metrics.md"


class Daemon:
    """A service that was never run, whose counters a test moves."""

    def __init__(self, notifier: Notifier | None = None) -> None:
        self.clock = ManualClock()
        self.service = Service(parse_config({"vehicle": {"name": "uav7"}}), self.clock, notifier=notifier)
        self.vitals = self.service._vitals
        self._exposition = Exposition(self.vitals.reading)

    def text(self) -> str:
        return self._exposition.text().decode()

    def scrape(self) -> dict[str, Metric]:
        return {family.name: family for family in text_string_to_metric_families(self.text())}

    def value(self, name: str, **labels: str) -> float:
        values = [
            sample.value
            for family in self.scrape().values()
            for sample in family.samples
            if sample.name == name and sample.labels == labels
        ]
        assert len(values) == 1, (name, labels, values)
        return float(values[0])


@pytest.fixture(scope="module")
def daemon() -> Daemon:
    return Daemon()


def test_every_metric_is_exposed_once_with_help_and_kind(daemon: Daemon) -> None:
    families = daemon.scrape()
    for metric in METRICS:
        family = families[metric.name]  # the parser takes _total off counters
        assert (family.type, family.documentation) == (metric.kind, metric.meaning)
    assert families[LATENCY].type == "histogram"
    assert "process_resident_memory_bytes" in families
    names = re.findall(r"^# TYPE (\S+)", daemon.text(), re.MULTILINE)
    assert len(names) == len(set(names))


def test_names_follow_the_rules_of_promtool(daemon: Daemon) -> None:
    """What `promtool check metrics` demands (client_golang, promlint/validations), written out."""
    units = [
        "milliseconds",
        "minutes",
        "hours",
        "days",
        "kilobytes",
        "megabytes",
        "bits",
        "percent",
        "grams",
        "celsius",
        "fahrenheit",
    ]
    for metric in METRICS:
        name = metric.exposed
        assert re.fullmatch(r"companion_[a-z0-9]+(_[a-z0-9]+)*", name)
        assert metric.meaning.endswith(".")
        assert (metric.kind == "counter") == name.endswith("_total")
        assert not any(word in name.split("_") for word in (*units, "ms", "counter", "gauge", "histogram", "metric"))
        assert not name.endswith(("_count", "_sum", "_bucket")) or metric.kind == "histogram"
        for label in metric.labels:
            assert re.fullmatch(r"[a-z][a-z0-9_]*", label)
            assert label not in ("le", "quantile")
    assert LATENCY.endswith("_seconds")


def test_the_histogram_holds_every_tick_in_the_right_bucket() -> None:
    daemon = Daemon()
    for latency_ms in (0.1, 0.25, 0.3, 4.0, 49.0, 51.0, 800.0):  # a bound belongs to its bucket
        daemon.service._meter.tick(latency_ms, latency_ms, "nominal")
    buckets = [s for s in daemon.scrape()[LATENCY].samples if s.name.endswith("_bucket")]
    counts = {s.labels["le"]: s.value for s in buckets}
    assert (counts["0.00025"], counts["0.0005"], counts["0.003"], counts["0.005"]) == (2, 3, 3, 4)
    assert (counts["0.05"], counts["+Inf"]) == (5, 7)
    assert list(counts.values()) == sorted(counts.values())
    assert daemon.value(f"{LATENCY}_count") == 7
    assert daemon.value(f"{LATENCY}_sum") == pytest.approx(0.90465)
    assert daemon.value("companion_ticks_total", verdict="nominal") == 7
    assert daemon.value("companion_ticks_total", verdict="braking") == 0  # known before it first happens
    assert daemon.value("companion_deadline_misses_total") == 2  # of 50 ms


def test_obstacle_frames_by_source_and_reason() -> None:
    daemon = Daemon()
    inbox = daemon.service._inbox
    ball = wire.Obstacle(id="b", position=(1.0, 0.0, 2.0), radius=0.2)
    for k in range(3):
        frame = wire.ObstacleFrame(stamp_ns=k * 10**9, clock="vehicle", obstacles=[ball])
        inbox.push("cam", wire.encode(frame))
        inbox.drain(k * 10**9)
    inbox.push("cam", b"{")
    inbox.push('odd"\n\\name', wire.encode(replace_stamp(ball, 2 * 10**9)))
    inbox.drain(2 * 10**9)
    daemon.service._vehicle_ns = 5 * 10**9 // 2
    assert daemon.value("companion_obstacle_frames_total", source="cam") == 3
    assert daemon.value("companion_obstacle_frames_total", source='odd"\n\\name') == 1  # quoted, or nothing parses
    assert daemon.value("companion_obstacle_frames_rejected_total", reason="malformed") == 1
    assert daemon.value("companion_obstacle_source_age_seconds", source="cam") == 0.5


def replace_stamp(obstacle: wire.Obstacle, stamp_ns: int) -> wire.ObstacleFrame:
    return wire.ObstacleFrame(stamp_ns=stamp_ns, clock="vehicle", obstacles=[obstacle])


def test_damaged_packets_and_state() -> None:
    daemon = Daemon()
    codec = daemon.service._codec
    beat = codec.encode_heartbeat(3)
    codec.receive(beat + b"junk" + beat[:-1] + bytes([beat[-1] ^ 1]) + beat)
    assert daemon.value("companion_mavlink_messages_received_total") == 2
    assert daemon.value("companion_mavlink_packets_damaged_total") == 1
    session = daemon.service._session
    session.situation = replace(session.situation, state=State.ACTIVE, fresh=True, engaged=True, airborne=True)
    assert daemon.value("companion_state", state="ACTIVE") == 1
    assert daemon.value("companion_state", state="WAITING") == 0
    assert [daemon.value(f"companion_{fact}") for fact in ("engaged", "airborne", "armed", "vehicle_fresh")] == [
        1,
        1,
        0,
        1,
    ]
    info = daemon.scrape()["companion_build_info"].samples[0]
    assert info.labels["vehicle"] == "uav7"
    assert len(info.labels["config_hash"]) >= 12


def test_the_page_is_what_the_command_prints(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["schema", "--metrics"]) == 0
    assert capsys.readouterr().out == PAGE.read_text(encoding="utf-8")


def test_every_metric_named_in_the_questions_exists(daemon: Daemon) -> None:
    exposed = {sample.name for family in daemon.scrape().values() for sample in family.samples}
    exposed |= {metric.exposed for metric in METRICS}  # those without a sample yet
    asked = re.findall(r"(?:companion|process|python)_[a-z_]+[a-z]", metrics_page())
    assert set(asked) - {LATENCY} <= exposed


def test_health() -> None:
    daemon = Daemon()
    assert daemon.vitals.health(live_only=True)[0] == 503  # not started
    daemon.vitals.beat()
    status, body = daemon.vitals.health()
    assert status == 503
    assert body["reasons"] == ["no fresh vehicle state: no vehicle"]
    assert daemon.vitals.health(live_only=True)[0] == 200  # it waits, and lives
    session = daemon.service._session
    session.situation = Situation(state=State.READY, reason="vehicle fresh", fresh=True)
    assert daemon.vitals.health() == (
        200,
        {"healthy": True, "reasons": [], "state": "READY", "reason": "vehicle fresh", "control_age_s": 0.0},
    )
    daemon.clock.advance(1.5)
    for live_only in (True, False):
        status, body = daemon.vitals.health(live_only=live_only)
        assert (status, body["reasons"]) == (503, ["the control task has not turned for 1.5 s"])


@pytest.mark.parametrize("state", list(State))
def test_which_states_are_healthy(state: State) -> None:
    fresh = state is not State.WAITING
    healthy = problems(0.1, Situation(state=state, reason="why", fresh=fresh)) == []
    assert healthy == (state in {State.READY, State.ACTIVE, State.HOLD, State.OVERRIDDEN})
    assert report(0.1, Situation(state=state, fresh=fresh), live_only=True)[0] == 200


def test_the_watchdog_is_fed_by_the_pulse(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "n"))
        daemon = Daemon(Notifier(str(tmp_path / "n"), watchdog_ns=10**9))
        daemon.vitals.beat()
        assert manager.recv(4096) == b"WATCHDOG=1\nSTATUS=WAITING: no vehicle"
        daemon.vitals.close()


def test_a_scrape_reads_and_changes_nothing() -> None:
    daemon = Daemon()
    daemon.service._meter.tick(1.0, 1.0, "nominal")
    before = daemon.vitals.reading()
    daemon.scrape()
    assert daemon.vitals.reading() == before
