"""A flight without processes: the shell's calls into a journalled pilot, its records into a real log."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
from tracking_scenes import frame, seen

from companion.config import Config, parse_config
from companion.errors import BrainFailure
from companion.journal import Journal
from companion.journal_format import TOPIC, schema
from companion.link import wire
from companion.pilot import Pilot, PilotInput, Task
from companion.record import Recorder
from companion.report import setpoint_record, tracks_out
from companion.state import State
from companion.types import DetectionFrame, Vec3, VehicleState, frozen

TICK_NS = 50_000_000
STATES = {Task.STAY: State.READY, Task.FLY: State.ACTIVE, Task.HOLD: State.HOLD}


def config_of(**sections: object) -> Config:
    return parse_config({"sync": "lockstep", "target": {"position": [6.0, 0.0, 1.5]}, **sections})


class Shell:
    """Calls a journalled brain as the service does and logs what comes of it."""

    def __init__(self, folder: Path, config: Config) -> None:
        self.config = config
        pilot = Pilot(config)
        self.brain = Journal(pilot, config, artifact=pilot.artifact)
        self.recorder = Recorder(folder / "flight.mcap", config)
        self.recorder.declare(TOPIC, "BrainCall", schema())
        self.brain.reset()
        self.tick_ns = 0
        self.sequence = 0
        self.p, self.v = np.array([0.0, 0.0, 1.5]), np.zeros(3)

    @property
    def path(self) -> Path:
        return self.recorder.path

    def retune(self, config: Config) -> None:
        self.brain.retune(config)
        self.recorder.config(config, self.tick_ns)

    def frames(self, *ids: str | None) -> tuple[DetectionFrame, ...]:
        """What one sensor sees: an obstacle that crosses the path, and more of them behind it."""
        t_s = self.tick_ns / 1e9
        rng = np.random.default_rng(self.sequence)
        at = [np.array([2.5 + 1.5 * k, 2.0 - 1.3 * t_s, 1.5]) + rng.normal(scale=0.05, size=3) for k in range(len(ids))]
        self.sequence += 1
        return (frame(t_s, *(seen(name, p) for name, p in zip(ids, at, strict=True)), sequence=self.sequence),)

    def tick(
        self,
        task: Task = Task.FLY,
        *,
        frames: tuple[DetectionFrame, ...] | None = None,
        ahead: bool = False,
        target: Vec3 | None = None,
        p: Vec3 | None = None,
    ) -> None:
        """One tick; the vehicle follows what it is sent."""
        self.tick_ns += TICK_NS
        given = self.frames("ball") if frames is None else frames
        if ahead:
            self.brain.observe(given, self.tick_ns)
        place = self.p if p is None else p
        vehicle = VehicleState(self.tick_ns, frozen(place), frozen(self.v), p_std_m=0.02)
        goal = frozen([6.0, 0.0, 1.5]) if target is None else target
        sent = task is not Task.STAY
        output = None
        try:
            output = self.brain.step(PilotInput(vehicle, given, task, goal), sent=sent)
        except BrainFailure:
            self.brain.reset()
        record = setpoint_record(
            self.tick_ns, STATES[task], output, sent=sent and output is not None, messages=1, timings_ms={"brain": 0.1}
        )
        payload, table = wire.encode(record), self.brain.tracks()
        self.brain.write(self.recorder, given)
        self.recorder.message("/companion/setpoint", self.tick_ns, payload)
        if output is not None:
            self.recorder.later("/companion/tracks", self.tick_ns, functools.partial(tracks_out, output, table))
            if sent:
                self.p = self.p + 0.05 * self.v + 0.5 * 0.05**2 * output.wire
                self.v = self.v + 0.05 * output.wire

    def close(self) -> Path:
        self.brain.write(self.recorder)
        self.recorder.close()
        return self.path
