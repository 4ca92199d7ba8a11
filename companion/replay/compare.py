"""Recorded answers against those of this version: equal to the bit, or where they part."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import msgspec

from companion.journal_format import answer_of
from companion.link import wire
from companion.link.wire import SetpointRecord
from companion.replay.player import Played
from companion.report import setpoint_record, tracks_out
from companion.state import State


@dataclass(frozen=True, slots=True)
class Difference:
    """The first field of a tick that is not as recorded."""

    stamp_ns: int
    field: str
    recorded: Any
    replayed: Any


@dataclass(slots=True)
class Comparison:
    """What a replay amounted to."""

    ticks: int = 0
    compared: int = 0  # ticks of which the log holds an answer
    differing: int = 0
    first: Difference | None = None
    largest: dict[str, float] = field(default_factory=dict)  # field without indices: largest difference of numbers

    def add(self, played: Played, tolerance: float) -> None:
        """Judge one tick."""
        self.ticks += 1
        if played.entry.setpoint is None and played.step.answer is None and played.step.error is None:
            return
        self.compared += 1
        found = differences(played, tolerance)
        if found and not self.differing:
            self.first = found[0]
        self.differing += bool(found)
        for one in found:
            self._note(one)

    def _note(self, one: Difference) -> None:
        name = ".".join(part for part in one.field.split(".") if not part.isdigit())
        size = math.inf
        if isinstance(one.recorded, float) and isinstance(one.replayed, float):
            size = abs(one.recorded - one.replayed)
        self.largest[name] = max(size, self.largest.get(name, 0.0))


def differences(played: Played, tolerance: float) -> list[Difference]:
    """Every field that is not as recorded; with ``tolerance`` > 0 numbers may differ by that share of max(1, |x|)."""
    entry, step, output = played.entry, played.step, played.output
    pairs: list[tuple[str, Any, Any]] = [("error", step.error, played.error)]
    if step.answer is not None and output is not None:
        pairs.append(("answer", step.answer, answer_of(output)))
    if entry.setpoint is not None:
        recorded = wire.decode(entry.setpoint, SetpointRecord)
        replayed = setpoint_record(
            step.stamp_ns,
            State(recorded.state),
            output,
            sent=recorded.sent,
            messages=recorded.messages,
            timings_ms=recorded.timings_ms,
        )
        if wire.encode(replayed) != entry.setpoint:
            pairs.append(("", msgspec.json.decode(entry.setpoint), replayed))
    if entry.tracks is not None and output is not None:
        replayed_tracks = tracks_out(output, played.table)
        if wire.encode(replayed_tracks) != entry.tracks:
            pairs.append(("tracks", msgspec.json.decode(entry.tracks), replayed_tracks))
    found: list[Difference] = []
    for name, recorded_value, replayed_value in pairs:
        _walk(
            name,
            msgspec.to_builtins(recorded_value),
            msgspec.to_builtins(replayed_value),
            step.stamp_ns,
            tolerance,
            found,
        )
    if tolerance > 0.0:
        found = [one for one in found if not _is_tie(one.field, {other.field for other in found})]
    return sorted(found, key=_rank)


_FIRST = ("error", "verdict", "u_ref", "u_safe", "wire", "disturbance", "worst", "rows")  # what is told first


def _is_tie(name: str, also: set[str]) -> bool:
    """Whether a field only says which of several equal things was named, or how the same answer was found.

    Rows that bind have the same slack but for rounding: which is called the worst, and which step of an obstacle stands
    for it, then depends on the last bits. Their slack, and epsilon, does not.
    """
    if name in ("answer.solver", "answer.iterations"):
        return True
    if name.startswith("worst."):
        return name != "worst.slack"
    row, found, rest = name.removeprefix("rows.").partition(".")
    return bool(found) and (rest == "step" or (rest.startswith("margin.") and f"rows.{row}.step" in also))


def _rank(one: Difference) -> int:
    head = one.field.partition(".")[0]
    return _FIRST.index(head) if head in _FIRST else len(_FIRST)


def _walk(name: str, recorded: Any, replayed: Any, stamp_ns: int, tolerance: float, found: list[Difference]) -> None:
    """Compare what both have: a field that one version does not know is no difference."""
    if isinstance(recorded, dict) and isinstance(replayed, dict):
        for key in [key for key in recorded if key in replayed]:
            _walk(f"{name}.{key}".lstrip("."), recorded[key], replayed[key], stamp_ns, tolerance, found)
    elif isinstance(recorded, list | tuple) and isinstance(replayed, list | tuple):
        if len(recorded) != len(replayed):
            found.append(Difference(stamp_ns, f"{name}.length", len(recorded), len(replayed)))
        for index, (one, other) in enumerate(zip(recorded, replayed, strict=False)):
            _walk(f"{name}.{index}", one, other, stamp_ns, tolerance, found)
    elif not _same(recorded, replayed, tolerance):
        found.append(Difference(stamp_ns, name, recorded, replayed))


def _same(one: Any, other: Any, tolerance: float) -> bool:
    if repr(one) == repr(other):  # shortest decimals are one to one with floats: -0.0 is not 0.0, and nan is nan
        return True
    if tolerance <= 0.0 or not isinstance(one, int | float) or not isinstance(other, int | float):
        return False
    return math.isclose(one, other, rel_tol=tolerance, abs_tol=tolerance)
