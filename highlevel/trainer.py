"""Training a planner: demonstrations, cloning, critic warm-up, PPO. Read :meth:`PlannerTrainer.train` first."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger

from highlevel.environment import CommandEnvironment, PhysicsConfig
from highlevel.episodes import run_episodes, stage_shares, success_rate
from highlevel.learning.cloning import clone
from highlevel.learning.config import PlannerTrainingConfig
from highlevel.learning.demonstrations import Demonstrations, Source, record
from highlevel.learning.policy import PlannerActor
from highlevel.learning.ppo import PlannerPPO
from highlevel.planner import Planner, PlannerConfig
from highlevel.registry import load_expert, load_task
from highlevel.vec_env import PlannerVecEnv
from lowlevel.control.controller import Controller, content_hash
from lowlevel.runs.interrupts import stop_on_signals
from lowlevel.runs.progress import ProgressReport
from lowlevel.runs.run_folder import RunFolder, describe_run
from robots.errors import PilotError

DEMONSTRATIONS_FILE = "demonstrations.npz"
"""Successful episodes of the scripted expert, in the folder of a run."""
CLONED_FOLDER, BEST_FOLDER = "cloned", "best"
"""The planner after cloning, and the one with the highest success rate on the selection episodes."""
SELECTION_SEED, DEMONSTRATION_SEED, TRAINING_SEED = 1_000_000, 2_000_000, 3_000_000
"""Seeds of the episodes for each purpose, far from each other and from those of evaluations, so none is met twice."""


class PlannerTrainer:
    """Trains a planner in ``folder``.

    Args:
        config: the run; its controller must be a folder.
        folder: where everything goes.

    Raises:
        PilotError: if the task is unknown, the controller cannot be used, or a number does not fit.
    """

    def __init__(self, config: PlannerTrainingConfig, folder: Path) -> None:
        if config.controller is None:
            raise PilotError("the run needs the folder of a controller")
        config.require_valid()
        self.config = config
        self.run = RunFolder(folder)
        self.controller = config.controller
        self.episode_seed = TRAINING_SEED + config.seed
        self.environment = self._build_environment(self.episode_seed)
        self.controller_hash = content_hash(config.controller)
        self.source = Source(
            config.task,
            self.environment.blocks,
            self.environment.task.action,
            config.ppo.discount,
            self.controller_hash,
        )
        """What this run's demonstrations are recorded with."""
        self.demonstrated_on = self.controller_hash
        """Identity of the controller that the demonstrations were recorded on."""
        self._selection_environment: CommandEnvironment | None = None
        self.vec_env = PlannerVecEnv(self.environment)
        self.scale = torch.cat([torch.full((block.size,), block.scale) for block in self.environment.blocks])
        self.model = PlannerPPO(config, self.vec_env, self.scale)
        # PPO has just seeded the episodes with the seed of its weights.
        self.vec_env.seed(self.episode_seed)
        self.phase = "demonstrations"
        self.best_rate, self.best_duration = -1.0, math.inf
        self.last_selection = -math.inf
        self.trained_seconds = 0.0
        self._stop_requested = False

    def _build_environment(self, seed: int) -> CommandEnvironment:
        # Every environment has a controller of its own, because a controller remembers its robots.
        return CommandEnvironment(
            load_task(self.config.task),
            Controller.load(self.controller),
            self.config.num_envs,
            seed,
            PhysicsConfig(num_threads=self.config.num_threads),
        )

    # -- the run ----------------------------------------------------------------------------------------------

    def train(self) -> None:
        """Go through the remaining phases; Ctrl-C and SIGTERM end the run with its work saved."""
        with stop_on_signals(self._request_stop):
            if self.phase == "demonstrations":
                self._begin()
            if self.phase == "ppo" and not self._stop_requested:
                self._improve()
            self.save()

    @property
    def is_finished(self) -> bool:
        """Whether all phases are over."""
        return self.phase == "ppo" and self.last_selection >= self.config.total_decisions

    def _request_stop(self) -> None:
        """End the run at the next safe point, with its work saved."""
        self._stop_requested = True

    def _begin(self) -> None:
        """Take the policy that PPO begins with from an earlier planner or from demonstrations, if from anything."""
        if self.config.warm_start is not None:
            self.earlier_planner(self.config.warm_start).actor.write_to(self.model.policy)
        elif self.config.imitates:
            self._imitate()
            if self._stop_requested:
                return
        if self.config.begins_skilled:
            self.model.set_exploration(self.config.ppo.log_std_after_cloning)
        # A run that was resumed before this has no seed pending, and recording has left its own.
        self.vec_env.seed(self.episode_seed)
        self.phase = "ppo"
        self.save()

    def earlier_planner(self, folder: Path) -> Planner:
        """The planner in ``folder``, if this run can go on from it.

        Raises:
            PilotError: if it cannot.
        """
        planner = Planner.load(folder)
        planner.require_environment(self.environment)
        if planner.config.hidden != self.config.network.hidden:
            wanted = " ".join(map(str, planner.config.hidden))
            raise PilotError(f"the planner in {folder} has other widths: add --network.hidden {wanted}")
        return planner

    def _imitate(self) -> None:
        """Record or read demonstrations and clone them."""
        demonstrations = self._demonstrations()
        if self._stop_requested:
            return
        config = self.config.cloning
        with _progress("cloning", config.epochs) as update:
            result = clone(
                self.model.policy,
                demonstrations,
                self.scale,
                config,
                self.config.seed,
                lambda epoch, error: update(epoch, f"action error {error:.3f}"),
            )
        self._log({f"cloning/{name}": value for name, value in asdict(result).items()})
        self.planner().save(self.run.path / CLONED_FOLDER)

    def _demonstrations(self) -> Demonstrations:
        """What to imitate; recording goes on where an interrupted run stopped."""
        config = self.config
        if config.demonstration_file is not None:
            loaded = Demonstrations.load(config.demonstration_file)
            loaded.source.require_like(self.source)
            self.demonstrated_on = loaded.source.controller
            return loaded
        path = self.run.path / DEMONSTRATIONS_FILE
        done = Demonstrations.load(path) if path.is_file() else None
        wanted = config.demonstrations - (done.count if done else 0)
        if done is not None and wanted <= 0:
            return done
        with _progress("demonstrations", config.demonstrations) as update:

            def report(successes: int, attempts: int) -> None:
                update(config.demonstrations - wanted + successes, f"{successes} of {attempts} succeeded")

            recorded = record(
                self.environment,
                load_expert(self.environment),
                wanted,
                DEMONSTRATION_SEED + config.seed + (done.attempts if done else 0),
                config.demonstration_noise,
                self.source,
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
        self.model.set_logger(Logger(None, [_RunLog(self.run)]))
        remaining = self.config.total_decisions - self.model.num_timesteps
        if remaining > 0:
            with _progress("PPO", self.config.total_decisions) as update:
                self.model.learn(
                    remaining,
                    callback=_TrainingCallback(self, update),
                    reset_num_timesteps=self.model.num_timesteps == 0,
                )
        if not self._stop_requested and not self.is_finished:
            self.select()

    # -- planners ---------------------------------------------------------------------------------------------

    def planner(self) -> Planner:
        """The current policy as a planner."""
        task = self.environment.task
        config = PlannerConfig(
            task=task.name,
            task_config=task.describe(),
            controller=self.controller_hash,
            observation=self.environment.blocks,
            action=task.action,
            hidden=self.config.network.hidden,
        )
        # A planner travels: of the files that made it, it keeps the names, not where they lay.
        recorded, earlier = self.config.demonstration_file, self.config.warm_start
        named = replace(
            self.config,
            controller=Path(self.controller.name),
            demonstration_file=None if recorded is None else Path(recorded.name),
            warm_start=None if earlier is None else Path(earlier.name),
        )
        details: dict[str, Any] = {"decisions": self.model.num_timesteps, "hours": self.trained_seconds / 3600.0}
        if self.config.imitates:
            details["demonstrated_on"] = self.demonstrated_on
        provenance = describe_run(named, **details)
        return Planner(config, PlannerActor.from_policy(self.model.policy, config.hidden), provenance)

    def select(self) -> float:
        """Measure the success rate on the fixed selection episodes, and keep the planner if it is the best.

        Among equals, the one whose episodes are over soonest is.
        """
        if self._selection_environment is None:
            self._selection_environment = self._build_environment(SELECTION_SEED)
        planner = self.planner()
        records = run_episodes(self._selection_environment, planner, self.config.selection_episodes, SELECTION_SEED)
        rate, duration = success_rate(records), sum(record.duration for record in records) / len(records)
        self.last_selection = self.model.num_timesteps
        if (rate, -duration) > (self.best_rate, -self.best_duration):
            self.best_rate, self.best_duration = rate, duration
            planner.provenance["selection"] = {"success_rate": rate, "episodes": len(records)}
            planner.save(self.run.path / BEST_FOLDER)
        figures = stage_shares(records, self.environment.task.stages)
        figures["success_rate"] = rate
        figures["fall_rate"] = sum(record.failure == "fall" for record in records) / len(records)
        figures["duration"] = duration
        self._log({f"selection/{name}": value for name, value in figures.items()})
        return rate

    def _log(self, figures: dict[str, float]) -> None:
        self.run.log(figures, self.trained_seconds, "decisions", self.model.num_timesteps)

    # -- saving -----------------------------------------------------------------------------------------------

    def save(self) -> None:
        """Write the training state into the folder.

        Raises:
            NonFiniteError: if the policy is not finite; the state of before stays.
        """
        state = self.model.state_dict() | {
            "controller": self.controller_hash,
            "demonstrated_on": self.demonstrated_on,
            "phase": self.phase,
            "episode": self.environment.episode,
            "best_rate": self.best_rate,
            "best_duration": self.best_duration,
            "last_selection": self.last_selection,
            "trained_seconds": self.trained_seconds,
        }
        self.run.save(state)

    def load(self) -> None:
        """Continue from the training state in the folder; running episodes begin anew.

        Raises:
            PilotError: if there is none.
            PilotError: if it is damaged, belongs to another configuration, or the controller has changed since.
        """
        state = self.run.load()
        try:
            self.model.load_state_dict(state)
            self.phase, self.trained_seconds = state["phase"], state["trained_seconds"]
            self.best_rate, self.best_duration = state["best_rate"], state["best_duration"]
            self.last_selection, self.demonstrated_on = state["last_selection"], state["demonstrated_on"]
            episode, controller = state["episode"], state["controller"]
        except (KeyError, RuntimeError, ValueError) as error:
            reason = str(error).splitlines()[-1].strip()
            raise PilotError(f"the training state in {self.run.path} does not fit this run: {reason}") from error
        if controller != self.controller_hash:
            raise PilotError(
                f"this run is for controller {controller}, but {self.controller} is {self.controller_hash} now: "
                "start a new run"
            )
        self.environment.reset(self.episode_seed)
        self.environment.episode = episode
        # The reset at the start of learning takes the episodes after these.
        self.vec_env._reset_seeds()
        self.run.drop_log_after("decisions", self.model.num_timesteps)


class _RunLog(KVWriter):
    """Hands what Stable-Baselines3 logs to TensorBoard by way of the run's folder."""

    def __init__(self, run: RunFolder) -> None:
        self._run = run

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        shown = {key: value for key, value in key_values.items() if "tensorboard" not in (key_excluded[key] or ())}
        self._run.plot({key: float(value) for key, value in shown.items() if isinstance(value, (int, float))}, step)

    def close(self) -> None:
        """The folder's writer stays open."""


class _TrainingCallback(BaseCallback):
    """Hooks into Stable-Baselines3's loop: stopping, selection, saving, progress."""

    def __init__(self, trainer: PlannerTrainer, update: Callable[[int, str], None]) -> None:
        super().__init__()
        self._trainer, self._update = trainer, update
        self._last_save = self._last_tick = time.monotonic()
        self._outcomes: list[bool] = []
        self._rollout_start = 0

    def _on_rollout_start(self) -> None:
        # Called after an update and before the next rollout: the policy is whole.
        trainer = self._trainer
        self._rollout_start = self.num_timesteps
        now = time.monotonic()
        trainer.trained_seconds += now - self._last_tick
        self._last_tick = now
        since_selection = self.num_timesteps - trainer.last_selection
        is_selecting = since_selection >= trainer.config.selection_interval and not trainer.model.is_warming_up
        if is_selecting:
            trainer.select()
        if is_selecting or now - self._last_save > trainer.config.save_interval:
            trainer.save()
            self._last_save = now

    def _on_step(self) -> bool:
        self._outcomes += [info["is_success"] for info in self.locals["infos"] if "is_success" in info]
        if self._trainer._stop_requested:
            # Nothing is learned from half a rollout, so that it does not count.
            self.model.num_timesteps = self._rollout_start
            return False
        return True

    def _on_rollout_end(self) -> None:
        self._outcomes = self._outcomes[-200:]
        recent = sum(self._outcomes) / max(len(self._outcomes), 1)
        self.logger.record("rollout/recent_success_rate", recent)
        best = f"best {self._trainer.best_rate:.0%}" if self._trainer.best_rate >= 0 else "warming up"
        self._update(self.num_timesteps, f"success {recent:.0%} ({best})")


@contextmanager
def _progress(name: str, total: int) -> Iterator[Callable[[int, str], None]]:
    with ProgressReport() as progress:
        task = progress.add_task(name, total=total)
        yield lambda completed, text: progress.update(task, completed=completed, description=f"{name}: {text}")
