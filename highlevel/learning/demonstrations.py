"""Demonstrations: successful episodes of a scripted expert, as arrays in one ``.npz`` file."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from highlevel.action import ActionConfig
from highlevel.environment import CommandEnvironment
from highlevel.episodes import Policy
from highlevel.task import ObservationBlock, rows
from lowlevel.runs.configs import from_plain
from lowlevel.runs.draws import uniform
from lowlevel.runs.files import atomic_write
from robots.errors import PilotError

_NOISE_STREAM = 3
_Step = tuple[Tensor, Tensor, float]
"""Observation, action and reward of one decision."""


class ExpertError(PilotError):
    """The expert does not succeed; the message says what to check."""


@dataclass(frozen=True)
class Source:
    """Where demonstrations come from; what their numbers mean depends on it."""

    task: str
    observation: tuple[ObservationBlock, ...]
    action: ActionConfig
    discount: float
    """Of the returns, per decision."""
    controller: str
    """Identity of the controller that the expert used. Its demonstrations may serve another one."""

    def require_like(self, wanted: Source) -> None:
        """Check that the numbers mean what ``wanted`` needs them to.

        Raises:
            PilotError: naming the first thing that differs.
        """
        for field in fields(self):
            if field.name != "controller" and getattr(self, field.name) != getattr(wanted, field.name):
                raise PilotError(f"the demonstrations were recorded with another {field.name}: record them again")


@dataclass(frozen=True)
class Demonstrations:
    """Decisions of successful episodes, one after the other."""

    source: Source
    observation: np.ndarray
    """(T, D) float32"""
    action: np.ndarray
    """What the expert wanted, not what noise made of it (T, 21) float32."""
    value: np.ndarray
    """Discounted sum of the rewards that followed (T,) float32."""
    episode: np.ndarray
    """Number of the episode each decision belongs to (T,) integers."""
    attempts: int
    """Episodes that were run to get these."""

    @property
    def count(self) -> int:
        """Number of episodes."""
        return len(np.unique(self.episode))

    def joined(self, other: Demonstrations) -> Demonstrations:
        """These, then ``other``, whose episodes are renumbered to stay apart."""
        offset = int(self.episode.max(initial=-1)) + 1
        return Demonstrations(
            self.source,
            np.concatenate([self.observation, other.observation]),
            np.concatenate([self.action, other.action]),
            np.concatenate([self.value, other.value]),
            np.concatenate([self.episode, other.episode + offset]),
            self.attempts + other.attempts,
        )

    def save(self, path: Path) -> None:
        """Write the file; a crash while writing leaves no half of it."""
        arrays = {name: getattr(self, name) for name in ("observation", "action", "value", "episode")}
        source, attempts = np.array(json.dumps(asdict(self.source))), np.array(self.attempts)
        atomic_write(path, lambda file: np.savez_compressed(file, source=source, attempts=attempts, **arrays))

    @classmethod
    def load(cls, path: Path) -> Demonstrations:
        """Read what :meth:`save` wrote.

        Raises:
            PilotError: if there is no such file.
            PilotError: if the file is damaged, of an earlier version, or holds numbers that are not finite.
        """
        if not path.is_file():
            raise PilotError(f"{path} does not exist: record demonstrations first")
        if not zipfile.is_zipfile(path):
            raise PilotError(f"{path} does not hold demonstrations: it is damaged, truncated or something else")
        try:
            with np.load(path, allow_pickle=False) as file:
                source = from_plain(Source, json.loads(str(file["source"])))
                attempts = int(file["attempts"])
                loaded = cls(source, file["observation"], file["action"], file["value"], file["episode"], attempts)
        except (OSError, KeyError, TypeError, ValueError, EOFError, zipfile.BadZipFile) as error:
            reason = f"{error}, so that it is damaged or of an earlier version: record it again"
            raise PilotError(f"{path} does not hold demonstrations: {reason}") from error
        if not len(loaded.observation) == len(loaded.action) == len(loaded.value) == len(loaded.episode):
            raise PilotError(f"{path} does not hold demonstrations: its arrays differ in length")
        for name in ("observation", "action", "value"):
            if not np.isfinite(getattr(loaded, name)).all():
                raise PilotError(f"{path} holds numbers in {name!r} that are not finite: record it again")
        return loaded


@torch.no_grad()
def record(
    environment: CommandEnvironment,
    expert: Policy,
    count: int,
    seed: int,
    noise: float,
    source: Source,
    on_progress: Callable[[int, int], None] | None = None,
    should_stop: Callable[[], bool] = lambda: False,
) -> Demonstrations:
    """Run the expert and keep the first ``count`` episodes that succeed, by number.

    Args:
        environment: where.
        expert: who.
        count: successes wanted.
        seed: seed of the episodes.
        noise: standard deviation of the noise on the executed actions, which shows how the expert recovers
        (DART).
        source: what is recorded, with the discount of the returns.
        on_progress: told successes and attempts after every episode.
        should_stop: asked after every decision; what has been recorded by then is returned.

    Returns:
        the episodes in order; the same ones for every number of robots.

    Raises:
        ExpertError: if the expert does not succeed once in 4 ``count`` + 100 attempts.
    """
    observation = environment.reset(seed)
    expert.reset(rows(environment.num_envs))
    running: list[list[_Step]] = [[] for _ in range(environment.num_envs)]
    successes: dict[int, list[_Step]] = {}
    ended: set[int] = set()
    leading = 0  # Episodes 0 to this - 1 have all ended: later ones that were quicker must not displace them.
    while sum(number < leading for number in successes) < count and not should_stop():
        action = expert.act(observation)
        moment = environment.episode * 10_000 + environment.decisions
        # Uniform numbers of the wanted standard deviation.
        shake = noise * 3.0**0.5 * (2.0 * uniform(seed, moment, _NOISE_STREAM, action.shape[1]) - 1.0)
        result = environment.step((action + shake).clamp(-1.0, 1.0))
        rewards, done = result.reward.tolist(), result.done.tolist()
        for robot, steps in enumerate(running):
            steps.append((observation[robot], action[robot], rewards[robot]))
            if done[robot]:
                number = int(result.episode[robot])
                ended.add(number)
                if result.success[robot]:
                    successes[number] = steps
                running[robot] = []
        if any(done):
            expert.reset(torch.nonzero(result.done)[:, 0])
            while leading in ended:
                leading += 1
            if on_progress is not None:
                on_progress(min(len(successes), count), len(ended))
            if not successes and len(ended) > 4 * count + 100:
                raise ExpertError(
                    f"the expert failed {len(ended)} times in a row: check the controller with 'evaluate-lowlevel'"
                )
        observation = result.observation
    kept = sorted(number for number in successes if number < leading)[:count]
    attempts = kept[-1] + 1 if len(kept) == count else leading
    return _pack([(number, successes[number]) for number in kept], attempts, source, environment)


def _pack(
    finished: list[tuple[int, list[_Step]]],
    attempts: int,
    source: Source,
    environment: CommandEnvironment,
) -> Demonstrations:
    steps = [step for _, episode in finished for step in episode]
    values: list[float] = []
    for _, episode in finished:
        following, returns = 0.0, []
        for _, _, reward in reversed(episode):
            following = reward + source.discount * following
            returns.append(following)
        values += reversed(returns)
    width = environment.observation_size
    return Demonstrations(
        source=source,
        observation=np.array([step[0].numpy() for step in steps], np.float32).reshape(-1, width),
        action=np.array([step[1].numpy() for step in steps], np.float32).reshape(-1, environment.command.shape[1]),
        value=np.array(values, np.float32),
        episode=np.repeat([number for number, _ in finished], [len(episode) for _, episode in finished]).astype(int),
        attempts=attempts,
    )
