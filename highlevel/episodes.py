"""Running numbered episodes to their end: for evaluation, model selection and demonstrations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import torch
from torch import Tensor

from highlevel.environment import CommandEnvironment, StepResult
from highlevel.task import rows


class Policy(Protocol):
    """Whatever decides for all robots of an environment: a planner, or a scripted expert."""

    def act(self, observation: Tensor) -> Tensor:
        """Actions (N, 21) in [-1, 1] for ``observation`` (N, D)."""

    def reset(self, ids: Tensor) -> None:
        """Robots ``ids`` (n,) begin new episodes."""


@dataclass(frozen=True)
class EpisodeRecord:
    """How one episode went."""

    number: int
    success: bool
    stage: int
    """Stages passed."""
    failure: str | None
    """Why it failed; None for a success."""
    duration: float
    """[s]"""
    total_reward: float
    stage_times: tuple[float, ...] = ()
    """When each passed stage was passed [s], to the decision."""
    conditions: dict[str, float] = field(default_factory=dict)
    """What :meth:`highlevel.task.Task.conditions` says about the episode."""


Observer = Callable[[Tensor, Tensor, StepResult], None]
"""Called after every decision with the observation and action it was made from and with, and the result."""


@torch.no_grad()
def run_episodes(
    environment: CommandEnvironment,
    policy: Policy,
    count: int,
    seed: int,
    observers: Sequence[Observer] = (),
    on_progress: Callable[[int], None] | None = None,
) -> list[EpisodeRecord]:
    """Run episodes 0 to ``count`` - 1 of ``seed`` and return their records in order.

    The same episodes are run for every number of robots. ``on_progress`` is told how many are over.
    """
    observation = environment.reset(seed)
    policy.reset(rows(environment.num_envs))
    records: dict[int, EpisodeRecord] = {}
    total = torch.zeros(environment.num_envs)
    stage_times: list[list[float]] = [[] for _ in range(environment.num_envs)]
    conditions = _copy(environment.task.conditions())
    while len(records) < count:
        action = policy.act(observation)
        result = environment.step(action)
        total += result.reward
        for observer in observers:
            observer(observation, action, result)
        for robot, (passed, duration) in enumerate(
            zip(result.final_stage.tolist(), result.duration.tolist(), strict=True)
        ):
            stage_times[robot] += [round(duration, 3)] * (passed - len(stage_times[robot]))
        over = torch.nonzero(result.done)[:, 0]
        for robot in over.tolist():
            number = int(result.episode[robot])
            if number < count:
                records[number] = EpisodeRecord(
                    number=number,
                    success=bool(result.success[robot]),
                    stage=int(result.final_stage[robot]),
                    failure=result.failures.get(robot),
                    duration=float(result.duration[robot]),
                    total_reward=float(total[robot]),
                    stage_times=tuple(stage_times[robot]),
                    conditions={name: float(values[robot]) for name, values in conditions.items()},
                )
            stage_times[robot] = []
        if len(over):
            total[over] = 0.0
            conditions = _copy(environment.task.conditions())
            policy.reset(over)
            if on_progress is not None:
                on_progress(len(records))
        observation = result.observation
    return [records[number] for number in sorted(records)]


def _copy(conditions: dict[str, Tensor]) -> dict[str, Tensor]:
    """The task overwrites its own when an episode ends."""
    return {name: values.clone() for name, values in conditions.items()}


def success_rate(records: Sequence[EpisodeRecord]) -> float:
    """Share of successes."""
    return sum(record.success for record in records) / max(len(records), 1)


def stage_shares(records: Sequence[EpisodeRecord], stages: Sequence[str]) -> dict[str, float]:
    """Share of episodes that passed each of the ``stages``."""
    return {
        stage: sum(record.stage >= number for record in records) / max(len(records), 1)
        for number, stage in enumerate(stages, start=1)
    }
