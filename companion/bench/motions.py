"""The fixed set of obstacle motions that tracking is measured on, exact at every instant.

Each is drawn anew for a trial (heading, size, phase, moments of a change) from the generator that is passed, so a
motion is a family, not one path. Speeds are those of obstacles that a small vehicle meets: up to about 3 m/s.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from companion.types import FloatArray

DURATION_S = 20.0
_MARGIN_S = 2.0  # truth is known this much longer, for predictions beyond the end

Path = Callable[[FloatArray], tuple[FloatArray, FloatArray]]  # t (K,) [s] -> position [m], velocity [m/s], (K, 3)


@dataclass(frozen=True, slots=True)
class Motion:
    """A family of paths."""

    name: str
    draw: Callable[[np.random.Generator], Path]


def _heading(rng: np.random.Generator, bearing: float | None = None) -> FloatArray:
    """A unit vector, any bearing unless one is given, climbing or sinking by up to 20 degrees."""
    bearing = rng.uniform(0.0, 2.0 * math.pi) if bearing is None else bearing
    climb = math.radians(rng.uniform(-20.0, 20.0))
    return np.array([math.cos(bearing) * math.cos(climb), math.sin(bearing) * math.cos(climb), math.sin(climb)])


def straight(rng: np.random.Generator) -> Path:
    """p = v t at 0.5 to 3 m/s."""
    v = rng.uniform(0.5, 3.0) * _heading(rng)
    return lambda t: (t[:, None] * v, np.broadcast_to(v, (len(t), 3)).copy())


def accelerating(rng: np.random.Generator) -> Path:
    """p = v0 t + a t^2 / 2 along one line, from -3 to +3 m/s over the trial or the half of that."""
    along, a = _heading(rng), rng.uniform(0.15, 0.3)
    v0 = -0.5 * a * DURATION_S
    return lambda t: (
        (v0 * t + 0.5 * a * t * t)[:, None] * along,
        (v0 + a * t)[:, None] * along,
    )


def circle(rng: np.random.Generator) -> Path:
    """A level circle of 1 to 2 m radius at 1 to 2.5 m/s, either way round."""
    return _turning(rng, radius_m=rng.uniform(1.0, 2.0), speed_m_s=rng.uniform(1.0, 2.5), climb_m_s=0.0)


def climbing_turn(rng: np.random.Generator) -> Path:
    """The circle with 0.3 to 0.8 m/s up or down."""
    climb = float(rng.choice((-1.0, 1.0)) * rng.uniform(0.3, 0.8))
    return _turning(rng, radius_m=rng.uniform(1.5, 3.0), speed_m_s=rng.uniform(1.0, 2.5), climb_m_s=climb)


def _turning(rng: np.random.Generator, *, radius_m: float, speed_m_s: float, climb_m_s: float) -> Path:
    phase, turn = rng.uniform(0.0, 2.0 * math.pi), float(rng.choice((-1.0, 1.0))) * speed_m_s / radius_m

    def path(t: FloatArray) -> tuple[FloatArray, FloatArray]:
        angle = phase + turn * t
        level = radius_m * np.stack((np.cos(angle), np.sin(angle)), axis=1)
        across = radius_m * turn * np.stack((-np.sin(angle), np.cos(angle)), axis=1)
        return np.column_stack((level, climb_m_s * t)), np.column_stack((across, np.full_like(t, climb_m_s)))

    return path


def eight(speed_m_s: float) -> Callable[[np.random.Generator], Path]:
    """Lemniscate of Gerono, p = A (sin wt e1 + sin wt cos wt e2), ``speed_m_s`` = sqrt(2) A w at its centre."""

    def draw(rng: np.random.Generator) -> Path:
        size = rng.uniform(1.0, 2.0)
        w = speed_m_s / (math.sqrt(2.0) * size)
        phase, bearing = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(0.0, 2.0 * math.pi)
        e1 = np.array([math.cos(bearing), math.sin(bearing), 0.0])
        e2 = np.array([-math.sin(bearing), math.cos(bearing), 0.0])

        def path(t: FloatArray) -> tuple[FloatArray, FloatArray]:
            angle = phase + w * t
            p = size * (np.sin(angle)[:, None] * e1 + 0.5 * np.sin(2.0 * angle)[:, None] * e2)
            v = size * w * (np.cos(angle)[:, None] * e1 + np.cos(2.0 * angle)[:, None] * e2)
            return p, v

        return path

    return draw


def jink(rng: np.random.Generator) -> Path:
    """1 to 2.5 m/s, every 1 to 3 s a bearing 40 to 120 degrees off and a new climb, within 0.5 s at constant force."""
    speed, turn_s = rng.uniform(1.0, 2.5), 0.5
    bearing = rng.uniform(0.0, 2.0 * math.pi)
    v = v0 = speed * _heading(rng, bearing)
    starts, accelerations, t = [0.0], [np.zeros(3)], 0.0
    while t < DURATION_S + _MARGIN_S:
        t += rng.uniform(1.0, 3.0)
        bearing += float(rng.choice((-1.0, 1.0))) * math.radians(rng.uniform(40.0, 120.0))
        new = speed * _heading(rng, bearing)
        starts += [t, t + turn_s]
        accelerations += [(new - v) / turn_s, np.zeros(3)]
        t, v = t + turn_s, new
    return _pieces(np.array(starts), np.array(accelerations), v0)


def dash_and_stop(rng: np.random.Generator) -> Path:
    """Stands for 0.5 to 1.5 s, dashes off at 3 m/s^2 to 1.5 to 3 m/s, cruises for 1 to 2 s, brakes at 3 m/s^2."""
    starts, accelerations, t = [0.0], [np.zeros(3)], 0.0
    while t < DURATION_S + _MARGIN_S:
        t += rng.uniform(0.5, 1.5)
        along, ramp_s = _heading(rng), rng.uniform(0.5, 1.0)
        for a, lasts_s in ((3.0, ramp_s), (0.0, rng.uniform(1.0, 2.0)), (-3.0, ramp_s)):
            starts.append(t)
            accelerations.append(a * along)
            t += lasts_s
        starts.append(t)
        accelerations.append(np.zeros(3))
    return _pieces(np.array(starts), np.array(accelerations), np.zeros(3))


def _pieces(starts: FloatArray, accelerations: FloatArray, v0: FloatArray) -> Path:
    """Constant acceleration from each of ``starts`` (S,) on; position and velocity are continuous."""
    lasts = np.diff(starts)[:, None]
    v = v0 + np.concatenate((np.zeros((1, 3)), np.cumsum(accelerations[:-1] * lasts, axis=0)))
    moved = v[:-1] * lasts + 0.5 * accelerations[:-1] * lasts**2
    p = np.concatenate((np.zeros((1, 3)), np.cumsum(moved, axis=0)))

    def path(t: FloatArray) -> tuple[FloatArray, FloatArray]:
        piece = np.searchsorted(starts, t, side="right") - 1
        since, a = (t - starts[piece])[:, None], accelerations[piece]
        return p[piece] + v[piece] * since + 0.5 * a * since**2, v[piece] + a * since

    return path


MOTIONS = (
    Motion("straight", straight),
    Motion("accelerating", accelerating),
    Motion("circle", circle),
    Motion("eight 0.5 m/s", eight(0.5)),
    Motion("eight 1.5 m/s", eight(1.5)),
    Motion("eight 3 m/s", eight(3.0)),
    Motion("climbing turn", climbing_turn),
    Motion("jink", jink),
    Motion("dash and stop", dash_and_stop),
)
