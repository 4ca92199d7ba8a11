"""An external sensor: true positions in, noisy, late and incomplete frames out.

z = p + sigma n, n ~ N(0, I). A frame of measurement time t leaves at t + latency. Two kinds of loss, both drawn
afresh each time: ``dropout`` for one obstacle of one frame (it is missing there, the frame still comes, empty if it
must), ``frame_dropout`` for a whole frame (it never comes). Frames are never merged, reordered or resampled.

A sensor that is carried by a vehicle may see a part of the space alone (`View`), and may see what is not there
(`Clutter`). Both are off unless asked for, and change no draw of the noise.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sim_bridge.body import to_body
from sim_bridge.crazyflie import Quad, Triple
from sim_bridge.errors import ScenarioError
from sim_bridge.obstacles import AWAY_ENU, Point
from sim_bridge.scenario import SensorSpec

NS_PER_S = 1_000_000_000
Sighting = tuple[str | None, Point, float]  # id (None: anonymous), measured position ENU [m], radius [m]
Frame = tuple[int, list[Sighting]]  # measurement stamp [ns], what was seen


class Observer(Protocol):
    """Who carries the sensor."""

    @property
    def p_enu(self) -> Triple: ...

    @property
    def q_wxyz(self) -> Quad: ...


@dataclass(frozen=True, slots=True)
class View:
    """What can be seen, in body axes: |r| <= range, |azimuth| <= fov / 2, |elevation| <= fov_up / 2.

    Azimuth is atan2(left, forward), elevation atan2(up, hypot(forward, left)). An obstacle is seen if its centre is.
    """

    range_m: float = math.inf
    fov_rad: float = math.tau
    fov_up_rad: float = math.pi

    @property
    def limited(self) -> bool:
        return self != View()

    def sees(self, p_enu: Point, observer: Observer) -> bool:
        (x, y, z), (ox, oy, oz) = p_enu, observer.p_enu
        r_enu = (x - ox, y - oy, z - oz)
        if math.hypot(*r_enu) > self.range_m:
            return False
        forward, left, up = to_body(observer.q_wxyz, r_enu)
        azimuth, elevation = math.atan2(left, forward), math.atan2(up, math.hypot(forward, left))
        return abs(azimuth) <= 0.5 * self.fov_rad and abs(elevation) <= 0.5 * self.fov_up_rad

    def draw(self, u: Sequence[float], observer: Observer) -> Point:
        """The point of the view, uniform in its volume, that belongs to three draws from [0, 1)."""
        r = self.range_m * u[0] ** (1.0 / 3.0)
        azimuth = self.fov_rad * (u[1] - 0.5)
        sine = math.sin(0.5 * self.fov_up_rad) * (2.0 * u[2] - 1.0)
        level = r * math.sqrt(1.0 - sine * sine)
        w, x, y, z = observer.q_wxyz
        dx, dy, dz = to_body((w, -x, -y, -z), (level * math.cos(azimuth), level * math.sin(azimuth), r * sine))
        px, py, pz = observer.p_enu
        return (px + dx, py + dy, pz + dz)


@dataclass(frozen=True, slots=True)
class Clutter:
    """False detections: N ~ Poisson(mean) in each frame, uniform in ``box`` (opposite corners, ENU) or in the view."""

    mean: float = 0.0
    box: tuple[Point, Point] | None = None
    radius_m: float = 0.2


class Sensor:
    """Measures on the grid floor(k 1e9 / rate_hz) ns, k = 0, 1, ... of the vehicle's clock.

    Args:
        ids, radii_m: of the obstacles, in the order in which ``sample`` gets their positions.
        rate_hz: measurements a second, > 0.
        sigma_m: standard deviation of each axis, >= 0.
        latency_s: from measurement to arrival, >= 0.
        dropout, frame_dropout: probabilities, see the module's head.
        rng: the only source of chance. Each measurement draws the same number of values, whatever is dropped or out
            of sight; clutter draws from a child of it.
        view, clutter: see there. anonymous: no detection carries an id.
    Raises:
        ScenarioError: an argument out of its range, or ids and radii of different number.
    """

    def __init__(
        self,
        ids: Sequence[str],
        radii_m: Sequence[float],
        *,
        rate_hz: float,
        sigma_m: float,
        latency_s: float,
        dropout: float,
        rng: np.random.Generator,
        frame_dropout: float = 0.0,
        view: View | None = None,
        clutter: Clutter | None = None,
        anonymous: bool = False,
    ) -> None:
        _check("rate_hz", rate_hz, rate_hz > 0.0, "above 0")
        _check("sigma_m", sigma_m, sigma_m >= 0.0, "0 or above")
        _check("latency_s", latency_s, latency_s >= 0.0, "0 or above")
        _check("dropout", dropout, 0.0 <= dropout <= 1.0, "a probability")
        _check("frame_dropout", frame_dropout, 0.0 <= frame_dropout <= 1.0, "a probability")
        if len(ids) != len(radii_m):
            raise ScenarioError(f"sensor: radii_m: expected {len(ids)} values, one for each id, got {len(radii_m)}")
        self._view = View() if view is None else view
        self._clutter = Clutter() if clutter is None else clutter
        if self._clutter.mean > 0.0 and self._clutter.box is None and math.isinf(self._view.range_m):
            raise ScenarioError("sensor: clutter: expected a range or a box to bound it")
        self._named = tuple(zip(ids, (float(radius_m) for radius_m in radii_m), strict=True))
        self._rate_hz = rate_hz
        self._sigma_m = sigma_m
        self._latency_ns = round(latency_s * NS_PER_S)
        self._dropout = dropout
        self._frame_dropout = frame_dropout
        self._anonymous = anonymous
        self._rng = rng
        self._clutter_rng = rng.spawn(1)[0] if self._clutter.mean > 0.0 else None
        self._clutter_count = 0
        self._tick = 0  # index of the next measurement on the grid
        self._in_transit: deque[Frame] = deque()

    @property
    def next_ns(self) -> int:
        """Time of the next measurement."""
        return int(self._tick * NS_PER_S // self._rate_hz)

    def sample(self, t_ns: int, positions: Sequence[Point], observer: Observer | None = None) -> None:
        """Measure at ``t_ns`` if a measurement is due by then, else do nothing. The frame is stamped ``t_ns``.

        Calls that come late skip the grid times that they missed: a sensor has no way to look back. An obstacle at
        `AWAY_ENU` is not there. ``observer`` is who carries the sensor; a sensor without limits does without.
        """
        if t_ns < self.next_ns:
            return
        while self.next_ns <= t_ns:
            self._tick += 1
        frame_lost = self._rng.random() < self._frame_dropout
        lost = self._rng.random(len(self._named)) < self._dropout
        noise = self._sigma_m * self._rng.standard_normal((len(self._named), 3))
        false = [] if self._clutter_rng is None else self._draw_clutter(self._clutter_rng, observer)
        if frame_lost:
            return
        seen: list[Sighting] = []
        for (name, radius_m), p_enu, (nx, ny, nz), missing in zip(
            self._named, positions, noise.tolist(), lost.tolist(), strict=True
        ):
            if not missing and p_enu != AWAY_ENU and self._in_sight(p_enu, observer):
                x, y, z = p_enu
                seen.append((None if self._anonymous else name, (x + nx, y + ny, z + nz), radius_m))
        self._in_transit.append((t_ns, seen + false))

    def due(self, t_ns: int) -> list[Frame]:
        """Frames that have arrived by ``t_ns`` (stamp + latency <= t_ns), oldest first, each handed out once."""
        arrived: list[Frame] = []
        while self._in_transit and self._in_transit[0][0] + self._latency_ns <= t_ns:
            arrived.append(self._in_transit.popleft())
        return arrived

    def _in_sight(self, p_enu: Point, observer: Observer | None) -> bool:
        return not self._view.limited or self._view.sees(p_enu, _needed(observer))

    def _draw_clutter(self, rng: np.random.Generator, observer: Observer | None) -> list[Sighting]:
        clutter, false = self._clutter, []
        draws = rng.random((int(rng.poisson(clutter.mean)), 3)).tolist()
        for u in draws:
            self._clutter_count += 1
            if clutter.box is None:
                p_enu = self._view.draw(u, _needed(observer))
            else:
                x, y, z = (a + share * (b - a) for a, b, share in zip(*clutter.box, u, strict=True))
                p_enu = (x, y, z)
            false.append((None if self._anonymous else f"clutter-{self._clutter_count}", p_enu, clutter.radius_m))
        return false


def sensor_of(spec: SensorSpec, ids: Sequence[str], radii_m: Sequence[float], rng: np.random.Generator) -> Sensor:
    """The sensor that a scenario's table describes."""
    return Sensor(
        ids,
        radii_m,
        rate_hz=spec.rate_hz,
        sigma_m=spec.sigma_m,
        latency_s=spec.latency_s,
        dropout=spec.dropout,
        frame_dropout=spec.frame_dropout,
        view=View(
            math.inf if spec.range_m is None else spec.range_m,
            math.radians(spec.fov_deg),
            math.radians(spec.fov_up_deg),
        ),
        clutter=Clutter(spec.clutter, spec.clutter_box, spec.clutter_radius_m),
        anonymous=spec.anonymous,
        rng=rng,
    )


def _needed(observer: Observer | None) -> Observer:
    if observer is None:
        raise ValueError("a sensor with a limited view, or clutter in it, needs to know who carries it")
    return observer


def _check(key: str, value: float, holds: bool, expectation: str) -> None:
    if not holds:
        raise ScenarioError(f"sensor: {key}: expected {expectation}, got {value}")
