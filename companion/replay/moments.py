"""Moments of a flight: seconds after it was engaged, or a stamp."""

from __future__ import annotations

import msgspec

from companion.errors import ConfigError
from companion.logbook.reader import FlightLog
from companion.state import State
from companion.types import NS_PER_S


class _Head(msgspec.Struct):
    stamp_ns: int
    state: str


_HEADS = msgspec.json.Decoder(_Head)


def engaged_ns(log: FlightLog) -> int:
    """The stamp of the first tick that was flown (ACTIVE), of the first tick at all where none was.

    Raises:
        ConfigError: the log holds no tick.
    """
    first: int | None = None
    for message in log.messages("/companion/setpoint"):
        head = _HEADS.decode(message.data)
        first = head.stamp_ns if first is None else first
        if head.state == State.ACTIVE.value:
            return head.stamp_ns
    if first is None:
        raise ConfigError(f"{log.path}: no message on /companion/setpoint, expected the log of a flight")
    return first


def moment_ns(option: str, text: str, origin_ns: int) -> int:
    """``text`` as a stamp: "2.5" seconds after ``origin_ns``, "123456ns" itself.

    Raises:
        ConfigError: it is neither.
    """
    try:
        if text.endswith("ns"):
            return int(text.removesuffix("ns"))
        return origin_ns + round(float(text) * NS_PER_S)
    except (ValueError, OverflowError):
        raise ConfigError(
            f"{option} {text}: expected seconds after engaging such as 2.5, or a stamp such as 123ns"
        ) from None
