"""Training state as safetensors: no pickle, so a checkpoint from anywhere can be opened without running its code."""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from stable_baselines3 import PPO

from companion.errors import ArtifactError


def save_checkpoint(model: PPO, path: Path) -> None:
    """Parameters, Adam's moments and the step count of ``model``."""
    tensors = {f"policy.{name}": value.contiguous() for name, value in model.policy.state_dict().items()}
    for i, parameter in enumerate(model.policy.parameters()):
        for name, value in model.policy.optimizer.state.get(parameter, {}).items():
            tensors[f"adam.{i}.{name}"] = value.contiguous()
    path.parent.mkdir(parents=True, exist_ok=True)
    save_file(tensors, path, metadata={"steps": str(model.num_timesteps)})


def restore_checkpoint(model: PPO, path: Path) -> None:
    """Set ``model``, built for the same widths, to the state in ``path``.

    Raises:
        ArtifactError: no such file, not a checkpoint, or one of another network.
    """
    try:
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  not a mapping
            steps = int((file.metadata() or {})["steps"])
        prefix = "policy."
        model.policy.load_state_dict({k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)})
    except (OSError, SafetensorError, KeyError, ValueError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        raise ArtifactError(f"{path}: expected a checkpoint written by `policies train`: {reason}") from None
    optimizer = model.policy.optimizer
    for i, parameter in enumerate(model.policy.parameters()):
        moments = {k.rpartition(".")[2]: v for k, v in tensors.items() if k.startswith(f"adam.{i}.")}
        if moments:
            optimizer.state[parameter] = {k: torch.clone(v) for k, v in moments.items()}
    model.num_timesteps = steps
