"""Reading and setting parameters without input or output: repeated requests, answers, one fix after another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from companion.doctor import parameters
from companion.doctor.observation import Fix, same_value
from companion.types import NS_PER_S

REPEAT_NS = NS_PER_S // 2
TRIES = 4  # an unknown name gets no reply: it is given up after TRIES * REPEAT_NS
BURST = 4  # requests a poll: no flood on a slow serial line


@dataclass(slots=True)
class _Read:
    asked_ns: int | None = None
    tries: int = 0
    value: float | int | None = None
    param_type: int = 0

    def over(self, now_ns: int) -> bool:
        waited = self.asked_ns is not None and now_ns - self.asked_ns >= REPEAT_NS
        return self.value is not None or (self.tries >= TRIES and waited)


@dataclass(slots=True)
class _Write:
    """One fix: the value is set, read again, and set again where it did not arrive."""

    name: str
    wanted: float
    sent_ns: int | None = None
    tries: int = 0
    reads: int = 0  # since the last set
    result: Fix | None = None
    before: float | int | None = None
    answer: float | int | None = None


@dataclass(slots=True)
class ParameterDialogue:
    """With one autopilot.

    Args:
        kind: MAV_AUTOPILOT, which says how integers travel.
        names: to read.
        fixes: (name, value) pairs to write, each after its parameter was read; the type is that of the answer.
        writable: whether anything may be written now (a vehicle that is armed is left alone).
    """

    system: int
    component: int
    kind: int
    names: Sequence[str]
    fixes: Sequence[tuple[str, float]]
    writable: bool
    _reads: dict[str, _Read] = field(default_factory=dict)
    _writes: list[_Write] = field(default_factory=list)

    def __post_init__(self) -> None:
        wanted = [*self.names, *(name for name, _ in self.fixes)]
        self._reads = {name: _Read() for name in dict.fromkeys(wanted)}
        self._writes = [_Write(name, value) for name, value in self.fixes]

    def heard(self, message: Any) -> None:
        """A PARAM_VALUE of the autopilot."""
        read = self._reads.get(message.param_id)
        if read is None:
            return
        read.value, read.param_type = parameters.read_value(message, self.kind), message.param_type
        for write in self._writes:
            if write.name == message.param_id and write.reads and write.result is None:
                write.answer = read.value

    def poll(self, now_ns: int) -> list[Any]:
        """Messages to send now."""
        out: list[Any] = []
        for name, read in self._reads.items():
            due = read.asked_ns is None or now_ns - read.asked_ns >= REPEAT_NS
            if read.value is None and read.tries < TRIES and due and len(out) < BURST:
                read.asked_ns, read.tries = now_ns, read.tries + 1
                out.append(parameters.request(name, self.system, self.component))
        write = next((write for write in self._writes if write.result is None), None)
        if write is not None:
            out.extend(self._advance(write, now_ns))
        return out

    def finished(self, now_ns: int) -> bool:
        return all(read.over(now_ns) for read in self._reads.values()) and all(w.result for w in self._writes)

    @property
    def values(self) -> dict[str, float | int]:
        return {name: read.value for name, read in self._reads.items() if read.value is not None}

    @property
    def unanswered(self) -> tuple[str, ...]:
        return tuple(name for name, read in self._reads.items() if read.value is None)

    @property
    def done(self) -> tuple[Fix, ...]:
        return tuple(write.result for write in self._writes if write.result is not None)

    def _advance(self, write: _Write, now_ns: int) -> list[Any]:
        """The next step of one fix."""
        read = self._reads[write.name]
        if write.sent_ns is None:
            return self._begin(write, read, now_ns) if read.over(now_ns) else []
        if now_ns - write.sent_ns < REPEAT_NS and write.answer is None:
            return []
        if write.reads < TRIES and write.answer is None:  # the autopilot has had its time: what does it say now?
            write.reads, write.sent_ns = write.reads + 1, now_ns
            return [parameters.request(write.name, self.system, self.component)]
        arrived = write.answer is not None and same_value(write.answer, write.wanted)
        if arrived or write.tries >= TRIES:
            write.result = Fix(write.name, write.wanted, write.before, write.answer)
            return []
        return self._set(write, read, now_ns)

    def _begin(self, write: _Write, read: _Read, now_ns: int) -> list[Any]:
        refused = None
        if read.value is None:
            refused = "the autopilot does not know this name"
        elif not self.writable:
            refused = "the vehicle is armed"
        else:
            try:
                parameters.wire_value(write.wanted, read.param_type, self.kind)
            except ValueError as error:
                refused = str(error)
        if refused is not None or (read.value is not None and same_value(read.value, write.wanted)):
            write.result = Fix(write.name, write.wanted, read.value, read.value, refused)
            return []
        write.before = read.value
        return self._set(write, read, now_ns)

    def _set(self, write: _Write, read: _Read, now_ns: int) -> list[Any]:
        write.sent_ns, write.tries, write.reads, write.answer = now_ns, write.tries + 1, 0, None
        wire = parameters.wire_value(write.wanted, read.param_type, self.kind)
        return [parameters.setting(write.name, wire, read.param_type, self.system, self.component)]
