"""One LiPo cell of 250 mAh behind a Crazyflie's motors: charge, voltage under load, and the thrust it can give.

The load is a power, P = P_e + c_p sum f (electronics, and the motors' electrical power against thrust), so the terminal
voltage V = U(s) - R P / V has the solution

    V = (U + sqrt(U^2 - 4 R P)) / 2,   I = P / V,   s' = -I / C

with the open-circuit voltage U of the state of charge s. At full duty a motor gives the thrust of the terminal voltage.

Sources
    Bitcraze, "PWM to thrust", Crazyflie 2.0 on a scale (16 points of current, voltage, duty and thrust): a straight
        line through P = V I gives c_p = 24.0 W/N and P_e = 1.07 W (largest residue 0.16 W), one through V(I) gives
        R = 0.163 ohm (27 mV; the cell discharged meanwhile, so R is an upper bound).
        Voltage times duty is the motors' voltage; at full duty they see all of the terminals': `MOTOR_V` to `MOTOR_G`,
        the last pair extrapolated to the 60 g at which the firmware (``motors.c``) puts full thrust. The same firmware
        compensates the voltage, so that below full duty thrust does not sag.
    Bitcraze firmware ``pm_stm32f4.c``: discharge curve of the battery 671723HS25C in steps of 10 %; 4.2 V when charged.
    250 mAh: the stock cell of the Crazyflie 2.1.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Iterable
from dataclasses import dataclass

CAPACITY_MAH = 250.0
RESISTANCE_OHM = 0.163
ELECTRONICS_W = 1.07
WATT_PER_NEWTON = 24.0
OPEN_CIRCUIT_V = (3.00, 3.78, 3.83, 3.87, 3.89, 3.92, 3.96, 4.00, 4.04, 4.10, 4.20)  # at 0, 10, ... 100 % of charge
MOTOR_V = (0.0, 0.249, 0.494, 0.735, 0.970, 1.200, 1.425, 1.626, 1.855, 2.064, 2.281, 2.489, 2.670, 2.828, 2.975, 3.094)
MOTOR_G = (0.0, 1.6, 4.8, 7.9, 10.9, 13.9, 17.3, 21.0, 24.4, 28.6, 32.8, 37.3, 41.7, 46.0, 51.9, 57.9)  # all four
RATED_G, RATED_V = 60.0, 3.136


@dataclass(frozen=True, slots=True)
class BatteryState:
    """What a power monitor measures."""

    share: float  # charge left, 0 to 1
    voltage_v: float
    current_a: float
    consumed_mah: float  # since the start


class Battery:
    """A cell that starts at ``share`` of its charge; `draw` discharges it."""

    def __init__(self, share: float = 1.0) -> None:
        self.share = share
        self._consumed_mah = 0.0
        self._power_w = ELECTRONICS_W

    @property
    def state(self) -> BatteryState:
        voltage_v = self.voltage_v
        return BatteryState(self.share, voltage_v, self._power_w / voltage_v, self._consumed_mah)

    @property
    def voltage_v(self) -> float:
        """At the terminals under the present load."""
        return loaded_voltage_v(open_circuit_v(self.share), self._power_w)

    @property
    def available(self) -> float:
        """Share of the rated thrust that the motors can give at the present voltage; 0 once the cell is empty."""
        return available_share(self.voltage_v) if self.share > 0.0 else 0.0

    def draw(self, thrusts_n: Iterable[float], dt_s: float) -> None:
        """Discharge for ``dt_s`` under the motors' thrusts [N]."""
        self._power_w = ELECTRONICS_W + WATT_PER_NEWTON * sum(thrusts_n)
        used_mah = self._power_w / self.voltage_v * dt_s / 3.6
        self._consumed_mah += used_mah
        self.share = max(0.0, self.share - used_mah / CAPACITY_MAH)


def open_circuit_v(share: float) -> float:
    """Voltage without load at a state of charge, linear between the curve's points.

    >>> open_circuit_v(0.5), round(open_circuit_v(0.05), 3)
    (3.92, 3.39)
    """
    tenths = min(max(share, 0.0), 1.0) * 10.0
    below = min(int(tenths), 9)
    low, high = OPEN_CIRCUIT_V[below], OPEN_CIRCUIT_V[below + 1]
    return low + (tenths - below) * (high - low)


def loaded_voltage_v(open_v: float, power_w: float) -> float:
    """Terminal voltage under a load of constant power; half the open-circuit voltage where that is more than the
    cell can give (then the load gets less).

    >>> round(loaded_voltage_v(3.9, 7.4), 3)
    3.561
    """
    return 0.5 * (open_v + math.sqrt(max(open_v * open_v - 4.0 * RESISTANCE_OHM * power_w, 0.0)))


def available_share(voltage_v: float) -> float:
    """Share of the rated thrust at full duty and ``voltage_v``, linear between the measured points.

    >>> available_share(3.6), round(available_share(2.67), 3)
    (1.0, 0.695)
    """
    if voltage_v >= RATED_V:
        return 1.0
    above = bisect.bisect_right(MOTOR_V, max(voltage_v, 0.0))
    high_v, high_g = (RATED_V, RATED_G) if above == len(MOTOR_V) else (MOTOR_V[above], MOTOR_G[above])
    low_v, low_g = MOTOR_V[above - 1], MOTOR_G[above - 1]
    return (low_g + (max(voltage_v, 0.0) - low_v) / (high_v - low_v) * (high_g - low_g)) / RATED_G
