"""Reading logs of flights: whole, cut anywhere, in parts, and files that are none; numbers, tables and the page."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from tracking_scenes import frame, seen, vehicle

from companion.cli import main
from companion.config import Config, parse_config
from companion.journal import Journal
from companion.link import wire
from companion.logbook.export import export
from companion.logbook.reader import LogUnreadable, open_log
from companion.logbook.series import load_series
from companion.pilot import Pilot, PilotInput
from companion.publisher import Publisher
from companion.record import Recorder
from companion.report import setpoint_record
from companion.scene_log import SceneLog
from companion.state import State
from companion.tlog import read_tlog
from companion.types import frozen

TICKS = 60
PERIOD_S = 0.05


class Nobody:
    """Stands for a Zenoh on which nobody listens."""

    def wanted(self, key: str) -> bool:
        return False

    def put_encoded(self, key: str, payload: bytes) -> None:
        pass

    def put(self, key: str, payload: wire.Status) -> None:
        pass


def fly(folder: Path, config: Config, ticks: int = TICKS) -> Path:
    """Fly a pilot past one obstacle that comes to meet it, as the service does, into a log."""
    recorder = Recorder(folder / "flight.mcap", config)
    flies = Pilot(config)
    pilot = Journal(flies, config, artifact=flies.artifact)
    publisher = Publisher(Nobody(), recorder, SceneLog(recorder, config, lambda: None), pilot)
    p, v, target = np.array([0.0, 0.0, 2.0]), np.zeros(3), frozen([6.0, 0.0, 2.0])
    for k in range(ticks):
        t = PERIOD_S * k
        own, frames = vehicle(t, p, v), (frame(t, seen("ball", [5.0 - t, 0.1, 2.0]), sequence=k),)
        output = pilot.step(PilotInput(own, frames, target_enu=target), sent=True)
        timings = {"total": 2.0 + 0.01 * k, "brain": 1.0, "queue": 0.1}
        record = setpoint_record(output.stamp_ns, State.ACTIVE, output, sent=True, messages=1, timings_ms=timings)
        publisher.tick(record, State.ACTIVE, own, frames, output, pilot.tracks, arrived_unix_ns=7, target_enu=target)
        publisher.keep_log()
        v = v + PERIOD_S * output.result.a_safe
        p = p + PERIOD_S * v
    recorder.text(output.stamp_ns, 4, "look out")
    recorder.close()
    assert recorder.failure is None
    assert not recorder.counts
    return recorder.path


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fly(tmp_path_factory.mktemp("flown"), parse_config({"sync": "lockstep"}))


def test_a_log_gives_back_what_was_flown(flown: Path) -> None:
    log = open_log(flown.parent)
    series = load_series(log)
    assert log.config == parse_config({"sync": "lockstep"})
    assert log.cut is None
    assert len(series.records) == len(series.p_enu) == TICKS
    assert series.t_s[-1] == pytest.approx(PERIOD_S * (TICKS - 1))
    assert {record.verdict for record in series.records} == {"nominal", "adjusted"}
    clearance_m, track, t_s = series.closest() or pytest.fail("nothing came close")
    assert track == "cam/ball"
    tick = round(t_s / PERIOD_S)
    ball = next(iter(log.messages("/companion/tracks")))  # its radius
    radius_m = ball.json["tracks"][0]["radius"]
    truth = np.linalg.norm(series.p_enu[tick] - [5.0 - PERIOD_S * tick, 0.1, 2.0]) - radius_m - 0.2
    assert clearance_m == pytest.approx(truth, abs=0.05)  # the track is as good as the detections are
    assert log.metadata["packages"]["mcap"]
    assert len(log.metadata["artifact_digest"]) == 64


def test_every_cut_of_a_log_opens_with_all_that_came_before(flown: Path, tmp_path: Path) -> None:
    data, path, before = flown.read_bytes(), tmp_path / "flight.mcap", 0
    for size in (*range(0, len(data), len(data) // 40), len(data) - 1):
        path.write_bytes(data[:size])
        try:
            log = open_log(path)
        except LogUnreadable:
            assert before == 0
            continue
        found = sum(1 for _ in log.messages("/companion/setpoint"))
        assert found >= before
        assert log.cut
        before = found
    assert before == TICKS


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (None, "cannot be read (No such file or directory), expected an MCAP file"),
        (b"", "not an MCAP file"),
        (b"PK\x03\x04 something else altogether", "not an MCAP file"),
        (b"\x89MCAP0\r\n", "cut before anything of a flight was written"),
    ],
)
def test_a_file_that_is_no_log_is_one_line(
    content: bytes | None, expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "flight.mcap"
    if content is not None:
        path.write_bytes(content)
    for words in (["info", str(path)], ["plot", str(path)], ["export", str(path), "-o", str(tmp_path / "out")]):
        assert main(["log", *words]) == 2
        line = capsys.readouterr().err
        assert line.count("\n") == 1
        assert str(path) in line
        assert expected in line


def test_an_mcap_of_somebody_else_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "theirs.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema(name="x", encoding="jsonschema", data=b"{}")
        channel = writer.register_channel(topic="/companion/config", message_encoding="json", schema_id=schema)
        writer.add_message(channel, log_time=0, data=b'{"version": 3}', publish_time=0)
        writer.finish()
    with pytest.raises(LogUnreadable, match=r"theirs\.mcap: /companion/config: Expected `str`"):
        _ = open_log(path).config


def test_a_flight_in_parts_reads_as_one(tmp_path: Path) -> None:
    config = parse_config({"sync": "lockstep", "log": {"max_mb": 1.0, "scene_hz": 100.0}})
    recorder = Recorder(tmp_path / "flight.mcap", config)
    filler = b"x" * 50_000
    for k in range(60):
        recorder.message("/companion/setpoint", k, b'{"k": %d, "filler": "%s"}' % (k, filler))
        recorder.packet(b"\xfe\x00\x00\x01\x01\x00\x00\x00", 1_000_000 + k, False)
        recorder.flush()  # so that the writer looks at the size in between
    recorder.close()
    log = open_log(tmp_path)
    assert [message.json["k"] for message in log.messages("/companion/setpoint")] == list(range(60))
    names = ["flight", *(f"flight-{number}" for number in range(1, len(log.paths)))]
    assert len(names) >= 3
    assert [path.name for path in log.paths] == [f"{name}.mcap" for name in names]
    assert len(log.configs) == 1  # repeated in each part, and the same
    for path in log.paths:
        assert path.stat().st_size < 1_200_000
        with path.open("rb") as file:
            assert make_reader(file).get_summary() is not None
    assert sorted(path.name for path in tmp_path.glob("*.tlog")) == sorted(f"{name}.tlog" for name in names)
    assert sum(1 for path in log.paths for _ in read_tlog(path.with_suffix(".tlog"))) == 60


def test_the_oldest_flights_make_room(tmp_path: Path) -> None:
    config = parse_config({"log": {"keep_files": 3}})
    for _ in range(5):
        Recorder(tmp_path / "flight.mcap", config).close()
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "flight-2.mcap",
        "flight-2.tlog",
        "flight-3.mcap",
        "flight-3.tlog",
        "flight-4.mcap",
        "flight-4.tlog",
    ]
    (tmp_path / "flight-2.mcap").write_bytes(b"x" * 2_000_000)
    Recorder(tmp_path / "flight.mcap", parse_config({"log": {"max_mb": 1.0, "keep_mb": 2.0}})).close()
    assert not (tmp_path / "flight-2.mcap").exists()
    assert (tmp_path / "flight-4.mcap").exists()


def test_info_counts_what_is_there(flown: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["log", "info", str(flown), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["ticks"] == told["sent"] == sum(told["verdicts"].values()) == TICKS
    assert told["topics"]["/companion/input/obstacles"] == TICKS
    assert told["topics"]["/foxglove/scene"] == TICKS // 2  # ten a second of twenty
    assert told["texts"] == [{"t_s": pytest.approx(PERIOD_S * (TICKS - 1)), "severity": 4, "text": "look out"}]
    assert told["latency_ms"]["total"]["max"] == pytest.approx(2.0 + 0.01 * (TICKS - 1))
    assert told["states_s"] == {"ACTIVE": pytest.approx(PERIOD_S * (TICKS - 1))}
    assert told["cut"] is None
    assert main(["log", "info", str(flown)]) == 0
    assert "look out" in capsys.readouterr().out


def test_tables_hold_every_number_to_the_bit(flown: Path, tmp_path: Path) -> None:
    log = open_log(flown)
    written = export(log, tmp_path, "csv")
    assert written["setpoints.csv"] == written["vehicle.csv"] == written["tracks.csv"] == TICKS
    with (tmp_path / "setpoints.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    for row, record in zip(rows, load_series(log).records, strict=True):
        assert tuple(float(row[f"u_safe_{axis}"]) for axis in "xyz") == record.u_safe
        assert int(row["stamp_ns"]) == record.stamp_ns
        assert row["verdict"] == record.verdict
    with (tmp_path / "obstacles.csv").open(encoding="utf-8", newline="") as file:
        first = next(csv.DictReader(file))
    assert (float(first["x"]), first["id"], first["source"]) == (5.0, "ball", "cam")


def test_parquet_holds_what_csv_holds(flown: Path, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    log = open_log(flown)
    written, lines = export(log, tmp_path, "parquet"), export(log, tmp_path, "csv")
    assert list(written.values()) == list(lines.values())
    table = parquet.read_table(tmp_path / "rows.parquet").to_pylist()
    with (tmp_path / "rows.csv").open(encoding="utf-8", newline="") as file:
        assert [row["slack"] for row in table] == [float(row["slack"]) for row in csv.DictReader(file)]


def test_the_page_of_plots_is_a_png(flown: Path, tmp_path: Path) -> None:
    path = tmp_path / "page.png"
    assert main(["log", "plot", str(flown), "-o", str(path)]) == 0
    data = path.read_bytes()
    assert data.startswith(b"\x89PNG\r\n")
    width, height = int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    assert (width, height) == (1210, 1705)


@pytest.mark.parametrize(
    ("package", "words", "extra"),
    [
        ("matplotlib", ("plot",), "companion-safety[plot]"),
        ("pyarrow", ("export", "-o", "{out}", "--format", "parquet"), "companion-safety[parquet]"),
    ],
)
def test_a_missing_extra_is_named_in_one_line(
    package: str, words: tuple[str, ...], extra: str, flown: Path, tmp_path: Path
) -> None:
    part, *options = [word.format(out=tmp_path) for word in words]
    blocked = f"import sys; sys.modules[{package!r}] = None; from companion.cli import main; sys.exit(main())"
    done = subprocess.run(
        [sys.executable, "-c", blocked, "log", part, str(flown), *options], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert extra in done.stderr
