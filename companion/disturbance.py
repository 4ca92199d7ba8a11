"""A slow estimate of the acceleration that nobody commanded (design 5.14).

Acceleration-only offboard closes no velocity loop and hover thrust is never exact. With the commanded acceleration
w passed through the autopilot's lag, da/dt = (w - a) / tau, the velocity innovation of a step is
nu = (v(k) - v(k-1)) - integral of a; the estimate follows nu / dt through a first-order low-pass:

    d += (1 - exp(-2 pi f dt)) (nu / dt - d),   |d| <= bound per axis.
"""

from __future__ import annotations

import math

import numpy as np

from companion.config import DisturbanceConfig
from companion.types import Vec3, frozen


class DisturbanceObserver:
    """``update`` once a tick with the new velocity, then ``command`` with what was sent.

    Args:
        config: bandwidth [Hz], bound [m/s^2].
        lag_s: first-order lag tau of the autopilot's acceleration loop [s].
    """

    def __init__(self, config: DisturbanceConfig, *, lag_s: float) -> None:
        self._config = config
        self._lag_s = lag_s
        self.reset()

    def reset(self) -> None:
        self._estimate: Vec3 = frozen([0.0, 0.0, 0.0])
        self._modelled = np.zeros(3)  # the acceleration that the commands should be causing
        self._command: Vec3 = frozen([0.0, 0.0, 0.0])
        self._v_last: Vec3 | None = None
        self._frozen = True

    def skip(self) -> None:
        """The next velocity does not follow from the last one (an estimator reset): it says nothing about forces."""
        self._v_last = None

    def update(self, v_enu: Vec3, elapsed_s: float | None, *, adapt: bool) -> Vec3:
        """The estimate [m/s^2] after this tick's velocity; unchanged unless ``adapt`` and the last command was free."""
        v_last, self._v_last = self._v_last, v_enu
        if v_last is None or elapsed_s is None or not self._config.enabled:
            return self._estimate
        start = self._modelled
        decay = math.exp(-elapsed_s / self._lag_s) if self._lag_s > 0.0 else 0.0
        self._modelled = self._command + (start - self._command) * decay
        mean = self._command + (start - self._command) * (1.0 - decay) * self._lag_s / elapsed_s
        if adapt and not self._frozen:
            raw = (v_enu - v_last) / elapsed_s - mean
            gain = 1.0 - math.exp(-2.0 * math.pi * self._config.bandwidth_hz * elapsed_s)
            bound = self._config.bound_m_s2
            self._estimate = frozen(np.clip(self._estimate + gain * (raw - self._estimate), -bound, bound))
        return self._estimate

    def command(self, wire_enu: Vec3, *, saturated: bool) -> None:
        """What the autopilot was told in this tick [m/s^2]; a saturated command freezes the next update."""
        self._command = wire_enu
        self._frozen = saturated
