"""What the operator is told as STATUSTEXT: not twice in a row, never a flood, and nothing lost without a word.

The same text is not sent again within 10 s unless another came between; two a second go out at most, after a burst
of five. What is more waits, sixteen at most, and the least severe of the older ones gives way. How many were repeated
or dropped is told afterwards in one line.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from companion.types import NS_PER_S

SAME_NS = 10 * NS_PER_S
BURST = 5
EVERY_NS = NS_PER_S // 2
WAITING = 16
NOTICE = 5  # MAV_SEVERITY of what is told about the texts themselves


@dataclass(slots=True)
class _Text:
    severity: int
    text: str
    repeats: int = 0  # while it waited


class TextGate:
    """A queue of texts. ``counts``: repeated, dropped."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._waiting: list[_Text] = []
        self._last: str | None = None  # the last text sent
        self._last_ns = 0
        self._repeats = 0  # of it, since
        self._dropped = 0  # not yet told
        self._allowance = float(BURST)
        self._taken_ns: int | None = None

    def push(self, severity: int, text: str) -> None:
        """One text; ``severity`` is a MAV_SEVERITY, 0 the worst."""
        if self._waiting and self._waiting[-1].text == text:
            self._waiting[-1].repeats += 1
            self.counts["repeated"] += 1
            return
        self._waiting.append(_Text(severity, text))
        if len(self._waiting) > WAITING:
            mildest = max(range(len(self._waiting)), key=lambda index: (self._waiting[index].severity, -index))
            lost = 1 + self._waiting.pop(mildest).repeats
            self._dropped += lost
            self.counts["dropped"] += lost

    def take(self, now_ns: int) -> list[tuple[int, str]]:
        """What may be sent now, in order: (severity, text)."""
        if self._taken_ns is not None:
            self._allowance = min(float(BURST), self._allowance + max(0, now_ns - self._taken_ns) / EVERY_NS)
        self._taken_ns = now_ns
        sent: list[tuple[int, str]] = []
        while self._allowance >= 1.0 and (said := self._next(now_ns)) is not None:
            self._allowance -= 1.0
            sent.append(said)
        return sent

    def _next(self, now_ns: int) -> tuple[int, str] | None:
        """The next text; a word about repeats goes before the one that ends them."""
        same_over = not 0 <= now_ns - self._last_ns < SAME_NS
        while self._waiting and self._waiting[0].text == self._last and not same_over:
            self._repeats += 1 + self._waiting.pop(0).repeats
            self.counts["repeated"] += 1
        if self._repeats and (self._waiting or same_over):
            told, self._repeats = f"(repeated {self._repeats} times: {self._last})", 0
            return NOTICE, told
        if self._waiting:
            said = self._waiting.pop(0)
            self._last, self._last_ns, self._repeats = said.text, now_ns, said.repeats
            return said.severity, said.text
        if self._dropped:
            told, self._dropped = f"companion: {self._dropped} texts dropped", 0
            return NOTICE, told
        return None
