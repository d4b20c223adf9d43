"""Behavior cloning of demonstrations into a Stable-Baselines3 policy, actor and critic.

The ``imitation`` package is tied to an older Stable-Baselines3, so the loss is written out: -log pi(a|s) for
the actor and the Huber loss of the demonstrated returns for the critic. PPO after cloning is known to
collapse when the critic has seen nothing (Stable-Baselines3 issue 543).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import Tensor

from highlevel.learning.demonstrations import Demonstrations
from highlevel.learning.policy import Normalizer
from robots.errors import PilotError


@dataclass(frozen=True)
class CloningConfig:
    """Behavior cloning."""

    epochs: int = 60
    """Passes over the demonstrations."""
    batch_size: int = 1024
    """Decisions per minibatch."""
    learning_rate: float = 1e-3
    """Falls to zero along a cosine."""
    held_out: float = 0.1
    """Share of the episodes that is only used to measure the error."""
    observation_noise: float = 0.02
    """Noise on normalized observations, against reading too much into them."""


@dataclass(frozen=True)
class CloningResult:
    """What cloning achieved."""

    train_error: float
    """Root mean square error of the action, over the last epoch."""
    held_out_error: float
    """The same on held-out episodes; not a number if there are none."""
    value_error: float
    """Root mean square error of the value on the last epoch."""


def clone(
    policy: ActorCriticPolicy,
    demonstrations: Demonstrations,
    scale: Tensor,
    config: CloningConfig,
    seed: int,
    on_progress: Callable[[int, float], None] | None = None,
) -> CloningResult:
    """Fit ``policy`` to the demonstrations; its normalizer takes their statistics, its exploration stays.

    Args:
        policy: to be changed.
        demonstrations: what to imitate.
        scale: the task's observation scale (D,); the normalizer's scales stay above a tenth of it.
        config: how.
        seed: of shuffling and noise.
        on_progress: told epoch and training error.

    Raises:
        PilotError: if there are no demonstrations or they belong to another observation.
    """
    if demonstrations.count == 0:
        raise PilotError("there are no demonstrations to clone: record some first")
    normalizer = policy.features_extractor
    assert isinstance(normalizer, Normalizer)
    if demonstrations.observation.shape[1] != normalizer.features_dim:
        raise PilotError(
            f"the demonstrations have {demonstrations.observation.shape[1]} observations, this task has "
            f"{normalizer.features_dim}: record them again"
        )
    observation = torch.from_numpy(demonstrations.observation)
    action, value = torch.from_numpy(demonstrations.action), torch.from_numpy(demonstrations.value)
    normalizer.fit(observation, 0.1 * scale)
    numbers = np.unique(demonstrations.episode)
    held_out = numbers[: int(config.held_out * len(numbers))]
    is_held_out = torch.from_numpy(np.isin(demonstrations.episode, held_out))
    train, test = torch.nonzero(~is_held_out)[:, 0], torch.nonzero(is_held_out)[:, 0]

    generator = torch.Generator().manual_seed(seed)
    parameters = [p for name, p in policy.named_parameters() if name != "log_std"]
    optimizer = torch.optim.Adam(parameters, lr=config.learning_rate)
    per_epoch = -(-len(train) // config.batch_size)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, config.epochs * per_epoch)
    policy.set_training_mode(True)
    action_error = value_error = float("nan")
    for epoch in range(config.epochs):
        squares, value_squares = 0.0, 0.0
        for batch in train[torch.randperm(len(train), generator=generator)].split(config.batch_size):
            seen = observation[batch]
            noise = torch.randn(seen.shape, generator=generator) * config.observation_noise * normalizer.scale
            values, log_probability, _ = policy.evaluate_actions(seen + noise, action[batch])
            distance = values[:, 0] - value[batch]
            loss = -log_probability.mean() + 0.5 * torch.nn.functional.huber_loss(values[:, 0], value[batch])
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(parameters, 1.0)
            optimizer.step()
            schedule.step()
            with torch.no_grad():
                wanted = policy.get_distribution(seen).mode() - action[batch]
                squares += float(wanted.square().mean(dim=1).sum())
                value_squares += float(distance.square().sum())
        action_error, value_error = (squares / len(train)) ** 0.5, (value_squares / len(train)) ** 0.5
        if on_progress is not None:
            on_progress(epoch + 1, action_error)
    policy.set_training_mode(False)
    with torch.no_grad():
        missed = policy.get_distribution(observation[test]).mode() - action[test] if len(test) else None
    held_out_error = float("nan") if missed is None else float(missed.square().mean().sqrt())
    return CloningResult(action_error, held_out_error, value_error)
