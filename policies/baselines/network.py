"""Actor and critic of Pure RL: those of `policies.network`, with an obstacle's position and velocity among the vectors.

One perceptron g for every axis, made odd, as in `companion.torch_backend`: with the axis' components of all vectors,
o_i = [v_i, e_i, fine e_i, r_i, w_i], and what no symmetry of the cube changes, s = lengths and products of vectors,

    a_i = g(o_i, s) - g(-o_i, s),     r = p_o - p, w = v_o - v.

The critic is a perceptron on a representative of each symmetry class: axes reflected to e_i >= 0, sorted by e_i.
"""

from __future__ import annotations

import torch
from torch import nn

from companion.torch_backend import FINE
from policies.network import SharedActorPolicy

_VECTORS = 5  # v, e, fine e, r, w of one axis
_INVARIANTS = 8


def vectors(observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """v, e, r, w of scaled (N, 12) observations [v, e, r, v_o]; v and v_o have one scale, so w = v_o - v."""
    v, e, r, v_o = observation.split(3, dim=1)
    return v, e, r, v_o - v


def invariants(v: torch.Tensor, e: torch.Tensor, r: torch.Tensor, w: torch.Tensor) -> torch.Tensor:
    """Lengths, the nearness of the obstacle, its closing speed and its distance when it is closest, (N, 8)."""
    distance = r.norm(dim=1).clamp(min=0.05)
    speed = w.norm(dim=1).clamp(min=0.05)
    closing = -(r * w).sum(dim=1) / distance
    ahead = (closing * distance / speed**2).clamp(0.0, 3.0)
    miss = (r + ahead[:, None] * w).norm(dim=1)
    lengths = [v.norm(dim=1), e.norm(dim=1), (v + e).norm(dim=1)]
    return torch.stack([*lengths, 0.2 / (0.1 + distance), closing, ahead, 0.2 / (0.1 + miss), speed], dim=1)


class EndToEndNet(nn.Module):  # type: ignore[misc]  # mypy does not read torch
    """Parameters of both, in the shape that stable-baselines3 expects of an ``mlp_extractor``."""

    def __init__(self, actor_width: int, critic_width: int) -> None:
        super().__init__()
        self.latent_dim_pi, self.latent_dim_vf = 3, critic_width
        self.odd = nn.Linear(_VECTORS, actor_width, bias=False)
        self.even = nn.Linear(_INVARIANTS, actor_width)
        self.hidden = nn.Linear(actor_width, actor_width)
        self.out = nn.Linear(actor_width, 1, bias=False)
        self.critic = nn.Sequential(
            nn.Linear(15 + _INVARIANTS, critic_width), nn.ReLU(), nn.Linear(critic_width, critic_width), nn.ReLU()
        )

    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return self.forward_actor(observation), self.forward_critic(observation)

    def forward_actor(self, observation: torch.Tensor) -> torch.Tensor:
        v, e, r, w = vectors(observation)
        components = torch.stack([v, e, nn.functional.softsign(FINE * e), r, w], dim=2)
        odd, even = self.odd(components), self.even(invariants(v, e, r, w))[:, None, :]
        first = torch.relu(torch.stack([even + odd, even - odd]))
        second = torch.relu(self.hidden(first))
        action: torch.Tensor = self.out(second[0] - second[1])[..., 0]
        return action

    def forward_critic(self, observation: torch.Tensor) -> torch.Tensor:
        v, e, r, w = vectors(observation)
        order, mirror = e.abs().argsort(dim=1), e.sign()
        own = [torch.gather(x * mirror, 1, order) for x in (v, e, r, w)]
        features = torch.cat([*own, own[1].sqrt(), invariants(v, e, r, w)], dim=1)
        latent: torch.Tensor = self.critic(features)
        return latent


class EndToEndPolicy(SharedActorPolicy):
    net = EndToEndNet
