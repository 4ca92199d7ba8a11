"""An external sensor: true positions in, noisy, late and incomplete frames out.

z = p + sigma n, n ~ N(0, I). A frame of measurement time t leaves at t + latency. Two kinds of loss, both drawn
afresh each time: ``dropout`` for one obstacle of one frame (it is missing there, the frame still comes, empty if it
must), ``frame_dropout`` for a whole frame (it never comes). Frames are never merged, reordered or resampled.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from sim_bridge.errors import ScenarioError
from sim_bridge.obstacles import Point

NS_PER_S = 1_000_000_000
Sighting = tuple[str, Point, float]  # id, measured position ENU [m], radius [m]
Frame = tuple[int, list[Sighting]]  # measurement stamp [ns], what was seen


class Sensor:
    """Measures on the grid floor(k 1e9 / rate_hz) ns, k = 0, 1, ... of the vehicle's clock.

    Args:
        ids, radii_m: of the obstacles, in the order in which ``sample`` gets their positions.
        rate_hz: measurements a second, > 0.
        sigma_m: standard deviation of each axis, >= 0.
        latency_s: from measurement to arrival, >= 0.
        dropout, frame_dropout: probabilities, see the module's head.
        rng: the only source of chance. Each measurement draws the same number of values, whatever is dropped.
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
    ) -> None:
        _check("rate_hz", rate_hz, rate_hz > 0.0, "above 0")
        _check("sigma_m", sigma_m, sigma_m >= 0.0, "0 or above")
        _check("latency_s", latency_s, latency_s >= 0.0, "0 or above")
        _check("dropout", dropout, 0.0 <= dropout <= 1.0, "a probability")
        _check("frame_dropout", frame_dropout, 0.0 <= frame_dropout <= 1.0, "a probability")
        if len(ids) != len(radii_m):
            raise ScenarioError(f"sensor: radii_m: expected {len(ids)} values, one for each id, got {len(radii_m)}")
        self._named = tuple(zip(ids, (float(radius_m) for radius_m in radii_m), strict=True))
        self._rate_hz = rate_hz
        self._sigma_m = sigma_m
        self._latency_ns = round(latency_s * NS_PER_S)
        self._dropout = dropout
        self._frame_dropout = frame_dropout
        self._rng = rng
        self._tick = 0  # index of the next measurement on the grid
        self._in_transit: deque[Frame] = deque()

    @property
    def next_ns(self) -> int:
        """Time of the next measurement."""
        return int(self._tick * NS_PER_S // self._rate_hz)

    def sample(self, t_ns: int, positions: Sequence[Point]) -> None:
        """Measure at ``t_ns`` if a measurement is due by then, else do nothing. The frame is stamped ``t_ns``.

        Calls that come late skip the grid times that they missed: a sensor has no way to look back.
        """
        if t_ns < self.next_ns:
            return
        while self.next_ns <= t_ns:
            self._tick += 1
        frame_lost = self._rng.random() < self._frame_dropout
        lost = self._rng.random(len(self._named)) < self._dropout
        noise = self._sigma_m * self._rng.standard_normal((len(self._named), 3))
        if frame_lost:
            return
        seen: list[Sighting] = []
        for (name, radius_m), (x, y, z), (nx, ny, nz), missing in zip(
            self._named, positions, noise.tolist(), lost.tolist(), strict=True
        ):
            if not missing:
                seen.append((name, (x + nx, y + ny, z + nz), radius_m))
        self._in_transit.append((t_ns, seen))

    def due(self, t_ns: int) -> list[Frame]:
        """Frames that have arrived by ``t_ns`` (stamp + latency <= t_ns), oldest first, each handed out once."""
        arrived: list[Frame] = []
        while self._in_transit and self._in_transit[0][0] + self._latency_ns <= t_ns:
            arrived.append(self._in_transit.popleft())
        return arrived


def _check(key: str, value: float, holds: bool, expectation: str) -> None:
    if not holds:
        raise ScenarioError(f"sensor: {key}: expected {expectation}, got {value}")
