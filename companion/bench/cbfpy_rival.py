"""cbfpy as a rival of the filter: its own double integrator with obstacles, compiled before it is timed.

The formulation is that of its example of a point robot, with the whole of the second-order barrier in its own terms:

    minimise |a - a_ref|^2   subject to   h_j'' + (k1 + k2) h_j' + k1 k2 h_j >= 0,   |a_i| <= a_max
    h_j = |p - o_j| - D_j of every obstacle j, and p - low, high - p of the arena

all of them `h_2`, gains 3 / s as in the example. The state is [p, v, t]: cbfpy differentiates along the state only, and
with o_j(t) = o_j + t v_j the obstacles' motion is in the constraint, as it is in ours. No horizon: h_j of the present
instant is all it looks at. Relaxed at the library's penalties.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from companion.config import LimitsConfig, SafetyConfig
from companion.safety.filter import FilterInput
from companion.types import FloatArray, Vec3

GAIN_HZ = 3.0
TOLERANCES = {"qpax": 1e-3, "elastiqp": 1e-6}  # qpax: the library's default, elastiqp: that of its examples
HOW_TO_INSTALL = "pip install 'companion-safety[bench]'"
_SETTINGS = {  # what cbfpy asks for on a processor; it warns without
    "JAX_PLATFORMS": "cpu",
    "JAX_ENABLE_X64": "True",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false",
    "OPENBLAS_NUM_THREADS": "1",
}

Rival = Callable[[FilterInput], Vec3]


def backends() -> tuple[str, ...]:
    """cbfpy's solvers that are installed: its default, and the one that it recommends on a processor."""
    if importlib.util.find_spec("cbfpy") is None:
        return ()
    return ("qpax",) if importlib.util.find_spec("elastiqp") is None else ("qpax", "elastiqp")


def keep_out_m(inputs: FilterInput, safety: SafetyConfig) -> FloatArray:
    """D_j of the present instant, (M,): radii, cushion and kappa sigma [m]."""
    prediction = inputs.prediction
    sigma = np.hypot(prediction.sigma_m[:, 0], inputs.p_std_m)
    return np.asarray(prediction.radius_m + safety.drone_radius_m + safety.cushion_m + safety.kappa * sigma)


def cbfpy_filter(backend: str, example: FilterInput, safety: SafetyConfig, limits: LimitsConfig) -> Rival:
    """A filter for as many obstacles as ``example`` has, already compiled; calls start from and end in numpy.

    Raises:
        ModuleNotFoundError: cbfpy or the backend is not installed (they are in the ``bench`` extra).
    """
    for name, value in _SETTINGS.items():
        os.environ.setdefault(name, value)
    with contextlib.redirect_stdout(sys.stderr):  # it prints advice, and stdout may be one JSON object
        from cbfpy import CBF

        config = _config(backend, arguments(example, safety), limits.acceleration_m_s2 - example.accel_shrink_m_s2)
        cbf = CBF.from_config(config(np.array(limits.arena_min), np.array(limits.arena_max)))

    def answer(inputs: FilterInput) -> Vec3:
        z = np.concatenate((inputs.p_enu, inputs.v_enu, (0.0,)))
        return np.asarray(cbf.safety_filter(z, inputs.a_ref, *arguments(inputs, safety)))

    answer(example)
    return answer


def arguments(inputs: FilterInput, safety: SafetyConfig) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Positions (M, 3), velocities (M, 3) and keep-out distances (M,) of the obstacles."""
    prediction = inputs.prediction
    return np.ascontiguousarray(prediction.p_enu[:, 0]), prediction.v_enu, keep_out_m(inputs, safety)


def _config(backend: str, example: tuple[FloatArray, ...], box_m_s2: float) -> Any:
    """The class of the configuration; it can only be made where cbfpy can be imported."""
    import jax.numpy as jnp
    from cbfpy import CBFConfig

    class DoubleIntegrator(CBFConfig):  # type: ignore[misc]
        def __init__(self, low: FloatArray, high: FloatArray) -> None:
            self.low, self.high = low, high
            super().__init__(
                n=7,
                m=3,
                u_min=[-box_m_s2] * 3,
                u_max=[box_m_s2] * 3,
                init_args=example,
                backend=backend,
                solver_tol=TOLERANCES[backend],
            )

        def f(self, z: Any, *args: Any) -> Any:
            return jnp.concatenate((z[3:6], jnp.zeros(3), jnp.ones(1)))

        def g(self, z: Any, *args: Any) -> Any:
            return jnp.concatenate((jnp.zeros((3, 3)), jnp.eye(3), jnp.zeros((1, 3))))

        def h_2(self, z: Any, p: Any, v: Any, keep_out: Any) -> Any:
            apart = jnp.linalg.norm(z[:3] - p - z[6] * v, axis=1)
            return jnp.concatenate((apart - keep_out, z[:3] - self.low, self.high - z[:3]))

        def alpha(self, h: Any, *args: Any) -> Any:
            return GAIN_HZ * h

        def alpha_2(self, h_2: Any, *args: Any) -> Any:
            return GAIN_HZ * h_2

    return DoubleIntegrator
