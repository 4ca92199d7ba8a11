"""A recorded flight again: equal to the bit, and where it is not."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest
from mcap.reader import NonSeekingReader
from mcap.writer import CompressionType, Writer
from replay_scenes import Shell, config_of

from companion.cli import main
from companion.pilot import Task
from companion.tunables import changed
from companion.types import frozen


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Every kind of call: ahead and not, anonymous and named, a retune, a failure, a settled profile, a reset."""
    shell = Shell(tmp_path_factory.mktemp("flown"), config_of())
    for _ in range(4):
        shell.tick(Task.STAY)
    for k in range(40):
        if k == 20:
            shell.retune(changed(shell.config, {"CA_CUSHION": 0.3}))
        shell.tick(Task.FLY, frames=shell.frames("ball", None), ahead=k % 2 == 0)
    for _ in range(10):
        shell.tick(Task.FLY)
    for _ in range(10):
        shell.tick(Task.HOLD, frames=())
    shell.tick(Task.FLY, p=np.full(3, np.nan))
    shell.brain.configured(changed(shell.config, {"CA_CUSHION": 0.2}))
    shell.recorder.config(changed(shell.config, {"CA_CUSHION": 0.2}), shell.tick_ns)
    shell.tick_ns = 0  # the clock began anew
    shell.brain.reset()
    for _ in range(5):
        shell.tick(Task.FLY, target=frozen([5.0, 1.0, 2.0]))
    return shell.close()


def rewritten(path: Path, into: Path, change: Callable[[str, int, dict], dict | None]) -> Path:
    """The log with each message as ``change(topic, count on that topic, JSON)`` gives it, without it where None."""
    counts: dict[str, int] = {}
    with path.open("rb") as file, into.open("wb") as out:
        writer = Writer(out, compression=CompressionType.NONE)
        writer.start()
        channels: dict[str, int] = {}
        for schema, channel, message in NonSeekingReader(file).iter_messages(log_time_order=False):
            assert schema is not None
            if channel.topic not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, "json", number)
            count = counts[channel.topic] = counts.get(channel.topic, -1) + 1
            body = change(channel.topic, count, msgspec.json.decode(message.data))
            if body is not None:
                data = msgspec.json.encode(body)
                writer.add_message(channels[channel.topic], message.log_time, data, message.publish_time)
        writer.finish()
    return into


def replay(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, dict]:
    status = main(["replay", *(str(word) for word in words), "--json"])
    return status, json.loads(capsys.readouterr().out)


def test_a_flight_replays_to_the_bit(flown: Path, capsys) -> None:
    status, report = replay(capsys, flown)
    assert status == 0, report["first_difference"]
    assert (report["equal"], report["ticks"], report["compared"], report["differing"]) == (True, 70, 70, 0)
    assert report["same_numerics"]
    assert [entry["what"].partition(":")[0] for entry in report["configurations"]] == [
        "live parameters changed",
        "the vehicle's profile is settled",
    ]
    assert "safety.cushion_m 0.1 -> 0.3" in report["configurations"][0]["what"]


@pytest.mark.parametrize(
    ("topic", "path", "field"),
    [
        ("/companion/setpoint", ("u_ref", 1), "u_ref.1"),
        ("/companion/setpoint", ("u_safe", 2), "u_safe.2"),
        ("/companion/setpoint", ("disturbance", 0), "disturbance.0"),
        ("/companion/setpoint", ("rows", 0, "slack"), "rows.0.slack"),
        ("/companion/setpoint", ("rows", 0, "epsilon"), "rows.0.epsilon"),
        ("/companion/setpoint", ("worst", "epsilon_star"), "worst.epsilon_star"),
        ("/companion/setpoint", ("wire", 0), "wire.0"),
        ("/companion/tracks", ("tracks", 0, "covariance", 3), "tracks.tracks.0.covariance.3"),
        ("/companion/tracks", ("tracks", 0, "predicted", 5, 1), "tracks.tracks.0.predicted.5.1"),
    ],
)
def test_the_last_bit_of_a_field_is_found(
    flown: Path, tmp_path: Path, capsys, topic: str, path: tuple, field: str
) -> None:
    def change(of: str, count: int, body: dict) -> dict:
        if of == topic and count == 20:
            at = body
            for key in path[:-1]:
                at = at[key]
            at[path[-1]] = float(np.nextafter(at[path[-1]], np.inf))
        return body

    status, report = replay(capsys, rewritten(flown, tmp_path / "changed.mcap", change))
    assert (status, report["differing"]) == (1, 1)
    assert report["first_difference"]["field"] == field
    assert report["first_difference"]["stamp_ns"] == 21 * 50_000_000
    if field == "u_ref.1":
        status, _ = replay(capsys, tmp_path / "changed.mcap", "--tolerance", 1e-9)
        assert status == 0


def test_another_input_is_told_with_both_values(flown: Path, tmp_path: Path, capsys) -> None:
    def change(of: str, count: int, body: dict) -> dict:
        if body.get("call") == "step" and body["stamp_ns"] == 30 * 50_000_000:
            body["v"][0] += 0.01
        return body

    path = rewritten(flown, tmp_path / "changed.mcap", change)
    assert main(["replay", str(path)]) == 1
    out = capsys.readouterr().out
    assert "differs:" in out
    assert "first    1.250 s (1500000000 ns): " in out  # engaged with the fifth tick
    assert "\n  log    " in out
    assert "\n  here   " in out


