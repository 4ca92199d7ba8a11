"""What a daemon publishes in a fixed scene, made by the brain itself: payloads for whoever listens to Zenoh."""

from __future__ import annotations

import numpy as np
from tracking_scenes import frame, seen, vehicle

from companion.config import Config
from companion.link import wire
from companion.pilot import Pilot, PilotInput, Task
from companion.report import setpoint_record, tracks_out, vehicle_out
from companion.state import State
from companion.types import frozen

TICKS = 40
TARGET = (8.0, 0.0, 2.0)


def payloads() -> dict[str, bytes]:
    """The last tick of a vehicle that flies east at 1 m/s, one ball head on and one beside, by kind."""
    brain = Pilot(Config())
    for k in range(TICKS):
        t = 0.05 * k
        state = vehicle(t, [1.0 * t, 0.0, 2.0], [1.0, 0.0, 0.0])
        balls = frame(t, seen("ball", [6.0 - 1.0 * t, 0.2, 2.0]), seen("post", [2.0, -3.0, 2.0]), sequence=k)
        output = brain.step(PilotInput(state, (balls,), Task.FLY, frozen(np.array(TARGET))), sent=True)
    record = setpoint_record(
        output.stamp_ns, State.ACTIVE, output, sent=True, messages=1, timings_ms={"total": 1.75, "brain": 1.5}
    )
    status = wire.Status(
        state="ACTIVE",
        reason="external mode entered",
        vehicle_mode=str(6 << 16),
        engaged=True,
        armed=True,
        airborne=True,
        profile="px4",
        warnings=["setpoints of 255/190 heard"],
        target=TARGET,
        tracks=2,
        agile=[],
        verdict=record.verdict,
        counts={"obstacles.frames": 40, "obstacles.stale": 3, "deadline_misses": 2},
        tick_ms={"p50": 1.2, "p99": 2.5, "max": 3.0},
        sources={"cam": wire.SourceOut(age_s=0.05, frames=40), "lidar": wire.SourceOut(age_s=None, frames=0)},
    )
    parts = {"status": status, "setpoint": record, "vehicle": vehicle_out(state)}
    return {name: wire.encode(part) for name, part in (parts | {"tracks": tracks_out(output, brain.tracks())}).items()}
