"""Cloning a better way of acting into the policy alone.

What a gait prior adds, or what a policy does that is told another velocity, is a function of what the policy sees or
estimates; so it is a policy, too. The student acts in the world by itself, and imitates what its teacher would do there
(DAgger, Ross et al., AISTATS 2011). A fade of a gait prior costs speed faster than PPO can take it over; this costs
minutes and no skill.
"""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from lowlevel.control.observation import FRAME, FRAME_SIZE, HISTORY_LENGTH, columns
from lowlevel.environment import PilotEnvironment
from lowlevel.gait_prior import GaitPrior
from lowlevel.learning.ppo import PPO
from lowlevel.networks.actor import CAPTURE_POINT
from lowlevel.runs.distributed import average_over_ranks
from robots.g1.constants import NUM_JOINTS


@dataclass(frozen=True)
class CloningConfig:
    """How long and how fast the student learns, after a gait prior and after a calibration."""

    rounds: int = 50
    """Rounds of acting and learning."""
    steps: int = 24
    """Control steps per robot and round."""
    mixed_rounds: int = 20
    """Rounds over which the teacher hands over to the student."""
    kept_rounds: int = 10
    """Rounds whose samples the student learns from."""
    gradient_steps: int = 24
    """Per round."""
    minibatch: int = 6144
    """Samples per gradient step."""
    learning_rate: float = 1e-3
    """Learning rate; a third of it in the last fifth of the rounds."""


class Teacher(Protocol):
    """What the student imitates."""

    def label(self, observation: dict[str, Tensor]) -> Tensor:
        """The action to imitate (N, A) [action scales], for what the policy sees; asked for once a control step."""

    def forget(self, robots: Tensor) -> None:
        """An episode of the ``robots`` (N,) bool has ended."""


class PolicyTeacher:
    """A copy of the policy as it is now."""

    def __init__(self, ppo: PPO) -> None:
        self._policy = copy.deepcopy(ppo.actor).eval().requires_grad_(False)

    @torch.no_grad()
    def label(self, observation: dict[str, Tensor]) -> Tensor:
        return self._policy(observation["history"], observation["elevation_map"], observation["flag"]).mean

    def forget(self, robots: Tensor) -> None:
        """A policy remembers nothing."""


class PriorTeacher:
    """A copy of the policy, and the gait prior under it in a world that has none."""

    def __init__(self, ppo: PPO, environment: PilotEnvironment, prior: GaitPrior) -> None:
        self._policy = copy.deepcopy(ppo.actor).eval().requires_grad_(False)
        self._environment, self._prior = environment, prior
        # What of each remembered action is the prior's: the policy has never seen it there.
        self._offsets = torch.zeros(environment.num_robots, HISTORY_LENGTH + 1, NUM_JOINTS, device=ppo.device)

    @torch.no_grad()
    def label(self, observation: dict[str, Tensor]) -> Tensor:
        seen = observation["history"].view(*self._offsets.shape[:2], FRAME_SIZE).clone()
        seen[:, :, columns(FRAME, "last_action")] -= self._offsets
        state = self._environment.buffers
        offset = self._prior(state.reference, state.capture_point, state.mean_velocity_error)
        offset = (offset / self._environment.action_scale).to(seen.device)
        self._offsets = torch.cat([self._offsets[:, 1:], offset[:, None]], dim=1)
        return self._policy(seen.flatten(1), observation["elevation_map"], observation["flag"]).mean + offset

    def forget(self, robots: Tensor) -> None:
        self._offsets[robots] = 0.0


@torch.no_grad()
def _mirrored(ppo: PPO, observation: dict[str, Tensor], label: Tensor) -> tuple[Tensor, ...]:
    """The mirror image of a sample. An asymmetric clone would spend PPO's first million steps on its mirror loss."""
    history, elevation = (ppo.mirrors(key, observation[key]) for key in ("history", "elevation_map"))
    motion, latent = ppo.actor.encode(history, elevation)
    frame = history[:, -FRAME_SIZE:].clone()
    return frame, elevation.clone(), observation["flag"].clone(), motion, latent, ppo.mirrors("action", label)


def clone(
    ppo: PPO, environment: PilotEnvironment, teacher: Teacher, config: CloningConfig, report: Callable[[str], None]
) -> dict[str, Tensor]:
    """Teach the actor of ``ppo`` to act in ``environment`` as ``teacher`` would.

    ``report`` is told how it goes, every ten rounds. Returns the observation to go on from.
    """
    student, device = ppo.actor, ppo.device
    acting = ppo.learner.acting
    optimizer = torch.optim.Adam(student.policy_parameters(), lr=config.learning_rate)
    kept: deque[tuple[Tensor, ...]] = deque(maxlen=config.kept_rounds)
    observation = environment.reset(spread_episodes=True)
    for round_number in range(config.rounds):
        handing_over = max(0.0, 1.0 - round_number / config.mixed_rounds)
        if round_number == config.rounds * 4 // 5:
            optimizer.param_groups[0]["lr"] = config.learning_rate / 3.0
        samples, falls = [], 0
        for _ in range(config.steps):
            seen = {name: values.to(device) for name, values in observation.items()}
            context = (seen["elevation_map"], seen["flag"])
            label = teacher.label(seen)
            with torch.no_grad():
                own = student(seen["history"], *context)
            teachers_turn = torch.rand(len(label), 1, generator=ppo.generator, device=device) < handing_over
            frame = seen["history"][:, -FRAME_SIZE:].clone()
            std = ppo.learner.std(frame).detach()
            noise = 0.5 * std * torch.randn(label.shape, generator=ppo.generator, device=device)
            action = torch.where(teachers_turn, label, own.mean) + noise
            samples.append((frame, *(c.clone() for c in context), own.motion, own.latent, label))
            samples.append(_mirrored(ppo, seen, label))
            result = environment.step(action.cpu(), own.motion[:, CAPTURE_POINT].cpu())
            falls += int(result.terminated.sum())
            teacher.forget((result.terminated | result.truncated).to(device))
            observation = result.observation
        kept.append(tuple(torch.cat(column) for column in zip(*samples, strict=True)))
        *inputs, labels = (torch.cat(column) for column in zip(*kept, strict=True))
        losses = []
        for _ in range(config.gradient_steps):
            index = torch.randint(len(labels), (config.minibatch,), generator=ppo.generator, device=device)
            chosen = [column[index] for column in inputs]
            mean, _ = student.decide(*chosen)
            std = ppo.learner.std(chosen[0]).detach()
            loss = 0.5 * ((mean - labels[index]) / std)[:, acting].square().sum(dim=1).mean()
            optimizer.zero_grad()
            loss.backward()
            average_over_ranks([p.grad for p in student.policy_parameters() if p.grad is not None])
            torch.nn.utils.clip_grad_norm_(student.policy_parameters(), 5.0)
            optimizer.step()
            losses.append(float(loss.detach()))
        between_falls = config.steps * environment.num_robots / max(falls, 1)
        divergence = sum(losses) / len(losses)
        if round_number % 10 == 0 or round_number + 1 == config.rounds:
            report(f"cloning: {divergence:.3f} nat, falls every {between_falls:.0f} steps")
    return observation
