"""Training a planner: demonstrations, cloning, critic warm-up, PPO. One :class:`PlannerTrainer` is one run
folder.

===========================  ====================================================================
``run.json``                 configuration, versions, revision
``demonstrations.npz``       successful episodes of the scripted expert
``cloned/``                  planner after behaviour cloning
``best/``                    planner with the highest success rate on the selection episodes
``training_state.pt``        everything needed to continue
``log.jsonl``, ``tensorboard/``  figures
===========================  ====================================================================
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from torch.utils.tensorboard import SummaryWriter

from highlevel.cloning import CloningConfig, clone
from highlevel.demonstrations import Demonstrations, record
from highlevel.environment import CommandEnvironment, PhysicsConfig
from highlevel.episodes import run_episodes, success_rate
from highlevel.planner import Planner, PlannerConfig
from highlevel.policy import PlannerActor, PlannerNetwork, actor_parameters, policy_arguments
from highlevel.task import load_task
from highlevel.vec_env import PlannerVecEnv
from lowlevel.controller import Controller, content_hash
from lowlevel.files import atomic_write
from lowlevel.interrupts import stop_on_signals
from lowlevel.plain import from_plain
from lowlevel.provenance import git_revision

STATE_FILE, RUN_FILE, LOG_FILE, DEMONSTRATIONS_FILE = (
    "training_state.pt",
    "run.json",
    "log.jsonl",
    "demonstrations.npz",
)
CLONED_FOLDER, BEST_FOLDER = "cloned", "best"
SELECTION_SEED, DEMONSTRATION_SEED = 1_000_000, 2_000_000
"""Seeds far from those of training and evaluation, so that no episode is met twice."""


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
    """Of the generalised advantage estimate."""
    learning_rate: float = 1e-4
    """Without demonstrations."""
    learning_rate_after_cloning: float = 3e-5
    """With demonstrations."""
    clip_range: float = 0.15
    """Of the probability ratio."""
    target_kl: float = 0.02
    """Updates stop early beyond 1.5 times this."""
    entropy: float = 0.0
    """Weight of the entropy bonus."""
    warm_up_updates: int = 6
    """Updates of the critic alone, after cloning."""
    warm_up_learning_rate: float = 1e-3
    """Of the critic during these."""


@dataclass(frozen=True)
class PlannerTrainingConfig:
    """One training run."""

    task: str = "lift_box"
    """Name of a task: a folder under tasks/."""
    controller: Path | None = None
    """Folder of the frozen controller; the only shipped one by default."""
    demonstrations: int = 500
    """Successful expert episodes to imitate first; 0 trains from nothing."""
    demonstration_file: Path | None = None
    """Use these recorded demonstrations instead of recording new ones."""
    demonstration_noise: float = 0.02
    """Standard deviation of the noise on the expert's executed actions."""
    total_decisions: int = 3_000_000
    """Planner decisions of PPO, over all robots."""
    num_envs: int = 64
    """Robots side by side."""
    num_threads: int = 2
    """Physics threads."""
    seed: int = 0
    """Of weights, episodes and exploration."""
    selection_episodes: int = 128
    """Fixed episodes that choose the best planner."""
    selection_interval: int = 100_000
    """Decisions between selections."""
    save_interval: float = 300.0
    """Time between saved training states [s]."""
    network: PlannerNetwork = field(default_factory=PlannerNetwork)
    cloning: CloningConfig = field(default_factory=CloningConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)


