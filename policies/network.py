"""Actor and critic for stable-baselines3's PPO that know the symmetry of the task.

The actor is `companion.torch_backend.axis_shared`, the very function that the torch backend flies. The critic is a
perceptron on a representative of each symmetry class: axes reflected to e_i >= 0 and sorted by e_i.
"""

from __future__ import annotations

from typing import Any

import torch
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn

from companion.torch_backend import axis_shared, lengths

V_SCALE_M_S, E_SCALE_M = 3.0, 5.0  # the normaliser: about the standard deviations met in training


class AxisSharedNet(nn.Module):  # type: ignore[misc]  # mypy does not read torch
    """Parameters of both, in the shape that stable-baselines3 expects of an ``mlp_extractor``."""

    scale: torch.Tensor

    def __init__(self, actor_width: int, critic_width: int) -> None:
        super().__init__()
        self.latent_dim_pi, self.latent_dim_vf = 3, critic_width
        self.register_buffer("scale", torch.tensor([V_SCALE_M_S] * 3 + [E_SCALE_M] * 3))
        self.odd = nn.Linear(3, actor_width, bias=False)
        self.even = nn.Linear(3, actor_width)
        self.hidden = nn.Linear(actor_width, actor_width)
        self.out = nn.Linear(actor_width, 1, bias=False)
        self.critic = nn.Sequential(
            nn.Linear(12, critic_width), nn.ReLU(), nn.Linear(critic_width, critic_width), nn.ReLU()
        )

    def actor_weights(self) -> dict[str, torch.Tensor]:
        """What is exported, normaliser included."""
        return {name: value for name, value in self.state_dict(keep_vars=True).items() if "critic" not in name}

    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return self.forward_actor(observation), self.forward_critic(observation)

    def forward_actor(self, observation: torch.Tensor) -> torch.Tensor:
        return axis_shared(self.actor_weights(), observation)

    def forward_critic(self, observation: torch.Tensor) -> torch.Tensor:
        scaled = observation / self.scale
        v, e = scaled[:, :3], scaled[:, 3:]
        order, mirror = e.abs().argsort(dim=1), e.sign()
        v_class, e_class = torch.gather(v * mirror, 1, order), torch.gather(e.abs(), 1, order)
        features = torch.cat([v_class, e_class, e_class.sqrt(), lengths(v, e)], dim=1)
        latent: torch.Tensor = self.critic(features)
        return latent


class SharedActorPolicy(ActorCriticPolicy):
    """stable-baselines3's Gaussian actor-critic around a net of ours; the mean is the net's answer itself."""

    net: type[nn.Module]  # of (actor width, critic width), with a last layer ``out``

    def __init__(self, *args: Any, actor_width: int = 32, critic_width: int = 48, **kwargs: Any) -> None:
        self._widths = (actor_width, critic_width)
        super().__init__(*args, **kwargs)

    def _build_mlp_extractor(self) -> None:
        self.mlp_extractor = self.net(*self._widths)

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        self.action_net = nn.Identity()
        nn.init.orthogonal_(self.mlp_extractor.out.weight, gain=0.01)
        self.optimizer = torch.optim.Adam(self.parameters(), lr=lr_schedule(1.0), **self.optimizer_kwargs)


class AxisSharedPolicy(SharedActorPolicy):
    net = AxisSharedNet
