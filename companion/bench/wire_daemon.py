"""The daemon of `companion bench wire`: the real service on real sockets, with notes of when it learned what.

    python -m companion.bench.wire_daemon CONFIG.toml [--plain]

Ends on SIGTERM with one JSON object on stdout. Two taps, nothing else differs from `companion run`: the instant at
which a frame reaches the service's loop, and the tick whose brain step took it. The monotonic clock is the machine's,
so that the other process can compare.
"""

from __future__ import annotations

import asyncio
import signal
import sys
from pathlib import Path

import msgspec

from companion.clock import Clock, SystemClock
from companion.config import load_config
from companion.link.inbox import ObstacleInbox
from companion.pilot import Pilot, PilotInput, PilotOutput
from companion.service import Service


class Notes(msgspec.Struct):
    """``arrivals_ns[n]``: when the n-th frame came in; ``taken``: n -> stamp of the vehicle state of its tick [ns]."""

    arrivals_ns: list[int] = []
    stamps_ns: list[int] = []  # of the frames as they came, to tell which were lost
    taken: dict[int, int] = {}
    tasks: list[str] = []
    tick_ms: dict[str, float] = {}  # the daemon's own figure: state received to setpoint sent
    counts: dict[str, int] = {}  # and everything that it counted


class NotingPilot(Pilot):
    """The brain, which also notes the tick of each frame."""

    notes: Notes

    def step(self, inputs: PilotInput, *, sent: bool = True) -> PilotOutput:
        for frame in inputs.frames:
            self.notes.taken[frame.sequence] = inputs.vehicle.stamp_ns
        if inputs.task.value not in self.notes.tasks:
            self.notes.tasks.append(inputs.task.value)
        return super().step(inputs, sent=sent)


class _Stamp(msgspec.Struct):
    stamp_ns: int


def note_arrivals(inbox: ObstacleInbox, notes: Notes, clock: Clock) -> None:
    """From now on every frame that reaches ``inbox`` is noted first."""
    push, decode = inbox.push, msgspec.json.Decoder(_Stamp).decode

    def noted(source: str, payload: bytes, encoding: str | None = None) -> None:
        notes.arrivals_ns.append(clock.monotonic_ns())
        notes.stamps_ns.append(decode(payload).stamp_ns)
        push(source, payload, encoding)

    inbox.push = noted  # type: ignore[method-assign]


async def serve(path: Path, *, plain: bool) -> Notes:
    """Fly until SIGTERM; ``plain`` leaves the taps out, whose notes grow."""
    config, clock, notes = load_config(path), SystemClock(), Notes()
    if plain:
        service = Service(config, clock)
    else:
        pilot = NotingPilot(config)
        pilot.notes = notes
        service = Service(config, clock, pilot=pilot)
        note_arrivals(service._inbox, notes, clock)
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, service.stop)
    summary = await service.run()
    notes.tick_ms, notes.counts = summary.tick_ms, summary.counts
    return notes


if __name__ == "__main__":
    sys.stdout.buffer.write(msgspec.json.encode(asyncio.run(serve(Path(sys.argv[1]), plain="--plain" in sys.argv[2:]))))
