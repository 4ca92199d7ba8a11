"""Figures of an artefact: what `policies evaluate` prints and a manifest holds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import msgspec

from companion.config import LimitsConfig, PolicyConfig
from companion.policy import load_policy, read_manifest
from policies.env import EnvConfig
from policies.evaluation.pointmass import fly, random_starts, report


def evaluate(
    artifact: Path,
    *,
    starts: int,
    seed: int,
    env: EnvConfig | None = None,
    plant: Literal["point", "pybullet"] = "point",
    on_flight: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """Figures of an artefact on seeded random starts: as it flies (hold law included), and the network alone.

    ``plant`` is the point mass of the training, or the PyBullet vehicle at 0.05 s, each flight told to ``on_flight``.
    Without ``env`` the task is the one that the artefact says it was trained in, lag 0.1 s and no randomisation where
    it says nothing.
    """
    manifest, _ = read_manifest(artifact)
    if env is None:
        known = manifest.training.get("env", {})
        env = msgspec.convert({"k_ma_m_s2": manifest.k_ma_m_s2, "dt_s": manifest.dt_s, **known}, EnvConfig)
    limits = LimitsConfig(acceleration_m_s2=manifest.k_ma_m_s2)
    p, v, target = random_starts(env, starts, seed)

    def flown(config: PolicyConfig) -> dict[str, Any]:
        policy = load_policy(config, limits)
        if plant == "pybullet":
            from policies.evaluation.bullet import fly_bullet  # the sim extra

            a_max = manifest.k_ma_m_s2
            flights = fly_bullet(policy.act, p, target, config=env, a_max_m_s2=a_max, on_flight=on_flight)
        else:
            flights = fly(policy.act, p, v, target, config=env, a_max_m_s2=manifest.k_ma_m_s2)
        return report(flights, seed=seed)

    figures = flown(PolicyConfig(artifact=str(artifact)))
    if plant == "pybullet":
        return figures | {"plant": plant}
    alone = flown(PolicyConfig(artifact=str(artifact), capture_radius_m=0.0))
    return figures | {"network_alone_passed_threshold": alone["passed_threshold"]}
