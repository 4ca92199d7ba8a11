"""Where the vehicle is when a setpoint acts: moved on under the accelerations already commanded."""

from __future__ import annotations

from collections.abc import Iterable

from companion.config import Config
from companion.types import NS_PER_S, Vec3, VehicleState


def acts_after_ns(config: Config) -> int:
    """From the stamp of a vehicle state to the instant at which the setpoint that answers it acts [ns]."""
    return round((config.delay.loop_s + config.actuation_s) * NS_PER_S)


def at_action(vehicle: VehicleState, commanded: Iterable[tuple[int, Vec3]], delay_ns: int) -> tuple[Vec3, Vec3]:
    """Position and velocity at the instant at which the setpoint of this tick acts.

    p += v t + a t^2 / 2, v += a t over each piece of [stamp, stamp + delay) under the command acting in it;
    before the first command the vehicle is taken to coast.

    Args:
        commanded: (acts from [ns], net acceleration [m/s^2]) of the commands before, in order.
    """
    p, v = vehicle.p_enu, vehicle.v_enu
    now, end = vehicle.stamp_ns, vehicle.stamp_ns + delay_ns
    commands = list(commanded)
    for index, (since, a) in enumerate(commands):
        until = commands[index + 1][0] if index + 1 < len(commands) else end
        t = (min(until, end) - max(since, now)) / NS_PER_S
        if t > 0.0:
            p = p + v * t + a * (0.5 * t * t)
            v = v + a * t
    commanded_from = max(now, commands[0][0]) if commands else end
    coast_s = max(0, min(end, commanded_from) - now) / NS_PER_S
    return p + vehicle.v_enu * coast_s, v