class PlannerTrainer:
    """Trains a planner in ``folder``.

    Args:
        config: the run; its controller must be a folder.
        folder: where everything goes.

    Raises:
        ValueError: if the task is unknown, the controller cannot be used, or the batch size does not fit.
    """

    def __init__(self, config: PlannerTrainingConfig, folder: Path) -> None:
        if config.controller is None:
            raise ValueError("the run needs the folder of a controller")
        rollout = config.ppo.decisions_per_update * config.num_envs
        if rollout % config.ppo.batch_size != 0:
            raise ValueError(
                f"the batch size {config.ppo.batch_size} must divide a rollout of {rollout} decisions "
                f"({config.num_envs} robots times {config.ppo.decisions_per_update})"
            )
        self.config = config
        self.folder = folder
        self._controller_hash = content_hash(config.controller)
        self.environment = self._build_environment(config.seed)
        self.vec_env = PlannerVecEnv(self.environment)
        blocks = self.environment.blocks
        self.scale = torch.cat([torch.full((block.size,), block.scale) for block in blocks])
        torch.manual_seed(config.seed)
        self.model = PPO(
            "MlpPolicy",
            self.vec_env,
            n_steps=config.ppo.decisions_per_update,
            batch_size=config.ppo.batch_size,
            n_epochs=config.ppo.epochs,
            gamma=config.ppo.discount,
            gae_lambda=config.ppo.gae_lambda,
            learning_rate=lambda remaining: self._learning_rate(),
            clip_range=config.ppo.clip_range,
            target_kl=config.ppo.target_kl,
            ent_coef=config.ppo.entropy,
            policy_kwargs=policy_arguments(config.network, self.scale),
            seed=config.seed,
            device="cpu",
        )
        self.vec_env.seed(config.seed)
        self.phase = "demonstrations"
        self.best_rate = -1.0
        self.best_decisions = 0
        self.last_selection = -math.inf
        self.trained_seconds = 0.0
        self._stop_requested = False

    def _build_environment(self, seed: int) -> CommandEnvironment:
        assert self.config.controller is not None
        # Every environment has a controller of its own, because a controller remembers its robots.
        return CommandEnvironment(
            load_task(self.config.task),
            Controller.load(self.config.controller),
            self.config.num_envs,
            seed,
            PhysicsConfig(num_threads=self.config.num_threads),
        )

    # -- the run ---------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Go through the remaining phases; Ctrl-C and SIGTERM end the run with its work saved."""
        with stop_on_signals(self._request_stop):
            if self.phase == "demonstrations":
                self._imitate()
            if self.phase == "ppo" and not self._stop_requested:
                self._improve()
        self.save()

    def _imitate(self) -> None:
        """Record or read demonstrations and clone them."""
        config = self.config
        if config.demonstrations > 0 or config.demonstration_file is not None:
            demonstrations = self._demonstrations()
            if self._stop_requested:
                return
            with _progress("cloning", config.cloning.epochs) as update:
                result = clone(
                    self.model.policy,
                    demonstrations,
                    self.scale,
                    config.cloning,
                    config.seed,
                    lambda epoch, error: update(epoch, f"action error {error:.3f}"),
                )
            self._log({f"cloning/{name}": value for name, value in asdict(result).items()})
            self.planner().save(self.folder / CLONED_FOLDER)
        self.phase = "ppo"
        self.save()

    def _demonstrations(self) -> Demonstrations:
        """What to imitate; recording goes on where an interrupted run stopped."""
        config = self.config
        if config.demonstration_file is not None:
            return Demonstrations.load(config.demonstration_file)
        path = self.folder / DEMONSTRATIONS_FILE
        done = Demonstrations.load(path) if path.is_file() else None
        wanted = config.demonstrations - (done.count if done else 0)
        if done is not None and wanted <= 0:
            return done
        expert = self.environment.task.expert(self.environment)
        with _progress("demonstrations", config.demonstrations) as update:

            def report(successes: int, attempts: int) -> None:
                update(config.demonstrations - wanted + successes, f"{successes} of {attempts} succeeded")

            recorded = record(
                self.environment,
                expert,
                wanted,
                DEMONSTRATION_SEED + config.seed + (done.attempts if done else 0),
                config.demonstration_noise,
                config.ppo.discount,
                report,
                lambda: self._stop_requested,
            )
        if done is not None:
            recorded = done.joined(recorded)
        recorded.save(path)
        self._log({"demonstrations/count": recorded.count, "demonstrations/attempts": recorded.attempts})
        return recorded

    def _improve(self) -> None:
        """PPO, from the cloned policy or from nothing."""
        self._freeze_actor(self._is_warming_up())
        self.model.set_logger(configure(str(self.folder / "tensorboard"), ["tensorboard"]))
        remaining = self.config.total_decisions - self.model.num_timesteps
        if remaining <= 0:
            return
        with _progress("PPO", self.config.total_decisions) as update:
            self.model.learn(
                remaining,
                callback=_TrainingCallback(self, update),
                reset_num_timesteps=self.model.num_timesteps == 0,
            )
        if not self._stop_requested:
            self.select()

    # -- learning rate and warm-up ---------------------------------------------------------------------------

    @property
    def _was_cloned(self) -> bool:
        return self.config.demonstrations > 0 or self.config.demonstration_file is not None

    def _is_warming_up(self) -> bool:
        per_update = self.config.ppo.decisions_per_update * self.config.num_envs
        updates = self.model.num_timesteps // per_update
        return self._was_cloned and updates < self.config.ppo.warm_up_updates

    def _learning_rate(self) -> float:
        ppo = self.config.ppo
        if not hasattr(self, "model") or not self._was_cloned:
            return ppo.learning_rate
        return ppo.warm_up_learning_rate if self._is_warming_up() else ppo.learning_rate_after_cloning

    def _freeze_actor(self, frozen: bool) -> None:
        for parameter in actor_parameters(self.model.policy):
            parameter.requires_grad_(not frozen)

    # -- planners --------------------------------------------------------------------------------------------

    def planner(self) -> Planner:
        """The current policy as a planner."""
        task = self.environment.task
        config = PlannerConfig(
            task=task.name,
            task_config=task.describe(),
            controller=self._controller_hash,
            observation=self.environment.blocks,
            action=task.action,
            hidden=self.config.network.hidden,
        )
        provenance = {
            "training": _plain(self.config),
            "decisions": self.model.num_timesteps,
            "hours": self.trained_seconds / 3600.0,
            "revision": git_revision(),
        }
        return Planner(config, PlannerActor.from_policy(self.model.policy, config.hidden), provenance)

    def select(self) -> float:
        """Measure the success rate on the fixed selection episodes, and keep the planner if it is the
        best."""
        if not hasattr(self, "_selection_environment"):
            self._selection_environment = self._build_environment(SELECTION_SEED)
        planner = self.planner()
        records = run_episodes(self._selection_environment, planner, self.config.selection_episodes, SELECTION_SEED)
        rate = success_rate(records)
        self.last_selection = self.model.num_timesteps
        if rate > self.best_rate:
            self.best_rate, self.best_decisions = rate, self.model.num_timesteps
            planner.provenance["selection"] = {"success_rate": rate, "episodes": len(records)}
            planner.save(self.folder / BEST_FOLDER)
        stages = [sum(record.stage > i for record in records) for i in range(len(self.environment.task.stages))]
        figures = {
            f"selection/{name}": passed / len(records)
            for name, passed in zip(self.environment.task.stages, stages, strict=True)
        }
        figures["selection/success_rate"] = rate
        figures["selection/fall_rate"] = sum(record.failure == "fall" for record in records) / len(records)
        figures["selection/duration"] = sum(record.duration for record in records) / len(records)
        self._log(figures)
        return rate

    # -- saving ----------------------------------------------------------------------------------------------

    def save(self) -> None:
        """Write the training state; a crash while writing leaves the previous one intact."""
        state = {
            "phase": self.phase,
            "policy": self.model.policy.state_dict(),
            "optimizer": self.model.policy.optimizer.state_dict(),
            "decisions": self.model.num_timesteps,
            "updates": self.model._n_updates,
            "episode": self.environment.episode,
            "best_rate": self.best_rate,
            "best_decisions": self.best_decisions,
            "last_selection": self.last_selection,
            "trained_seconds": self.trained_seconds,
            "generator": torch.get_rng_state(),
        }
        atomic_write(self.folder / STATE_FILE, lambda file: torch.save(state, file))

    def load(self) -> None:
        """Continue from the training state in the folder; running episodes begin anew.

        Raises:
            FileNotFoundError: if there is none.
            ValueError: if it is damaged or belongs to another configuration.
        """
        path = self.folder / STATE_FILE
        if not path.is_file():
            raise FileNotFoundError(f"{self.folder} holds no {STATE_FILE}: give the folder of a training run")
        try:
            state = torch.load(path, map_location="cpu", weights_only=True)
            self.model.policy.load_state_dict(state["policy"])
            self.model.policy.optimizer.load_state_dict(state["optimizer"])
        except (RuntimeError, EOFError, OSError, ValueError, KeyError) as error:
            reason = str(error).splitlines()[0]
            raise ValueError(f"{path} is not a training state of this configuration: {reason}") from error
        self.phase = state["phase"]
        self.model.num_timesteps, self.model._n_updates = state["decisions"], state["updates"]
        self.best_rate, self.best_decisions = state["best_rate"], state["best_decisions"]
        self.last_selection, self.trained_seconds = state["last_selection"], state["trained_seconds"]
        torch.set_rng_state(state["generator"])
        self.environment.reset(self.config.seed)
        self.environment.episode = state["episode"]
        # The reset at the start of learning takes the episodes after these.
        self.vec_env._reset_seeds()
        _drop_entries_after(self.folder / LOG_FILE, state["decisions"])

    def _log(self, figures: dict[str, float]) -> None:
        decisions = self.model.num_timesteps
        figures = {name: value for name, value in figures.items() if math.isfinite(value)}
        writer = SummaryWriter(str(self.folder / "tensorboard"))
        for name, value in figures.items():
            writer.add_scalar(name, value, decisions)
        writer.close()
        entry = {"decisions": decisions, "seconds": round(self.trained_seconds, 1), **figures}
        with (self.folder / LOG_FILE).open("a") as file:
            file.write(json.dumps({name: float(f"{value:.6g}") for name, value in entry.items()}) + "\n")

    def _request_stop(self) -> None:
        """End the run at the next safe point, with its work saved."""
        self._stop_requested = True


