"""Everything about a training run that can be chosen."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from highlevel.learning.cloning import CloningConfig
from highlevel.learning.policy import PlannerNetwork
from robots.errors import PilotError


@dataclass(frozen=True)
class PPOConfig:
    """Stable-Baselines3 PPO at ten decisions per second."""

    decisions_per_update: int = 128
    """Decisions of each robot between updates."""
    batch_size: int = 2048
    """Decisions per minibatch."""
    epochs: int = 5
    """Passes over each rollout."""
    discount: float = 0.98
    """Per decision."""
    gae_lambda: float = 0.95
    """Of the generalized advantage estimate."""
    learning_rate: float = 1e-4
    """Without demonstrations."""
    learning_rate_after_cloning: float = 1e-5
    """With demonstrations or a warm start: an update may change the policy by so much in units of its exploration,
    which is small."""
    log_std_after_cloning: float = -4.0
    """Logarithm of the standard deviation of the action from then on: grasps that were cloned fail under the
    exploration that training from nothing needs."""
    clip_range: float = 0.15
    """Of the probability ratio."""
    target_kl: float = 0.02
    """Updates stop early beyond 1.5 times this."""
    entropy: float = 0.0
    """Weight of the entropy bonus."""
    warm_up_updates: int = 2
    """Updates of the critic alone, after cloning."""
    warm_up_learning_rate: float = 1e-3
    """Of the critic during these."""


@dataclass(frozen=True)
class PlannerTrainingConfig:
    """One training run."""

    task: str = "lift_box"
    """Name of a task: a folder under tasks/."""
    controller: Path | None = None
    """Folder of the frozen controller; pilot-g1-simple by default."""
    demonstrations: int = 400
    """Successful expert episodes to imitate first; 0 trains from nothing."""
    demonstration_file: Path | None = None
    """Use these recorded demonstrations instead of recording new ones."""
    warm_start: Path | None = None
    """Go on from the planner in this folder, of whatever controller, instead of imitating demonstrations."""
    demonstration_noise: float = 0.02
    """Standard deviation of the noise on the expert's executed actions."""
    total_decisions: int = 200_000
    """Planner decisions of PPO, over all robots."""
    num_envs: int = 64
    """Robots side by side."""
    num_threads: int = 2
    """Physics threads."""
    seed: int = 0
    """Of weights, episodes and exploration."""
    selection_episodes: int = 128
    """Fixed episodes that choose the best planner: by successes, then by time."""
    selection_interval: int = 50_000
    """Decisions between selections."""
    save_interval: float = 300.0
    """Time between saved training states [s]."""
    network: PlannerNetwork = field(default_factory=PlannerNetwork)
    cloning: CloningConfig = field(default_factory=CloningConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)

    @property
    def imitates(self) -> bool:
        """Whether demonstrations are cloned before PPO."""
        return self.warm_start is None and (self.demonstrations > 0 or self.demonstration_file is not None)

    @property
    def begins_skilled(self) -> bool:
        """Whether PPO begins with a policy that succeeds: it explores little then, its critic learns alone at first."""
        return self.imitates or self.warm_start is not None

    @property
    def decisions_per_update(self) -> int:
        """Decisions of all robots between updates."""
        return self.ppo.decisions_per_update * self.num_envs

    def require_valid(self) -> None:
        """Check the numbers that would fail late.

        Raises:
            PilotError: naming the first one that does not fit.
        """
        counts = {
            "num_threads": self.num_threads,
            "selection_episodes": self.selection_episodes,
            "cloning.epochs": self.cloning.epochs,
            "cloning.batch_size": self.cloning.batch_size,
            "ppo.decisions_per_update": self.ppo.decisions_per_update,
            "ppo.batch_size": self.ppo.batch_size,
        }
        for name, count in counts.items():
            if count < 1:
                raise PilotError(f"{name} is {count}, but it must be at least 1")
        if not 0 <= self.seed < 2**31:
            raise PilotError(f"seed is {self.seed}, but it must be between 0 and 2^31 - 1")
        if not 0.0 <= self.cloning.held_out < 1.0:
            raise PilotError(f"cloning.held_out is {self.cloning.held_out}, but it must be at least 0 and below 1")
        if not self.network.hidden or min(self.network.hidden) < 1:
            raise PilotError(f"network.hidden is {self.network.hidden}, but it must name widths of at least 1")
        if self.decisions_per_update % self.ppo.batch_size != 0:
            raise PilotError(
                f"the batch size {self.ppo.batch_size} must divide a rollout of {self.decisions_per_update} decisions "
                f"({self.num_envs} robots times {self.ppo.decisions_per_update})"
            )
