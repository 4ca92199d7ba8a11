"""Where the time of a loop goes: exclusive wall time by name, from calls that are wrapped on the objects themselves.

What runs inside a section that another one calls counts for the inner one alone, so the sections add up to the whole.
A wrapped call costs a fraction of a microsecond more: figures of speed are taken without sections.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
from msgspec import Struct

REST = "rest"


class Sections:
    """Exclusive time by section, from `start` on; what no section claims is ``rest``."""

    def __init__(self) -> None:
        self.ns: dict[str, int] = {}
        self._now = REST
        self._since_ns = 0

    def start(self) -> None:
        """Count from here."""
        self.ns = dict.fromkeys(self.ns, 0)
        self.ns[REST] = 0
        self._since_ns = time.perf_counter_ns()

    def ms_per(self, count: int) -> dict[str, float]:
        """Milliseconds of each section over ``count`` ticks, up to now, the largest first."""
        self._enter(self._now)
        shares = {name: spent / 1e6 / count for name, spent in self.ns.items()}
        return dict(sorted(shares.items(), key=lambda item: -item[1]))

    def timed(self, section: str, call: Callable[..., Any]) -> Callable[..., Any]:
        """``call``, its time counted for ``section``."""
        self.ns.setdefault(section, 0)

        def within(*args: Any, **keywords: Any) -> Any:
            outer = self._now
            self._enter(section)
            try:
                return call(*args, **keywords)
            finally:
                self._enter(outer)

        return within

    def wrap(self, owner: Any, section: str, *names: str) -> None:
        """Time these methods of one object (not of its class)."""
        for name in names:
            setattr(owner, name, self.timed(section, getattr(owner, name)))

    def module(self, section: str, module: Any) -> SimpleNamespace:
        """A stand-in for a module whose functions are timed, constants as they are."""
        return SimpleNamespace(
            **{
                name: self.timed(section, value) if callable(value) else value
                for name, value in vars(module).items()
                if not name.startswith("__")
            }
        )

    def _enter(self, section: str) -> None:
        now_ns = time.perf_counter_ns()
        self.ns[self._now] = self.ns.get(self._now, 0) + now_ns - self._since_ns
        self._now, self._since_ns = section, now_ns


class Case(Struct, frozen=True, kw_only=True):
    """Times of a control tick in ms, and vehicle time over wall time; a quantile is None of too few ticks."""

    name: str
    n: int
    p50: float
    p99: float | None  # of 100 ticks and more
    p999: float | None  # of 1000 and more
    max: float
    factor: float
    demand: float  # of the factor, at least
    acting: float | None = None  # share of the ticks in which the filter changed the reference; None: no filter
    sections: dict[str, float] = {}  # ms per tick by section, of a run of its own

    @property
    def met(self) -> bool:
        return self.factor >= self.demand


def case(
    name: str,
    ticks_ns: Sequence[int],
    factor: float,
    *,
    demand: float,
    sections: dict[str, float] | None = None,
    acting: float | None = None,
) -> Case:
    """A case out of the time of each tick."""
    p50, p99, p999 = (float(value) / 1e6 for value in np.quantile(ticks_ns, (0.5, 0.99, 0.999)))
    n = len(ticks_ns)
    return Case(
        name=name,
        n=n,
        p50=round(p50, 4),
        p99=round(p99, 4) if n >= 100 else None,
        p999=round(p999, 4) if n >= 1000 else None,
        max=round(max(ticks_ns) / 1e6, 4),
        factor=round(factor, 2),
        demand=demand,
        acting=None if acting is None else round(acting, 3),
        sections={key: round(value, 4) for key, value in (sections or {}).items()},
    )