def test_a_window_is_compared_and_nothing_after_it_is_played(flown: Path, tmp_path: Path, capsys) -> None:
    def change(of: str, count: int, body: dict) -> dict:
        if of == "/companion/setpoint" and count in (2, 30):
            body["verdict"] = "braking"
        return body

    path = rewritten(flown, tmp_path / "changed.mcap", change)
    status, report = replay(capsys, path, "--from", "0.5", "--to", "1.0")
    assert (status, report["ticks"]) == (0, 11)
    status, report = replay(capsys, path, "--from", "1.0")
    assert (status, report["first_difference"]["field"]) == (1, "verdict")
    status, report = replay(capsys, path, "--from", "150000000ns", "--to", "150000000ns")
    assert (status, report["ticks"]) == (1, 1)


def test_a_log_cut_short_is_replayed_as_far_as_it_goes(flown: Path, tmp_path: Path, capsys) -> None:
    data = flown.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: 2 * len(data) // 3])
    status, report = replay(capsys, cut)
    assert status == 0
    assert 10 < report["compared"] < 70
    assert any("cut short" in note for note in report["notes"])


def test_a_message_that_the_log_lost_ends_the_replay_and_is_told(flown: Path, tmp_path: Path, capsys) -> None:
    path = rewritten(
        flown, tmp_path / "gap.mcap", lambda of, count, body: None if of == "/companion/brain" and count == 40 else body
    )
    status, report = replay(capsys, path)
    assert status == 0
    assert report["notes"] == ["calls 40 to 40 are missing from the log: replayed up to there"]
    path = rewritten(
        flown,
        tmp_path / "gap2.mcap",
        lambda of, count, body: None if of == "/companion/input/obstacles" and count == 9 else body,
    )
    status, report = replay(capsys, path)
    assert (status, report["compared"]) == (0, 9)
    assert report["notes"] == ["frame 10 of cam is missing from the log: replayed up to there"]


def test_what_another_configuration_would_have_answered(flown: Path, tmp_path: Path, capsys) -> None:
    status, report = replay(capsys, flown, "--set", "safety.cushion_m=0.1")
    assert status == 0
    assert report["open_loop"] is True
    assert report["differing_ticks"] > 0  # the retune to 0.3 m is laid over
    assert report["first_difference"]["stamp_ns"] == 25 * 50_000_000
    file = tmp_path / "other.toml"
    file.write_text('sync = "lockstep"\n[safety]\nfilter = "none"\n', encoding="utf-8")
    status, report = replay(capsys, flown, "--config", file)
    assert status == 0
    assert report["other"]["verdicts"] == {"nominal": report["ticks"]}
    assert report["other"]["mean_change_m_s2"] == 0.0
    assert report["other"]["min_predicted_clearance_m"] < report["log"]["min_predicted_clearance_m"]
    assert main(["replay", str(flown), "--config", str(file)]) == 0
    out = capsys.readouterr().out
    assert "open loop" in out
    assert "least predicted clearance" in out


def test_the_same_configuration_answers_the_same(flown: Path, capsys) -> None:
    status, report = replay(capsys, flown, "--set", "vehicle.name=uav7")
    assert status == 0
    assert (report["differing_ticks"], report["first_difference"]) == (0, None)
    assert report["log"] == report["other"]


def test_another_artefact_is_refused_unless_asked_for(flown: Path, tmp_path: Path, capsys) -> None:
    def change(of: str, count: int, body: dict) -> dict:
        return {**body, "artifact": "0" * 64} if body.get("call") == "construct" else body

    path = rewritten(flown, tmp_path / "other.mcap", change)
    assert main(["replay", str(path)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert "policy.artifact builtin:default: expected the manifest of SHA-256 000000000000..., here it is" in lines[0]
    assert main(["replay", str(path), "--artifact", "builtin:default"]) == 0


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--from", "soon"], "--from soon: expected seconds after engaging"),
        (["--tolerance", "-1"], "--tolerance: expected a number >= 0"),
        (["--set", "safety.kappa=-1"], "--set: safety.kappa"),
        (["--artifact", "nowhere"], "policy.artifact: nowhere: expected a folder"),
    ],
)
def test_what_cannot_be_is_one_line(flown: Path, capsys, words: list[str], expected: str) -> None:
    assert main(["replay", str(flown), *words]) == 2
    error = capsys.readouterr().err
    assert expected in error
    assert error.count("\n") == 1


def test_a_file_that_is_no_log_is_wrong_usage(flown: Path, tmp_path: Path, capsys) -> None:
    (tmp_path / "notes.txt").write_text("hello", encoding="utf-8")
    broken = rewritten(
        flown,
        tmp_path / "broken.mcap",
        lambda of, count, body: {"call": "dance", "n": count} if of == "/companion/brain" and count == 9 else body,
    )
    for path, expected in (
        (tmp_path / "notes.txt", "not an MCAP file"),
        (tmp_path / "none.mcap", "cannot be read"),
        (broken, "/companion/brain: Invalid value 'dance'"),
    ):
        for words in (["replay", str(path)], ["explain", str(path), "--worst"]):
            assert main(words) == 2
            error = capsys.readouterr().err
            assert expected in error
            assert error.count("\n") == 1


def test_a_log_without_a_journal_is_one_line(flown: Path, tmp_path: Path, capsys) -> None:
    path = rewritten(flown, tmp_path / "old.mcap", lambda of, count, body: None if of == "/companion/brain" else body)
    assert main(["replay", str(path)]) == 2
    assert "no message on /companion/brain" in capsys.readouterr().err
    late = rewritten(
        flown, tmp_path / "late.mcap", lambda of, n, body: None if of == "/companion/brain" and n < 5 else body
    )
    assert main(["replay", str(late)]) == 2
    assert "begins with call 5 of the brain" in capsys.readouterr().err
