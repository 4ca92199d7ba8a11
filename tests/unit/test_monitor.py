"""The monitor's numbers against the scene's geometry, and its pictures as text."""

from __future__ import annotations

import io
import math

import msgspec
import pytest
from monitor_scene import payloads
from rich.console import Console

from companion.link import wire
from companion.monitor.command import Choice, keys_in
from companion.monitor.essentials import Sight, essentials
from companion.monitor.fleet import MAX_VEHICLES, Fleet
from companion.monitor.plan import Canvas
from companion.monitor.view import line, screen

S = 1_000_000_000


@pytest.fixture(scope="module")
def recorded() -> dict[str, bytes]:
    return payloads()


def fleet(recorded: dict[str, bytes], *names: str) -> Fleet:
    found = Fleet()
    for name in names:
        found.token(f"uav/{name}/companion/alive", True)
        for tick in range(3):
            for kind, payload in recorded.items():
                found.take(f"uav/{name}/companion/{kind}", payload, tick * S // 20)
    return found


def text(found: Fleet, now_ns: int, *, chosen: int = 0, columns: int = 120, rows: int = 40) -> str:
    console = Console(record=True, width=columns, height=rows, file=io.StringIO())
    console.print(screen(found.look(now_ns), chosen, columns=columns, rows=rows, endpoint="tcp/there"))
    return console.export_text()


def test_the_essentials_of_the_scene(recorded: dict[str, bytes]) -> None:
    """At the last tick, t = 1.95 s: vehicle (1.95, 0, 2) at 1 m/s east, ball (4.05, 0.2, 2) at 1 m/s west."""
    found = fleet(recorded, "uav7")
    found.configured("uav/uav7/companion/config", b'{"config": {"safety": {"drone_radius_m": 0.3}}}')
    (sight,) = found.look(S // 5)
    told = essentials(sight)
    assert (told.presence, told.state, told.mode, told.silent_s) == ("alive", "ACTIVE", "OFFBOARD", 0.1)
    assert told.speed_m_s == 1.0
    assert told.target_m == pytest.approx(6.05)
    assert told.nearest is not None
    assert told.nearest.id == "cam/ball"
    assert told.nearest.clearance_m == pytest.approx(math.hypot(2.1, 0.2) - 0.2 - 0.3, abs=0.03)
    assert told.nearest.closing_m_s == pytest.approx(2.0 * 2.1 / math.hypot(2.1, 0.2), abs=0.1)
    record = wire.decode(recorded["setpoint"], wire.SetpointRecord)
    assert record.worst is not None
    assert (told.worst, told.epsilon) == (record.worst.track, round(record.worst.epsilon, 3))
    assert (told.latency_ms, told.rate_hz, told.tracks, told.deadline_misses) == (1.75, 20.0, 2, 2)
    assert told.rejected == {"stale": 3}
    assert set(told.sources) == {"cam", "lidar"}


def test_a_parting_track_closes_negatively() -> None:
    ball = wire.TrackOut(
        id="b",
        position=(3.0, 0.0, 0.0),
        velocity=(2.0, 0.0, 0.0),
        acceleration=(0.0, 0.0, 0.0),
        radius=0.5,
        covariance=[],
        mode_probabilities=(1.0, 0.0, 0.0),
        predicted=[],
        status="confirmed",
        sources=["cam"],
        surprise=1.0,
        growth=1.0,
    )
    level = (1.0, 0.0, 0.0, 0.0)
    here = wire.VehicleOut(stamp_ns=0, position=(0.0, 0.0, 0.0), velocity=(0.5, 0.0, 0.0), attitude=level)
    sight = Sight("x", vehicle=here, tracks=wire.TracksOut(stamp_ns=0, tracks=[ball]), drone_radius_m=0.2)
    near = essentials(sight).nearest
    assert near is not None
    assert (near.clearance_m, near.closing_m_s) == (2.3, -1.5)


def test_a_daemon_that_falls_silent_and_one_that_ends(recorded: dict[str, bytes]) -> None:
    found = fleet(recorded, "a", "b")
    found.token("uav/b/companion/alive", False)
    silent, gone = (essentials(sight) for sight in found.look(5 * S))
    assert (silent.presence, gone.presence) == ("silent", "gone")
    assert (
        silent.nearest is silent.position is silent.verdict is silent.rate_hz is None
    )  # what is old is not shown as new
    assert line(silent) == "a SILENT for 4.9 s, was ACTIVE"
    assert line(gone) == "b GONE: its presence token was dropped, nothing heard for 4.9 s"
    shown = text(found, 5 * S)
    assert "SILENT for 4.9 s, was ACTIVE" in shown
    assert [row.split()[:2] for row in shown.splitlines()[1:3]] == [["▶", "a"], ["b", "GONE"]]
    assert "setpoints of 255/190" not in shown


def test_a_token_without_a_word_is_silent() -> None:
    found = Fleet()
    found.token("uav/a/companion/alive", True)
    (sight,) = found.look(S)
    assert line(essentials(sight)) == "a SILENT: no status yet"


def test_the_screen_of_one_vehicle(recorded: dict[str, bytes]) -> None:
    shown = text(fleet(recorded, "uav7"), S // 5)
    for words in (
        "companion monitor: uav7",
        "ACTIVE",
        "OFFBOARD armed in the air engaged",
        "m to cam/ball, closing ",
        "6.0 m away",
        "epsilon ",
        "1.8 ms, p99 2.5 ms, 20 Hz, 2 deadlines missed",
        "cam: 0.05 s old, 40 frames",
        "lidar: never heard",
        "3 stale",
        "setpoints of 255/190 heard",
    ):
        assert words in shown, shown
    rows = [row for row in shown.splitlines() if "@" in row and "vehicle" not in row]
    assert len(rows) == 1  # the vehicle flies east at its target: both are on one line of the plan
    assert rows[0].index("@") < rows[0].index("X")
    assert max(map(len, shown.splitlines())) <= 120


def test_a_small_terminal_and_one_with_many_vehicles(recorded: dict[str, bytes]) -> None:
    small = text(fleet(recorded, "uav7"), S // 5, columns=70, rows=20)
    assert "@ vehicle" not in small
    assert "cam/ball" in small
    many = text(fleet(recorded, "a", "b", "c"), S // 5, chosen=1)
    listed = [row for row in many.splitlines() if row.startswith(("▶", " "))]
    assert [row.split()[:2] for row in listed[1:]] == [["a", "ACTIVE"], ["▶", "b"], ["c", "ACTIVE"]]
    assert "companion monitor: b" in many
    crowd = text(fleet(recorded, *(f"v{k:02}" for k in range(30))), S // 5, chosen=20, rows=24)
    assert len(crowd.splitlines()) <= 24
    assert "▶  v20" in crowd
    assert "companion monitor: v20" in crowd
    assert "no vehicle heard yet (tcp/there)" in text(Fleet(), 0)


def test_names_of_strangers_cannot_command_the_terminal(recorded: dict[str, bytes]) -> None:
    found = fleet(recorded, "[red]x\x1b[2J")
    status = msgspec.json.decode(recorded["status"])
    status["reason"] = "[bold]\x1b]0;title\x07"
    found.take("uav/[red]x\x1b[2J/companion/status", msgspec.json.encode(status), S // 5)
    (sight,) = found.look(S // 5)
    for shown in (text(found, S // 5), line(essentials(sight))):
        assert "\x1b" not in shown
        assert "\x07" not in shown
        assert "[red]x?[2J" in shown
        assert "[bold]?]0;title?" in shown


def test_what_cannot_be_read_is_counted_and_the_last_good_kept(recorded: dict[str, bytes]) -> None:
    found = fleet(recorded, "a")
    found.look(S // 5)
    found.take("uav/a/companion/status", b'{"state": 7}', S // 5)
    for _ in range(2):  # counted once, however often it is looked at
        (sight,) = found.look(S // 5)
    assert essentials(sight).malformed == 1
    assert essentials(sight).state == "ACTIVE"


def test_strange_keys_and_too_many_vehicles() -> None:
    found = Fleet()
    for key in ("uav/a/companion/other", "uav/a/status", "x/a/companion/status", "uav/a/companion/status/x"):
        found.take(key, b"{}", 0)
    assert found.look(0) == []
    for k in range(MAX_VEHICLES + 5):
        found.take(f"uav/{k}/companion/status", b"{}", 0)
    assert len(found.look(0)) == MAX_VEHICLES


def test_a_new_daemon_of_the_same_name_is_asked_again(recorded: dict[str, bytes]) -> None:
    found = fleet(recorded, "a")
    assert found.unasked() == ["a"]
    assert found.unasked() == []
    found.token("uav/a/companion/alive", False)
    assert found.unasked() == ["a"]


def test_dots_of_the_canvas() -> None:
    """Two by four dots of 1 m a cell; the centre is the corner between the middle cells (Unicode, U+2800)."""
    canvas = Canvas(2, 2, (0.0, 0.0), 1.0)
    canvas.dot(0.5, 0.5, "")  # right of and above the centre: the lowest left dot of the upper right cell
    canvas.dot(-1.5, -3.5, "")  # the lowest left dot of the lower left cell
    canvas.dot(2.5, 0.0, "")  # outside
    canvas.dot(math.nan, 0.0, "")
    assert canvas.text().plain == " \u2840\n\u2840 "
    canvas.mark(0.5, 0.5, "@", "")
    assert canvas.text().plain == " @\n\u2840 "


def test_keys() -> None:
    choice = Choice()
    for key in keys_in(b"\x1b[Bjj\x1b[A"):
        choice.press(key)
    assert choice.among(5) == 2
    assert choice.among(2) == 1
    choice.press("up")
    assert choice.among(2) == 0
    assert not choice.ended
    choice.press("q")
    assert choice.ended