class _TrainingCallback(BaseCallback):
    """Hooks into Stable-Baselines3's loop: stopping, warm-up, selection, saving, progress."""

    def __init__(self, trainer: PlannerTrainer, update: Callable[[int, str], None]) -> None:
        super().__init__()
        self._trainer, self._update = trainer, update
        self._last_save = self._last_tick = time.monotonic()
        self._outcomes: list[bool] = []

    def _on_rollout_start(self) -> None:
        # Called after an update and before the next rollout: the policy is whole.
        trainer = self._trainer
        now = time.monotonic()
        trainer.trained_seconds += now - self._last_tick
        self._last_tick = now
        if not trainer._is_warming_up():
            trainer._freeze_actor(False)
            if trainer.model.num_timesteps - trainer.last_selection >= trainer.config.selection_interval:
                trainer.select()
        if now - self._last_save > trainer.config.save_interval:
            trainer.save()
            self._last_save = now

    def _on_step(self) -> bool:
        self._outcomes += [info["is_success"] for info in self.locals["infos"] if "is_success" in info]
        return not self._trainer._stop_requested

    def _on_rollout_end(self) -> None:
        self._outcomes = self._outcomes[-200:]
        recent = sum(self._outcomes) / max(len(self._outcomes), 1)
        self.logger.record("rollout/recent_success_rate", recent)
        best = f"best {self._trainer.best_rate:.0%}" if self._trainer.best_rate >= 0 else "warming up"
        self._update(self.num_timesteps, f"success {recent:.0%} ({best})")


