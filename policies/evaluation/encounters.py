"""Closed-loop encounters: the unmodified tracker and filter on a point mass, against obstacles timed to hit it.

The vehicle follows its acceleration setpoint with a first-order lag; obstacles (linear, accelerating, figure eight)
are placed so that they meet the undisturbed flight, and an encounter counts only if the unfiltered vehicle is hit.
Clearance is surface to surface, taken at every substep. Flight time is compared with the same flight without
obstacles.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import msgspec
import numpy as np

from companion.config import Config
from companion.errors import CompanionError
from companion.safety.filter import FilterInput, SafetyFilter
from companion.tracking.tracker import Tracker
from companion.types import (
    NS_PER_S,
    Detection,
    DetectionFrame,
    DetectionKind,
    FilterResult,
    FloatArray,
    Vec3,
    VehicleState,
    Verdict,
    frozen,
)
from policies.evaluation.obstacles import Obstacle, crossing_obstacle

TICK_S = 0.05
SUBSTEPS = 10
LAG_S = 0.1
REACHED_M = 0.3
DWELL_S = 1.0  # the target counts as reached where the vehicle then stays within REACHED_M for this long
TIME_OUT_S = 30.0
MAX_DRAWS = 1000  # of one seed, before the reference is held to be unable to fly
WARM_UP_S = 1.0  # the sensor runs this long before the flight, as it does while a vehicle takes off

Reference = Callable[[Vec3, Vec3], Vec3]  # (v_enu, e_enu) -> net acceleration [m/s^2]


@dataclass(frozen=True, slots=True)
class Encounter:
    """Where to fly, and what is in the way."""

    seed: int
    start_enu: Vec3
    target_enu: Vec3
    obstacles: tuple[Obstacle, ...]


@dataclass(frozen=True, slots=True)
class Sensor:
    """An external sensor of all obstacles at the tick rate."""

    noise_std_m: float = 0.05
    latency_s: float = 0.05
    dropout: float = 0.0

    @property
    def stated_std_m(self) -> float:
        return max(self.noise_std_m, 0.01)


@dataclass(slots=True)
class Flight:
    """What one flight came to. ``time_s`` None: the target was not reached."""

    time_s: float | None = None
    clearance_m: float = math.inf
    verdicts: Counter[str] = field(default_factory=Counter)
    reversals: int = 0  # ticks at which the correction turned by more than 90 degrees
    path: list[Vec3] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one encounter came to, beside its own unobstructed flight."""

    seed: int
    collided: bool
    reached: bool  # within TIME_OUT_S
    clearance_m: float
    time_ratio: float | None  # to the unobstructed flight; None where either did not reach the target
    verdicts: dict[str, int]  # ticks under each
    reversals: int
    ticks: int


def stand_in_reference(limit_m_s2: float, speed_m_s: float) -> Reference:
    """A nearly time-optimal reference: the speed from which 0.6 of the limit still stops, chased at 3 / s."""
    braking = 0.6 * limit_m_s2

    def act(v_enu: Vec3, e_enu: Vec3) -> Vec3:
        distance = math.dist((0.0, 0.0, 0.0), e_enu)
        direction = e_enu / max(distance, 1e-9)
        profile = math.sqrt(2.0 * braking * distance)
        speed = min(speed_m_s, profile, 1.5 * distance)
        closing = float(direction @ v_enu)
        a = 3.0 * (speed * direction - v_enu)
        if speed == profile and closing > 0.7 * profile:  # on the braking parabola: its deceleration fed forward
            a = a - braking * direction
        return np.asarray(a * min(1.0, limit_m_s2 / max(float(np.abs(a).max()), 1e-9)))

    return act


