"""The log of a flight as instants that can be drawn: the truth trace of `sim-bridge run --trace`, JSON lines."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass
from pathlib import Path

import msgspec

from sim_bridge.crazyflie import Quad, Triple
from sim_bridge.errors import ScenarioError
from sim_bridge.obstacles import AWAY_ENU


class Pose(msgspec.Struct, frozen=True, kw_only=True):
    """One vehicle at one instant, ENU; attitude as enu_from_flu (w, x, y, z)."""

    name: str
    position: Triple
    attitude: Quad
    radius_m: float  # of its collision sphere
    target: Triple | None = None
    mode: str = ""
    clearance_m: float | None = None


class _Line(Pose, frozen=True, kw_only=True):
    """A line of the trace: the first vehicle flat, all of them under ``vehicles`` where there are several."""

    t_ns: int
    obstacles: list[Triple]  # `AWAY_ENU`: not there now
    obstacle_ids: list[str]
    obstacle_radii_m: list[float]
    vehicles: list[Pose] = []


@dataclass(frozen=True, slots=True)
class Ball:
    """An obstacle at one instant."""

    id: str
    p_enu: Triple
    radius_m: float


@dataclass(frozen=True, slots=True)
class Instant:
    """What is to be seen at ``t_s`` of the vehicle's clock."""

    t_s: float
    vehicles: tuple[Pose, ...]
    balls: tuple[Ball, ...]


class Log:
    """Instants in the order of time, at least one."""

    def __init__(self, instants: tuple[Instant, ...]) -> None:
        self.instants = instants
        self._times = [instant.t_s for instant in instants]

    @property
    def start_s(self) -> float:
        return self._times[0]

    @property
    def end_s(self) -> float:
        return self._times[-1]

    def at(self, t_s: float) -> Instant:
        """Between two instants: straight lines, and the shorter arc of attitudes (normalised linear)."""
        after = bisect_right(self._times, t_s)
        if after == 0 or after == len(self._times):
            return self.instants[min(after, len(self._times) - 1)]
        one, two = self.instants[after - 1], self.instants[after]
        share = (t_s - one.t_s) / (two.t_s - one.t_s)
        then = {ball.id: ball for ball in two.balls}
        balls = tuple(
            Ball(b.id, _between(b.p_enu, then[b.id].p_enu, share), b.radius_m) if b.id in then else b for b in one.balls
        )
        poses = tuple(_posed(a, b, share) for a, b in zip(one.vehicles, two.vehicles, strict=True))
        return Instant(t_s, poses, balls)

    def until(self, t_s: float, since_s: float = -math.inf) -> tuple[Instant, ...]:
        """The instants from ``since_s`` to ``t_s``."""
        return self.instants[bisect_right(self._times, since_s) : bisect_right(self._times, t_s)]


def read_log(path: Path) -> Log:
    """A trace by its path.

    Raises:
        ScenarioError: one line that names the file and what was expected.
    """
    try:
        lines = path.read_bytes().splitlines()
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read ({error.strerror})") from None
    decoder = msgspec.json.Decoder(_Line)
    instants: list[Instant] = []
    for number, line in enumerate(lines, start=1):
        try:
            instant = _instant(decoder.decode(line))
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            if number == len(lines) and instants and not isinstance(error, msgspec.ValidationError):
                break  # a run that was killed leaves its last line cut short
            raise ScenarioError(
                f"{path}: line {number}: expected a trace of sim-bridge run --trace ({error})"
            ) from None
        except ValueError as error:
            raise ScenarioError(f"{path}: line {number}: {error}") from None
        if instants and instant.t_s <= instants[-1].t_s:
            raise ScenarioError(f"{path}: line {number}: t_ns: expected a later time than on the line before")
        if instants and len(instant.vehicles) != len(instants[-1].vehicles):
            raise ScenarioError(f"{path}: line {number}: vehicles: expected as many as on the line before")
        instants.append(instant)
    if not instants:
        raise ScenarioError(f"{path}: expected a trace of sim-bridge run --trace, got an empty file")
    return Log(tuple(instants))


def _instant(line: _Line) -> Instant:
    if not len(line.obstacles) == len(line.obstacle_ids) == len(line.obstacle_radii_m):
        raise ValueError("obstacles: expected as many as obstacle_ids and obstacle_radii_m")
    balls = tuple(
        Ball(name, p_enu, radius_m)
        for name, p_enu, radius_m in zip(line.obstacle_ids, line.obstacles, line.obstacle_radii_m, strict=True)
        if p_enu != AWAY_ENU  # not there now
    )
    return Instant(line.t_ns / 1e9, tuple(line.vehicles) or (line,), balls)


def _posed(one: Pose, two: Pose, share: float) -> Pose:
    return msgspec.structs.replace(
        one,
        position=_between(one.position, two.position, share),
        attitude=_turned(one.attitude, two.attitude, share),
    )


def _between(one: Triple, two: Triple, share: float) -> Triple:
    (a, b, c), (d, e, f) = one, two
    return (a + share * (d - a), b + share * (e - b), c + share * (f - c))


def _turned(one: Quad, two: Quad, share: float) -> Quad:
    side = math.copysign(1.0, sum(a * b for a, b in zip(one, two, strict=True)))
    w, x, y, z = ((1.0 - share) * a + share * side * b for a, b in zip(one, two, strict=True))
    length = math.sqrt(w * w + x * x + y * y + z * z)
    return (w / length, x / length, y / length, z / length)
