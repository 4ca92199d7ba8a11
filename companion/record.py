"""What the log of a flight holds: JSON messages with named JSON Schemas in MCAP, which Foxglove and `mcap` open.

Topics: ``/companion/metadata`` (versions, artefact) and ``/companion/config`` (resolved configuration, its hash and
version: first, and again when live parameters change), ``/companion/input/obstacles`` (frames as the brain consumed
them, vehicle clock, ENU, with their arrival), ``/companion/vehicle``, ``/companion/setpoint``, ``/companion/tracks``,
``/companion/status``, ``/companion/texts`` (STATUSTEXT as sent). Times are nanoseconds of the vehicle's clock; arrivals
are those of this computer's unix clock. Beside it lies a tlog of every MAVLink packet.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import msgspec

from companion import __version__, foxglove
from companion.clock import Clock, SystemClock
from companion.config import Config, config_hash
from companion.errors import ConfigError
from companion.link.wire import OUTGOING, ObstacleFrame, encode
from companion.log_files import Limits, LogFiles
from companion.log_writer import LogWriter
from companion.provenance import Provenance, provenance
from companion.tlog import is_secret
from companion.types import DetectionFrame

CONFIG, METADATA, OBSTACLES = "/companion/config", "/companion/metadata", "/companion/input/obstacles"
TEXTS = "/companion/texts"
MB = 1_000_000

Message: TypeAlias = tuple[str, int, bytes]  # topic, stamp, payload

_ENCODER = msgspec.json.Encoder()


class TextOut(msgspec.Struct, frozen=True, kw_only=True):
    """``/companion/texts``: a STATUSTEXT as it was sent; ``severity`` is a MAV_SEVERITY."""

    stamp_ns: int
    severity: int
    text: str


class Recorder:
    """The log of one flight. Appending never blocks (but in lockstep, where nothing is dropped) and never raises.

    A daemon that is killed loses no more than the last second, and the file still reads from front to back. After the
    first OSError nothing is written any more and ``failure`` tells why. ``counts``: as `LogWriter`.

    Raises:
        ConfigError: the file cannot be created (the constructor only).
    """

    def __init__(self, path: Path, config: Config, clock: Clock | None = None) -> None:
        log, started_unix_ns = config.log, (clock or SystemClock()).unix_ns()
        limits = Limits(round(log.max_mb * MB), round(log.keep_mb * MB), log.keep_files)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._files = LogFiles(path, limits, tlog=log.tlog)
        except OSError as error:
            raise ConfigError(f"log.directory: {path.parent}: cannot write there ({error.strerror})") from None
        self._told: set[str] = set()
        self._writer = LogWriter(self._files, lossless=config.sync == "lockstep")
        try:
            self._files.start()
            self._declare_own()
        except OSError as error:
            self._writer.fail(error)
        self._writer.start()
        self.config(config, 0)
        self._writer.put(partial(_add_provenance, config=config, unix_ns=started_unix_ns), 0)

    @property
    def path(self) -> Path:
        """The first file of this flight."""
        return self._files.path

    @property
    def failure(self) -> str | None:
        """Why nothing is written any more."""
        return self._writer.failure

    @property
    def counts(self) -> Counter[str]:
        """Messages that did not get into the log: dropped, lost, broken (as `LogWriter`)."""
        return self._writer.counts

    def trouble(self) -> str | None:
        """What has befallen the log and was not told yet: it ended, or the first messages were dropped."""
        if self.failure is not None and "failure" not in self._told:
            self._told.add("failure")
            return f"{self.failure}; flying on without it"
        if self.counts["dropped"] and "dropped" not in self._told:
            self._told.add("dropped")
            return f"{self.path}: the disk does not keep up, the log has gaps"
        return None

    def declare(self, topic: str, name: str, schema: dict[str, Any]) -> None:
        """A topic of another module and the JSON Schema of its messages; before its first message."""
        self._writer.put(partial(LogFiles.declare, topic=topic, name=name, schema=_schema(schema)), 0)

    def message(self, topic: str, stamp_ns: int, payload: bytes) -> None:
        """Append one JSON message."""
        self._writer.put(lambda files: files.add(topic, stamp_ns, payload), len(payload))

    def later(self, topic: str, stamp_ns: int, build: Callable[[], msgspec.Struct], size: int = 1024) -> None:
        """Append the message that ``build`` makes of frozen values, on the writer's thread.

        ``size`` is about what it holds on to until then [bytes].
        """
        self._writer.put(lambda files: files.add(topic, stamp_ns, encode(build())), size)

    def batch(self, build: Callable[[], Iterable[Message]], size: int) -> None:
        """Append what ``build`` makes of frozen values: topic, stamp and payload of each; as `later`."""
        self._writer.put(lambda files: _add_all(files, build()), size)

    def text(self, stamp_ns: int, severity: int, text: str) -> None:
        """Append a STATUSTEXT as it was sent; ``severity`` is a MAV_SEVERITY."""
        self.later(TEXTS, stamp_ns, lambda: TextOut(stamp_ns=stamp_ns, severity=severity, text=text))
        self.later("/foxglove/log", stamp_ns, lambda: foxglove.log_of(stamp_ns, severity, text, "companion"))

    def config(self, config: Config, stamp_ns: int) -> None:
        """Append the resolved configuration that holds from here on."""
        head = {"version": __version__, "hash": config_hash(config), "config": msgspec.to_builtins(config)}
        payload = _ENCODER.encode(head)
        self._writer.put(lambda files: files.standing(CONFIG, stamp_ns, payload), len(payload))

    def frames(self, frames: tuple[DetectionFrame, ...], tick_ns: int) -> None:
        """Append the obstacle frames that a tick consumed."""
        for frame in frames:
            self._writer.put(partial(_add_frame, frame=frame, tick_ns=tick_ns), 200 * len(frame.detections))

    def packet(self, raw: bytes, unix_us: int, outgoing: bool) -> None:
        """Append one MAVLink packet, as it was on the wire, to the tlog."""
        if not is_secret(raw):
            self._writer.put(lambda files: files.packet(unix_us, raw), len(raw))

    def kick(self) -> None:
        """A tick is over: now is a good time to write."""
        self._writer.kick()

    def flush(self) -> None:
        """Wait until all that was appended is with the system. Not for the control path."""
        self._writer.flush()

    def close(self) -> None:
        """Write what waits and the index, end the thread; appending afterwards does nothing."""
        self._writer.close()

    def _declare_own(self) -> None:
        for suffix in ("companion/vehicle", "companion/setpoint", "companion/tracks", "companion/status"):
            kind = OUTGOING[suffix]
            self._files.declare(f"/{suffix}", kind.__name__, _schema(msgspec.json.schema(kind)))
        self._files.declare(OBSTACLES, "ObstacleFrame", _schema(msgspec.json.schema(ObstacleFrame)))
        self._files.declare(CONFIG, "Config", b'{"type":"object"}')
        for topic, record in ((METADATA, Provenance), (TEXTS, TextOut)):
            self._files.declare(topic, record.__name__, _schema(msgspec.json.schema(record)))
        for topic, drawn in foxglove.TOPICS.items():
            name, schema = foxglove.schema_of(drawn)
            self._files.declare(topic, name, _schema(schema))


def _schema(schema: dict[str, Any]) -> bytes:
    return _ENCODER.encode(foxglove.inlined(schema))


def _add_provenance(files: LogFiles, *, config: Config, unix_ns: int) -> None:
    told = provenance(config, unix_ns)
    values = msgspec.to_builtins(told)
    packages = values.pop("packages")
    files.describe({key: str(value) for key, value in (values | packages).items() if value is not None})
    files.standing(METADATA, 0, encode(told))


def _add_all(files: LogFiles, messages: Iterable[Message]) -> None:
    for topic, stamp_ns, payload in messages:
        files.add(topic, stamp_ns, payload)


def _add_frame(files: LogFiles, *, frame: DetectionFrame, tick_ns: int) -> None:
    files.add(OBSTACLES, tick_ns, _ENCODER.encode(_frame_json(frame)))


def _frame_json(frame: DetectionFrame) -> dict[str, Any]:
    return {
        "stamp_ns": frame.stamp_ns,
        "clock": "vehicle",
        "frame": "local_enu",
        "source": frame.source,
        "sequence": frame.sequence,
        "kind": frame.kind.value,
        "arrived_unix_ns": frame.arrived_unix_ns,
        "obstacles": [
            {
                "id": seen.id,
                "position": seen.p_enu.tolist(),
                "radius": seen.radius_m,
                "position_std": seen.p_std_m,
                "velocity": None if seen.v_enu is None else seen.v_enu.tolist(),
                "velocity_std": seen.v_std_m_s,
                "covariance": None if seen.covariance is None else _upper(seen.covariance.tolist()),
            }
            for seen in frame.detections
        ],
    }


def _upper(matrix: list[list[float]]) -> list[float]:
    return [value for i, row in enumerate(matrix) for value in row[i:]]
