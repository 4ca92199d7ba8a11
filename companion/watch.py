"""What can go wrong between daemon and autopilot without ending the flight: noticed, counted, told once.

Setpoints that are not followed (`confirm`), a second sender of setpoints, streams that stop (`requests`), an
autopilot that is not the profile's. The answers are the operator's: none of it changes the state.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from companion.config import Config
from companion.confirm import Confirmation
from companion.link import mav
from companion.link.events import Heartbeat, SetpointEcho, SetpointHeard
from companion.notices import Notices
from companion.types import NS_PER_S, Vec3

SENDER_NS = 2 * NS_PER_S  # a second sender not heard for this long is gone


class AutopilotWatch:
    """Follows one autopilot.

    Args:
        say: tells the operator one line.
    """

    def __init__(self, config: Config, say: Callable[[str], None]) -> None:
        self.notices = Notices(say)
        self._heard: Counter[str] = Counter()
        self.adopt(config)

    def adopt(self, config: Config) -> None:
        """The profile is known."""
        self._profile = config.profile
        self._confirmation = Confirmation(config.profile, config.type_mask)
        self.restart()

    def restart(self) -> None:
        """The autopilot began anew."""
        self._confirmation.reset()
        self._sender: tuple[str, int] | None = None  # as told, last heard

    @property
    def counts(self) -> dict[str, int]:
        """By kind: conditions (how often each began), echoes, foreign setpoints."""
        return dict(self.notices.counts + self._confirmation.counts + self._heard)

    def clock_restarted(self, why: str, now_ns: int) -> None:
        """The vehicle's clock began anew or jumped, which is how a reboot shows first."""
        self.notices.happened("clock_restarts", f"{why}: tracks and time base start anew", now_ns)

    def unix_stepped(self, step_s: float, now_ns: int) -> None:
        """Our own clock was set: the stamps of sensor hosts that were not are off by as much."""
        self.notices.happened("unix_steps", f"companion's clock stepped by {step_s:+.1f} s", now_ns)

    def origin_moved(self, moved_m: float, now_ns: int) -> None:
        """The estimator was reset: targets and the arena now lie elsewhere on the ground."""
        self.notices.happened("origin_resets", f"estimator reset: the origin moved by {moved_m:.1f} m", now_ns)

    def heartbeat(self, beat: Heartbeat, now_ns: int) -> None:
        """Whether the autopilot is of the profile's kind."""
        expected = self._profile.autopilot
        heard, named = mav.autopilot_name(beat.autopilot), self._profile.name
        text = f"autopilot is {heard}, vehicle.profile is {named}" if beat.autopilot != expected else None
        self.notices.stand("other_autopilot", text, now_ns)

    def sent(self, a_enu: Vec3, now_ns: int) -> None:
        """A setpoint left while the autopilot obeys."""
        self._confirmation.sent(a_enu, now_ns)

    def echo(self, echo: SetpointEcho, now_ns: int) -> None:
        self._confirmation.echo(echo, now_ns)

    def overheard(self, setpoint: SetpointHeard, autopilot: tuple[int, int], now_ns: int) -> None:
        """A setpoint on the link that may be meant for our ``autopilot`` (system, component) and is not ours."""
        system, component = autopilot
        if setpoint.target_system not in (0, system) or setpoint.target_component not in (0, component):
            return
        if (setpoint.system, setpoint.component) == (system, mav.COMPONENT):
            return  # our own, sent back by a router
        self._heard["foreign_setpoints"] += 1
        name = mav.message_name(setpoint.message)
        self._sender = (f"{setpoint.system}/{setpoint.component} {name}", now_ns)

    def poll(self, now_ns: int, *, obeyed: bool, engaged: bool) -> None:
        """Time passes.

        Args:
            obeyed: setpoints go out and the autopilot is in its external mode.
            engaged: the latch: from then on a second sender is one too many.
        """
        if not obeyed:
            self._confirmation.reset()
        self.notices.stand("not_followed", self._confirmation.complaint(now_ns), now_ns)
        if self._sender is not None and now_ns - self._sender[1] > SENDER_NS:
            self._sender = None
        second = self._sender is not None and (obeyed or engaged)
        text = f"second setpoint sender: {self._sender[0]}" if self._sender and second else None
        self.notices.stand("second_sender", text, now_ns)
