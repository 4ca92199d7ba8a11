"""The brain's tick alone, in this process: track, predict, ask the policy, filter, encode the setpoint.

The vehicle flies to and fro through obstacles on straight lines that turn back at the walls of their box, and
obeys the answers, so that the filter is in the state in which it flies. Detections are named and carry an error.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.bench.timing import Quantiles, quantiles
from companion.clock import processor_ns, stopwatch_ns
from companion.config import Config, parse_config
from companion.link.mavlink import MavlinkCodec
from companion.pilot import Pilot, PilotInput
from companion.types import NS_PER_S, Detection, DetectionFrame, DetectionKind, FloatArray, VehicleState, frozen

COUNTS = (1, 10, 100, 1000)
TICKS, QUICK_TICKS = 4000, 400  # with one and ten obstacles; fewer with more, at least 1000 or 100
WARM = 20
DT_S, RADIUS_M, SIGMA_M = 0.05, 0.2, 0.05
LEAST_M = (12.0, 8.0, 3.0)  # the obstacles' box, about the vehicle's way; larger where they are many:
DENSITY = 1.0 / 40.0  # obstacles a cubic metre at most
NEAREST_M = 1.5
REACH = np.array([6.0, 0.0, 0.0])  # from the middle of the box to the targets, which take turns
SEED = 8108


@dataclass(frozen=True, slots=True)
class BrainTiming:
    """Milliseconds a tick."""

    obstacles: int
    horizon: int
    ticks: int
    whole: Quantiles
    brain: Quantiles  # without the encoding
    processor: Quantiles  # of the whole, what it used of the processor: others on the machine do not count
    acting: float  # share of ticks in which the filter changed the reference


def measure_brain(count: int, ticks: int) -> BrainTiming:
    """``ticks`` of a flight among ``count`` obstacles with the default configuration, N = 20."""
    config = brain_config(count)
    pilot, codec, world = Pilot(config), MavlinkCodec(system=1), _World(count, config)
    samples: list[tuple[int, int, int]] = []
    acted = 0
    for k in range(ticks + WARM):
        inputs = world.inputs(k)
        began, used = stopwatch_ns(), processor_ns()
        output = pilot.step(inputs)
        thought = stopwatch_ns()
        codec.encode_setpoint(output.stamp_ns // 1_000_000, output.wire, config.type_mask, v_enu=output.v_next)
        done, used = stopwatch_ns(), processor_ns() - used
        world.advance(output.result.a_safe)
        if k >= WARM:
            samples.append((done - began, thought - began, used))
            acted += output.result.verdict.value != "nominal"
    whole, brain, processor = (quantiles(list(column)) for column in zip(*samples, strict=True))
    return BrainTiming(count, config.safety.horizon, ticks, whole, brain, processor, acted / ticks)


def brain_config(count: int) -> Config:
    """The defaults, in an arena that holds ``count`` obstacles."""
    x, y, z = (0.5 * box_m(count)).tolist()
    limits = {"arena_min": [-x - 4.0, -y - 4.0, 0.3], "arena_max": [x + 4.0, y + 4.0, 0.3 + 2.0 * z + 4.0]}
    return parse_config({"tracking": {"max_tracks": max(128, count)}, "limits": limits})


def box_m(count: int) -> FloatArray:
    """Edges of the box in which ``count`` obstacles move, (3,)."""
    least = np.array(LEAST_M)
    grown = max(1.0, math.sqrt(count / DENSITY / float(least.prod())))
    return least * (grown, grown, 1.0)


class _World:
    """Obstacles and vehicle, ENU."""

    def __init__(self, count: int, config: Config) -> None:
        rng = self._rng = np.random.default_rng((SEED, count))
        span = box_m(count)
        self._low = np.array([-0.5 * span[0], -0.5 * span[1], config.limits.arena_min[2] + 2.0])
        self._high = self._low + span
        self._centre = 0.5 * (self._low + self._high)
        self._p = self._centre - REACH
        self._v = np.zeros(3)
        self._begin = rng.uniform(self._low, self._high, (count, 3))
        near = np.linalg.norm(self._begin - self._p, axis=1) < NEAREST_M
        self._begin[near] += 2.0 * NEAREST_M
        self._drift = rng.normal(scale=1.0, size=(count, 3)) * (1.0, 1.0, 0.3)
        self._names = [f"o{m:04d}" for m in range(count)]

    def inputs(self, k: int) -> PilotInput:
        """The tick of number ``k``; the target changes sides every eight seconds."""
        stamp_ns = round(k * DT_S * NS_PER_S) + NS_PER_S
        z = self._obstacles(k * DT_S) + self._rng.normal(scale=SIGMA_M, size=self._begin.shape)
        found = tuple(Detection(name, frozen(p), RADIUS_M, SIGMA_M) for name, p in zip(self._names, z, strict=True))
        frame = DetectionFrame(stamp_ns, "bench", k, DetectionKind.DETECTION, found)
        target = frozen(self._centre + (REACH if k // 160 % 2 == 0 else -REACH))
        vehicle = VehicleState(stamp_ns, frozen(self._p), frozen(self._v), frozen([1.0, 0.0, 0.0, 0.0]))
        return PilotInput(vehicle, (frame,), target_enu=target)

    def advance(self, a: FloatArray) -> None:
        self._p = self._p + self._v * DT_S + 0.5 * DT_S**2 * a
        self._v = self._v + DT_S * a

    def _obstacles(self, t_s: float) -> FloatArray:
        """Straight lines, mirrored at the walls: x = |((x0 + v t) mod 2 L) - L|'s triangle."""
        span = self._high - self._low
        folded = np.mod(self._begin - self._low + self._drift * t_s, 2.0 * span)
        return np.asarray(self._low + np.minimum(folded, 2.0 * span - folded))


def growth_exponent(times: list[BrainTiming], few: int = 10, many: int = 1000) -> float | None:
    """log(ratio of medians) / log(ratio of obstacles), None where one of them was not measured."""
    by_count = {timing.obstacles: timing.whole.p50 for timing in times}
    if few not in by_count or many not in by_count:
        return None
    return math.log(by_count[many] / by_count[few]) / math.log(many / few)


def repeats(count: int, *, quick: bool) -> int:
    """Ticks for so many obstacles."""
    ticks = QUICK_TICKS if quick else TICKS
    return ticks if count <= 10 else ticks // 4
