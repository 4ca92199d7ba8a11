"""A serial port on the loop's readiness events, without a thread."""

from __future__ import annotations

import asyncio
import os
import termios
import tty
from collections import Counter

from companion.clock import Clock
from companion.link.url import FIRST_RETRY_S, LAST_RETRY_S, OnBytes, TransportUrl


class SerialPort:
    """A raw 8N1 port on the loop's own readiness events. Opening fails at once if the device is not there; a device
    lost in flight is opened again as a TCP peer would be."""

    def __init__(self, url: TransportUrl, on_bytes: OnBytes, clock: Clock) -> None:
        self.counts: Counter[str] = Counter()
        self._url = url
        self._on_bytes = on_bytes
        self._clock = clock
        self._fd: int | None = None
        self._reopening: asyncio.Task[None] | None = None
        self._open()

    def send(self, data: bytes) -> None:
        """A packet cut short by a full buffer fails its checksum at the receiver, as a lost one would."""
        if self._fd is None:
            return
        try:
            written = os.write(self._fd, data)
        except BlockingIOError:
            written = 0
        except OSError:
            self._lose()
            return
        self.counts["bytes_out"] += written
        self.counts["dropped"] += written < len(data)

    async def close(self) -> None:
        if self._reopening is not None:
            self._reopening.cancel()
            await asyncio.wait((self._reopening,))
        self._release()

    def _open(self) -> None:
        fd = os.open(self._url.host, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            _make_raw(fd, self._url.port)
        except termios.error as error:
            os.close(fd)
            raise OSError(error.args[0], f"not a serial port: {error.args[1]}") from None
        self._fd = fd
        asyncio.get_running_loop().add_reader(fd, self._read)

    def _read(self) -> None:
        assert self._fd is not None
        try:
            data = os.read(self._fd, 4096)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._lose()
            return
        self.counts["bytes_in"] += len(data)
        self._on_bytes(data)

    def _release(self) -> None:
        if self._fd is not None:
            asyncio.get_running_loop().remove_reader(self._fd)
            os.close(self._fd)
            self._fd = None

    def _lose(self) -> None:
        self._release()
        self.counts["losses"] += 1
        self._reopening = asyncio.get_running_loop().create_task(self._reopen(), name="serial")

    async def _reopen(self) -> None:
        retry_s = FIRST_RETRY_S
        while self._fd is None:
            await self._clock.sleep(retry_s)
            retry_s = min(2.0 * retry_s, LAST_RETRY_S)
            try:
                self._open()
            except OSError:
                self.counts["failed_connects"] += 1


def _make_raw(fd: int, baud: int) -> None:
    tty.setraw(fd)
    attributes = termios.tcgetattr(fd)
    speed = getattr(termios, f"B{baud}")
    attributes[2] |= termios.CLOCAL | termios.CREAD
    attributes[4] = attributes[5] = speed
    termios.tcsetattr(fd, termios.TCSANOW, attributes)
