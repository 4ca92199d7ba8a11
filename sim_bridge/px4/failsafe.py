"""PX4's failsafe framework: what several failing conditions together make of the flight.

Each condition asks for an action; the worst of those active is chosen. First the vehicle holds COM_FAIL_ACT_T seconds
so that the pilot notices, then the action is carried out, unless the pilot takes over by a mode change or with the
sticks, as the condition allows. An action ends with its condition, at the next mode change or at disarming, as it
says. A termination is for ever.

Source: PX4 1.15, user guide "Safety Configuration", and commander's failsafe framework.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum, IntEnum


class Action(IntEnum):
    """In the order of severity."""

    NONE = 0
    WARN = 1
    POSITION = 2
    ALTITUDE = 3
    STABILIZED = 4
    HOLD = 5
    RETURN = 6
    LAND = 7
    DISARM = 9
    TERMINATE = 10


class Takeover(IntEnum):
    """How the pilot may take over, the most restrictive of the active conditions counts."""

    ALWAYS = 0
    MODE_SWITCH = 1
    NEVER = 2
    AUTO = 3  # ALWAYS after the hold of COM_FAIL_ACT_T, MODE_SWITCH where there is none


class Clear(Enum):
    """When an action ends."""

    WITH_CONDITION = "with its condition"
    MODE_CHANGE_OR_DISARM = "at a mode change or at disarming"
    NEVER = "never"


@dataclass(frozen=True, slots=True)
class Reaction:
    """What a failing condition asks for."""

    cause: str
    action: Action
    takeover: Takeover = Takeover.AUTO
    clear: Clear = Clear.WITH_CONDITION


@dataclass(frozen=True, slots=True)
class Verdict:
    """What to do now; ``delayed`` is what comes after the hold."""

    action: Action = Action.NONE
    delayed: Action = Action.NONE
    cause: str = ""
    taken_over: bool = False  # the pilot flies in spite of a failsafe
    by_sticks: bool = False  # and wants Position mode
    notify: bool = False


@dataclass(slots=True)
class _Active:
    reaction: Reaction
    failing: bool = True


_FLOWN = (Action.HOLD, Action.RETURN, Action.LAND)  # the pilot may take over from these


class Failsafe:
    """The active conditions of one vehicle. ``fallback`` of `update` is asked what a mode that cannot run falls to."""

    def __init__(self) -> None:
        self._active: dict[str, _Active] = {}
        self._verdict = Verdict()
        self._delay_s = 0.0
        self._armed = False

    @property
    def verdict(self) -> Verdict:
        return self._verdict

    def update(
        self,
        failing: Mapping[str, Reaction],
        *,
        armed: bool,
        changed: bool,
        sticks: bool,
        landing: bool,
        fallback: Callable[[bool], Reaction | None],
        hold_s: float,
        dt_s: float,
    ) -> Verdict:
        """One look at the conditions.

        Args:
            failing: by name of the condition.
            armed: nothing but a warning happens on a disarmed vehicle.
            changed: the pilot asked for a mode since the last look.
            sticks: the pilot moved the sticks enough to take over.
            landing: the pilot's mode is Land: Return would be a step back.
            fallback: what the pilot's mode (True: Position, after a takeover by sticks) falls back to.
            hold_s: COM_FAIL_ACT_T.
            dt_s: since the last look.
        """
        before = self._verdict
        taken_over = before.taken_over and armed == self._armed
        if armed != self._armed or changed or taken_over:
            self._drop(lambda a: not a.failing and a.reaction.clear is Clear.MODE_CHANGE_OR_DISARM)
        self._armed = armed
        self._delay_s = max(0.0, self._delay_s - dt_s)
        own = fallback(False)
        added = self._note({**failing, **({} if own is None else {"mode": own})}, hold_s)
        if any(action >= Action.HOLD for action in added):
            taken_over = False
        if before.action > Action.HOLD or taken_over:
            self._delay_s = 0.0
        verdict = self._select(before, changed=changed, sticks=sticks, taken_over=taken_over, fallback=fallback)
        if landing and Action.RETURN in (verdict.action, verdict.delayed):
            verdict = Verdict(Action.WARN, Action.NONE, verdict.cause, verdict.taken_over)
        worse = verdict.action > before.action or (verdict.action is not Action.NONE and Action.WARN in added)
        self._verdict = Verdict(
            verdict.action,
            verdict.delayed,
            verdict.cause,
            verdict.taken_over,
            verdict.by_sticks,
            notify=worse and not verdict.taken_over,
        )
        return self._verdict

    def _drop(self, unwanted: Callable[[_Active], bool]) -> None:
        self._active = {name: active for name, active in self._active.items() if not unwanted(active)}

    def _note(self, failing: Mapping[str, Reaction], hold_s: float) -> list[Action]:
        """Bring the active conditions up to date; the actions that are new."""
        for name, active in self._active.items():
            active.failing = name in failing
        self._drop(lambda a: not a.failing and a.reaction.clear is Clear.WITH_CONDITION)
        added = []
        for name, reaction in failing.items():
            known = self._active.get(name)
            if known is not None:
                known.reaction = Reaction(
                    reaction.cause, reaction.action, known.reaction.takeover, known.reaction.clear
                )
                continue
            takeover = reaction.takeover
            if takeover is Takeover.AUTO:
                takeover = Takeover.ALWAYS if hold_s > 0.1 else Takeover.MODE_SWITCH
                if hold_s > 0.1 and reaction.action > Action.WARN and self._delay_s <= 0.0 and self._armed:
                    self._delay_s = hold_s
            self._active[name] = _Active(Reaction(reaction.cause, reaction.action, takeover, reaction.clear))
            added.append(reaction.action)
        return added

    def _select(
        self,
        before: Verdict,
        *,
        changed: bool,
        sticks: bool,
        taken_over: bool,
        fallback: Callable[[bool], Reaction | None],
    ) -> Verdict:
        if before.action is Action.TERMINATE:
            return before
        if not self._armed or not self._active:
            return Verdict()
        worst = max((active.reaction for active in self._active.values()), key=lambda r: r.action)
        allowed = max(active.reaction.takeover for active in self._active.values())
        action, delayed = worst.action, Action.NONE
        delays = self._delay_s > 0.0 and not taken_over and allowed <= Takeover.MODE_SWITCH
        if delays and Action.WARN < action < Action.DISARM:
            action, delayed, allowed = Action.HOLD, action, Takeover.MODE_SWITCH
        switched = changed and before.action is action
        by_sticks = sticks and not taken_over and allowed is Takeover.ALWAYS
        takes = taken_over or switched or by_sticks
        if action in _FLOWN and takes and allowed <= Takeover.MODE_SWITCH:
            refuge = fallback(by_sticks)
            action = Action.WARN if refuge is None else max(Action.WARN, refuge.action)
            return Verdict(action, Action.NONE, worst.cause, taken_over=True, by_sticks=by_sticks)
        return Verdict(action, delayed, worst.cause)
