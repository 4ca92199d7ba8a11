"""From the log of a flight to the calls of the brain, in order, each tick with what the log says came of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import msgspec

from companion.config import Config, parse_config
from companion.errors import CompanionError, ConfigError
from companion.journal_format import (
    FRAMES_TOPIC,
    TOPIC,
    Call,
    Construct,
    Observe,
    Step,
    decode_call,
    decode_frame,
)
from companion.logbook.reader import CONFIG, FlightLog
from companion.types import DetectionFrame

SETPOINT, TRACKS = "/companion/setpoint", "/companion/tracks"
STATUS = "/companion/status"
FRAMES_KEPT = 4096  # by (source, sequence): a call uses those that were written just before it


@dataclass(slots=True)
class Entry:
    """One call, its frames, and of a tick the records that followed (None where the log was cut before them)."""

    call: Call
    frames: tuple[DetectionFrame, ...] = ()
    setpoint: bytes | None = None
    tracks: bytes | None = None
    status: bytes | None = None  # the newest before the tick


@dataclass(slots=True)
class JournalReader:
    """Reads `entries` once. ``notes`` says what is missing, ``configs`` is complete up to the entry just read."""

    log: FlightLog
    notes: list[str] = field(default_factory=list)
    configs: dict[str, dict[str, Any]] = field(default_factory=dict)  # by hash, as recorded

    def entries(self) -> Iterator[Entry]:
        """Every call up to the end of the log, or to the first that is missing.

        Raises:
            ConfigError: the log holds no journal, or not its beginning.
            CompanionError: a message is not what this version reads.
        """
        pending: Entry | None = None
        expected = 0
        frames: dict[tuple[str, int], DetectionFrame] = {}
        status: bytes | None = None
        for topic, _, data in self.log.messages(TOPIC, FRAMES_TOPIC, CONFIG, SETPOINT, TRACKS, STATUS):
            if topic == CONFIG:
                told = msgspec.json.decode(data)
                self.configs[told["hash"]] = told["config"]
            elif topic == STATUS:
                status = data
            elif topic == FRAMES_TOPIC:
                _keep(frames, data)
            elif topic != TOPIC:
                if pending is not None and isinstance(pending.call, Step):
                    setattr(pending, topic.rpartition("/")[2], data)
            else:
                if pending is not None:
                    yield pending
                call = decode_call(data)
                pending = self._entry(call, expected, frames)
                if pending is None:
                    return
                pending.status = status
                expected = call.n + 1
        if pending is None:
            raise ConfigError(
                f"{self.log.path}: no message on {TOPIC}, expected the log of a version that keeps the brain's journal"
            )
        yield pending
        if self.log.cut is not None:
            self.notes.append(f"the log was cut short: {self.log.cut}")

    def config(self, name: str) -> Config:
        """The configuration of a hash, as this version understands it.

        Raises:
            ConfigError: it is not in the log, or this version cannot fly it.
        """
        raw = self.configs.get(name)
        if raw is None:
            raise ConfigError(f"{self.log.path}: {CONFIG}: expected the configuration {name[:12]}, it is not there")
        return parse_config(raw, source=f"{self.log.path}: configuration {name[:12]}")

    def _entry(self, call: Call, expected: int, frames: dict[tuple[str, int], DetectionFrame]) -> Entry | None:
        """The call with its frames; None, and a note, where the log has lost something."""
        if expected == 0 and not isinstance(call, Construct):
            raise ConfigError(
                f"{self.log.path}: begins with call {call.n} of the brain, expected the first part of the flight, "
                "which names the others"
            )
        if call.n != expected:
            self.notes.append(f"calls {expected} to {call.n - 1} are missing from the log: replayed up to there")
            return None
        if not isinstance(call, Step | Observe):
            return Entry(call)
        missing = [name for name in call.frames if name not in frames]
        if missing:
            source, sequence = missing[0]
            self.notes.append(f"frame {sequence} of {source} is missing from the log: replayed up to there")
            return None
        return Entry(call, tuple([frames[name] for name in call.frames]))


def _keep(frames: dict[tuple[str, int], DetectionFrame], data: bytes) -> None:
    frame = decode_frame(data)
    key = (frame.source, frame.sequence)
    frames.pop(key, None)  # a number comes again after a restart of the clock: newest last
    frames[key] = frame
    while len(frames) > FRAMES_KEPT:
        del frames[next(iter(frames))]


def first_construct(reader: JournalReader, entry: Entry) -> Construct:
    """The first entry's call. Raises CompanionError where it is another."""
    if not isinstance(entry.call, Construct):
        raise CompanionError(f"{reader.log.path}: {TOPIC}: expected construct first")
    return entry.call
