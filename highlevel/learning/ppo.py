"""Stable-Baselines3's PPO as the planner needs it: a critic that learns alone at first, and a state without pickles."""

from __future__ import annotations

from typing import Any

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor

from highlevel.learning.config import PlannerTrainingConfig
from highlevel.learning.policy import actor_parameters, policy_arguments
from lowlevel.runs.checks import require_finite


class PlannerPPO(PPO):
    """PPO on all robots of ``vec_env``.

    After cloning or a warm start the actor is good and the critic is not, so the first ``warm_up_updates`` leave the
    actor alone.

    Args:
        config: the run.
        vec_env: what to learn from.
        scale: the task's observation scale (D,).
    """

    def __init__(self, config: PlannerTrainingConfig, vec_env: VecEnv, scale: Tensor) -> None:
        ppo = config.ppo
        self.warm_up_updates = ppo.warm_up_updates if config.begins_skilled else 0
        self.finished_updates = 0
        rate = ppo.learning_rate_after_cloning if config.begins_skilled else ppo.learning_rate
        super().__init__(
            "MlpPolicy",
            vec_env,
            n_steps=ppo.decisions_per_update,
            batch_size=ppo.batch_size,
            n_epochs=ppo.epochs,
            gamma=ppo.discount,
            gae_lambda=ppo.gae_lambda,
            learning_rate=lambda remaining: ppo.warm_up_learning_rate if self.is_warming_up else rate,
            clip_range=ppo.clip_range,
            target_kl=ppo.target_kl,
            ent_coef=ppo.entropy,
            policy_kwargs=policy_arguments(config.network, scale),
            seed=config.seed,
            device="cpu",
        )

    @property
    def is_warming_up(self) -> bool:
        """Whether the next update is of the critic alone."""
        return self.finished_updates < self.warm_up_updates

    @torch.no_grad()
    def set_exploration(self, log_std: float) -> None:
        """Give every action the standard deviation exp(``log_std``)."""
        self.policy.log_std.fill_(log_std)

    def train(self) -> None:
        """Learn from the collected rollout."""
        for parameter in actor_parameters(self.policy):
            parameter.requires_grad_(not self.is_warming_up)
        super().train()
        self.finished_updates += 1

    def state_dict(self) -> dict[str, Any]:
        """Weights, optimizer, counters and torch's random numbers; not the environment.

        The order of minibatches is drawn by NumPy, which begins anew in a resumed run.

        Raises:
            NonFiniteError: if a weight is not finite.
        """
        policy = self.policy.state_dict()
        for name, tensor in policy.items():
            require_finite(f"policy weight {name!r} after {self.num_timesteps} decisions", tensor)
        return {
            "policy": policy,
            "optimizer": self.policy.optimizer.state_dict(),
            "decisions": self.num_timesteps,
            "updates": self.finished_updates,
            "epochs": self._n_updates,
            "generator": torch.get_rng_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what :meth:`state_dict` returned.

        Raises:
            NonFiniteError: if a weight is not finite.
            KeyError, RuntimeError, ValueError: if it is of another network or version.
        """
        for name, tensor in state["policy"].items():
            require_finite(f"policy weight {name!r}", tensor)
        self.policy.load_state_dict(state["policy"])
        self.policy.optimizer.load_state_dict(state["optimizer"])
        self.num_timesteps = state["decisions"]
        self.finished_updates, self._n_updates = state["updates"], state["epochs"]
        torch.set_rng_state(state["generator"])
