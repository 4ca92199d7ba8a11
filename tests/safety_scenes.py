"""Obstacles for tests of the safety layer."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from companion.types import Prediction, frozen

DT_S = 0.05


def uniform_motion(
    p_enu: npt.ArrayLike,
    v_enu: npt.ArrayLike,
    *,
    radius_m: npt.ArrayLike = 0.2,
    sigma_m: float = 0.0,
    horizon: int = 20,
    prefix: str = "",
) -> Prediction:
    """Spheres that start at ``p_enu`` (M, 3) with ``v_enu`` (M, 3) and fly on, named by ``prefix`` and their number."""
    start, velocity = np.reshape(p_enu, (-1, 3)), np.reshape(v_enu, (-1, 3))
    count, t = len(start), DT_S * np.arange(horizon + 3)
    return Prediction(
        start_ns=0,
        dt_s=DT_S,
        ids=tuple(f"{prefix}{index}" for index in range(count)),
        p_enu=frozen(start[:, None] + t[:, None] * velocity[:, None]),
        sigma_m=frozen(np.full((count, len(t)), sigma_m)),
        v_enu=frozen(velocity),
        a_enu=frozen(np.zeros((count, 3))),
        radius_m=frozen(np.broadcast_to(np.asarray(radius_m, dtype=np.float64), count)),
    )
