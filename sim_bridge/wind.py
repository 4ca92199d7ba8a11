"""Wind that a vehicle flies in: steady, plus Dryden gusts of MIL-F-8785C for low altitude, plus gusts on request.

Dryden spectra, longitudinal (along the steady wind), lateral and vertical, at the airspeed V:

    H_u(s) = s_u sqrt(2 T_u) / (1 + T_u s)                          T_u = L_u / V
    H_v(s) = s_v sqrt(T_v) (1 + sqrt(3) T_v s) / (1 + T_v s)^2      T_v = L_v / V, and the same for w

driven by white noise of unit intensity, so that the variances are s_u^2, s_v^2, s_w^2. Below 1000 ft (h in ft):

    L_w = h,  L_u = L_v = h / (0.177 + 0.000823 h)^1.2
    s_w = 0.1 W_20,  s_u = s_v = s_w / (0.177 + 0.000823 h)^0.4

W_20, the wind at 20 ft, is 15, 30 or 45 knots for light, moderate and severe turbulence. The forms hold from 10 ft up:
nearer to the ground the values of 10 ft are taken. Source: MIL-F-8785C (1980), 3.7.3, as the MathWorks documentation of
its Dryden blocks restates them.

The filters are stepped with their exact discretisation: the state after dt is e^(A dt) x plus a Gaussian draw with the
covariance of the noise over dt, in coordinates whose stationary covariance does not depend on T, so that altitude and
airspeed may change from step to step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sim_bridge.crazyflie import Triple

FOOT_M = 0.3048
KNOT_M_S = 1852.0 / 3600.0
W20_M_S = {"light": 15.0 * KNOT_M_S, "moderate": 30.0 * KNOT_M_S, "severe": 45.0 * KNOT_M_S}
LEAST_AIRSPEED_M_S = 1.0  # the frozen field does not pass a vehicle that hovers in still air; there, at this speed
_LEAST_H_FT, _MOST_H_FT = 10.0, 1000.0
_ROOT3 = math.sqrt(3.0)


@dataclass(frozen=True, slots=True)
class DrydenParameters:
    """Intensities [m/s] and scale lengths [m] at one altitude."""

    sigma_uv_m_s: float
    sigma_w_m_s: float
    length_uv_m: float
    length_w_m: float


def dryden_parameters(w20_m_s: float, height_m: float) -> DrydenParameters:
    """The low-altitude model at ``height_m`` above the ground.

    >>> p = dryden_parameters(W20_M_S["light"], 30.48)
    >>> round(p.sigma_w_m_s, 3), round(p.length_w_m, 2), round(p.length_uv_m, 1)
    (0.772, 30.48, 154.0)
    """
    h_ft = min(max(height_m / FOOT_M, _LEAST_H_FT), _MOST_H_FT)
    base = 0.177 + 0.000823 * h_ft
    sigma_w = 0.1 * w20_m_s
    return DrydenParameters(sigma_w / base**0.4, sigma_w, h_ft / base**1.2 * FOOT_M, h_ft * FOOT_M)


class Dryden:
    """Gusts at one vehicle; starts in the stationary state.

    Args:
        w20_m_s: wind at 20 ft.
        heading_rad: of the longitudinal axis, from east towards north.
        rng: the only source of chance; five draws a step.
    """

    def __init__(self, w20_m_s: float, *, heading_rad: float, dt_s: float, rng: np.random.Generator) -> None:
        self._w20_m_s = w20_m_s
        self._dt_s = dt_s
        self._rng = rng
        self._cos, self._sin = math.cos(heading_rad), math.sin(heading_rad)
        draws = rng.standard_normal(5).tolist()
        self._u = draws[0]
        self._v = _coloured(draws[1], draws[2], 0.5, 0.25, 0.25)
        self._w = _coloured(draws[3], draws[4], 0.5, 0.25, 0.25)

    def step(self, airspeed_m_s: float, height_m: float) -> Triple:
        """Gust velocity one step later, ENU [m/s]."""
        at = dryden_parameters(self._w20_m_s, height_m)
        travelled_m = max(airspeed_m_s, LEAST_AIRSPEED_M_S) * self._dt_s
        n0, n1, n2, n3, n4 = self._rng.standard_normal(5).tolist()
        a = travelled_m / at.length_uv_m
        decay = math.exp(-a)
        self._u = decay * self._u + math.sqrt(-math.expm1(-2.0 * a)) * n0
        self._v = _second_order(self._v, a, n1, n2)
        self._w = _second_order(self._w, travelled_m / at.length_w_m, n3, n4)
        along = at.sigma_uv_m_s * self._u
        across = at.sigma_uv_m_s * _output(self._v)
        up = at.sigma_w_m_s * _output(self._w)
        return (self._cos * along - self._sin * across, self._sin * along + self._cos * across, up)


def _second_order(x: tuple[float, float], a: float, n0: float, n1: float) -> tuple[float, float]:
    """z1' = (-z1 + n)/T, z2' = (-z2 + z1)/T over dt = a T, n of intensity T."""
    decay = math.exp(-a)
    if a < 1e-2:  # series: the closed forms below lose their digits
        q11 = a - a * a + 2.0 / 3.0 * a**3
        q12 = 0.5 * a * a - 2.0 / 3.0 * a**3 + 0.5 * a**4
        q22 = a**3 / 3.0 - 0.5 * a**4 + 0.4 * a**5
    else:
        e2 = decay * decay
        q11 = 0.5 * (1.0 - e2)
        q12 = 0.25 * (1.0 - e2 * (1.0 + 2.0 * a))
        q22 = 0.25 * (1.0 - e2 * (1.0 + 2.0 * a + 2.0 * a * a))
    d0, d1 = _coloured(n0, n1, q11, q12, q22)
    return (decay * x[0] + d0, decay * (x[1] + a * x[0]) + d1)


def _coloured(n0: float, n1: float, q11: float, q12: float, q22: float) -> tuple[float, float]:
    """Two draws with the covariance [[q11, q12], [q12, q22]] out of two of N(0, 1)."""
    first = math.sqrt(q11)
    cross = q12 / first
    return (first * n0, cross * n0 + math.sqrt(max(q22 - cross * cross, 0.0)) * n1)


def _output(x: tuple[float, float]) -> float:
    """(1 + sqrt(3) T s) / (1 + T s)^2 by partial fractions."""
    return _ROOT3 * x[0] + (1.0 - _ROOT3) * x[1]


class Wind:
    """The air's velocity at each vehicle.

    Args:
        steady_enu: [m/s].
        gusts: ``none`` or a key of `W20_M_S`.
        rngs: one generator per vehicle: gusts of vehicles are independent.
    """

    def __init__(self, steady_enu: Triple, gusts: str, *, dt_s: float, rngs: tuple[np.random.Generator, ...]) -> None:
        heading_rad = math.atan2(steady_enu[1], steady_enu[0])
        self.steady_enu = steady_enu
        self._dt_s = dt_s
        self._dryden = (
            [Dryden(W20_M_S[gusts], heading_rad=heading_rad, dt_s=dt_s, rng=rng) for rng in rngs]
            if gusts != "none"
            else []
        )
        self._added: list[tuple[float, Triple]] = []  # end of each gust on request, its velocity

    def gust(self, v_enu: Triple, until_s: float) -> None:
        """Add ``v_enu`` everywhere until ``until_s``."""
        self._added.append((until_s, v_enu))

    @property
    def still(self) -> bool:
        """No air moves now, and none will unless asked for."""
        return not self._dryden and not self._added and self.steady_enu == (0.0, 0.0, 0.0)

    def at(self, index: int, v_enu: Triple, height_m: float) -> Triple:
        """Air velocity at vehicle ``index`` for the coming step, ENU [m/s]; call once a step."""
        x, y, z = self.steady_enu
        for _, (gx, gy, gz) in self._added:
            x, y, z = x + gx, y + gy, z + gz
        if self._dryden:
            airspeed_m_s = math.dist(v_enu, (x, y, z))
            gx, gy, gz = self._dryden[index].step(airspeed_m_s, height_m)
            x, y, z = x + gx, y + gy, z + gz
        return (x, y, z)

    def forget(self, t_s: float) -> None:
        """Drop the gusts on request that are over at ``t_s``."""
        if self._added:
            self._added = [(until_s, v_enu) for until_s, v_enu in self._added if until_s > t_s + 1e-9]
