"""What a rollout leaves behind, and the advantages computed from it."""

from __future__ import annotations

import torch
from torch import Tensor

from lowlevel.runs.distributed import sum_over_ranks


def generalized_advantages(
    rewards: Tensor,
    values: Tensor,
    next_values: Tensor,
    terminated: Tensor,
    truncated: Tensor,
    gamma: float,
    lam: float,
) -> Tensor:
    """Generalized advantage estimates (T, N) (Schulman et al., arXiv 1506.02438).

    All arguments are (T, N). ``next_values[t]`` is the value of the state that step t led to *before* any
    reset: a truncated episode is bootstrapped with it, a terminated one is worth nothing after its end. No
    estimate reaches across the end of an episode.
    """
    continues = (~(terminated | truncated)).to(rewards.dtype)
    errors = rewards + gamma * next_values * (~terminated).to(rewards.dtype) - values
    advantages = torch.empty_like(rewards)
    following = torch.zeros_like(rewards[0])
    for step in reversed(range(len(rewards))):
        following = errors[step] + gamma * lam * continues[step] * following
        advantages[step] = following
    return advantages


def normalized_by_task(advantages: Tensor, task: Tensor, tasks: int) -> Tensor:
    """``advantages`` (T, N) with mean 0 and deviation 1 within each ``task`` (T, N), over all ranks.

    A task in which robots fall has advantages ten times as large as one that they master: over both together, what
    would still improve the second is lost in the noise of the first.
    """

    def totals(values: Tensor) -> Tensor:
        total = torch.zeros(tasks, dtype=values.dtype, device=values.device)
        return sum_over_ranks(total.index_add(0, task.flatten(), values.flatten()))

    count = totals(torch.ones_like(advantages)).clamp_min(1.0)
    centered = advantages - (totals(advantages) / count)[task]
    deviation = (totals(centered.square()) / count).sqrt()
    return centered / (deviation[task] + 1e-8)


class RolloutStorage:
    """Preallocated tensors of one rollout, filled step by step and reused.

    ``data`` holds one tensor (T, N, ...) per name.
    """

    def __init__(self, steps: int, num_envs: int, shapes: dict[str, tuple[int, ...]], device: torch.device) -> None:
        """``shapes``: the shape of one robot's entry at one step, per name; all entries are float32."""
        self.steps = steps
        self.num_envs = num_envs
        self.size = steps * num_envs
        self.position = 0
        self.data = {name: torch.zeros(steps, num_envs, *shape, device=device) for name, shape in shapes.items()}
        self.terminated = torch.zeros(steps, num_envs, dtype=torch.bool, device=device)
        self.truncated = torch.zeros(steps, num_envs, dtype=torch.bool, device=device)
        self.task = torch.zeros(steps, num_envs, dtype=torch.long, device=device)

    @property
    def full(self) -> bool:
        """Whether every step has been recorded."""
        return self.position == self.steps

    def write(self, values: dict[str, Tensor]) -> None:
        """Copy ``values``, each (N, ...), into the current step.

        Raises:
            ValueError: if the rollout is full or a tensor has another shape than was announced.
        """
        self._require_room()
        for name, value in values.items():
            slot = self.data[name][self.position]
            if value.shape != slot.shape:
                raise ValueError(f"{name} has shape {tuple(value.shape)}, expected {tuple(slot.shape)}")
            slot.copy_(value)

    def finish_step(self, terminated: Tensor, truncated: Tensor, task: Tensor) -> None:
        """Record how the current step ended, (N,) bool each, and its ``task`` (N,) long, and move on to the next.

        Raises:
            ValueError: if the rollout is full.
        """
        self._require_room()
        self.terminated[self.position] = terminated
        self.truncated[self.position] = truncated
        self.task[self.position] = task
        self.position += 1

    def flat(self, name: str) -> Tensor:
        """What was recorded under ``name``, (T * N, ...), step-major; a view."""
        return self.data[name].flatten(0, 1)

    def clear(self) -> None:
        """Start over; the tensors are reused."""
        self.position = 0

    def _require_room(self) -> None:
        if self.full:
            raise ValueError(f"the rollout already holds its {self.steps} steps; call update() before acting again")
