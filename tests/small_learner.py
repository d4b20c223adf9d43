"""A small learner and a small symmetric task, shared by the learner's tests."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from lowlevel.learning.ppo import PPO, PPOConfig
from lowlevel.networks.actor import NetworkConfig, ObservationSizes
from robots.g1.mirror import Mirror

SIZES = ObservationSizes(frame=10, history_length=5, elevation_map=121, privileged=133, action=4)
NETWORKS = NetworkConfig(
    history_hidden=(32,),
    latent=8,
    map_hidden=8,
    map_global=4,
    attention_width=8,
    attention_heads=2,
    token_features=4,
    expert_hidden=(16, 16),
    gate_hidden=8,
    monolithic_hidden=(32, 32),
    critic_hidden=(32,),
    target_hidden=(32,),
    prototypes=16,
)
_FRAME = Mirror(np.array([1, 0, 3, 2, 4, 5, 6, 7, 8, 9]), np.array([1, 1, -1, -1, -1, 1, -1, 1, 1, 1.0]))
_PRIVILEGED = Mirror(np.arange(133), np.array([1, -1, 1, 1, -1] + [1] * 128, dtype=float))
MIRRORS = {
    "history": _FRAME.repeated(6),
    "elevation_map": Mirror(np.arange(121).reshape(11, 11)[:, ::-1].reshape(-1), np.ones(121)),
    "privileged": _PRIVILEGED,
    "action": Mirror(np.array([1, 0, 3, 2]), np.array([1, 1, -1, -1.0])),
}
COMMANDS = torch.arange(10) >= 8
TARGET = torch.zeros(4, 10)
TARGET[0, :2] = torch.tensor([0.5, -0.3])
TARGET[1, :2] = torch.tensor([-0.3, 0.5])
TARGET[2, 2:5] = torch.tensor([0.4, 0.2, 0.3])
TARGET[3, 2:5] = torch.tensor([0.2, 0.4, -0.3])
TARGET[3, 4] = 0.3
"""The best action is ``TARGET @ frame``; mirroring the frame mirrors it."""


def observation(generator: torch.Generator, robots: int) -> dict[str, Tensor]:
    """Random observations of ``robots`` robots."""
    return {
        "history": torch.randn(robots, SIZES.history, generator=generator),
        "elevation_map": 0.1 * torch.randn(robots, SIZES.elevation_map, generator=generator),
        "flag": torch.randint(0, 2, (robots, 1), generator=generator).float(),
        "privileged": torch.randn(robots, SIZES.privileged, generator=generator),
    }


def best_action(observed: dict[str, Tensor]) -> Tensor:
    """The action (N, 4) that earns the highest reward."""
    return observed["history"][:, -SIZES.frame :] @ TARGET.T


def make_ppo(robots: int = 32, network: NetworkConfig = NETWORKS, **settings: object) -> PPO:
    """A PPO over the small networks; ``settings`` replace those of PPOConfig."""
    config = PPOConfig(**{"gamma": 0.0, "steps_per_update": 12, "minibatches": 4, **settings})  # type: ignore[arg-type]
    return PPO(config, network, SIZES, MIRRORS, robots, "cpu", COMMANDS, seed=3)


def run_update(ppo: PPO, seed: int) -> dict[str, float]:
    """One rollout of the task "track TARGET @ frame", and one update; all randomness comes from ``seed``."""
    generator = torch.Generator().manual_seed(seed)
    robots = ppo.storage.num_envs
    observed = observation(generator, robots)
    for _ in range(ppo.storage.steps):
        action, _ = ppo.act(observed)
        reward = -(action - best_action(observed)).square().sum(dim=1)
        ended = torch.rand(robots, generator=generator) < 0.1
        observed = observation(generator, robots)
        ppo.record(reward, ended, torch.zeros_like(ended), observed["privileged"])
    return ppo.update(observed)


def tracking_error(ppo: PPO) -> float:
    """Mean squared distance of the mean action from the best one."""
    observed = observation(torch.Generator().manual_seed(99), 512)
    return float((ppo.deterministic(observed) - best_action(observed)).square().mean())


def asymmetry(ppo: PPO) -> float:
    """Mean squared distance between the action of a mirrored observation and the mirrored action."""
    observed = observation(torch.Generator().manual_seed(98), 512)
    mirrored = {key: ppo.mirrors(key, value) for key, value in observed.items()}
    difference = ppo.deterministic(mirrored) - ppo.mirrors("action", ppo.deterministic(observed))
    return float(difference.square().mean())
