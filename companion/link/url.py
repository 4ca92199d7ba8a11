"""What every transport has in common: its URL, its interface, its limits."""

from __future__ import annotations

import re
import termios
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from companion.errors import ConfigError

OnBytes = Callable[[bytes], None]
MAX_BACKLOG_BYTES = 8192  # beyond this a stream's message is dropped: it would leave too late
FIRST_RETRY_S, LAST_RETRY_S = 0.2, 5.0

_EXPECTED = "expected udpin://HOST:PORT, udpout://, tcpin://, tcpout:// or serial:///dev/NAME:BAUD"
_NETWORK = re.compile(r"(udpin|udpout|tcpin|tcpout)://(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9_.-]+):([0-9]{1,5})/?")
_SERIAL = re.compile(r"serial://(/[^:]+):([0-9]+)")


class Transport(Protocol):
    """An open link. ``counts``: bytes_in, bytes_out, dropped (messages that could not leave at once)."""

    counts: Counter[str]

    def send(self, data: bytes) -> None:
        """Send at once or drop; never blocks, never raises."""

    async def close(self) -> None: ...


@dataclass(frozen=True, slots=True)
class TransportUrl:
    """A parsed URL: ``host`` is the device of a serial port, ``port`` its baud rate."""

    scheme: str
    host: str
    port: int


def parse_url(url: str, key: str = "mavlink.url") -> TransportUrl:
    """The parts of a transport URL; ``key`` is where the configuration has it.

    >>> parse_url("udpin://0.0.0.0:14540")
    TransportUrl(scheme='udpin', host='0.0.0.0', port=14540)

    Raises:
        ConfigError: naming the URL and the expectation.
    """
    if match := _NETWORK.fullmatch(url):
        scheme, host, port = match[1], match[2].strip("[]"), int(match[3])
        lowest = 0 if scheme.endswith("in") else 1
        if not lowest <= port <= 65535:
            raise ConfigError(f"{key} {url}: expected a port within {lowest}..65535")
        return TransportUrl(scheme, host, port)
    if match := _SERIAL.fullmatch(url):
        if not hasattr(termios, f"B{match[2]}"):
            raise ConfigError(f"{key} {url}: expected a standard baud rate such as 57600 or 921600")
        return TransportUrl("serial", match[1], int(match[2]))
    raise ConfigError(f"{key} {url}: {_EXPECTED}")
