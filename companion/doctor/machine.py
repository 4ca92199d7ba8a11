"""What needs no vehicle: the artefact, the solvers, the time of a brain step, files that hold secrets."""

from __future__ import annotations

import stat
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from companion.clock import stopwatch_ns
from companion.config import Config
from companion.doctor.observation import Deadline, Machine, SecretFile
from companion.errors import CompanionError, SolverError
from companion.pilot import Pilot, PilotInput
from companion.policy import load_policy
from companion.safety.qp import BACKENDS, Backend, Program
from companion.types import NS_PER_S, Detection, DetectionFrame, DetectionKind, VehicleState, frozen

OBSTACLES = 10
STEPS = 600
WARM = 50  # steps not counted
REACH_M = 6.0  # of the flight and the obstacles from the middle of the arena
SOLUTION_TOLERANCE = 1e-4
_SECRET_WORDS = ("key", "password", "secret", "credential", "users", "token")
_FILE_WORDS = ("file", "path")


def examine(config: Config, *, steps: int, stopwatch: Callable[[], int] = stopwatch_ns) -> Machine:
    """Everything about this machine; failures are part of the answer."""
    digest = artifact_error = deadline = deadline_error = None
    try:
        digest = load_policy(config.policy, config.limits).digest
    except CompanionError as error:
        artifact_error = str(error)
    if artifact_error is None:
        try:
            deadline = measure_deadline(config, steps=steps, stopwatch=stopwatch)
        except CompanionError as error:
            deadline_error = str(error)
    return Machine(
        artifact=config.policy.artifact,
        artifact_digest=digest,
        artifact_error=artifact_error,
        solvers={name: check_solver(solve) for name, solve in BACKENDS.items()},
        deadline=deadline,
        deadline_error=deadline_error,
        secrets=tuple(secret_files(config)),
    )


def check_solver(solve: Backend) -> str | None:
    """Why a solver does not work, None where it answers a small program as worked out by hand.

    minimise |x|^2 / 2 - 2 x_1 within |x_i| <= 10 and x_1 + x_2 >= 3. Without the row: (2, 0). On it, x_1 - 2 = x_2 =
    mu and 2 + 2 mu = 3, so mu = 1/2 and x = (5/2, 1/2).
    """
    program = Program(
        weight=np.ones(2),
        linear=np.array([-2.0, 0.0]),
        low=np.full(2, -10.0),
        high=np.full(2, 10.0),
        rows=np.array([[1.0, 1.0]]),
        floor=np.array([3.0]),
    )
    try:
        x = solve(program)
    except (SolverError, ImportError, ValueError, RuntimeError) as error:
        return str(error) or type(error).__name__
    if x is None or not np.allclose(x, (2.5, 0.5), atol=SOLUTION_TOLERANCE):
        return f"expected (2.5, 0.5), got {x}"
    return None


def measure_deadline(
    config: Config, *, obstacles: int = OBSTACLES, steps: int = STEPS, stopwatch: Callable[[], int] = stopwatch_ns
) -> Deadline:
    """Times of ``Pilot.step`` on a flight to a target, ``obstacles`` crossing it, a frame each tick.

    The vehicle does what it is told (p' = v, v' = a); obstacles fly to and fro through its path. The seed is fixed.
    """
    rng = np.random.default_rng(196)
    pilot, dt_s = Pilot(config), 1.0 / config.rate_hz
    low, high = np.array(config.limits.arena_min), np.array(config.limits.arena_max)
    centre, reach = 0.5 * (low + high), np.minimum(0.4 * (high - low), REACH_M)
    goals = (centre - reach * (1.0, 0.0, 0.0), centre + reach * (1.0, 0.0, 0.0))
    p, v = goals[0].copy(), np.zeros(3)
    ways = rng.uniform(-1.0, 1.0, (obstacles, 3)) * reach
    phases, speeds = rng.uniform(0.0, 6.28, obstacles), rng.uniform(0.2, 1.0, obstacles)
    took_ns: list[int] = []
    for k in range(steps + WARM):
        stamp_ns = round((k + 1) * dt_s * NS_PER_S)
        swing = np.sin(phases + speeds * k * dt_s)[:, None]
        seen = centre + ways * (0.3 + 0.7 * swing) + rng.normal(scale=0.05, size=(obstacles, 3))
        found = tuple(Detection(f"o{m}", frozen(seen[m]), 0.2, 0.05) for m in range(obstacles))
        frame = DetectionFrame(stamp_ns, "doctor", k, DetectionKind.DETECTION, found)
        target = goals[1 if (k * dt_s) % 12.0 < 6.0 else 0]
        inputs = PilotInput(VehicleState(stamp_ns, frozen(p), frozen(v)), (frame,), target_enu=frozen(target))
        began = stopwatch()
        output = pilot.step(inputs)
        ended = stopwatch()
        if k >= WARM:
            took_ns.append(ended - began)
        a = output.result.a_safe
        p, v = p + v * dt_s + a * (0.5 * dt_s**2), v + a * dt_s
    p50, p99 = np.quantile(took_ns, (0.5, 0.99)) / 1e6
    return Deadline(steps, obstacles, float(p50), float(p99), max(took_ns) / 1e6, 1e3 * dt_s)


def secret_files(config: Config) -> Iterator[SecretFile]:
    """Every configured file whose key says that it holds a secret (``mavlink.signing_key_file`` and the like)."""
    yield from _secrets("", msgspec.to_builtins(config))


def _secrets(prefix: str, table: dict[str, Any]) -> Iterator[SecretFile]:
    for name, value in table.items():
        key = f"{prefix}{name}"
        if isinstance(value, dict):
            yield from _secrets(f"{key}.", value)
        elif isinstance(value, str) and _is_secret(name):
            path = Path(value).expanduser()
            yield SecretFile(key, value, stat.S_IMODE(path.stat().st_mode) if path.exists() else None)


def _is_secret(name: str) -> bool:
    words = name.lower().split("_")
    return any(word in words for word in _SECRET_WORDS) and (words[-1] in _FILE_WORDS or words[-1] == "key")
