"""Quadratic programs behind one small interface; the only module that knows the solvers.

    minimise  x' diag(weight) x / 2 + linear' x   subject to   low <= x <= high,   A x >= floor

DAQP (dual active set) solves cold each time, so an answer depends on its problem alone. OSQP runs with a pinned
penalty update and polishing, for the same reason. When one fails or its answer breaks the program, the other is
asked; a program that a solver proves infeasible is not asked again.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import daqp
import numpy as np

from companion.errors import SolverError
from companion.types import FloatArray

UNBOUNDED = 1e30
_DAQP_OPTIMAL, _DAQP_INFEASIBLE = 1, -1
RESIDUAL = 1e-5  # an answer that breaks its own rows by more is no answer


@dataclass(frozen=True, slots=True)
class Program:
    """n variables, m rows. Arrays are C-contiguous float64."""

    weight: FloatArray  # (n,) diagonal of the Hessian, > 0
    linear: FloatArray  # (n,)
    low: FloatArray  # (n,)
    high: FloatArray  # (n,)
    rows: FloatArray  # (m, n)
    floor: FloatArray  # (m,)

    def residual(self, x: FloatArray) -> float:
        """Greatest violation of a row or bound at ``x``, 0 where all hold."""
        broken = np.concatenate((self.low - x, x - self.high, self.floor - self.rows @ x))
        return max(float(np.maximum.reduce(broken)), 0.0)


class Infeasible(SolverError):
    """The program has no solution: an answer about the rows, not a failure of the solver."""


Backend = Callable[[Program], FloatArray | None]


def solve_daqp(program: Program) -> FloatArray | None:
    """The minimiser, or None where DAQP fails.

    Raises:
        Infeasible: proven by the dual's growth.
    """
    size = len(program.linear)
    count = size + len(program.floor)
    hessian = np.zeros((size, size))
    hessian.reshape(-1)[:: size + 1] = program.weight
    upper = np.empty(count)
    upper[:size], upper[size:] = program.high, UNBOUNDED
    x, _, flag, _ = daqp.solve(
        hessian,
        program.linear,
        program.rows,
        upper,
        np.concatenate((program.low, program.floor)),
        np.zeros(count, dtype=np.int32),
        primal_tol=1e-9,
    )
    if flag == _DAQP_INFEASIBLE:
        raise Infeasible(f"infeasible: {len(program.linear)} variables, {len(program.floor)} rows")
    return np.asarray(x, dtype=np.float64) if flag == _DAQP_OPTIMAL else None


def solve_osqp(program: Program) -> FloatArray | None:
    """The minimiser, or None where OSQP does not converge.

    Raises:
        Infeasible: a certificate of primal infeasibility was found.
    """
    import osqp  # brings scipy.sparse, which takes longer to load than all the rest: not before READY
    from scipy import sparse

    solver = osqp.OSQP()
    solver.setup(
        sparse.csc_matrix(np.diag(program.weight)),
        program.linear,
        sparse.csc_matrix(np.vstack((np.eye(len(program.linear)), program.rows))),
        np.concatenate((program.low, program.floor)),
        np.concatenate((program.high, np.full(len(program.floor), np.inf))),
        verbose=False,
        eps_abs=1e-6,
        eps_rel=1e-6,
        adaptive_rho_interval=25,
        polishing=True,
        max_iter=4000,
    )
    answer = solver.solve(raise_error=False)
    if answer.info.status == "primal infeasible":
        raise Infeasible(f"infeasible: {len(program.linear)} variables, {len(program.floor)} rows")
    return np.asarray(answer.x, dtype=np.float64) if answer.info.status == "solved" else None


BACKENDS: dict[str, Backend] = {"daqp": solve_daqp, "osqp": solve_osqp}


def solve(program: Program, order: tuple[str, ...]) -> tuple[FloatArray, str]:
    """The minimiser and the name of the solver that found it, asked in ``order``.

    Raises:
        Infeasible: the first solver with a usable answer proved that there is none.
        SolverError: none has an answer that keeps the program's own rows.
    """
    for name in order:
        x = BACKENDS[name](program)
        if x is not None and math.isfinite(x @ x) and program.residual(x) <= RESIDUAL:
            return x, name
    raise SolverError(f"no answer from {', '.join(order)}: {len(program.linear)} variables, {len(program.floor)} rows")
