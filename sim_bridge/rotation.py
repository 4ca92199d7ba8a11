"""Quaternions (w, x, y, z) that turn body axes FLU to ENU."""

from __future__ import annotations

import math

from sim_bridge.crazyflie import Quad, Triple


def yaw_of(q_wxyz: Quad) -> float:
    """Heading of the body x axis, counter-clockwise from east [rad]."""
    w, x, y, z = q_wxyz
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def from_euler(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Quad:
    """Yaw about up, then pitch about left (nose down is positive), then roll about forward.

    >>> [round(x, 4) for x in from_euler(0.0, 0.0, math.pi / 2)]
    [0.7071, 0.0, 0.0, 0.7071]
    """
    cr, sr = math.cos(0.5 * roll_rad), math.sin(0.5 * roll_rad)
    cp, sp = math.cos(0.5 * pitch_rad), math.sin(0.5 * pitch_rad)
    cy, sy = math.cos(0.5 * yaw_rad), math.sin(0.5 * yaw_rad)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def to_euler(q_wxyz: Quad) -> Triple:
    """Roll, pitch and yaw of `from_euler` [rad].

    >>> [round(x, 4) for x in to_euler(from_euler(0.1, -0.2, 3.0))]
    [0.1, -0.2, 3.0]
    """
    w, x, y, z = q_wxyz
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    return (roll, math.asin(min(1.0, max(-1.0, 2.0 * (w * y - z * x)))), yaw_of(q_wxyz))


def from_body(q_wxyz: Quad, v_flu: Triple) -> Triple:
    """ENU components of a body vector: R v.

    >>> [round(x, 4) for x in from_body(from_euler(0.0, 0.0, math.pi / 2), (1.0, 0.0, 0.0))]
    [0.0, 1.0, 0.0]
    """
    w, x, y, z = q_wxyz
    a, b, c = v_flu
    # v + 2 w (u x v) + 2 u x (u x v) with u = (x, y, z)
    cx, cy, cz = y * c - z * b, z * a - x * c, x * b - y * a
    return (
        a + 2.0 * (w * cx + y * cz - z * cy),
        b + 2.0 * (w * cy + z * cx - x * cz),
        c + 2.0 * (w * cz + x * cy - y * cx),
    )
