"""The planner's network in Stable-Baselines3's terms, and where its actor is found in there."""

from __future__ import annotations

from dataclasses import dataclass

import gymnasium
import torch
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, create_mlp
from torch import Tensor, nn

CLIP = 8.0
"""Normalized observations are clipped to +- this."""


@dataclass(frozen=True)
class PlannerNetwork:
    """Shape of actor and critic, which share nothing but the normalizer."""

    hidden: tuple[int, ...] = (256, 256, 128)
    """Widths of the hidden layers, with ELU between them."""
    log_std: float = -1.5
    """Logarithm of the initial standard deviation of the action."""


class Normalizer(BaseFeaturesExtractor):
    """Fixed normalization of the observation. It is part of the weights, so it cannot be lost."""

    def __init__(self, observation_space: gymnasium.Space, scale: Tensor | None = None) -> None:
        assert observation_space.shape is not None
        super().__init__(observation_space, features_dim=observation_space.shape[0])
        size = observation_space.shape[0]
        self.mean: Tensor
        self.scale: Tensor
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("scale", torch.ones(size) if scale is None else scale.clone())

    def forward(self, observations: Tensor) -> Tensor:
        return ((observations - self.mean) / self.scale).clamp(-CLIP, CLIP)

    def fit(self, observations: Tensor, floor: Tensor) -> None:
        """Take mean and standard deviation from ``observations`` (T, D), but no scale below ``floor``
        (D,)."""
        self.mean.copy_(observations.mean(dim=0))
        self.scale.copy_(torch.maximum(observations.std(dim=0), floor))


class PlannerActor(nn.Module):
    """The deterministic planner alone: observation (N, D) -> action (N, 21), not clipped."""

    def __init__(self, observation_size: int, action_size: int, hidden: tuple[int, ...]) -> None:
        super().__init__()
        self.mean: Tensor
        self.scale: Tensor
        self.register_buffer("mean", torch.zeros(observation_size))
        self.register_buffer("scale", torch.ones(observation_size))
        self.hidden = nn.Sequential(*create_mlp(observation_size, -1, list(hidden), nn.ELU))
        self.output = nn.Linear(hidden[-1], action_size)

    def forward(self, observation: Tensor) -> Tensor:
        normalized = ((observation - self.mean) / self.scale).clamp(-CLIP, CLIP)
        return self.output(self.hidden(normalized))

    @classmethod
    def from_policy(cls, policy: ActorCriticPolicy, hidden: tuple[int, ...]) -> PlannerActor:
        """A copy of the actor of a policy that was built with :func:`policy_arguments`."""
        normalizer = policy.features_extractor
        assert isinstance(normalizer, Normalizer)
        action_size = policy.action_net.state_dict()["bias"].numel()
        actor = cls(normalizer.features_dim, action_size, hidden)
        actor.hidden.load_state_dict(policy.mlp_extractor.policy_net.state_dict())
        actor.output.load_state_dict(policy.action_net.state_dict())
        actor.mean.copy_(normalizer.mean)
        actor.scale.copy_(normalizer.scale)
        return actor.eval().requires_grad_(False)

    @torch.no_grad()
    def write_to(self, policy: ActorCriticPolicy) -> None:
        """Make a policy of the same shape act like this, the inverse of :meth:`from_policy`."""
        normalizer = policy.features_extractor
        assert isinstance(normalizer, Normalizer)
        policy.mlp_extractor.policy_net.load_state_dict(self.hidden.state_dict())
        policy.action_net.load_state_dict(self.output.state_dict())
        normalizer.mean.copy_(self.mean)
        normalizer.scale.copy_(self.scale)


def policy_arguments(network: PlannerNetwork, scale: Tensor) -> dict[str, object]:
    """``policy_kwargs`` of Stable-Baselines3's ``MlpPolicy``; ``scale`` (D,) is the task's own observation
    scale."""
    return {
        "net_arch": {"pi": list(network.hidden), "vf": list(network.hidden)},
        "activation_fn": nn.ELU,
        "ortho_init": False,
        "log_std_init": network.log_std,
        "features_extractor_class": Normalizer,
        "features_extractor_kwargs": {"scale": scale},
    }


def actor_parameters(policy: ActorCriticPolicy) -> list[nn.Parameter]:
    """Parameters that only the actor uses."""
    return [*policy.mlp_extractor.policy_net.parameters(), *policy.action_net.parameters(), policy.log_std]
