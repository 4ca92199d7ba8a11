"""Which messages the autopilot is asked to stream: SET_MESSAGE_INTERVAL until each arrives, and again when it stops.

Intervals hold for one link and end with a reboot of the autopilot, which may come back without a word: what stops is
asked for again, however it came about.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from companion.types import NS_PER_S

RETRY_NS = 2 * NS_PER_S
LOST_NS = NS_PER_S  # a stream of 3 Hz or more is lost after this, a slower one after
LOST_PERIODS = 3
ALIVE_PERIODS = 2  # a heartbeat this much later than a stream's last message: it is the stream, not the link


class StreamRequests:
    """Asks, and knows what arrives.

    Args:
        ask: sends a request for a message id at a rate [Hz].
    """

    def __init__(self, ask: Callable[[int, float], None]) -> None:
        self._ask = ask
        self.restart()

    def restart(self) -> None:
        """The autopilot began anew: it forgot what it was asked for."""
        self._asked_ns: dict[int, int] = {}
        self._heard_ns: dict[int, int] = {}

    def heard(self, message: int, now_ns: int) -> None:
        """A message arrived."""
        self._heard_ns[message] = now_ns

    def poll(self, wanted: Mapping[int, float], now_ns: int, heartbeat_ns: int | None) -> set[int]:
        """Ask for what does not arrive of ``wanted`` (id: rate [Hz]), every two seconds.

        Args:
            heartbeat_ns: the last heartbeat of the autopilot.
        Returns:
            Those that have stopped while heartbeats went on.
        """
        stopped = set()
        for message, rate_hz in wanted.items():
            asked_ns, heard_ns = self._asked_ns.get(message), self._heard_ns.get(message)
            lost_ns = max(LOST_NS, round(LOST_PERIODS * NS_PER_S / rate_hz))
            arriving = heard_ns is not None and now_ns - heard_ns <= lost_ns
            alive_ns = ALIVE_PERIODS * NS_PER_S / rate_hz
            if (
                heard_ns is not None
                and not arriving
                and heartbeat_ns is not None
                and heartbeat_ns - heard_ns > alive_ns
            ):
                stopped.add(message)
            if asked_ns is None or (not arriving and now_ns - asked_ns >= RETRY_NS):
                self._asked_ns[message] = now_ns
                self._ask(message, rate_hz)
        return stopped
