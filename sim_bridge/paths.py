"""Motions through given points: straight legs, cubic splines, recorded tracks.

All rest at their first point before its time and at their last one after its time. Plain floats: these run every
physics step.
"""

from __future__ import annotations

import bisect
import csv
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from sim_bridge.errors import ScenarioError
from sim_bridge.obstacles import Point

_REST: Point = (0.0, 0.0, 0.0)
_HEADER = ("t_s", "x", "y", "z")
_MOST_ROWS = 200_000
_BOUND_M = 1e4


@dataclass(frozen=True, slots=True)
class Polyline:
    """p(t) linear between (times[i], points[i]); the velocity at a corner is that of the leg that begins there.

    Args:
        times_s: rising. loop: begin again at the last time; the last point must then be the first.
    """

    times_s: tuple[float, ...]
    points: tuple[Point, ...]
    loop: bool = False

    def position(self, t_s: float) -> Point:
        i, since_s = self._leg(t_s)
        if i < 0:
            return self.points[0]
        (px, py, pz), (vx, vy, vz) = self.points[i], self._slope(i)
        return (px + vx * since_s, py + vy * since_s, pz + vz * since_s)

    def velocity(self, t_s: float) -> Point:
        i, _ = self._leg(t_s)
        return self._slope(i) if i >= 0 else _REST

    def _leg(self, t_s: float) -> tuple[int, float]:
        """Index of the leg at ``t_s`` and the time since it began; -1 before the first."""
        times = self.times_s
        if self.loop and t_s >= times[0]:
            t_s = times[0] + math.fmod(t_s - times[0], times[-1] - times[0])
        i = bisect.bisect_right(times, t_s) - 1
        return i, (t_s - times[i] if i >= 0 else 0.0)

    def _slope(self, i: int) -> Point:
        """[m/s]; nothing moves from the last point on."""
        if i == len(self.points) - 1:
            return _REST
        dt_s = self.times_s[i + 1] - self.times_s[i]
        (ax, ay, az), (bx, by, bz) = self.points[i], self.points[i + 1]
        return ((bx - ax) / dt_s, (by - ay) / dt_s, (bz - az) / dt_s)


def waypoints(points: Sequence[Point], speed_m_s: float, *, loop: bool = False) -> Polyline:
    """Straight legs at constant speed from t = 0 on; ``loop`` closes the way back to the first point."""
    way = [*points, points[0]] if loop else [*points]
    times = [0.0]
    for start, end in pairwise(way):
        times.append(times[-1] + math.dist(start, end) / speed_m_s)
    return Polyline(tuple(times), tuple(way), loop)


@dataclass(frozen=True, slots=True)
class Spline:
    """Between two knots p(t) = c0 + c1 s + c2 s^2 + c3 s^3 with s = t - times[i]; twice continuously differentiable,
    at rest at both ends (clamped). Build it with `spline`.
    """

    times_s: tuple[float, ...]
    points: tuple[Point, ...]
    cubics: tuple[tuple[Point, Point, Point, Point], ...]  # c0, c1, c2, c3 of each piece

    def position(self, t_s: float) -> Point:
        i = bisect.bisect_right(self.times_s, t_s) - 1
        if i < 0 or i >= len(self.cubics):
            return self.points[min(max(i, 0), len(self.points) - 1)]
        s = t_s - self.times_s[i]
        x, y, z = (a + s * (b + s * (c + s * d)) for a, b, c, d in zip(*self.cubics[i], strict=True))
        return (x, y, z)

    def velocity(self, t_s: float) -> Point:
        i = bisect.bisect_right(self.times_s, t_s) - 1
        if i < 0 or i >= len(self.cubics):
            return _REST
        s = t_s - self.times_s[i]
        x, y, z = (b + s * (2.0 * c + 3.0 * s * d) for _, b, c, d in zip(*self.cubics[i], strict=True))
        return (x, y, z)


