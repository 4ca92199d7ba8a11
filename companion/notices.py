"""Conditions that are not the state's reason and do not change it: each is told once when it begins."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from companion.types import NS_PER_S

AGAIN_NS = 10 * NS_PER_S  # one that comes and goes is told this often at most


class Notices:
    """What stands, by key; ``counts`` has how often each began.

    Args:
        say: tells the operator one line.

    >>> told: list[str] = []
    >>> notices = Notices(told.append)
    >>> for now_s, text in enumerate(["late", "late", None, "late"]):
    ...     notices.stand("clock", text, now_s * 10**9)
    >>> told, notices.standing, notices.counts["clock"]
    (['late'], ('late',), 2)
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._standing: dict[str, str] = {}
        self._told_ns: dict[str, int] = {}
        self.counts: Counter[str] = Counter()

    @property
    def standing(self) -> tuple[str, ...]:
        """The conditions of now, sorted."""
        return tuple(sorted(self._standing.values()))

    def stand(self, key: str, text: str | None, now_ns: int) -> None:
        """Condition ``key`` holds as ``text`` says, or no longer (None)."""
        before = self._standing.get(key)
        if text == before:
            return
        if text is None:
            del self._standing[key]
            return
        self._standing[key] = text
        self.counts[key] += before is None
        self._tell(key, text, now_ns)

    def happened(self, key: str, text: str, now_ns: int) -> None:
        """Something that is over already: counted each time, told as often as the others."""
        self.counts[key] += 1
        self._tell(key, text, now_ns)

    def _tell(self, key: str, text: str, now_ns: int) -> None:
        told_ns = self._told_ns.get(key)
        if told_ns is None or not 0 <= now_ns - told_ns < AGAIN_NS:
            self._told_ns[key] = now_ns
            self._say(text)
