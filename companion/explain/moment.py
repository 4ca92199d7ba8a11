"""One tick of a log with all that is needed to explain it, and an outline of the ticks around it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

from msgspec.structs import replace

from companion.config import Config
from companion.errors import ConfigError
from companion.journal_format import Step
from companion.link.wire import SetpointRecord, Status, TracksOut, decode
from companion.logbook.reader import FlightLog
from companion.pilot import PilotInput, Task
from companion.replay.journal_reader import Entry, JournalReader
from companion.replay.player import Player
from companion.replay.progress import Advance
from companion.replay.whatif import Commanded
from companion.types import DetectionFrame, Prediction, Vec3, frozen

NOT_THE_REFERENCE = ("adjusted", "relaxed", "braking")


@dataclass(frozen=True, slots=True)
class Outline:
    """A tick in brief."""

    stamp_ns: int
    state: str
    verdict: str
    task: Task
    p: tuple[float, ...]
    target: tuple[float, ...] | None
    worst: str | None
    slack: float
    change_m_s2: float  # |u_safe - u_ref|
    asked_ahead_m_s2: float  # of the reference, towards the target

    @property
    def distance_m(self) -> float | None:
        """To the target."""
        return None if self.target is None else math.dist(self.p, self.target)


@dataclass(slots=True)
class Sightings:
    """When which source showed what last."""

    sources: dict[str, int] = field(default_factory=dict)  # stamp of the newest frame [ns]
    named: dict[str, int] = field(default_factory=dict)  # the same of "source/id"

    def note(self, frames: tuple[DetectionFrame, ...]) -> None:
        for frame in frames:
            self.sources[frame.source] = max(frame.stamp_ns, self.sources.get(frame.source, frame.stamp_ns))
            for seen in frame.detections:
                if seen.id is not None:
                    name = f"{frame.source}/{seen.id}"
                    self.named[name] = max(frame.stamp_ns, self.named.get(name, frame.stamp_ns))


@dataclass(frozen=True, slots=True)
class Moment:
    """A tick as it was recorded."""

    outline: Outline
    inputs: PilotInput
    config: Config
    record: SetpointRecord
    tracks: TracksOut
    status: Status | None
    detour: bool
    before: Vec3 | None  # the command before [m/s^2]
    at: tuple[Vec3, Vec3]  # position and velocity where the setpoint acts
    elapsed_s: float | None  # since the tick before
    sightings: Sightings
    prediction: Prediction | None  # of all confirmed tracks, as the brain had it


def nothing() -> None:
    """Stands for a progress display that nobody watches."""


def outlines(log: FlightLog, on_tick: Advance = nothing) -> list[Outline]:
    """Every tick that the brain was asked for, in order."""
    found: list[Outline] = []
    for entry in JournalReader(log).entries():
        if isinstance(entry.call, Step) and entry.setpoint is not None:
            on_tick()
            found += [_outline(entry.call, decode(entry.setpoint, SetpointRecord))]
    return found


class _NoReference:
    """Stands for the policy where only the tracks are wanted."""

    def act(self, v_enu: Vec3, error_enu: Vec3) -> Vec3:
        return frozen([0.0, 0.0, 0.0])


def _tracks_only(config: Config) -> Config:
    return replace(config, safety=replace(config.safety, filter="none"))


def moment(log: FlightLog, number: int, on_tick: Advance = nothing) -> Moment:
    """The tick ``number`` of `outlines`. Raises ConfigError as `moments`, or where there is none."""
    for count, found in enumerate(moments(log)):
        on_tick()
        if count == number:
            return found
    raise ConfigError(f"{log.path}: expected a tick {number}, it is not there")


def moments(log: FlightLog) -> Iterator[Moment]:
    """Every tick of `outlines` with the prediction that the brain had: its tracker is played along.

    Raises:
        ConfigError: the log's configuration is none of this version's.
    """
    player = Player(JournalReader(log), variant=_tracks_only, law=_NoReference())
    commanded, sightings = Commanded(), Sightings()
    before, last_ns = None, None
    for played in player.ticks():
        entry, config = played.entry, player.logged_config
        sightings.note(played.inputs.frames)
        if entry.setpoint is None:
            continue
        record = decode(entry.setpoint, SetpointRecord)
        stamp_ns = record.stamp_ns
        at = commanded.at(played.inputs.vehicle, config)
        yield Moment(
            outline=_outline(played.step, record),
            inputs=played.inputs,
            config=config,
            record=record,
            tracks=_tracks(entry),
            status=None if entry.status is None else decode(entry.status, Status),
            detour=played.step.answer is not None and played.step.answer.detour,
            before=before,
            at=at,
            elapsed_s=None if last_ns is None else (stamp_ns - last_ns) / 1e9,
            sightings=sightings,
            prediction=None if played.output is None else played.output.prediction,
        )
        before, last_ns = commanded.note(record, played.step.sent, config), stamp_ns


def intervention(ticks: list[Outline], number: int) -> tuple[int, int] | None:
    """First and last tick of the run of ticks with a changed reference about ``number``; None where it passed.

    Ticks of the same run may be a tenth of a second apart.
    """
    if ticks[number].verdict not in NOT_THE_REFERENCE:
        return None
    first = last = number
    for step, limit in ((-1, -1), (1, len(ticks))):
        edge = number
        for index in range(number, limit, step):
            if abs(ticks[index].stamp_ns - ticks[edge].stamp_ns) > 100_000_000:
                break
            if ticks[index].verdict in NOT_THE_REFERENCE and ticks[index].task is ticks[number].task:
                edge = index
        first, last = (edge, last) if step < 0 else (first, edge)
    return first, last


def _outline(step: Step, record: SetpointRecord) -> Outline:
    worst = record.worst
    changed = 0.0 if record.u_ref is None or record.u_safe is None else math.dist(record.u_ref, record.u_safe)
    p = tuple(float(x) for x in step.p)
    target = None if step.target is None else tuple(float(x) for x in step.target)
    return Outline(
        stamp_ns=step.stamp_ns,
        state=record.state,
        verdict=record.verdict,
        task=step.task,
        p=p,
        target=target,
        worst=None if worst is None else worst.track,
        slack=math.inf if worst is None else worst.slack,
        change_m_s2=changed,
        asked_ahead_m_s2=0.0 if record.u_ref is None else towards(p, target, record.u_ref),
    )


def towards(p: tuple[float, ...], target: tuple[float, ...] | None, a: tuple[float, ...]) -> float:
    """Component of ``a`` from ``p`` towards the target, 0 without one."""
    if target is None or (distance := math.dist(p, target)) < 1e-6:
        return 0.0
    return sum(x * (to - at) for x, at, to in zip(a, p, target, strict=True)) / distance


def _tracks(entry: Entry) -> TracksOut:
    return TracksOut(stamp_ns=0, tracks=[]) if entry.tracks is None else decode(entry.tracks, TracksOut)
