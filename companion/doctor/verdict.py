"""One check's outcome, and what a list of them means."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum


class Level(StrEnum):
    PASS = "PASS"
    WARN = "WARN"
    FAIL = "FAIL"
    SKIP = "SKIP"  # could not be made; ``found`` says why


@dataclass(frozen=True, slots=True)
class Check:
    """One line: what was found beside what was expected."""

    level: Level
    name: str
    found: str
    expected: str = ""


def grade(name: str, found: str, expected: str, *, fail: bool = False, warn: bool = False) -> Check:
    """FAIL before WARN before PASS."""
    level = Level.FAIL if fail else Level.WARN if warn else Level.PASS
    return Check(level, name, found, expected)


def skip(name: str, why: str) -> Check:
    return Check(Level.SKIP, name, why)


def worst(checks: Iterable[Check]) -> Level:
    """FAIL, WARN or PASS; a check that could not be made decides nothing.

    >>> worst([skip("a", "no vehicle"), grade("b", "1", "2", warn=True)])
    <Level.WARN: 'WARN'>
    """
    levels = {check.level for check in checks}
    return next((level for level in (Level.FAIL, Level.WARN) if level in levels), Level.PASS)
