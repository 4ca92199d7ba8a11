"""Conversions between local ENU (inside) and NED or body frames (wires only).

``enu_from_ned`` is its own inverse: (x, y, z) -> (y, x, -z). Quaternions are (w, x, y, z), Hamilton;
``q_a_from_b`` rotates a vector given in b into a. Source: REP 103 of ROS.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from companion.types import FloatArray, Vec3


def enu_from_ned(v_ned: npt.ArrayLike) -> Vec3:
    """ENU components of a vector given in NED (any unit); also NED from ENU.

    >>> enu_from_ned([1.0, 2.0, 3.0]).tolist()
    [2.0, 1.0, -3.0]
    """
    x, y, z = np.asarray(v_ned, dtype=np.float64)
    return np.array([y, x, -z])


def enu_covariance_from_ned(covariance_ned: FloatArray) -> FloatArray:
    """A (3, 3) or (6, 6) covariance over [p] or [p, v], NED axes to ENU axes."""
    block = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    rotation = np.kron(np.eye(covariance_ned.shape[0] // 3), block)
    return np.asarray(rotation @ covariance_ned @ rotation.T)


def multiply(q: npt.ArrayLike, r: npt.ArrayLike) -> FloatArray:
    """Hamilton product q r."""
    w0, x0, y0, z0 = np.asarray(q, dtype=np.float64)
    w1, x1, y1, z1 = np.asarray(r, dtype=np.float64)
    return np.array(
        [
            w0 * w1 - x0 * x1 - y0 * y1 - z0 * z1,
            w0 * x1 + x0 * w1 + y0 * z1 - z0 * y1,
            w0 * y1 - x0 * z1 + y0 * w1 + z0 * x1,
            w0 * z1 + x0 * y1 - y0 * x1 + z0 * w1,
        ]
    )


_SQRT_HALF = math.sqrt(0.5)
_Q_ENU_FROM_NED = (0.0, _SQRT_HALF, _SQRT_HALF, 0.0)  # half a turn about (1, 1, 0)
_Q_FRD_FROM_FLU = (0.0, 1.0, 0.0, 0.0)  # half a turn about x


def q_enu_from_flu(q_ned_from_frd: npt.ArrayLike) -> FloatArray:
    """Attitude of a FLU body in ENU from MAVLink's attitude of a FRD body in NED, w >= 0.

    Level and facing north in NED (identity) is a yaw of 90 degrees in ENU:

    >>> q_enu_from_flu([1.0, 0.0, 0.0, 0.0]).round(4).tolist()
    [0.7071, 0.0, 0.0, 0.7071]
    """
    q = multiply(_Q_ENU_FROM_NED, multiply(q_ned_from_frd, _Q_FRD_FROM_FLU))
    if q[0] < 0.0 or (q[0] == 0.0 and q[3] < 0.0):
        q = -q
    return q + 0.0  # no negative zeros in the log


def rotate(q_a_from_b: npt.ArrayLike, v_b: npt.ArrayLike) -> Vec3:
    """Components in a of a vector given in b."""
    w, x, y, z = np.asarray(q_a_from_b, dtype=np.float64)
    u = np.array([x, y, z])
    v = np.asarray(v_b, dtype=np.float64)
    return np.asarray(v + 2.0 * w * np.cross(u, v) + 2.0 * np.cross(u, np.cross(u, v)))
