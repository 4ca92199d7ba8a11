"""The log of a flight: an MCAP file of JSON messages with named JSON Schemas, which Foxglove and `mcap` open.

Topics: ``/companion/config`` (resolved configuration, its hash and version: first, and again when live parameters
change), ``/companion/input/obstacles`` (frames as the brain consumed them, vehicle clock, ENU),
``/companion/brain`` (every call of the shell into the brain, see `journal`), ``/companion/vehicle``,
``/companion/setpoint``, ``/companion/tracks``, ``/companion/status``. Times are nanoseconds of the vehicle's clock.
"""

from __future__ import annotations

import contextlib
import itertools
from io import BufferedWriter
from pathlib import Path
from typing import Any

import msgspec
from mcap.writer import CompressionType, Writer

from companion import __version__, journal_format
from companion.config import Config, config_hash
from companion.errors import ConfigError
from companion.link.wire import OUTGOING, ObstacleFrame

CHUNK_BYTES = 65536  # what the writer holds back between two flushes at most

_ENCODER = msgspec.json.Encoder()


class Recorder:
    """Appends a flight to one file, the first of ``flight.mcap``, ``flight-1.mcap``, ... that does not exist yet.

    ``flush``, called once a second, hands all that was appended to the system: a daemon that is killed loses no more
    than that second, and the file still reads from front to back. ``close`` writes the index. A disk that fails ends
    the log and not the flight: after the first OSError nothing is written any more and ``failure`` tells why.

    Raises:
        ConfigError: the file cannot be created (the constructor only; nothing else raises).
    """

    def __init__(self, path: Path, config: Config) -> None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = _create(path)
        except OSError as error:
            raise ConfigError(f"log.directory: {path.parent}: cannot write there ({error.strerror})") from None
        self.path = Path(self._file.name)
        self.failure: str | None = None
        self._open = True
        self._writer: Any = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE)
        self._channels: dict[str, int] = {}
        try:
            self._start()
        except OSError as error:
            self._fail(error)
        self.config(config, 0)
        self.flush()

    def config(self, config: Config, stamp_ns: int) -> None:
        """Append the resolved configuration that holds from here on."""
        head = {"version": __version__, "hash": config_hash(config), "config": msgspec.to_builtins(config)}
        self.message("/companion/config", stamp_ns, _ENCODER.encode(head))

    def message(self, topic: str, stamp_ns: int, payload: bytes) -> None:
        """Append one JSON message."""
        if not self._open:
            return
        try:
            self._writer.add_message(self._channels[topic], log_time=stamp_ns, data=payload, publish_time=stamp_ns)
        except OSError as error:
            self._fail(error)

    def flush(self) -> None:
        """Write the chunk in progress and hand it to the system, which keeps it when this process is killed."""
        if not self._open:
            return
        try:
            self._writer.flush()
        except OSError as error:
            self._fail(error)

    def close(self) -> None:
        """Write the index; appending afterwards does nothing."""
        if not self._open:
            return
        try:
            self._writer.finish()
            self._file.close()
        except OSError as error:
            self._fail(error)
        self._open = False

    def _fail(self, error: OSError) -> None:
        self.failure = f"{self.path}: the log ends here ({error.strerror or error})"
        self._open = False
        with contextlib.suppress(OSError):  # closing writes what is still buffered, and fails as the write did
            self._file.close()

    def _start(self) -> None:
        self._writer.start(profile="", library=f"companion {__version__}")
        for suffix in ("companion/vehicle", "companion/setpoint", "companion/tracks", "companion/status"):
            self._register(f"/{suffix}", OUTGOING[suffix].__name__, msgspec.json.schema(OUTGOING[suffix]))
        self._register("/companion/input/obstacles", "ObstacleFrame", msgspec.json.schema(ObstacleFrame))
        self._register("/companion/config", "Config", {"type": "object"})
        self._register(
            journal_format.TOPIC, "BrainCall", {"type": "object", **msgspec.json.schema(journal_format.Call)}
        )

    def _register(self, topic: str, name: str, schema: dict[str, Any]) -> None:
        schema_id = self._writer.register_schema(name=name, encoding="jsonschema", data=_ENCODER.encode(schema))
        self._channels[topic] = self._writer.register_channel(topic=topic, message_encoding="json", schema_id=schema_id)


def _create(path: Path) -> BufferedWriter:
    """A new file: a daemon that was restarted must not destroy the log of what came before."""
    for number in itertools.count():
        name = path if number == 0 else path.with_stem(f"{path.stem}-{number}")
        with contextlib.suppress(FileExistsError):
            return name.open("xb")
    raise AssertionError("itertools.count ends")
