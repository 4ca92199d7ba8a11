"""The log of a flight: an MCAP file of JSON messages with named JSON Schemas, which Foxglove and `mcap` open.

Topics: ``/companion/config`` (resolved configuration, its hash and versions, first), ``/companion/input/obstacles``
(frames as the brain consumed them, vehicle clock, ENU), ``/companion/vehicle``, ``/companion/setpoint``,
``/companion/tracks``, ``/companion/status``. Times are nanoseconds of the vehicle's clock.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
from mcap.writer import CompressionType, Writer

from companion import __version__
from companion.config import Config, config_hash
from companion.errors import ConfigError
from companion.link.wire import OUTGOING, ObstacleFrame
from companion.types import DetectionFrame

_ENCODER = msgspec.json.Encoder()


class Recorder:
    """Appends a flight to one file; ``close`` writes the index (a file cut short still opens with recovery).

    Raises:
        ConfigError: the file cannot be created.
    """

    def __init__(self, path: Path, config: Config) -> None:
        self.path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("wb")
        except OSError as error:
            raise ConfigError(f"log.directory: {path.parent}: cannot write there ({error.strerror})") from None
        self._writer: Any = Writer(self._file, compression=CompressionType.NONE)
        self._writer.start(profile="", library=f"companion {__version__}")
        self._channels: dict[str, int] = {}
        for suffix in ("companion/vehicle", "companion/setpoint", "companion/tracks", "companion/status"):
            self._register(f"/{suffix}", OUTGOING[suffix].__name__, msgspec.json.schema(OUTGOING[suffix]))
        self._register("/companion/input/obstacles", "ObstacleFrame", msgspec.json.schema(ObstacleFrame))
        self._register("/companion/config", "Config", {"type": "object"})
        head = {"version": __version__, "hash": config_hash(config), "config": msgspec.to_builtins(config)}
        self.message("/companion/config", 0, _ENCODER.encode(head))

    def message(self, topic: str, stamp_ns: int, payload: bytes) -> None:
        """Append one JSON message."""
        self._writer.add_message(self._channels[topic], log_time=stamp_ns, data=payload, publish_time=stamp_ns)

    def frames(self, frames: tuple[DetectionFrame, ...], tick_ns: int) -> None:
        """Append the obstacle frames that a tick consumed."""
        for frame in frames:
            self.message("/companion/input/obstacles", tick_ns, _ENCODER.encode(_frame_json(frame)))

    def close(self) -> None:
        self._writer.finish()
        self._file.close()

    def _register(self, topic: str, name: str, schema: dict[str, Any]) -> None:
        schema_id = self._writer.register_schema(name=name, encoding="jsonschema", data=_ENCODER.encode(schema))
        self._channels[topic] = self._writer.register_channel(topic=topic, message_encoding="json", schema_id=schema_id)


def _frame_json(frame: DetectionFrame) -> dict[str, Any]:
    return {
        "stamp_ns": frame.stamp_ns,
        "clock": "vehicle",
        "frame": "local_enu",
        "source": frame.source,
        "sequence": frame.sequence,
        "kind": frame.kind.value,
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