class _Loop:
    """Tracker, delay compensation and filter around a point mass, one tick at a time."""

    def __init__(self, config: Config, reference: Reference, encounter: Encounter, sensor: Sensor) -> None:
        self._config, self._reference, self._encounter, self._sensor = config, reference, encounter, sensor
        self._tracker = Tracker(config.tracking, config.safety.drone_radius_m)
        self._filter = SafetyFilter(config.safety, config.limits)
        self._noise = np.random.default_rng([encounter.seed, 1])
        self._delay_ticks = round(config.actuation_s / TICK_S)
        for step in range(-round(WARM_UP_S / TICK_S), 0):
            self._tracker.update(tuple(self._frames(step, encounter.obstacles)), step * round(TICK_S * NS_PER_S))
        self._shrink_m_s2 = config.limits.acceleration_m_s2 - config.reference_limit_m_s2
        self._before: Vec3 | None = None  # the last command; none before the first, as in the pilot
        self._commands: deque[Vec3] = deque([np.zeros(3)] * self._delay_ticks, maxlen=max(self._delay_ticks, 1))

    def tick(self, step: int, p: Vec3, v: Vec3, obstacles: tuple[Obstacle, ...]) -> tuple[Vec3, FilterResult | None]:
        """The reference and the filter's answer at tick ``step``."""
        config = self._config
        now_ns = step * round(TICK_S * NS_PER_S)
        a_ref = self._reference(v, self._encounter.target_enu - p)
        if config.safety.filter == "none":
            return a_ref, None
        self._tracker.update(tuple(self._frames(step, obstacles)), now_ns)
        self._tracker.note_vehicle(VehicleState(now_ns, frozen(p), frozen(v)))
        p_act, v_act = p, v
        for a in list(self._commands)[-self._delay_ticks :] if self._delay_ticks else []:
            p_act = p_act + v_act * TICK_S + a * (0.5 * TICK_S * TICK_S)
            v_act = v_act + a * TICK_S
        start_ns = now_ns + round(self._delay_ticks * TICK_S * NS_PER_S)
        prediction = self._tracker.predict(start_ns, config.safety.horizon + 3, config.safety.dt_s)
        result = self._filter.step(
            FilterInput(
                p_act,
                v_act,
                a_ref,
                prediction,
                accel_shrink_m_s2=self._shrink_m_s2,
                elapsed_s=TICK_S if step else None,
                a_before=self._before,
            )
        )
        self._before = result.a_safe
        self._commands.append(result.a_safe)
        return a_ref, result

    def _frames(self, step: int, obstacles: tuple[Obstacle, ...]) -> Iterator[DetectionFrame]:
        sensor = self._sensor
        seen_s = step * TICK_S - sensor.latency_s
        noise = sensor.noise_std_m * self._noise.standard_normal((len(obstacles), 3))
        if self._noise.random() < sensor.dropout or not obstacles:
            return
        yield DetectionFrame(
            stamp_ns=round(seen_s * NS_PER_S),
            source="sensor",
            sequence=step,
            kind=DetectionKind.DETECTION,
            detections=tuple(
                Detection(
                    id=str(index),
                    p_enu=frozen(obstacle.position(np.array(seen_s)) + noise[index]),
                    radius_m=obstacle.radius_m,
                    p_std_m=sensor.stated_std_m,
                )
                for index, obstacle in enumerate(obstacles)
            ),
        )


def fly(
    encounter: Encounter,
    config: Config,
    reference: Reference,
    sensor: Sensor,
    *,
    observe: Callable[[int, Vec3, Vec3, Vec3, FilterResult | None], None] | None = None,
) -> Flight:
    """One flight to the target or to the time-out; ``observe`` sees (step, p, v, a_ref, result) of each tick."""
    loop = _Loop(config, reference, encounter, sensor)
    flight = Flight()
    p, v, a = encounter.start_enu, np.zeros(3), np.zeros(3)
    inside_since: float | None = None
    correction = np.zeros(3)
    radii = np.array([config.safety.drone_radius_m + o.radius_m for o in encounter.obstacles])
    for step in range(round(TIME_OUT_S / TICK_S)):
        a_ref, result = loop.tick(step, p, v, encounter.obstacles)
        command = a_ref if result is None else result.a_safe
        flight.verdicts[(result.verdict if result else Verdict.NOMINAL).value] += 1
        flight.reversals += int(float((command - a_ref) @ correction) < -1e-6)
        correction = command - a_ref
        if observe is not None:
            observe(step, p, v, a_ref, result)
        flight.path.append(p)
        path, v, a = _follow(command, p, v, a)
        p = path[-1]
        times: FloatArray = step * TICK_S + TICK_S / SUBSTEPS * np.arange(1.0, SUBSTEPS + 1.0)
        for obstacle, reach in zip(encounter.obstacles, radii, strict=True):
            gap = np.linalg.norm(path - obstacle.position(times), axis=-1).min() - reach
            flight.clearance_m = min(flight.clearance_m, float(gap))
        near = math.dist(p, encounter.target_enu) < REACHED_M
        inside_since = (times[-1] if inside_since is None else inside_since) if near else None
        if inside_since is not None and times[-1] - inside_since >= DWELL_S:
            flight.time_s = float(inside_since)
            break
    return flight


