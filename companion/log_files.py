"""The files of a flight on disk: an MCAP file with its tlog, begun anew when it is large, the oldest ones removed.

A flight begins in the first free one of ``flight.mcap``, ``flight-1.mcap``, ...; one that outgrows its limit goes on
in the next and says so (metadata ``companion.next`` and ``companion.previous``), so that a reader finds the rest.
Synchronous; used from the writer's thread alone once it runs. Every method may raise OSError.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from io import BufferedWriter
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer

from companion import __version__
from companion.tlog import entry

CHUNK_BYTES = 65536  # what the writer holds back between two flushes at most
ABOUT = "companion"
NEXT, PREVIOUS = "companion.next", "companion.previous"  # metadata records that chain the parts of a flight


@dataclass(frozen=True, slots=True)
class Limits:
    """Sizes in bytes: of one file, and of all flights in the folder; ``keep_files`` MCAP files at most."""

    file_bytes: int
    keep_bytes: int
    keep_files: int


@dataclass(frozen=True, slots=True)
class Topic:
    """A channel: JSON messages of one named JSON Schema, both encoded once."""

    name: str
    schema: bytes


class LogFiles:
    """The part that is being written. ``path``: the first of this flight."""

    def __init__(self, path: Path, limits: Limits, *, tlog: bool) -> None:
        self._limits = limits
        self._tlog_wanted = tlog
        self._about: dict[str, str] = {}
        self._topics: dict[str, Topic] = {}
        self._standing: dict[str, tuple[int, bytes]] = {}  # what every part begins with
        self._template = path
        self._file = _create(path)
        self.path = self._part = Path(self._file.name)
        self._tlog: BufferedWriter | None = None
        self._bytes_before = 0

    def start(self, previous: str | None = None) -> None:
        """Write the head of a part; the topics known so far are declared in it."""
        self._writer: Any = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE)
        self._channels: dict[str, int] = {}
        self._writer.start(profile="", library=f"companion {__version__}")
        if self._about:
            self._writer.add_metadata(ABOUT, self._about)
        if previous is not None:
            self._writer.add_metadata(PREVIOUS, {"file": previous})
        for topic in self._topics:
            self._register(topic)
        for topic, (stamp_ns, payload) in self._standing.items():
            self.add(topic, stamp_ns, payload)
        if self._tlog_wanted:
            self._tlog = self._part.with_suffix(".tlog").open("xb")
        self._prune()

    def describe(self, about: dict[str, str]) -> None:
        """A metadata record on what wrote the file, in this part and those to come."""
        self._about = about
        self._writer.add_metadata(ABOUT, about)

    def declare(self, topic: str, name: str, schema: bytes) -> None:
        """A topic and its schema, before its first message."""
        self._topics[topic] = Topic(name, schema)
        self._register(topic)

    def standing(self, topic: str, stamp_ns: int, payload: bytes) -> None:
        """A message that holds from here on: later parts repeat the newest of its topic at their head."""
        self._standing[topic] = (stamp_ns, payload)
        self.add(topic, stamp_ns, payload)

    def add(self, topic: str, stamp_ns: int, payload: bytes) -> None:
        """Append one message; a topic that nobody declared is any JSON object."""
        channel = self._channels.get(topic)
        if channel is None:
            self.declare(topic, "Object", b'{"type":"object"}')
            channel = self._channels[topic]
        stamp = max(0, stamp_ns)  # MCAP's times are unsigned
        self._writer.add_message(channel, log_time=stamp, data=payload, publish_time=stamp)

    def packet(self, unix_us: int, raw: bytes) -> None:
        """Append one MAVLink packet to the tlog."""
        if self._tlog is not None:
            self._tlog.write(entry(unix_us, raw))

    def flush(self, *, sync: bool = False) -> None:
        """End the chunk in progress and hand everything to the system; with ``sync`` to the disk as well."""
        self._writer.flush()
        files = [self._file] if self._tlog is None else [self._file, self._tlog]
        for file in files:
            file.flush()
            if sync:
                with contextlib.suppress(OSError):  # not every file system knows it; an error of its own comes again
                    os.fdatasync(file.fileno())

    def rotate_if_large(self) -> None:
        """Go on in the next part once this one has outgrown its limit."""
        if self._file.tell() < self._limits.file_bytes:
            return
        following = _create(self._template)
        name = Path(following.name)
        self._writer.add_metadata(NEXT, {"file": name.name})
        self.close()
        previous, self._part, self._file = self._part, name, following
        self.start(previous=previous.name)

    def close(self) -> None:
        """Write the index and close."""
        self._writer.finish()
        self._file.close()
        if self._tlog is not None:
            self._tlog.close()

    def abandon(self) -> None:
        """Close after a failure, whatever that says."""
        for file in (self._file, self._tlog):
            if file is not None:
                with contextlib.suppress(OSError):  # closing writes what is still buffered, and fails as the write did
                    file.close()

    def _register(self, topic: str) -> None:
        about = self._topics[topic]
        schema = self._writer.register_schema(name=about.name, encoding="jsonschema", data=about.schema)
        self._channels[topic] = self._writer.register_channel(topic=topic, message_encoding="json", schema_id=schema)

    def _prune(self) -> None:
        """Remove the oldest flights until what is left fits; never the part that is being written."""
        others = [path for _, path in parts(self._template) if path != self._part]
        sizes = {path: _size(path) + _size(path.with_suffix(".tlog")) for path in others}
        kept_bytes = sum(sizes.values()) + self._limits.file_bytes  # room for this one, too
        while others and (len(others) >= self._limits.keep_files or kept_bytes > self._limits.keep_bytes):
            oldest = others.pop(0)
            kept_bytes -= sizes[oldest]
            oldest.unlink(missing_ok=True)
            oldest.with_suffix(".tlog").unlink(missing_ok=True)


def parts(template: Path) -> list[tuple[int, Path]]:
    """The numbered files of a folder that are named like ``template``, the oldest first."""
    pattern = re.compile(re.escape(template.stem) + r"(?:-(\d+))?" + re.escape(template.suffix))
    found = ((pattern.fullmatch(path.name), path) for path in template.parent.iterdir())
    return sorted((int(match[1] or 0), path) for match, path in found if match is not None)


def _create(template: Path) -> BufferedWriter:
    """A new file behind all that exist: a daemon that was restarted must not destroy the log of what came before."""
    existing = parts(template)
    for number in _from(existing[-1][0] + 1 if existing else 0):
        name = template if number == 0 else template.with_stem(f"{template.stem}-{number}")
        with contextlib.suppress(FileExistsError):
            return name.open("xb")
    raise AssertionError("numbers end")


def _from(number: int) -> Iterator[int]:
    while True:
        yield number
        number += 1


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0