def spline(times_s: Sequence[float], points: Sequence[Point]) -> Spline:
    """The cubic spline through ``points`` at rising ``times_s`` that rests at both ends.

    With steps h_i, slopes m_i at the knots and secants d_i, continuity of the second derivative demands
    m_{i-1} / h_{i-1} + 2 m_i (1 / h_{i-1} + 1 / h_i) + m_{i+1} / h_i = 3 (d_{i-1} / h_{i-1} + d_i / h_i).
    Source: de Boor, A Practical Guide to Splines, chapter IV.
    """
    slopes = [_clamped_slopes(times_s, [p[axis] for p in points]) for axis in range(3)]
    cubics = []
    for i, (start, end) in enumerate(pairwise(points)):
        h = times_s[i + 1] - times_s[i]
        pieces = []
        for a, b, m in zip(start, end, slopes, strict=True):
            d = (b - a) / h
            pieces.append((a, m[i], (3.0 * d - 2.0 * m[i] - m[i + 1]) / h, (m[i] + m[i + 1] - 2.0 * d) / (h * h)))
        (ax, bx, cx, dx), (ay, by, cy, dy), (az, bz, cz, dz) = pieces
        cubics.append(((ax, ay, az), (bx, by, bz), (cx, cy, cz), (dx, dy, dz)))
    return Spline(tuple(times_s), tuple(points), tuple(cubics))


def _clamped_slopes(times_s: Sequence[float], values: Sequence[float]) -> list[float]:
    """The slopes at the knots, 0 at both ends: a tridiagonal system, solved by elimination."""
    n = len(values)
    inverse = [1.0 / (b - a) for a, b in pairwise(times_s)]
    above, right = [0.0] * n, [0.0] * n  # after elimination: m_i + above_i m_{i+1} = right_i
    for i in range(1, n - 1):
        before, after = inverse[i - 1], inverse[i]
        secants = (values[i] - values[i - 1]) * before * before + (values[i + 1] - values[i]) * after * after
        pivot = 2.0 * (before + after) - before * above[i - 1]
        above[i] = after / pivot
        right[i] = (3.0 * secants - before * right[i - 1]) / pivot
    slopes = [0.0] * n
    for i in range(n - 2, 0, -1):
        slopes[i] = right[i] - above[i] * slopes[i + 1]
    return slopes


def read_track(path: str | Path) -> tuple[tuple[float, ...], tuple[Point, ...]]:
    """Times [s] and positions ENU [m] of a CSV file with the header ``t_s,x,y,z``.

    Raises:
        ScenarioError: it cannot be read, or a line is not four numbers with a time later than the last one's.
    """
    times: list[float] = []
    points: list[Point] = []
    try:
        with Path(path).open(newline="", encoding="utf-8") as file:
            for t_s, p_enu in _rows(csv.reader(file), str(path)):
                if times and t_s <= times[-1]:
                    raise ScenarioError(f"{path}: row {len(times) + 1}: t_s: expected after {times[-1]}, got {t_s}")
                times.append(t_s)
                points.append(p_enu)
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read ({error.strerror}), expected a CSV file") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise ScenarioError(f"{path}: not CSV: {error}") from None
    if len(times) < 2:
        raise ScenarioError(f"{path}: expected at least 2 rows, got {len(times)}")
    return tuple(times), tuple(points)


def _rows(lines: Iterator[list[str]], path: str) -> Iterator[tuple[float, Point]]:
    header = tuple(name.strip() for name in next(lines, []))
    if header != _HEADER:
        raise ScenarioError(f"{path}: expected the header {','.join(_HEADER)}, got {','.join(header)[:60]}")
    for row, fields in enumerate((line for line in lines if line), 1):
        if row > _MOST_ROWS:
            raise ScenarioError(f"{path}: expected at most {_MOST_ROWS} rows")
        try:
            t_s, x, y, z = (float(field) for field in fields)
        except ValueError:
            raise ScenarioError(f"{path}: row {row}: expected four numbers, got {','.join(fields)[:60]}") from None
        if not all(abs(value) <= _BOUND_M for value in (t_s, x, y, z)):
            raise ScenarioError(f"{path}: row {row}: expected numbers within +-{_BOUND_M:g}, got {','.join(fields)}")
        yield t_s, (x, y, z)
