"""``policies bench``: time of one inference on each backend over states drawn as in training."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from companion.bench.timing import Quantiles, quantiles
from companion.clock import stopwatch_ns
from companion.config import LimitsConfig, PolicyConfig
from companion.errors import ArtifactError
from companion.policy import Policy, load_policy, read_manifest

BLOCK, WARM_UP = 500, 20  # calls
BACKENDS = ("onnx", "torch")


def measure(artifact: Path, calls: int, seed: int = 0) -> dict[str, Any]:
    """Quantiles [ms] of the network alone and of the law that flies (`Policy.act`), the backends in turn by blocks.

    torch is left out where it is not installed or the artefact has no weights for it.
    """
    limits = LimitsConfig(acceleration_m_s2=read_manifest(artifact)[0].k_ma_m_s2)
    config = PolicyConfig(artifact=str(artifact))
    policies: dict[str, Policy] = {"onnx": load_policy(config, limits)}
    try:
        policies["torch"] = load_policy(msgspec.structs.replace(config, backend="torch"), limits)
    except ArtifactError as error:
        reason = str(error)
    else:
        reason = ""
    rng = np.random.default_rng(seed)
    velocities, errors = rng.normal(0.0, 1.5, (calls, 3)), rng.uniform(-10.0, 10.0, (calls, 3))
    observations = np.concatenate([velocities, errors], axis=1).astype(np.float32)[:, None]
    taken: dict[str, list[int]] = {}
    answers: dict[str, list[npt.NDArray[np.float64]]] = {name: [] for name in policies}
    for first in range(0, calls, BLOCK):
        block = range(first, min(first + BLOCK, calls))
        for name, policy in policies.items():
            for _ in range(WARM_UP):  # what the other backend has left in the caches is not its cost
                policy.network(observations[first])
            for index in block:
                began = stopwatch_ns()
                policy.network(observations[index])
                taken.setdefault(f"{name}: network", []).append(stopwatch_ns() - began)
            for index in block:
                v, e = velocities[index], errors[index]
                answers[name].append(policy.action(v, e))
                began = stopwatch_ns()
                policy.act(v, e)
                taken.setdefault(f"{name}: as flown", []).append(stopwatch_ns() - began)
    told: dict[str, Quantiles] = {name: quantiles(samples) for name, samples in taken.items()}
    stacked = [np.array(values) for values in answers.values()]
    apart = float(np.abs(stacked[0] - stacked[-1]).max())
    return {
        "artifact": str(artifact),
        "calls": calls,
        "milliseconds": {name: asdict(values) for name, values in told.items()},
        "greatest_difference": apart,
        "left_out": reason,
    }
