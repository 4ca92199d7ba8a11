"""When the autopilot is asked for a mode: to engage, to release, and to hold after a fault in flight."""

from __future__ import annotations

from collections.abc import Callable

from companion.config import Config
from companion.profiles import ModeRequest
from companion.state import Situation, State
from companion.types import NS_PER_S

REPEAT_NS = NS_PER_S // 2


class ModeRequests:
    """The sequences, driven by `poll`.

    Args:
        ask: sends MAV_CMD_DO_SET_MODE.
    """

    def __init__(self, config: Config, ask: Callable[[ModeRequest], None]) -> None:
        self._ask = ask
        self.hold_wanted = False  # a fault in flight, or an external mode that came after a release
        self._sequence_ns: int | None = None  # start of the engage sequence
        self._requested_ns: int | None = None  # last request
        self._external_ns: int | None = None  # last request of the external mode
        self.adopt(config)

    def adopt(self, config: Config) -> None:
        """The profile is known."""
        self._config = config

    def engage(self) -> None:
        """The operator engages: begin anew, and forget that holding was wanted."""
        self._sequence_ns = None
        self.hold_wanted = False

    def at_once(self) -> None:
        """The next request does not wait for its turn."""
        self._requested_ns = None

    def are_ours(self, now_ns: int) -> bool:
        """Whether the external mode, seen now, is the one that was asked for."""
        timeout_ns = self._config.engage.timeout_s * NS_PER_S
        return self._external_ns is not None and now_ns - self._external_ns <= timeout_ns

    def poll_engage(self, situation: Situation, now_ns: int) -> bool:
        """Engaged but not in the external mode: stream for a while, then ask for it; True where it is given up."""
        s, engage = situation, self._config.engage
        if not (s.engaged and s.state is State.READY and s.airborne and not s.external):
            self._sequence_ns = None
            return False
        if self._sequence_ns is None:
            self._sequence_ns, self._requested_ns = now_ns, None
        since_s = (now_ns - self._sequence_ns) / NS_PER_S
        if since_s >= engage.stream_s + engage.timeout_s:
            return True
        if since_s >= engage.stream_s:
            self._external_ns = now_ns
            self._request(self._config.profile.external, now_ns)
        return False

    def poll_hold(self, situation: Situation, now_ns: int) -> None:
        """A release, or a fault in flight, asks for the hold mode until it is seen; what a pilot does then stands."""
        if situation.releasing or self.hold_wanted:
            self._request(self._config.profile.hold, now_ns)

    def _request(self, mode: ModeRequest, now_ns: int) -> None:
        if self._config.mode == "monitor":
            return
        if self._requested_ns is None or now_ns - self._requested_ns >= REPEAT_NS:
            self._requested_ns = now_ns
            self._ask(mode)
