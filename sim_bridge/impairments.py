"""What goes wrong on the way: messages lost, late, twice, out of order, damaged, on one direction of one link.

Every message of a channel passes its active impairments in their order. Chance comes from generators that are passed
in, one for each impairment and direction, and each message draws once: same seed, same losses. In lockstep a few
messages are timed by the wall clock (``timed`` false); they have a generator of their own and are never held back for
order's sake, so that they change nothing in what is drawn for the others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np

T = TypeVar("T")

_V1, _V2, _SIGNED = 0xFE, 0xFD, 0x01
_HEADER = {_V1: 6, _V2: 10}
KINDS = ("drop", "delay", "duplicate", "reorder", "corrupt", "cut", "freeze")


@dataclass(frozen=True, slots=True)
class Passage(Generic[T]):
    """A message that came out of a channel; ``intact`` false: damaged on the way."""

    item: T
    intact: bool = True


class Impairment(Generic[T]):
    """One fault on one direction of one link.

    Args:
        kind: of `KINDS`. drop: lost; delay: ``delay_ns`` late; duplicate: twice; reorder: after the next message;
            corrupt: one byte changed; cut: lost, whatever it is; freeze: the first comes again and again.
        share: of the messages, 0 to 1; cut and freeze hit all.
        rng, wall_rng: the chance for timed messages, and for those timed by the wall clock.
        damage: a message with one byte changed (corrupt).
    """

    def __init__(
        self,
        kind: str,
        *,
        share: float,
        delay_ns: int,
        rng: np.random.Generator,
        wall_rng: np.random.Generator,
        damage: Callable[[T, np.random.Generator], T],
    ) -> None:
        if kind not in KINDS:
            raise ValueError(f"impairment: expected one of {', '.join(KINDS)}, got {kind}")
        self.kind = kind
        self._share = share
        self._delay_ns = delay_ns
        self._rng = rng
        self._wall_rng = wall_rng
        self._damage = damage
        self._first: Passage[T] | None = None
        self._held: list[Passage[T]] = []

    def apply(self, passage: Passage[T], timed: bool) -> list[tuple[int, Passage[T]]]:
        """What becomes of one message: (extra delay [ns], message), in the order of sending."""
        if self.kind == "cut":
            return []
        if self.kind == "freeze":
            self._first = self._first or passage
            return [(0, self._first)]
        rng = self._rng if timed else self._wall_rng
        hit = bool(rng.random() < self._share)
        if self.kind == "reorder":
            return [(0, each) for each in self._swap(passage, hit and timed, timed)]
        if not hit:
            return [(0, passage)]
        if self.kind == "delay":
            return [(self._delay_ns, passage)]
        if self.kind == "duplicate":
            return [(0, passage), (0, passage)]
        if self.kind == "corrupt":
            return [(0, Passage(self._damage(passage.item, rng), intact=False))]
        return []  # drop

    def finish(self) -> list[Passage[T]]:
        """The fault is over: what it still holds."""
        held, self._held = self._held, []
        return held

    def _swap(self, passage: Passage[T], hit: bool, timed: bool) -> list[Passage[T]]:
        if not timed:
            return [passage]
        if hit:
            self._held.append(passage)
            return []
        return [passage, *self.finish()]


@dataclass(slots=True)
class Channel(Generic[T]):
    """One direction of one link: messages in, messages out, now or later.

    ``clock`` tells vehicle time [ns]. What was delayed comes out of `release`, in the order (due time, entry).
    """

    clock: Callable[[], int]
    impairments: list[Impairment[T]] = field(default_factory=list)
    _later: list[tuple[int, int, Passage[T]]] = field(default_factory=list)
    _entries: int = 0

    @property
    def clear(self) -> bool:
        """Nothing is in the way and nothing is on its way."""
        return not self.impairments and not self._later

    def pass_on(self, items: Iterable[T], *, timed: bool = True) -> list[Passage[T]]:
        """What of ``items`` comes out now."""
        now: list[Passage[T]] = []
        for item in items:
            for delay_ns, passage in self._through([(0, Passage(item))], timed):
                if delay_ns == 0:
                    now.append(passage)
                else:
                    self._keep(self.clock() + delay_ns, passage)
        return now

    def release(self) -> list[Passage[T]]:
        """What was delayed until now."""
        now_ns = self.clock()
        due = sorted((entry for entry in self._later if entry[0] <= now_ns), key=lambda entry: entry[:2])
        self._later = [entry for entry in self._later if entry[0] > now_ns]
        return [passage for _, _, passage in due]

    def remove(self, impairment: Impairment[T]) -> None:
        """The fault is over; what it held back for order's sake comes out at the next `release`."""
        self.impairments.remove(impairment)
        for passage in impairment.finish():
            self._keep(self.clock(), passage)

    def _keep(self, due_ns: int, passage: Passage[T]) -> None:
        self._later.append((due_ns, self._entries, passage))
        self._entries += 1

    def _through(self, entering: list[tuple[int, Passage[T]]], timed: bool) -> list[tuple[int, Passage[T]]]:
        for impairment in self.impairments:
            entering = [
                (before_ns + delay_ns, passage)
                for before_ns, each in entering
                for delay_ns, passage in impairment.apply(each, timed)
            ]
        return entering


def split(datagram: bytes) -> list[bytes]:
    """The MAVLink messages of one datagram, each whole with its signature; what is none comes as one last piece.

    >>> [len(m) for m in split(bytes([0xFD, 2, 0, 0, 0, 1, 1, 0, 0, 0, 7, 7, 9, 9]) * 2)]
    [14, 14]
    """
    messages, at = [], 0
    while at < len(datagram):
        size = _size(datagram, at)
        messages.append(datagram[at : at + size])
        at += size
    return messages


def message_id(message: bytes) -> int:
    """MAVLink message id of one packet, -1 where it is none."""
    if len(message) >= 12 and message[0] == _V2:
        return int.from_bytes(message[7:10], "little")
    return message[5] if len(message) >= 8 and message[0] == _V1 else -1


def payload(message: bytes) -> bytes:
    """Its payload as it travels: MAVLink 2 leaves trailing zeros out."""
    header = _HEADER.get(message[0], 0)
    return message[header : header + message[1]]


def damage_message(message: bytes, rng: np.random.Generator) -> bytes:
    """One byte of payload or checksum changed: the checksum no longer holds, the framing still does."""
    header = _HEADER.get(message[0], 0) if message else 0
    return damage_bytes(message, rng, start=header, end=header + message[1] + 2 if header else len(message))


def damage_bytes(data: bytes, rng: np.random.Generator, *, start: int = 0, end: int | None = None) -> bytes:
    """One byte of ``data[start:end]`` changed; the same number of draws whatever its length."""
    where, change = float(rng.random()), int(rng.integers(1, 256))
    stop = len(data) if end is None else min(end, len(data))
    if stop <= start:
        return data
    at = start + int(where * (stop - start))
    return data[:at] + bytes([data[at] ^ change]) + data[at + 1 :]


def join(passages: Sequence[Passage[bytes]]) -> bytes:
    """One datagram of what came out together."""
    return b"".join(passage.item for passage in passages)


def _size(datagram: bytes, at: int) -> int:
    left = len(datagram) - at
    size = left
    if left >= 12 and datagram[at] == _V2:
        size = 12 + datagram[at + 1] + (13 if datagram[at + 2] & _SIGNED else 0)
    elif left >= 8 and datagram[at] == _V1:
        size = 8 + datagram[at + 1]
    return min(size, left)
