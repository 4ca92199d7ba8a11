"""What another configuration would have answered to the same inputs, open loop: the recorded vehicle does not follow.

Both answers of a tick are judged on one picture, that of the log: the vehicle at the instant at which the setpoint
acts, and the obstacles as the log predicted them. Holding u, r_k = c_k + s_k u as in `safety.barrier`; the predicted
clearance is the least |r_k| less the radii over the log's horizon, surface to surface.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass, field

import msgspec
import numpy as np

from companion.commanded import acts_after_ns, at_action
from companion.config import Config
from companion.link.wire import SetpointRecord, TracksOut, decode
from companion.pilot import Task
from companion.replay.player import Played
from companion.types import FloatArray, Vec3, VehicleState, frozen

SAME_M_S2 = 1e-9  # answers no farther apart are the same
COMMANDS = 64  # that can still be under way


@dataclass(frozen=True, slots=True)
class Apart:
    """The first tick at which the two answers are not the same [m/s^2]."""

    stamp_ns: int
    logged: tuple[float, ...]
    other: tuple[float, ...]
    logged_verdict: str
    other_verdict: str


@dataclass(slots=True)
class Side:
    """One of the two: the log, or the other configuration."""

    verdicts: Counter[str] = field(default_factory=Counter)
    changed_m_s2: list[float] = field(default_factory=list)  # |u_safe - u_ref| of each tick
    clearance_m: float = math.inf  # least predicted one over the flight
    clearance_ns: int | None = None

    def add(self, verdict: str, u_ref: Vec3, u_safe: Vec3, clearance_m: float, stamp_ns: int) -> None:
        self.verdicts[verdict] += 1
        self.changed_m_s2.append(math.dist(u_ref, u_safe))
        if clearance_m < self.clearance_m:
            self.clearance_m, self.clearance_ns = clearance_m, stamp_ns


@dataclass(slots=True)
class WhatIf:
    """Ticks of the flight that both answered, or of READY where nothing was flown."""

    ticks: int = 0
    logged: Side = field(default_factory=Side)
    other: Side = field(default_factory=Side)
    apart_m_s2: list[float] = field(default_factory=list)  # |difference of u_safe| of each tick
    first: Apart | None = None
    failed: int = 0  # ticks that one of the two could not answer

    def add(self, played: Played, recorded: SetpointRecord, tracks: TracksOut, at: tuple[Vec3, Vec3]) -> None:
        """Judge one tick; ``at``: vehicle where the setpoint acts, ``tracks`` as recorded."""
        if played.output is None or recorded.u_safe is None or recorded.u_ref is None:
            self.failed += 1
            return
        self.ticks += 1
        logged, output = frozen(recorded.u_safe), played.output
        other = output.result.a_safe
        dt_s = played.config.safety.dt_s
        radius_m = played.config.safety.drone_radius_m
        stamp_ns = recorded.stamp_ns
        for side, verdict, u_ref, u_safe in (
            (self.logged, recorded.verdict, frozen(recorded.u_ref), logged),
            (self.other, output.result.verdict.value, output.u_ref, other),
        ):
            side.add(verdict, u_ref, u_safe, predicted_clearance(tracks, at, u_safe, dt_s, radius_m), stamp_ns)
        apart = math.dist(logged, other)
        self.apart_m_s2.append(apart)
        if self.first is None and (apart > SAME_M_S2 or recorded.verdict != output.result.verdict.value):
            self.first = Apart(
                stamp_ns,
                tuple(logged.tolist()),
                tuple(other.tolist()),
                recorded.verdict,
                output.result.verdict.value,
            )


class Commanded:
    """Where the vehicle is when a setpoint acts, by what the log says was commanded before."""

    def __init__(self) -> None:
        self._commands: deque[tuple[int, Vec3]] = deque(maxlen=COMMANDS)

    def at(self, vehicle: VehicleState, config: Config) -> tuple[Vec3, Vec3]:
        """Position and velocity at the instant of action of the setpoint for ``vehicle``."""
        return at_action(vehicle, self._commands, acts_after_ns(config))

    def note(self, recorded: SetpointRecord, sent: bool, config: Config) -> Vec3:
        """What that tick commanded [m/s^2]."""
        if self._commands and recorded.stamp_ns < self._commands[-1][0] - acts_after_ns(config):
            self._commands.clear()  # the clock began anew
        sent_a = frozen(recorded.u_safe if sent and recorded.u_safe is not None else (0.0, 0.0, 0.0))
        self._commands.append((recorded.stamp_ns + acts_after_ns(config), sent_a))
        return sent_a


def predicted_distance(predicted: FloatArray, at: tuple[Vec3, Vec3], u: Vec3, dt_s: float) -> FloatArray:
    """|r_k| of the vehicle that holds ``u``, from each of (K, 3) predicted positions, centre to centre, (K,) [m]."""
    k = np.arange(float(len(predicted)))[:, None]
    p, v = at
    r = p + k * dt_s * v + (dt_s**2 * k * (k - 1.0) / 2.0) * u - predicted
    return np.asarray(np.sqrt(np.vecdot(r, r)))


def predicted_clearance(tracks: TracksOut, at: tuple[Vec3, Vec3], u: Vec3, dt_s: float, radius_m: float) -> float:
    """Least predicted distance of surfaces to any obstacle while ``u`` is held [m]; infinite without obstacles."""
    gaps = [
        float(predicted_distance(np.array(track.predicted), at, u, dt_s).min()) - track.radius - radius_m
        for track in tracks.tracks
        if track.predicted
    ]
    return min(gaps, default=math.inf)


def judge(result: WhatIf, played: Played, commanded: Commanded, logged_config: Config, *, flown: bool) -> None:
    """Add one tick where it was flown (``flown``: only then), and note what the log commanded in it."""
    if played.entry.setpoint is None:
        return
    recorded = decode(played.entry.setpoint, SetpointRecord)
    at = commanded.at(played.inputs.vehicle, logged_config)
    commanded.note(recorded, played.step.sent, logged_config)
    if flown and played.step.task is Task.STAY:
        return
    empty = TracksOut(stamp_ns=recorded.stamp_ns, tracks=[])
    tracks = empty if played.entry.tracks is None else decode(played.entry.tracks, TracksOut)
    result.add(played, recorded, tracks, at)


def as_json(result: WhatIf) -> dict[str, object]:
    """For ``--json``."""
    sides = {
        name: {
            "verdicts": dict(side.verdicts),
            "mean_change_m_s2": float(np.mean(side.changed_m_s2)) if side.changed_m_s2 else None,
            "min_predicted_clearance_m": None if math.isinf(side.clearance_m) else side.clearance_m,
            "min_predicted_clearance_ns": side.clearance_ns,
        }
        for name, side in (("log", result.logged), ("other", result.other))
    }
    return {
        "ticks": result.ticks,
        "unanswered": result.failed,
        **sides,
        "mean_difference_m_s2": float(np.mean(result.apart_m_s2)) if result.apart_m_s2 else None,
        "max_difference_m_s2": max(result.apart_m_s2, default=None),
        "differing_ticks": sum(apart > SAME_M_S2 for apart in result.apart_m_s2),
        "first_difference": None if result.first is None else msgspec.to_builtins(result.first),
    }
