"""The simulated vehicle: a Crazyflie 2.x with Table 2 of the paper, completed by published values.

Rotor i at ``rotor_positions_flu[i]`` gives the thrust f_i = k_f w_i^2 along body z and, against its direction of
turning, the torque c_i k_m w_i^2 about body z (w in RPM). Order, seen from above, x forward, y left:
0 front left, 1 rear left, 2 rear right, 3 front right; c = (-1, +1, -1, +1).

Sources
    Table 2 of the paper: mass, inertia, k_f, k_m, g, collision radius.
    gym-pybullet-drones ``cf2x.urdf`` (Panerati et al., IROS 2021; the paper's simulator): arm 0.0397 m,
        thrust-to-weight ratio 2.25, rotor drag 9.1785e-7 and 10.311e-7 kg/rad, which are those of
        J. Foerster, "System Identification of the Crazyflie 2.0 Nano Quadrocopter", ETH Zurich, 2015.
    CrazyS ``crazyflie2.xacro`` (Silano, Aucone, Iannelli, MED 2018): motor time constants 12.5 ms up, 25 ms down.
    utiasDSL drone-models, ``cf2x_L250``: least thrust of a running motor 0.02 N.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

Triple = tuple[float, float, float]
Quad = tuple[float, float, float, float]

SPIN_TORQUE_SIGN: Quad = (-1.0, 1.0, -1.0, 1.0)  # c_i: sign of the reaction torque on the body, about body z


@dataclass(frozen=True, slots=True, kw_only=True)
class Crazyflie:
    """Physical parameters; the defaults are the vehicle of the paper."""

    mass_kg: float = 0.027
    inertia_kg_m2: Triple = (2.39e-5, 2.39e-5, 3.23e-5)  # principal, about x, y, z of the body
    k_f: float = 3.16e-10  # thrust [N/RPM^2]
    k_m: float = 7.94e-12  # reaction torque [N m/RPM^2]
    arm_m: float = 0.0397  # centre to rotor axis
    radius_m: float = 0.2  # collision sphere r_d
    motor_up_s: float = 0.0125  # first-order lag of a rotor that speeds up
    motor_down_s: float = 0.025  # and of one that slows down
    thrust_to_weight: float = 2.25  # all four motors at full speed
    idle_thrust_n: float = 0.02  # one motor, the least while armed
    drag_xy_kg_rad: float = 9.1785e-7  # rotor drag: F = -k (sum of |w|, rad/s) v, body axes
    drag_z_kg_rad: float = 10.311e-7
    g_m_s2: float = 9.8

    @property
    def weight_n(self) -> float:
        return self.mass_kg * self.g_m_s2

    @property
    def hover_rpm(self) -> float:
        """4 k_f w^2 = m g.

        >>> round(Crazyflie().hover_rpm)
        14468
        """
        return math.sqrt(self.weight_n / (4.0 * self.k_f))

    @property
    def max_rpm(self) -> float:
        return self.hover_rpm * math.sqrt(self.thrust_to_weight)

    @property
    def idle_rpm(self) -> float:
        return math.sqrt(self.idle_thrust_n / self.k_f)

    @property
    def rotor_positions_flu(self) -> tuple[Triple, Triple, Triple, Triple]:
        """X layout: the arms stand at 45 degrees to the body axes [m]."""
        d = self.arm_m / math.sqrt(2.0)
        return ((d, d, 0.0), (-d, d, 0.0), (-d, -d, 0.0), (d, -d, 0.0))
