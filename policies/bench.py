"""``policies bench``: time of one inference on each backend, in turn, over states drawn as in training."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from companion.bench.timing import Quantiles, quantiles
from companion.clock import stopwatch_ns
from companion.config import LimitsConfig, PolicyConfig
from companion.errors import ArtifactError
from companion.policy import Policy, load_policy, read_manifest

WARM_UP = 200
BACKENDS = ("onnx", "torch")


def measure(artifact: Path, calls: int, seed: int = 0) -> dict[str, Any]:
    """Quantiles [ms] of the network alone (`Policy.action`) and of the law that flies (`Policy.act`).

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
    velocities, errors = rng.normal(0.0, 1.5, (WARM_UP + calls, 3)), rng.uniform(-10.0, 10.0, (WARM_UP + calls, 3))
    taken: dict[str, list[int]] = {name: [] for name in policies}
    flown: list[int] = []
    apart = 0.0
    for index, (v, e) in enumerate(zip(velocities, errors, strict=True), start=-WARM_UP):
        answers = []
        for name, policy in policies.items():
            began = stopwatch_ns()
            answers.append(policy.action(v, e))
            took = stopwatch_ns() - began
            if index >= 0:
                taken[name].append(took)
        began = stopwatch_ns()
        policies["onnx"].act(v, e)
        if index >= 0:
            flown.append(stopwatch_ns() - began)
        apart = max(apart, float(np.abs(answers[0] - answers[-1]).max()))
    told: dict[str, Quantiles] = {f"{name}: network": quantiles(samples) for name, samples in taken.items()}
    told["onnx: with the hold law"] = quantiles(flown)
    return {
        "artifact": str(artifact),
        "calls": calls,
        "milliseconds": {name: asdict(values) for name, values in told.items()},
        "greatest_difference": apart,
        "left_out": reason,
    }
