"""The simulator with the daemon's brain in one process, timed: `sim-bridge bench` runs it as a subprocess.

    python -m policies.evaluation.inprocess SECONDS DEMAND

Prints one JSON object, a `sim_bridge.sections.Case`: tracker, policy and filter on the frames of the noisy sensor, the
autopilot and PyBullet behind it, no wires.
"""

from __future__ import annotations

import gc
import sys
from collections.abc import Sequence

import msgspec
import numpy as np

from companion.config import Config
from companion.pilot import Pilot, PilotInput
from companion.types import Detection, DetectionFrame, DetectionKind, VehicleState, Verdict, frozen
from sim_bridge.bench import scenery
from sim_bridge.flight import Flight
from sim_bridge.inprocess import Law, measure
from sim_bridge.messages import Vec3
from sim_bridge.sections import Sections
from sim_bridge.sensors import Frame


class BrainLaw:
    """The pilot as a law of `sim_bridge.inprocess`."""

    def __init__(self, std_m: float) -> None:
        self.pilot = Pilot(Config())
        self._std_m = std_m
        self.ticks = self.acted = 0  # in all, and those in which the filter changed the reference
        self._sequence = 0

    def __call__(self, flight: Flight, frames: Sequence[Frame]) -> Vec3:
        craft = flight.crafts[0]
        body, target = craft.state, craft.target_enu
        vehicle = VehicleState(
            flight.t_ns, frozen(np.array(body.p_enu)), frozen(np.array(body.v_enu)), frozen(np.array(body.q_wxyz))
        )
        seen = tuple(self._detections(frame) for frame in frames)
        goal = None if target is None else frozen(np.array(target))
        output = self.pilot.step(PilotInput(vehicle, seen, target_enu=goal))
        self.ticks += 1
        self.acted += output.result.verdict is not Verdict.NOMINAL
        x, y, z = output.wire.tolist()
        return (x, y, z)

    def _detections(self, frame: Frame) -> DetectionFrame:
        stamp_ns, sightings = frame
        self._sequence += 1
        found = tuple(Detection(name, frozen(np.array(p)), radius_m, self._std_m) for name, p, radius_m in sightings)
        return DetectionFrame(stamp_ns, "sim", self._sequence, DetectionKind.DETECTION, found)


def claimed(sections: Sections, law: Law) -> Law:
    """The brain's parts under names of their own."""
    assert isinstance(law, BrainLaw)
    pilot = law.pilot
    sections.wrap(pilot, "brain: tracking", "_track")
    sections.wrap(pilot, "brain: policy", "_reference")
    sections.wrap(pilot, "brain: filter", "_filtered")
    return sections.timed("brain: rest", law)


def acting(law: Law) -> float:
    """Share of the ticks in which the filter changed the reference."""
    assert isinstance(law, BrainLaw)
    return law.acted / law.ticks


def main(arguments: list[str]) -> int:
    """Fly SECONDS of vehicle time, print the case."""
    seconds, demand = (float(word) for word in arguments)
    resolved = scenery(seconds)
    std_m = resolved.scenario.sensors[0].sigma_m
    gc.collect()
    gc.freeze()  # as the daemon does
    case = measure(
        "in process with the brain",
        resolved,
        lambda: BrainLaw(std_m),
        seconds,
        demand=demand,
        claim=claimed,
        acting=acting,
    )
    sys.stdout.buffer.write(msgspec.json.encode(case))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
