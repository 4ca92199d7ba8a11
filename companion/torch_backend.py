"""The networks of this project in torch: pi(o) = clip(f(o / scale), -1, 1), rebuilt from a safetensors file.

Two kinds, named by ``network.kind`` of the manifest. ``mlp`` is a plain multilayer perceptron. ``axis_shared`` is one
perceptron g for every axis, made odd: with o_i = [v_i, e_i, 4 e_i / (1 + 4 |e_i|)], the last fine near the target, and
lengths that no symmetry of the cube changes, s = [|v|, |e|, |v + e|] (speed, distance, the angle between them),

    a_i = g(o_i, s) - g(-o_i, s).

The task has the 48 symmetries of the cube; so has this policy, by construction, and at rest on the target a = 0.
torch is an optional dependency: nothing here is imported unless ``policy.backend = "torch"``, or for training.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from companion.errors import ArtifactError
from companion.policy import Float32, Manifest, Network

try:
    import torch
    from safetensors import SafetensorError
    from safetensors.torch import load
except ModuleNotFoundError as error:
    raise ArtifactError(
        f'policy.backend: expected "onnx", or torch and safetensors installed ({error.name} is not)'
    ) from None

Weights = Mapping[str, torch.Tensor]
FINE = 4.0  # slope of the third feature at the target


def lengths(v: torch.Tensor, e: torch.Tensor) -> torch.Tensor:
    """[|v|, |e|, |v + e|] of scaled (N, 3) tensors: (N, 3)."""
    return torch.stack([v, e, v + e], dim=1).norm(dim=2)


def axis_shared(weights: Weights, observation: torch.Tensor) -> torch.Tensor:
    """a_i = g(o_i, s) - g(-o_i, s), before the clip: (N, 6) -> (N, 3)."""
    o = observation / weights["scale"]
    v, e = o[:, :3], o[:, 3:]
    fine = torch.nn.functional.softsign(FINE * e)
    odd = torch.stack([v, e, fine], dim=2) @ weights["odd.weight"].T  # (N, 3, H)
    even = (lengths(v, e) @ weights["even.weight"].T + weights["even.bias"])[:, None, :]
    first = torch.relu(torch.stack([even + odd, even - odd]))
    second = torch.relu(first @ weights["hidden.weight"].T + weights["hidden.bias"])
    return ((second[0] - second[1]) @ weights["out.weight"].T)[..., 0]


def mlp(weights: Weights, observation: torch.Tensor, activation: str) -> torch.Tensor:
    """W_n act(... act(W_0 (o - mean) / scale + b_0)) + b_n, before the clip: (N, 6) -> (N, 3)."""
    x = (observation - weights["mean"]) / weights["scale"]
    last = len([name for name in weights if name.endswith(".weight")]) - 1
    for i in range(last + 1):
        x = x @ weights[f"layers.{i}.weight"].T + weights[f"layers.{i}.bias"]
        if i < last:
            x = torch.tanh(x) if activation == "tanh" else torch.relu(x)
    return x


def load_network(data: bytes, manifest: Manifest, path: Path) -> Network:
    """The network of an artefact as a function of one row, on one thread.

    Raises:
        ArtifactError: not safetensors, a kind that is not known, or tensors that do not fit together.
    """
    try:
        weights = {name: value.double() for name, value in load(data).items()}  # as in the ONNX model
    except SafetensorError as error:
        raise ArtifactError(f"{path}: expected safetensors: {error}") from None
    kind, activation = manifest.network.get("kind"), str(manifest.network.get("activation"))
    if kind not in ("axis_shared", "mlp"):
        raise ArtifactError(f"{path}: network.kind: expected axis_shared or mlp, got {kind!r}")
    if kind == "mlp" and activation not in ("tanh", "relu"):
        raise ArtifactError(f"{path}: network.activation: expected tanh or relu, got {activation!r}")
    torch.set_num_threads(1)

    def infer(observation: Float32) -> Float32:
        with torch.inference_mode():
            x = torch.from_numpy(observation).double()
            raw = axis_shared(weights, x) if kind == "axis_shared" else mlp(weights, x, activation)
            action: Float32 = raw.clamp(-1.0, 1.0).float().numpy()
            return action

    try:
        infer(np.zeros((1, 6), dtype=np.float32))
    except (KeyError, RuntimeError) as error:
        raise ArtifactError(f"{path}: weights: expected those of a network of kind {kind}: {error}") from None
    return infer
