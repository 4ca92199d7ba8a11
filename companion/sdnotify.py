"""What systemd is told (sd_notify(3)): one datagram each to the socket that it names, without its library.

``NOTIFY_SOCKET`` is a path or, with a leading @, a name in the abstract namespace. ``WATCHDOG_USEC`` is the longest
silence that systemd bears, ``WATCHDOG_PID`` the process that it watches. Without NOTIFY_SOCKET nothing is sent.
"""

from __future__ import annotations

import os
import socket
from collections import Counter
from collections.abc import Mapping

NS_PER_US = 1_000


class Notifier:
    """Sends to one socket. Never blocks, never raises: what systemd does not take is counted and gone.

    ``counts``: sent, failed.

    Args:
        address: of the socket; None: nobody listens.
        watchdog_ns: the silence after which systemd ends the daemon; None: it does not watch.
    """

    def __init__(self, address: str | None, watchdog_ns: int | None = None) -> None:
        self.counts: Counter[str] = Counter()
        self._address = address
        # half of what systemd bears is its own advice (sd_watchdog_enabled(3))
        self._every_ns = None if watchdog_ns is None else watchdog_ns // 2
        self._fed_ns: int | None = None
        self._told = ""
        self._socket: socket.socket | None = None
        if address is not None:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._socket.setblocking(False)

    @classmethod
    def from_environment(cls, environment: Mapping[str, str], pid: int | None = None) -> Notifier:
        """As systemd has set the variables; one that is not understood counts as unset.

        >>> Notifier.from_environment({}).watches
        False
        """
        address = environment.get("NOTIFY_SOCKET", "")
        if address[:1] not in ("/", "@") or len(address) < 2:
            return cls(None)
        usec = environment.get("WATCHDOG_USEC", "")
        watched = environment.get("WATCHDOG_PID", "")
        ours = not watched or watched == str(os.getpid() if pid is None else pid)
        return cls(address, int(usec) * NS_PER_US if ours and usec.isascii() and usec.isdigit() and int(usec) else None)

    @property
    def watches(self) -> bool:
        """Whether systemd ends a daemon that goes silent."""
        return self._socket is not None and self._every_ns is not None

    def ready(self) -> None:
        """The links are open: units ordered after this one may start."""
        self._send("READY=1")

    def stopping(self) -> None:
        """The shutdown has begun."""
        self._send("STOPPING=1")

    def alive(self, now_ns: int, status: str) -> None:
        """The control task has made a turn: feed the watchdog when it is due, and tell ``status`` where it changed.

        ``now_ns`` is the monotonic clock.
        """
        if self._socket is None:
            return
        status = " ".join(status.split())  # a line break would begin another assignment
        words = []
        if self._every_ns is not None and (self._fed_ns is None or now_ns - self._fed_ns >= self._every_ns):
            self._fed_ns = now_ns
            words.append("WATCHDOG=1")
        if status != self._told:
            self._told = status
            words.append(f"STATUS={status}")
        if words:
            self._send("\n".join(words))

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, text: str) -> None:
        if self._socket is None or self._address is None:
            return
        address = "\0" + self._address[1:] if self._address[0] == "@" else self._address
        try:
            self._socket.sendto(text.encode(), address)
        except OSError:  # a full socket, or a systemd that restarts: the next turn tries again
            self.counts["failed"] += 1
            self._fed_ns = None if "WATCHDOG" in text else self._fed_ns
            self._told = "" if "STATUS" in text else self._told
        else:
            self.counts["sent"] += 1
