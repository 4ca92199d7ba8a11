"""The writer's thread: it never holds up who appends, drops and counts what does not fit, and in lockstep nothing."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import pytest

from companion.config import parse_config
from companion.log_files import LogFiles
from companion.log_writer import LogWriter
from companion.record import Recorder


class SlowDisk:
    """Stands for `LogFiles`: every write waits until it may."""

    path = Path("flight.mcap")

    def __init__(self) -> None:
        self.may = threading.Event()
        self.begun = threading.Event()
        self.written: list[int] = []

    def add(self, number: int) -> None:
        self.begun.set()
        self.may.wait()
        self.written.append(number)

    def flush(self, *, sync: bool = False) -> None:
        pass

    def rotate_if_large(self) -> None:
        pass

    def close(self) -> None:
        pass


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> SlowDisk:
    monkeypatch.setattr(LogFiles, "close", SlowDisk.close)  # the writer calls them on the class
    monkeypatch.setattr(LogFiles, "flush", SlowDisk.flush)
    return SlowDisk()


def writer_to(disk: SlowDisk, **options: Any) -> LogWriter:
    writer = LogWriter(disk, **options)  # type: ignore[arg-type]
    writer.start()
    return writer


def put(writer: LogWriter, number: int, size: int = 1) -> None:
    writer.put(lambda files: files.add(number), size)  # type: ignore[call-arg, arg-type]


def test_a_slow_disk_costs_the_newest_messages_and_no_time(disk: SlowDisk) -> None:
    writer = writer_to(disk, lossless=False, max_items=10)
    put(writer, 0)
    writer.kick()
    disk.begun.wait()  # it holds the first; ten more find room
    for number in range(1, 100):
        put(writer, number)
    assert writer.counts["dropped"] == 89
    disk.may.set()
    writer.close()
    assert disk.written == list(range(11))


def test_bytes_count_as_well_and_one_large_message_always_fits(disk: SlowDisk) -> None:
    writer = writer_to(disk, lossless=False, max_bytes=1000)
    put(writer, 0, size=5000)
    writer.kick()
    disk.begun.wait()
    for number in range(1, 4):
        put(writer, number, size=400)
    disk.may.set()
    writer.close()
    assert disk.written == [0, 1]  # while 5000 bytes are held, one more may wait and no third
    assert writer.counts["dropped"] == 2


def test_in_lockstep_it_waits_for_room_and_loses_nothing(disk: SlowDisk) -> None:
    writer = writer_to(disk, lossless=True, max_items=3)
    disk.may.set()
    for number in range(1000):
        put(writer, number)
    writer.close()
    assert disk.written == list(range(1000))
    assert not writer.counts


def test_a_message_that_cannot_be_built_costs_itself_only(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    recorder = Recorder(tmp_path / "flight.mcap", parse_config({}))
    for number in range(3):
        recorder.later("/companion/vehicle", number, lambda: 1 / 0)  # type: ignore[arg-type, return-value]
    recorder.message("/companion/vehicle", 3, b"{}")
    recorder.close()
    assert recorder.counts["broken"] == 3
    assert recorder.failure is None
    assert caplog.text.count("could not be built") == 1


def test_trouble_is_told_once(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "flight.mcap", parse_config({}))
    assert recorder.trouble() is None
    recorder.counts["dropped"] += 1
    assert recorder.trouble() == f"{tmp_path}/flight.mcap: the disk does not keep up, the log has gaps"
    recorder.counts["dropped"] += 1
    assert recorder.trouble() is None
    recorder.close()
