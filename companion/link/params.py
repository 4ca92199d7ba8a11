"""The MAVLink parameter protocol of component 196, without input or output.

PARAM_REQUEST_LIST, PARAM_REQUEST_READ (by name or index) and PARAM_SET come in, PARAM_VALUE goes out. All parameters
are MAV_PARAM_TYPE_REAL32; the declared encoding is bytewise, which for floats is the same bytes as the C cast. What
is wanted waits as a set of names and leaves a few at a time with its value of then, so a list asked for twice is sent
once, and no request, however often it comes, can fill a serial line or the memory. Answers leave before the list.

Source: MAVLink parameter protocol, https://mavlink.io/en/services/parameter.html.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.link import mav

BURST = 4  # PARAM_VALUE at once
EVERY_NS = 25_000_000  # and then one: 40 a second are 1.5 kB/s, a quarter of a line of 57600 baud
REAL32 = 9  # MAV_PARAM_TYPE_REAL32

MSG_REQUEST_READ, MSG_REQUEST_LIST, MSG_SET = 20, 21, 23
REQUESTS = (MSG_REQUEST_READ, MSG_REQUEST_LIST, MSG_SET)


@dataclass(frozen=True, slots=True)
class ParamList:
    """PARAM_REQUEST_LIST."""


@dataclass(frozen=True, slots=True)
class ParamRead:
    """PARAM_REQUEST_READ; ``index`` counts where it is not negative, ``name`` otherwise."""

    name: str
    index: int


@dataclass(frozen=True, slots=True)
class ParamSet:
    """PARAM_SET; ``value`` as the float field held it, ``kind`` is the MAV_PARAM_TYPE that the sender believes in."""

    name: str
    value: float
    kind: int


ParamRequest: TypeAlias = ParamList | ParamRead | ParamSet


def is_for(message: Any, system: int) -> bool:
    """Whether a request is addressed to component 196 of ``system``, or to all components, or to all systems."""
    return message.target_system in (0, system) and message.target_component in (0, mav.COMPONENT)


def decode(message: Any) -> ParamRequest:
    """One of the three requests; numbers are checked by whoever knows the range, NaN included."""
    kind = message.get_msgId()
    if kind == MSG_REQUEST_LIST:
        return ParamList()
    if kind == MSG_REQUEST_READ:
        return ParamRead(message.param_id, message.param_index)
    return ParamSet(message.param_id, message.param_value, message.param_type)


def value_message(name: str, value: float, *, index: int, count: int) -> Any:
    """PARAM_VALUE."""
    return dialect.MAVLink_param_value_message(name.encode("ascii"), value, REAL32, count, index)


class ParameterServer:
    """Answers for a fixed list of parameters.

    Args:
        names: of all parameters, at most 16 characters each; their order is that of the indices.
        read: the value of one.
        write: sets one; why it is refused, or None. Changes are announced by whoever makes them, with ``announce``.
        refused: told why a PARAM_SET was refused, in one line.
    """

    def __init__(
        self,
        names: Sequence[str],
        *,
        read: Callable[[str], float],
        write: Callable[[str, float], str | None],
        refused: Callable[[str], None],
    ) -> None:
        self._names = tuple(names)
        self._indices = {name: index for index, name in enumerate(self._names)}
        self._read = read
        self._write = write
        self._refused = refused
        self._urgent: dict[str, None] = {}  # an ordered set
        self._listed: dict[str, None] = {}
        self._allowance = float(BURST)
        self._polled_ns: int | None = None

    @property
    def idle(self) -> bool:
        """Whether nothing waits to be sent."""
        return not self._urgent and not self._listed

    def handle(self, request: ParamRequest) -> None:
        """Take one request. Unknown names and indices get no answer, as the protocol has it."""
        match request:
            case ParamList():
                self._listed = dict.fromkeys(self._names)
            case ParamRead(name=name, index=index):
                if index >= 0:
                    name = self._names[index] if index < len(self._names) else ""
                if name in self._indices:
                    self.announce(name)
            case ParamSet(name=name) if name in self._indices:
                self._set(request)

    def announce(self, name: str) -> None:
        """Send the value of one parameter soon: it was asked for, or it has changed."""
        self._urgent[name] = None
        self._listed.pop(name, None)

    def take(self, now_ns: int) -> list[Any]:
        """The PARAM_VALUE messages that may leave now; ``now_ns`` from one monotonic clock."""
        if self._polled_ns is not None:
            self._allowance = min(float(BURST), self._allowance + max(0, now_ns - self._polled_ns) / EVERY_NS)
        self._polled_ns = now_ns
        messages = []
        while self._allowance >= 1.0 and not self.idle:
            waiting = self._urgent or self._listed
            name = next(iter(waiting))
            del waiting[name]
            self._allowance -= 1.0
            messages.append(
                value_message(name, self._read(name), index=self._indices[name], count=len(self._names)),
            )
        return messages

    def _set(self, request: ParamSet) -> None:
        """Set it; the sender hears the value that now holds, the old one where it was refused."""
        why: str | None
        if request.kind != REAL32:
            why = f"{request.name}: expected MAV_PARAM_TYPE_REAL32 (9), got type {request.kind}"
        else:
            why = self._write(request.name, request.value)
        if why is not None:
            self._refused(why)
        self.announce(request.name)
