"""Is the daemon alive, and is it fit to fly: what `/livez` and `/healthz` answer, and systemd's watchdog goes by.

- **alive** (`/livez`): the control task has made a turn within `BEAT_LIMIT_S`. It turns at least five times a second,
  vehicle or not. A daemon that is not alive should be restarted. One whose loop is blocked does not answer at all.
- **healthy** (`/healthz`): alive, a vehicle with a fresh state, and the daemon not in FAULT, which is to say READY,
  ACTIVE, HOLD or, with the pilot flying, OVERRIDDEN. A daemon that is alive but not healthy waits for its vehicle or
  has told its operator what is wrong; a restart helps neither, so a container's liveness probe belongs on `/livez`.
"""

from __future__ import annotations

from typing import Any

from companion.clock import Clock
from companion.state import Situation, State

BEAT_LIMIT_S = 1.0  # the control task turns every 0.2 s


class Pulse:
    """When the control task last made a turn."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._beat_ns: int | None = None

    def beat(self) -> int:
        """The control task has made a turn; the monotonic clock now [ns]."""
        self._beat_ns = self._clock.monotonic_ns()
        return self._beat_ns

    @property
    def age_s(self) -> float | None:
        """Seconds since the last turn, None before the first."""
        return None if self._beat_ns is None else (self._clock.monotonic_ns() - self._beat_ns) / 1e9


def liveness(age_s: float | None) -> list[str]:
    """Why the daemon is not alive; empty where it is. ``age_s``: of the control task's last turn."""
    if age_s is None:
        return ["the control task has not started"]
    if age_s > BEAT_LIMIT_S:
        return [f"the control task has not turned for {age_s:.1f} s"]
    return []


def problems(age_s: float | None, situation: Situation) -> list[str]:
    """Why the daemon is not fit to fly; empty where it is.

    >>> problems(0.1, Situation(state=State.READY, reason="vehicle fresh", fresh=True))
    []
    """
    found = liveness(age_s)
    if not situation.fresh:
        found.append(f"no fresh vehicle state: {situation.reason}")
    if situation.state is State.FAULT:
        found.append(f"FAULT: {situation.reason}")
    return found


def report(age_s: float | None, situation: Situation, *, live_only: bool = False) -> tuple[int, dict[str, Any]]:
    """HTTP status and JSON body: 200 where nothing is wrong, 503 with the reasons otherwise."""
    found = liveness(age_s) if live_only else problems(age_s, situation)
    body = {
        "healthy": not found,
        "reasons": found,
        "state": situation.state.value,
        "reason": situation.reason,
        "control_age_s": None if age_s is None else round(age_s, 3),
    }
    return (503 if found else 200), body
