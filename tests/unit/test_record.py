"""The log of a flight: what survives a kill, a full disk and a restart."""

from __future__ import annotations

import json
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader, make_reader

from companion.config import Config
from companion.errors import ConfigError
from companion.record import Recorder

SETPOINT = "/companion/setpoint"

# appends 100 ticks, flushes after 90 of them, says so and waits to be killed
CHILD = """
import sys
from pathlib import Path
from companion.config import Config
from companion.record import Recorder

recorder = Recorder(Path(sys.argv[1]), Config())
for tick in range(100):
    recorder.message("/companion/setpoint", tick, b'{"tick": %d}' % tick)
    if tick == 89:
        recorder.flush()
print("written", flush=True)
sys.stdin.read()
"""


@contextmanager
def disk_with_room_for(size_bytes: int) -> Iterator[None]:
    """A write beyond this size of a file fails with OSError, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def ticks(path: Path) -> list[int]:
    """What a reader recovers that goes from front to back and needs no summary."""
    found: list[int] = []
    with path.open("rb") as file, suppress(EndOfFile):  # the stock reader's answer to a file cut short
        for _, _, message in NonSeekingReader(file).iter_messages(topics=[SETPOINT], log_time_order=False):
            found.append(json.loads(message.data)["tick"])
    return found


def test_a_killed_process_leaves_what_was_flushed(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    with subprocess.Popen(
        [sys.executable, "-c", CHILD, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == b"written\n"
        child.kill()
    assert child.returncode == -signal.SIGKILL
    assert ticks(path)[:90] == list(range(90))


def test_what_is_appended_after_a_kick_reaches_the_disk_by_itself(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "flight.mcap", Config())
    payload = b'{"tick": 1, "filler": "%s"}' % (b"x" * 1000)
    for stamp_ns in range(200):
        recorder.message(SETPOINT, stamp_ns, payload)
    recorder.kick()
    while len(ticks(recorder.path)) < 200:  # the writer flushes once a second; the test's own time-out ends this
        pass
    recorder.close()
    assert len(ticks(recorder.path)) == 200


@pytest.mark.parametrize("room_bytes", [0, 100, 20_000])
def test_a_full_disk_ends_the_log_and_raises_nothing(tmp_path: Path, room_bytes: int) -> None:
    path = tmp_path / "flight.mcap"
    with disk_with_room_for(room_bytes):
        recorder = Recorder(path, Config())
        for stamp_ns in range(100):
            recorder.message(SETPOINT, stamp_ns, b'{"tick": 1, "filler": "%s"}' % (b"x" * 1000))
        recorder.flush()
        first = recorder.failure
        recorder.message(SETPOINT, 101, b"{}")
        recorder.flush()
        recorder.close()
    assert first == f"{path}: the log ends here (File too large)"
    assert recorder.failure == first


def test_a_disk_that_is_full_at_the_end_only(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "flight.mcap", Config())
    for tick in range(10):
        recorder.message(SETPOINT, tick, b'{"tick": %d}' % tick)
    recorder.flush()
    with disk_with_room_for(recorder.path.stat().st_size):
        recorder.close()
    assert recorder.failure is not None
    assert ticks(recorder.path) == list(range(10))


def test_a_restart_keeps_the_logs_of_before(tmp_path: Path) -> None:
    paths = []
    for run in range(3):
        recorder = Recorder(tmp_path / "flight.mcap", Config())
        recorder.message(SETPOINT, run, b'{"tick": %d}' % run)
        recorder.close()
        recorder.message(SETPOINT, run, b"{}")  # after the end: nothing
        paths.append(recorder.path)
        assert recorder.failure is None
    assert [path.name for path in paths] == ["flight.mcap", "flight-1.mcap", "flight-2.mcap"]
    assert [ticks(path) for path in paths] == [[0], [1], [2]]
    with paths[0].open("rb") as file:
        assert make_reader(file).get_summary().statistics.message_count == 3  # configuration, metadata, setpoint


def test_a_folder_that_cannot_be_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(ConfigError, match=r"log\.directory: .*/file: cannot write there \(File exists\)"):
        Recorder(tmp_path / "file" / "flight.mcap", Config())