def _follow(command: Vec3, p: Vec3, v: Vec3, a: Vec3) -> tuple[FloatArray, Vec3, Vec3]:
    """One tick of the point mass: positions (SUBSTEPS, 3) [m], then velocity and acceleration at its end."""
    h = TICK_S / SUBSTEPS
    keep = math.exp(-h / LAG_S)
    path = np.empty((SUBSTEPS, 3))
    for substep in range(SUBSTEPS):
        a = command + (a - command) * keep
        v = v + a * h
        p = p + v * h
        path[substep] = p
    return path, v, a


def make_encounter(seed: int, count: int, config: Config, reference: Reference) -> Encounter:
    """``count`` obstacles timed to cross an 8 m flight; the unfiltered vehicle is hit by the first of them.

    Raises:
        CompanionError: MAX_DRAWS flights of the seed came to nothing.
    """
    rng = np.random.default_rng([seed, 0])
    unfiltered = _with_filter(config, "none")
    for _ in range(MAX_DRAWS):
        heading = rng.uniform(-math.pi, math.pi)
        climb = rng.uniform(-0.15, 0.15)
        level = math.cos(climb)
        direction = np.array([math.cos(heading) * level, math.sin(heading) * level, math.sin(climb)])
        middle = np.array([*rng.uniform(-1.5, 1.5, 2), rng.uniform(2.5, 5.0)])
        start, target = frozen(middle - 4.0 * direction), frozen(middle + 4.0 * direction)
        free = fly(Encounter(seed, start, target, ()), unfiltered, reference, Sensor())
        if free.time_s is None:
            continue
        path = np.array(free.path)
        obstacles: list[Obstacle] = []
        while len(obstacles) < count:
            obstacle = crossing_obstacle(rng, path, free.time_s, TICK_S)
            early = np.arange(0.0, 1.0, TICK_S)
            gap_start = np.linalg.norm(obstacle.position(early) - start, axis=-1).min()
            after = free.time_s + np.arange(0.0, 6.0, TICK_S)
            gap_target = np.linalg.norm(obstacle.position(after) - target, axis=-1).min()
            if gap_start > 2.0 and gap_target > 1.5:
                obstacles.append(obstacle)
        encounter = Encounter(seed, start, target, tuple(obstacles))
        if fly(Encounter(seed, start, target, (obstacles[0],)), unfiltered, reference, Sensor()).clearance_m < 0.0:
            return encounter
    raise CompanionError(f"encounter {seed}: no flight in {MAX_DRAWS} that arrives alone and is hit unfiltered")


def outcome_of(seed: int, count: int, config: Config, reference: Reference, sensor: Sensor) -> Outcome:
    """Fly the encounter of ``seed`` with ``count`` obstacles, and the same flight without them."""
    encounter = make_encounter(seed, count, config, reference)
    free = fly(Encounter(seed, encounter.start_enu, encounter.target_enu, ()), config, reference, sensor)
    flight = fly(encounter, config, reference, sensor)
    return Outcome(
        seed=seed,
        collided=flight.clearance_m < 0.0,
        reached=flight.time_s is not None,
        clearance_m=flight.clearance_m,
        time_ratio=None if flight.time_s is None or free.time_s is None else flight.time_s / free.time_s,
        verdicts=dict(flight.verdicts),
        reversals=flight.reversals,
        ticks=flight.verdicts.total(),
    )


def _with_filter(config: Config, name: str) -> Config:
    return msgspec.structs.replace(config, safety=msgspec.structs.replace(config.safety, filter=name))
