"""Whole flights past obstacles at 20 Hz: does the correction a_safe - a_ref stay on its side, and does one arrive?

A double integrator is sent 8 m ahead by a saturated PD law and told exactly where the obstacles will be, or that with
white noise on every obstacle's position in every tick, whose sigma it is told too. In the first flight the encounter
is symmetrical to the bit, where noise has most to say; in the others the obstacles start a little beside that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.bench.scenes import RADIUS_M, SHRINK_M_S2, Flight, Scene
from companion.config import LimitsConfig, SafetyConfig
from companion.safety.filter import SafetyFilter
from companion.types import FloatArray, Vec3, Verdict

SEED = 7321
FLIGHTS = 10  # of every encounter and noise
SIGMAS_M = (0.0, 0.05)
LIMIT_S = 20.0
ARRIVED_M = 0.3
CRUISE_M_S = 2.0
GAIN_P_HZ, GAIN_D_HZ = 1.0, 2.0  # of the way to go, to a velocity; of that velocity's lack, to an acceleration
OFFSET_M = 0.3
COUNTED_M_S2 = 0.05  # corrections that are smaller have no side
SUBSTEPS = 10  # of a tick, at which the clearance is taken
START, TARGET = np.array([0.0, 0.0, 5.0]), np.array([8.0, 0.0, 5.0])

# name: position and velocity of every obstacle, ENU [m], [m/s]; the vehicle flies along east at 2 m/s
ENCOUNTERS: dict[str, tuple[tuple[tuple[float, ...], tuple[float, ...]], ...]] = {
    "static": (((4.0, 0.0, 5.0), (0.0, 0.0, 0.0)),),
    "head-on": (((8.0, 0.0, 5.0), (-1.5, 0.0, 0.0)),),
    "crossing": (((4.0, -3.5, 5.0), (0.0, 1.5, 0.0)),),
    "overtaking": (((2.0, 0.0, 5.0), (0.7, 0.0, 0.0)),),
    "four crossing": (
        ((2.0, -1.6, 5.0), (0.0, 1.2, 0.0)),
        ((3.5, 2.5, 5.0), (0.0, -1.2, 0.0)),
        ((5.0, -3.4, 5.0), (0.0, 1.2, 0.0)),
        ((6.5, 4.3, 5.0), (0.0, -1.2, 0.0)),
    ),
}


@dataclass(frozen=True, slots=True)
class FlightResult:
    """One flight."""

    turns: int  # ticks in which the correction points against that of the tick before
    adjusted: float  # shares of the ticks
    relaxed: float
    braking: float
    arrival_s: float | None  # None: not within 20 s
    clearance_m: float  # least, surface to surface


@dataclass(frozen=True, slots=True)
class Encounter:
    """All flights of one encounter and noise."""

    name: str
    sigma_m: float
    flights: tuple[FlightResult, ...]


def turns(corrections: FloatArray) -> int:
    """Ticks of ``corrections`` (T, 3) that turn by more than 90 degrees from the one before, both above 0.05 m/s^2."""
    before, after = corrections[:-1], corrections[1:]
    large = np.linalg.norm(corrections, axis=1) > COUNTED_M_S2
    return int(np.count_nonzero((np.vecdot(before, after) < 0.0) & large[:-1] & large[1:]))


def reference(p_enu: Vec3, v_enu: Vec3, box_m_s2: float) -> Vec3:
    """The saturated PD law: a velocity of at most 2 m/s towards the target, followed within the box."""
    velocity = GAIN_P_HZ * (TARGET - p_enu)
    velocity *= min(1.0, CRUISE_M_S / max(math.hypot(*velocity), 1e-9))
    return np.clip(GAIN_D_HZ * (velocity - v_enu), -box_m_s2, box_m_s2)


def free_s() -> float:
    """Time of arrival without obstacles [s]."""
    config, nobody = SafetyConfig(), np.zeros((0, 3))
    flight = Flight(Scene(START, np.zeros(3), np.zeros(3), nobody, nobody), config, sigma_m=0.0)
    arrival_s = _fly(flight, config, np.random.default_rng(SEED)).arrival_s
    return math.inf if arrival_s is None else arrival_s


def measure_encounter(name: str, sigma_m: float, flights: int, *, seed: int = SEED) -> Encounter:
    """``flights`` flights of one encounter, the first of them without an offset."""
    config = SafetyConfig()
    results = []
    for index in range(flights):
        rng = np.random.default_rng((seed, index))
        position, velocity = (np.array(part) for part in zip(*ENCOUNTERS[name], strict=True))
        offset = rng.uniform(-OFFSET_M, OFFSET_M, position.shape) if index else 0.0
        scene = Scene(START, np.zeros(3), np.zeros(3), position + offset, velocity)
        results.append(_fly(Flight(scene, config, sigma_m=sigma_m), config, rng))
    return Encounter(name, sigma_m, tuple(results))


def _fly(flight: Flight, config: SafetyConfig, rng: np.random.Generator) -> FlightResult:
    limits = LimitsConfig()
    safety_filter = SafetyFilter(config, limits)
    corrections, verdicts, clearance_m = [], [], math.inf
    arrived = False
    while not arrived and flight.ticks * config.dt_s < LIMIT_S:
        a_ref = reference(flight.p_enu, flight.v_enu, limits.acceleration_m_s2 - SHRINK_M_S2)
        error_m = rng.normal(scale=flight.sigma_m, size=flight.obstacles().shape)
        result = safety_filter.step(flight.inputs(a_ref, error_m=error_m))
        corrections.append(result.a_safe - a_ref)
        verdicts.append(result.verdict)
        clearance_m = min(clearance_m, flight.clearance_m(result.a_safe, SUBSTEPS) - config.drone_radius_m - RADIUS_M)
        flight.advance(result.a_safe)
        arrived = math.dist(flight.p_enu, TARGET) < ARRIVED_M
    adjusted, relaxed, braking = (
        verdicts.count(verdict) / len(verdicts) for verdict in (Verdict.ADJUSTED, Verdict.RELAXED, Verdict.BRAKING)
    )
    return FlightResult(
        turns=turns(np.array(corrections)),
        adjusted=adjusted,
        relaxed=relaxed,
        braking=braking,
        arrival_s=round(flight.ticks * config.dt_s, 3) if arrived else None,
        clearance_m=clearance_m,
    )
