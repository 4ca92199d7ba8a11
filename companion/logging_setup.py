"""What the daemon says on standard error: lines for people, or one JSON object a line for machines.

A JSON line has ``time`` (RFC 3339, UTC), ``level``, ``logger`` and ``message``, ``vehicle``, an ``exception`` with its
whole traceback where there was one, and whatever the event was logged with (``extra``): ``state``, ``reason``, ``t_ns``
(vehicle time) and the like. Whatever an event holds, it is one line.
"""

from __future__ import annotations

import json
import logging
import math
import sys
from datetime import UTC, datetime
from typing import Any, Literal, TextIO

Format = Literal["text", "json"]
LEVELS = ("debug", "info", "warning", "error", "critical")

_TEXT = "%(asctime)s %(levelname)s %(message)s"
# what every record has; anything else came as `extra`
_STANDARD = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "taskName"}


class JsonFormatter(logging.Formatter):
    """A record as one line of JSON.

    Args:
        vehicle: its name, in every line.
    """

    def __init__(self, vehicle: str | None = None) -> None:
        super().__init__()
        self._vehicle = vehicle

    def format(self, record: logging.LogRecord) -> str:
        line: dict[str, Any] = {
            "time": rfc3339(record.created),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        if self._vehicle is not None:
            line["vehicle"] = self._vehicle
        for name, value in vars(record).items():
            if name not in _STANDARD and name not in line:
                line[name] = repr(value) if isinstance(value, float) and not math.isfinite(value) else value
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        if record.stack_info:
            line["stack"] = self.formatStack(record.stack_info)
        return json.dumps(line, default=str)  # in ASCII, so that no terminal or half a character can spoil a line


def rfc3339(unix_s: float) -> str:
    """Unix time as RFC 3339 in UTC, to the microsecond.

    >>> rfc3339(1_700_000_000.25)
    '2023-11-14T22:13:20.250000Z'
    """
    return datetime.fromtimestamp(unix_s, UTC).isoformat(timespec="microseconds").replace("+00:00", "Z")


def set_up_logging(
    *, format: Format, level: str, vehicle: str | None = None, stream: TextIO | None = None
) -> logging.Handler:
    """Send every record of ``level`` and above to ``stream`` (standard error) and nowhere else; Python's warnings too.

    ``level`` is one of `LEVELS`. Returns the handler.
    """
    handler = logging.StreamHandler(sys.stderr if stream is None else stream)
    handler.setFormatter(JsonFormatter(vehicle) if format == "json" else logging.Formatter(_TEXT))
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)
    logging.captureWarnings(True)
    return handler
