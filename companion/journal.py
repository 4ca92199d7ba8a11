"""The brain's journal: every call of the shell into the brain, in order, so that a flight can be replayed to the bit.

Each call is one message on ``/companion/brain`` (`journal_format`). ``n`` counts them without gaps from the first: a
message that the log lost shows. Nothing is built or encoded while a setpoint waits: `Journal` keeps the values, which
are frozen, until `Journal.write`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Protocol

from msgspec import Struct

from companion import __version__
from companion.config import Config, config_hash
from companion.journal_format import (
    FRAMES_TOPIC,
    TOPIC,
    Call,
    Configure,
    Construct,
    Observe,
    Reset,
    Retune,
    frame_of,
    names_of,
    step_of,
)
from companion.numerics import this_machine
from companion.pilot import PilotInput, PilotOutput
from companion.types import DetectionFrame, TrackTable

FRAME_BYTES = 200  # about what a detection takes until it is written


class Sink(Protocol):
    """Where messages go: the recorder, which builds and encodes them when nobody waits."""

    def later(self, topic: str, stamp_ns: int, build: Callable[[], Struct], size: int = ...) -> None: ...


class Brain(Protocol):
    """What the shell asks of a pilot."""

    def reset(self) -> None: ...
    def configured(self, config: Config) -> Brain: ...
    def retune(self, config: Config) -> None: ...
    def tracks(self) -> TrackTable: ...
    @property
    def tracking_counts(self) -> dict[str, int]: ...
    def observe(self, frames: tuple[DetectionFrame, ...], stamp_ns: int) -> None: ...
    def step(self, inputs: PilotInput, *, sent: bool) -> PilotOutput: ...


class Journal:
    """A brain that keeps note of how it was called; it answers as ``brain`` does and raises what that raises."""

    def __init__(self, brain: Brain, config: Config, *, artifact: str | None) -> None:
        self._brain = brain
        self._stamp_ns = 0
        self._number = 0
        self._written: tuple[DetectionFrame, ...] = ()  # the frames written last, which the next call may use again
        self._notes: list[tuple[int, Callable[[int], Call], tuple[DetectionFrame, ...]]] = []
        name, machine = config_hash(config), this_machine()
        self._note(lambda n: Construct(n=n, config=name, artifact=artifact, version=__version__, machine=machine))

    def reset(self) -> None:
        self._note(lambda n: Reset(n=n))
        self._brain.reset()

    def configured(self, config: Config) -> Brain:
        self._brain = self._brain.configured(config)
        self._note(lambda n: Configure(n=n, config=config_hash(config)))
        return self

    def retune(self, config: Config) -> None:
        self._brain.retune(config)  # what it refuses has changed nothing
        self._note(lambda n: Retune(n=n, config=config_hash(config)))

    def tracks(self) -> TrackTable:
        return self._brain.tracks()

    @property
    def tracking_counts(self) -> dict[str, int]:
        return self._brain.tracking_counts

    def observe(self, frames: tuple[DetectionFrame, ...], stamp_ns: int) -> None:
        error: str | None = None
        try:
            self._brain.observe(frames, stamp_ns)
        except Exception as raised:
            error = type(raised).__name__
            raise
        finally:
            self._stamp_ns = stamp_ns
            self._note(lambda n: Observe(n=n, stamp_ns=stamp_ns, frames=names_of(frames), error=error), frames)

    def step(self, inputs: PilotInput, *, sent: bool) -> PilotOutput:
        output, error = None, None
        try:
            output = self._brain.step(inputs, sent=sent)
        except Exception as raised:
            error = type(raised).__name__
            raise
        finally:
            self._stamp_ns = inputs.vehicle.stamp_ns
            self._note(lambda n: step_of(n, inputs, sent, output, error), inputs.frames)
        return output

    def write(self, sink: Sink, frames: tuple[DetectionFrame, ...] = ()) -> None:
        """Append what was noted since the last time, and the ``frames`` of a tick for which no brain was asked."""
        for stamp_ns, make, used in self._notes:
            self._write_frames(sink, used, stamp_ns)
            sink.later(TOPIC, stamp_ns, partial(make, self._number))
            self._number += 1
        self._notes.clear()
        self._write_frames(sink, frames, self._stamp_ns)

    def _write_frames(self, sink: Sink, frames: tuple[DetectionFrame, ...], stamp_ns: int) -> None:
        if frames and frames is not self._written:
            self._written = frames
            for frame in frames:
                sink.later(FRAMES_TOPIC, stamp_ns, partial(frame_of, frame), FRAME_BYTES * (1 + len(frame.detections)))

    def _note(self, make: Callable[[int], Call], frames: tuple[DetectionFrame, ...] = ()) -> None:
        self._notes.append((self._stamp_ns, make, frames))
