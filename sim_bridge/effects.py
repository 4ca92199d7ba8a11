"""Aerodynamic effects between a rotor, the ground and other vehicles: thrust factors and forces, no state.

Coefficients: gym-pybullet-drones ``cf2x.urdf`` and ``BaseAviary`` (Panerati et al., IROS 2021), identified on the
Crazyflie at the University of Toronto's Dynamic Systems Lab; the ground effect after Shi et al., "Neural Lander", ICRA
2019, which generalises Cheeseman and Bennett, ARC R&M 3021, 1955 (a single rotor: T/T_inf = 1 / (1 - (R/4z)^2)).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from sim_bridge.crazyflie import Quad, Triple

ROTOR_RADIUS_M = 2.31348e-2
GROUND_COEFFICIENT = 11.36859
DOWNWASH_1 = 2267.18  # [N]
DOWNWASH_2 = 0.16
DOWNWASH_3_M = -0.11
DOWNWASH_REACH_M = 10.0  # aside of the upper vehicle
LEAST_WIDTH_M = 0.0397  # of the wake: the arm. The published width passes through 0 at 0.69 m below


def ground_clip_m() -> float:
    """Height below which the ground effect grows no more: R/4 sqrt(15 k_g f_max / F_max).

    f_max is the most thrust of one rotor, F_max of all four.

    >>> round(ground_clip_m(), 4)
    0.0378
    """
    return 0.25 * ROTOR_RADIUS_M * math.sqrt(15.0 * GROUND_COEFFICIENT / 4.0)


_CLIP_M = ground_clip_m()
_FACTOR = GROUND_COEFFICIENT * (0.25 * ROTOR_RADIUS_M) ** 2


def ground_factor(height_m: float) -> float:
    """T/T_inf = 1 + k_g (R / 4z)^2 of a rotor ``height_m`` above the ground.

    >>> round(ground_factor(2 * ROTOR_RADIUS_M), 4), round(ground_factor(0.2), 4)
    (1.1776, 1.0095)
    """
    z = max(height_m, _CLIP_M)
    return 1.0 + _FACTOR / (z * z)


def ground_factors(p_enu: Triple, q_wxyz: Quad, rotors_flu: Sequence[Triple]) -> Quad:
    """`ground_factor` of each rotor above z = 0; 1 while the vehicle is tilted by 90 degrees or more."""
    w, x, y, z = q_wxyz
    if 1.0 - 2.0 * (x * x + y * y) <= 0.0:
        return (1.0, 1.0, 1.0, 1.0)
    zx, zy = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x)  # third row of enu_from_flu; rotors lie in the body's plane
    f0, f1, f2, f3 = (ground_factor(p_enu[2] + zx * rx + zy * ry) for rx, ry, _ in rotors_flu)
    return (f0, f1, f2, f3)


def downwash_n(below_m: float, aside_m: float, *, thrust_n: float, weight_n: float) -> float:
    """Downward force on a vehicle ``below_m`` under and ``aside_m`` beside another that gives ``thrust_n``.

    F = a exp(-(aside / b)^2 / 2) T / (m g) with a = d_1 (R / 4 dz)^2 and b = d_2 dz + d_3. The model was identified on
    hovering vehicles: it is scaled by the upper one's thrust. Two bounds keep it physical near by: a wake pushes with
    no more than the thrust that drives it (a <= m g), and is no narrower than `LEAST_WIDTH_M`.

    >>> round(downwash_n(1.0, 0.0, thrust_n=0.2646, weight_n=0.2646), 4)
    0.0758
    """
    if below_m <= 0.0 or aside_m >= DOWNWASH_REACH_M:
        return 0.0
    strength = min(DOWNWASH_1 * (ROTOR_RADIUS_M / (4.0 * below_m)) ** 2, weight_n)
    width_m = max(abs(DOWNWASH_2 * below_m + DOWNWASH_3_M), LEAST_WIDTH_M)
    return strength * math.exp(-0.5 * (aside_m / width_m) ** 2) * thrust_n / weight_n
