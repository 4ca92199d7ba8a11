"""Opens the log of a flight, whole or cut short, in one file or in several parts."""

from __future__ import annotations

import struct
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from mcap.exceptions import InvalidMagic, McapError
from mcap.records import Channel, McapRecord, Message, Metadata
from mcap.stream_reader import CRCValidationError, StreamReader

from companion.config import Config, SafetyConfig
from companion.errors import ConfigError

CONFIG, METADATA = "/companion/config", "/companion/metadata"
NEXT = "companion.next"
MAX_RECORD_BYTES = 1 << 28  # a damaged length must not fill the memory

_DAMAGE = (McapError, CRCValidationError, struct.error, UnicodeDecodeError, ValueError, KeyError, OverflowError)


class LogUnreadable(ConfigError):
    """A file that is no log of ours; the line names it."""


class LogMessage(NamedTuple):
    """One message: JSON of the schema that its topic names, at a vehicle time."""

    topic: str
    stamp_ns: int
    data: bytes

    @property
    def json(self) -> Any:
        return msgspec.json.decode(self.data)


@dataclass(frozen=True, slots=True)
class ConfigEntry:
    """What flew from ``stamp_ns`` on."""

    stamp_ns: int
    version: str
    hash: str
    values: dict[str, Any]


class _Head(msgspec.Struct):
    version: str
    hash: str
    config: dict[str, Any]


class FlightLog:
    """A log; every query reads the files from front to back and holds no more than one chunk of them.

    Once the whole of it has been read, ``paths`` are its parts, and ``cut`` tells why the last one ends early (the
    writer was killed, or its disk was full), None where it does not.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.paths: tuple[Path, ...] = ()
        self.cut: str | None = None
        self._head()

    @property
    def version(self) -> str:
        """Of the daemon that wrote it."""
        return self.configs[0].version

    @property
    def config_hash(self) -> str:
        return self.configs[0].hash

    @cached_property
    def metadata(self) -> dict[str, Any]:
        """Versions and artefact, of `/companion/metadata`; empty in logs of daemons that did not write it."""
        for message in self.messages(METADATA):
            found: dict[str, Any] = message.json
            return found
        return {}

    @cached_property
    def configs(self) -> tuple[ConfigEntry, ...]:
        """Every configuration that was flown, in order; more than one where live parameters or the profile changed."""
        entries: list[ConfigEntry] = []
        for message in self.messages(CONFIG):
            try:
                head = msgspec.json.decode(message.data, type=_Head)
            except msgspec.DecodeError as error:
                raise LogUnreadable(f"{self.path}: {CONFIG}: {error}") from None
            entry = ConfigEntry(message.stamp_ns, head.version, head.hash, head.config)
            if not entries or entry != entries[-1]:  # each part begins with the one that holds
                entries.append(entry)
        return tuple(entries)

    @property
    def config(self) -> Config:
        """The first configuration.

        Raises:
            LogUnreadable: this version knows no such configuration.
        """
        return self.typed(self.configs[0])

    @property
    def drone_radius_m(self) -> float:
        """Of the first configuration, whether or not this version understands the rest of it."""
        return float(self.configs[0].values.get("safety", {}).get("drone_radius_m", SafetyConfig().drone_radius_m))

    def typed(self, entry: ConfigEntry) -> Config:
        """A configuration of the log as this version understands it; raises LogUnreadable as ``config``."""
        try:
            return msgspec.convert(entry.values, Config)
        except msgspec.ValidationError as error:
            raise LogUnreadable(
                f"{self.path}: the configuration of version {entry.version} is not one of this version: {error}"
            ) from None

    def messages(self, *topics: str) -> Iterator[LogMessage]:
        """Messages of ``topics``, of all where none is named, in the order in which they were written."""
        known: list[Path] = []
        damage: list[str] = []
        following: Path | None = self.path
        while following is not None and following not in known and (following == self.path or following.exists()):
            known.append(following)
            following = yield from self._of_part(following, frozenset(topics), damage)
        self.paths, self.cut = tuple(known), damage[-1] if damage else None

    def _of_part(
        self, path: Path, topics: frozenset[str], damage: list[str]
    ) -> Generator[LogMessage, None, Path | None]:
        """The messages of one part; its return value is the part after it."""
        channels: dict[int, str] = {}
        following: Path | None = None
        for record in self._records(path, damage):
            if isinstance(record, Message):
                topic = channels.get(record.channel_id, "")
                if not topics or topic in topics:
                    yield LogMessage(topic, record.log_time, record.data)
            elif isinstance(record, Channel):
                channels[record.id] = record.topic
            elif isinstance(record, Metadata) and record.name == NEXT:
                following = path.with_name(Path(record.metadata["file"]).name)
        return following

    @staticmethod
    def _records(path: Path, damage: list[str]) -> Iterator[McapRecord]:
        """The records up to the end, or to where it ends early; ``damage`` then gets why."""
        try:
            with path.open("rb") as file:
                reader = StreamReader(file, validate_crcs=True, record_size_limit=MAX_RECORD_BYTES)
                yield from reader.records
        except OSError as error:
            raise LogUnreadable(f"{path}: cannot be read ({error.strerror}), expected an MCAP file") from None
        except InvalidMagic:
            damage.append("its end is missing or damaged")
        except _DAMAGE as error:
            damage.append(f"it ends early ({error})" if str(error) else "it ends early")

    def _head(self) -> None:
        """Read as far as the configuration, which every log of ours begins with."""
        try:
            with self.path.open("rb") as file:
                magic = file.read(8)
        except OSError as error:
            raise LogUnreadable(f"{self.path}: cannot be read ({error.strerror}), expected an MCAP file") from None
        if magic != b"\x89MCAP0\r\n":
            raise LogUnreadable(f"{self.path}: not an MCAP file, expected the log of a flight (flight.mcap)")
        if next(self.messages(CONFIG), None) is None:
            what = "cut before anything of a flight was written" if self.cut else "written by something else"
            raise LogUnreadable(f"{self.path}: no message on {CONFIG} ({what}), expected the log of a flight")


def open_log(path: Path) -> FlightLog:
    """The log at ``path``; a folder stands for its ``flight.mcap``.

    Raises:
        LogUnreadable: it is missing, or no log of a flight.
    """
    return FlightLog(path / "flight.mcap" if path.is_dir() else path)
