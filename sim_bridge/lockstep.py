"""Lockstep's bookkeeping, without sockets: what the companion still owes for a tick, what the operator owes for a step.

A tick of time T is answered by one record of stamp T; where that says ``sent``, also by a setpoint of time_boot_ms
T, and by as many further MAVLink messages as it counts. Operator commands that come before their tick are kept and
applied on their tick; a command that was applied and comes again is answered again, not applied twice.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from sim_bridge.craft import Craft
from sim_bridge.errors import SimError
from sim_bridge.mavlink import Packet
from sim_bridge.messages import Cmd, Command
from sim_bridge.placement import step_command
from sim_bridge.scenario import OperatorStep

COMPANION = 196  # MAV_COMP_ID_OBSTACLE_AVOIDANCE
UNCOUNTED_IDS = {0, 22, 148, 247, 390}  # heartbeats, and what is timed by the wall clock: no part of a tick's answer
SETPOINT_ID = 84
_HOLDS = ((4.0, 3.0), (17.0, 0.0), (5.0, 0.0))  # DO_SET_MODE of hold: PX4's AUTO.LOITER, ArduCopter's BRAKE, LOITER


class LockstepStalled(SimError):
    """A participant did not answer in time; the message names what was missing."""


class Answer:
    """What has come in for the tick of time ``t_ns``."""

    def __init__(self, t_ns: int, record_key: str) -> None:
        self.t_ns = t_ns
        self.progress = 0  # counts what has come in, for the wall guard
        self._record_key = record_key
        self._record: tuple[bool, int] | None = None
        self._setpoint = False
        self._others = 0

    def record(self, stamp_ns: int, *, sent: bool, messages: int) -> None:
        if stamp_ns == self.t_ns:
            self._record = (sent, messages)
            self.progress += 1

    def packet(self, message_id: int, component: int, time_boot_ms: int | None) -> None:
        """A MAVLink message of the onboard link; what is timed by the wall clock does not count."""
        if component != COMPANION or message_id in UNCOUNTED_IDS:
            return
        if message_id == SETPOINT_ID:
            self._setpoint = self._setpoint or time_boot_ms == self.t_ns // 1_000_000
        else:
            self._others += 1
        self.progress += 1

    @property
    def complete(self) -> bool:
        if self._record is None:
            return False
        sent, messages = self._record
        return (self._setpoint or not sent) and self._others >= messages

    def missing(self) -> str:
        """What the companion still owes, in words."""
        if self._record is None:
            return f"no record of stamp_ns {self.t_ns} on {self._record_key}"
        sent, messages = self._record
        owed = []
        if sent and not self._setpoint:
            owed.append(f"no SET_POSITION_TARGET_LOCAL_NED of time_boot_ms {self.t_ns // 1_000_000}")
        if self._others < messages:
            owed.append(f"{self._others} of {messages} further MAVLink messages")
        return " and ".join(owed) + f" from component {COMPANION} for the tick {self.t_ns} ns"


@dataclass(frozen=True, slots=True)
class Offer:
    """An operator's command and the packet in which it came."""

    command: Command
    packet: Packet


class Desk:
    """The operator's steps in their order, commands kept until their tick, answers kept for repetitions."""

    def __init__(self, steps: tuple[OperatorStep, ...]) -> None:
        self._steps = steps
        self._next = 0
        self._kept: dict[int, Offer] = {}  # by index of the step
        self._answered: dict[tuple[object, ...], bytes] = {}

    @property
    def next_step(self) -> OperatorStep | None:
        return self._steps[self._next] if self._next < len(self._steps) else None

    def take(self, offer: Offer) -> bytes | None:
        """Keep a command that belongs to a coming step.

        Returns:
            None if it is no step's business; else the bytes to answer with now, empty while its tick has not come.
        """
        command, identity = offer.command, _identity(offer.command)
        step = self.next_step
        if identity in self._answered and (step is None or not _belongs(step, command)):
            return self._answered[identity]
        for index in range(self._next, len(self._steps)):
            if not _belongs(self._steps[index], command):
                continue
            kept = self._kept.get(index)
            if kept is None:
                self._kept[index] = offer
                return b""
            if _identity(kept.command) == identity:
                return b""
        return None

    def ready(self) -> Offer | None:
        """The command of the next step, once it is here."""
        return self._kept.get(self._next)

    def done(self, answer: bytes) -> None:
        """The next step is applied; ``answer`` is what a repetition of its command gets."""
        self._answered[_identity(self._kept.pop(self._next).command)] = answer
        self._next += 1


def step_due(step: OperatorStep, craft: Craft, period_ns: int, *, ended: bool) -> bool:
    """Whether it is time for ``step`` of ``craft``; ``ended``: the flight is over."""
    if step.at_tick is not None:
        return craft.t_ns >= step.at_tick * period_ns
    if step.after == "airborne_hover":
        return craft.autopilot.hovering(craft.t_ns)
    if step.after == "on_ground":
        return not craft.autopilot.airborne
    return ended


def _identity(command: Command) -> tuple[object, ...]:
    """Equal for a command and its repetition; NaN parameters count as equal."""
    params = struct.pack("<7d", *command.params)
    return (command.command, params, command.sender, command.target_system, command.target_component)


def _belongs(step: OperatorStep, command: Command) -> bool:
    number, component, param1 = step_command(step)
    if command.command != number or command.target_component not in ({1: (0, 1)}.get(component, (component,))):
        return False
    if number == Cmd.DO_SET_MODE:
        return command.params[1:3] in _HOLDS
    return param1 is None or command.params[0] == param1