@contextmanager
def _progress(name: str, total: int) -> Iterator[Callable[[int, str], None]]:
    columns = (
        TextColumn(name),
        BarColumn(),
        TextColumn("{task.percentage:>5.1f}%"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.description}"),
    )
    with Progress(*columns) as progress:
        task = progress.add_task("starting", total=total)
        yield lambda completed, text: progress.update(task, completed=completed, description=text)


def write_run_description(folder: Path, config: PlannerTrainingConfig) -> None:
    """Write ``run.json``."""
    text = json.dumps({"config": _plain(config), "revision": git_revision()}, indent=2)
    atomic_write(folder / RUN_FILE, lambda file: file.write(text.encode()))


def read_run_description(folder: Path) -> PlannerTrainingConfig:
    """The configuration of an existing run.

    Raises:
        FileNotFoundError: if the folder holds no run.
        ValueError: if the description is damaged or was written by another version.
    """
    path = folder / RUN_FILE
    if not path.is_file():
        raise FileNotFoundError(f"{folder} holds no {RUN_FILE}: give the folder of a training run")
    try:
        plain = json.loads(path.read_text())["config"]
        for name in ("controller", "demonstration_file"):
            plain[name] = None if plain[name] is None else Path(plain[name])
        return from_plain(PlannerTrainingConfig, plain)
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise ValueError(f"{path} does not describe a run of this version: {error}") from error


def _plain(config: PlannerTrainingConfig) -> dict[str, Any]:
    return {name: str(value) if isinstance(value, Path) else value for name, value in asdict(config).items()}


def _drop_entries_after(path: Path, decisions: int) -> None:
    """Remove log lines that a killed run wrote after its last save."""
    if not path.exists():
        return
    lines = [line for line in path.read_text().splitlines() if line.endswith("}")]
    kept = [line for line in lines if json.loads(line)["decisions"] <= decisions]
    atomic_write(path, lambda file: file.write("".join(f"{line}\n" for line in kept).encode()))
