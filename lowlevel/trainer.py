"""The training loop: collect, learn, move the curriculum, log, save. One :class:`Trainer` is one run."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from torch import Tensor

from lowlevel.commands import KINDS, shares
from lowlevel.control.elevation_map import MAP_SIZE
from lowlevel.control.observation import (
    FRAME,
    FRAME_SIZE,
    HISTORY_LENGTH,
    columns,
    normalized_columns,
)
from lowlevel.control.velocity_correction import VelocityCorrection
from lowlevel.curriculum import Curriculum, CurriculumConfig
from lowlevel.environment import EnvironmentConfig, PilotEnvironment, StepResult
from lowlevel.imitation.calibration import CalibrationConfig, calibrate, correct
from lowlevel.imitation.cloning import CloningConfig, PriorTeacher, clone
from lowlevel.learning.ppo import PPO, PPOConfig
from lowlevel.networks.actor import NetworkConfig, ObservationSizes
from lowlevel.networks.sight import give_sight
from lowlevel.runs.distributed import any_rank, average_over_ranks, rank, world_size
from lowlevel.runs.draws import require_seed
from lowlevel.runs.interrupts import stop_on_signals
from lowlevel.runs.precision import coarse_products
from lowlevel.runs.progress import ProgressReport
from lowlevel.runs.run_folder import RunFolder
from lowlevel.stages import Stage
from lowlevel.world.measures import TRACKING_FIGURES
from lowlevel.world.privileged import MIRRORS, PRIVILEGED, PRIVILEGED_SIZE
from lowlevel.world.randomization import between
from lowlevel.world.terrain import tile_shares
from robots.errors import PilotError
from robots.g1.constants import LOWER_JOINTS, NUM_JOINTS


@dataclass(frozen=True)
class TrainingConfig:
    """A training run: task, stages, networks, learner and curriculum."""

    total_steps: int = 250_000_000
    """Environment steps (robots times control steps) of PPO, over all ranks; calibrating and cloning take some more."""
    seed: int = 0
    """Seed of weights, noise, commands and randomization."""
    device: str = "cpu"
    """Where the learner runs; physics always runs on the CPU."""
    save_interval: float = 300.0
    """Time between saved training states [s]."""
    environment: EnvironmentConfig = field(default_factory=EnvironmentConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    curriculum: CurriculumConfig = field(default_factory=CurriculumConfig)
    cloning: CloningConfig = field(default_factory=CloningConfig)
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    stages: Annotated[tuple[Stage, ...], tyro.conf.Suppress] = (Stage(),)
    """Run one after the other."""


def observation_sizes() -> ObservationSizes:
    """Sizes of the environment's observations, as the networks need them."""
    return ObservationSizes(
        frame=FRAME_SIZE,
        history_length=HISTORY_LENGTH,
        elevation_map=MAP_SIZE,
        privileged=PRIVILEGED_SIZE,
        action=NUM_JOINTS,
    )


class Averages:
    """Running sums of scalars over one iteration."""

    def __init__(self) -> None:
        self._sums: dict[str, Tensor] = {}
        self._count = 0

    def add(self, values: dict[str, Tensor]) -> None:
        """Add the means of per-robot ``values``."""
        self._count += 1
        for name, value in values.items():
            self._sums[name] = self._sums.get(name, torch.zeros(())) + value.float().mean().cpu()

    def take(self) -> dict[str, float]:
        """Means since the last call, averaged over ranks."""
        names = sorted(self._sums)
        means = torch.stack([self._sums[name] for name in names]) / max(self._count, 1)
        average_over_ranks([means])
        self._sums, self._count = {}, 0
        return dict(zip(names, means.tolist(), strict=True))


class Trainer:
    """Trains one controller in ``folder``; everything needed to continue is in its ``training_state.pt``."""

    def __init__(self, config: TrainingConfig, folder: Path) -> None:
        require_seed(config.seed)
        self.config = config
        self.run = RunFolder(folder)
        self.curriculum = Curriculum(config.curriculum)
        self.ppo = PPO(
            config=config.ppo,
            network_config=config.network,
            sizes=observation_sizes(),
            mirrors=MIRRORS,
            num_envs=config.environment.num_robots,
            device=config.device,
            command_columns=~normalized_columns(FRAME),
            privileged_command_columns=~normalized_columns(PRIVILEGED),
            gait_clock=columns(FRAME, "gait_clock"),
            tasks=len(KINDS),
            seed=config.seed,
        )
        self.steps = 0
        self.trained_seconds = 0.0
        self.observation: dict[str, Tensor] = {}
        self._correction: VelocityCorrection | None = None
        self._stop_requested = False
        self._begin_stage(0)

    # -- stages -----------------------------------------------------------------------------------------------

    def _begin_stage(self, number: int) -> None:
        """Set up the task and the learner as stage ``number`` has them; the robots start anew."""
        self.stage_number = number
        self.stage_begin = self.steps
        self.waited_for = 0.0
        stage = self.stage
        seed = self.config.seed + 7919 * rank() + 104729 * number
        self.environment = PilotEnvironment(self.config.environment, stage, seed, correction=self._correction)
        self._correction = self.environment.correction
        self._shares, self._tile_shares = shares(stage.mixture), tile_shares(stage.terrain)
        self.ppo.enter(
            stage.std,
            acting=NUM_JOINTS if stage.arms_act else LOWER_JOINTS.stop,
            rollout_doublings=stage.rollout_doublings,
            gait_noise_share=stage.gait_noise,
            normalizes_by_task=stage.normalizes_by_kind,
            noise_at_rest=stage.noise_at_rest,
            advantage_limit=stage.advantage_limit,
        )
        self._apply_curriculum()
        self.observation = {}

    @property
    def stage(self) -> Stage:
        """The stage that runs."""
        return self.config.stages[self.stage_number]

    def _apply_curriculum(self) -> None:
        self.environment.opening = self.curriculum.opening
        self.environment.kind_probability = self.curriculum.kind_chances(self._shares)
        self.environment.tile_probability = self.curriculum.tile_chances(self._tile_shares)
        easy, hard = self.stage.randomization, self.stage.harder
        if hard is not None:
            self.environment.randomizer.config = between(easy, hard, float(self.curriculum.hardness))

    def _stage_is_over(self, figures: dict[str, float]) -> bool:
        """Whether the figure that this stage waits for is reached, or its steps are used up; never of the last stage.

        ``figures`` of the last update enter the average that is waited for.
        """
        stage = self.stage
        if stage.waits_for:
            self.waited_for += 0.1 * (figures[stage.waits_for] - self.waited_for)
        if self.stage_number + 1 == len(self.config.stages):
            return False
        taken = self.steps - self.stage_begin
        reached = bool(stage.waits_for) and self.waited_for > stage.above and taken >= stage.least_steps
        return reached or taken >= stage.most_steps

    def _enter_next_stage(self, report: Callable[[str], None]) -> None:
        """Begin the next stage, and ``report`` how far what is to be cloned or calibrated first has come."""
        self.save()
        prior, upcoming = self.environment.prior, self.config.stages[self.stage_number + 1]
        self.curriculum.introduce((shares(upcoming.mixture) > 0.0) & (self._shares == 0.0))
        if upcoming.harder is not None:
            self.curriculum.hardness = torch.zeros(())  # what is calibrated in hard conditions is their noise
        self._begin_stage(self.stage_number + 1)
        if prior is not None and upcoming.prior is None:
            report("absorbing the gait prior")
            teacher = PriorTeacher(self.ppo, self.environment, prior)
            self.observation = clone(self.ppo, self.environment, teacher, self.config.cloning, report)
        if upcoming.calibrates:
            self.observation = calibrate(
                self.ppo, self.environment, self.config.calibration, self.config.cloning, report
            )
        if not self.observation:
            self.observation = self.environment.reset(spread_episodes=True)
        self.save()

    # -- the loop ---------------------------------------------------------------------------------------------

    def train(self) -> None:
        """Run until ``total_steps``, a signal, or an error; the training state is saved in every case but the last.

        At ``total_steps`` a policy that was ever calibrated is told velocities that suit what it is then.
        """
        if not self.observation:
            self.observation = self.environment.reset(spread_episodes=True)
        last_save, trained = time.monotonic(), self.steps < self.config.total_steps
        progress = ProgressReport(hidden=rank() != 0)
        task = progress.add_task("starting", total=self.config.total_steps, completed=self.steps)
        if rank() == 0:
            self.run.drop_log_after("steps", self.steps)
        with stop_on_signals(self._request_stop), progress:
            # A rank that stopped alone would leave the others waiting for it in their next all-reduce.
            while self.steps < self.config.total_steps and not any_rank(self._stop_requested):
                started = time.monotonic()
                figures = self.iterate()
                seconds = time.monotonic() - started
                self.trained_seconds += seconds
                figures["speed/steps_per_second"] = self._steps_per_iteration / seconds
                if rank() == 0:
                    self.run.log(figures, self.trained_seconds, "steps", self.steps)
                started = time.monotonic()
                if self._stage_is_over(figures):
                    self._enter_next_stage(progress.say)
                self.trained_seconds += time.monotonic() - started
                progress.update(task, completed=self.steps, description=self._headline(figures))
                if time.monotonic() - last_save > self.config.save_interval:
                    self.save()
                    last_save = time.monotonic()
            if trained and self.steps >= self.config.total_steps:
                self._correct_once_more(progress.say)
            self.save()

    def _correct_once_more(self, report: Callable[[str], None]) -> None:
        """Correct what has changed since the last calibration, if there has been one."""
        if any(stage.calibrates for stage in self.config.stages[: self.stage_number + 1]):
            started = time.monotonic()
            correct(self.ppo, self.environment, self.config.calibration, report)
            self.trained_seconds += time.monotonic() - started

    @property
    def _steps_per_iteration(self) -> int:
        return self.ppo.storage.size * world_size()

    def iterate(self) -> dict[str, float]:
        """One rollout and one update; returns figures to log."""
        terms, tracking = Averages(), Averages()
        started = time.monotonic()
        for _ in range(self.ppo.storage.steps):
            with coarse_products():
                action, capture_point = self.ppo.act(self.observation)
            result = self.environment.step(action.cpu(), capture_point.cpu())
            # New commands and pushes change what the future is worth, and no action is to blame for it.
            interrupted = result.truncated | result.surprised
            self.ppo.record(result.reward, result.terminated, interrupted, result.next_privileged, result.kind)
            self.observation = result.observation
            self.curriculum.observe(result.kind, result.tile_kind, result.quality, result.terminated)
            terms.add(result.terms | {"total": result.reward / self.environment.control_period})
            tracking.add(_tracking(result))
        collection_seconds = time.monotonic() - started
        with coarse_products():  # as when it acted, or the first ratios of probabilities would not be 1
            losses = self.ppo.update(self.observation)
        self.steps += self._steps_per_iteration

        mean_terms = terms.take()
        self.curriculum.update(hardens=self.stage.harder is not None)
        self._apply_curriculum()
        figures = {f"reward/{name}": value for name, value in mean_terms.items()}
        figures |= {f"tracking/{name}": value for name, value in tracking.take().items()}
        curriculum = self.curriculum.figures(self._shares, self._tile_shares) | self.environment.levels.figures()
        figures |= {f"curriculum/{name}": value for name, value in curriculum.items()}
        figures["curriculum/stage"] = float(self.stage_number)
        figures |= {f"learner/{name}": value for name, value in losses.items()}
        figures["speed/collection_seconds"] = collection_seconds
        return figures

    # -- saving -----------------------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """The whole run: learner, environment, curriculum and counters."""
        return {
            "ppo": self.ppo.state_dict(),
            "environment": self.environment.state_dict(),
            "curriculum": self.curriculum.state_dict(),
            "observation": self.observation,
            "steps": self.steps,
            "trained_seconds": self.trained_seconds,
            "action_scale": self.environment.action_scale.cpu(),
            "correction": self.environment.correction.state_dict(),
            "stage": self.stage_number,
            "stage_begin": self.stage_begin,
            "waited_for": self.waited_for,
        }

    def save(self) -> None:
        """Write the training state; a crash while writing leaves the previous one intact."""
        if rank() == 0:
            self.run.save(self.state_dict())

    def load(self, with_environment: bool = True) -> None:
        """Continue from the training state in the folder; where it has no environment the robots start anew.

        The state is rank 0's: the robots of other ranks always start anew.

        Raises:
            PilotError: if there is none, it is damaged, or it belongs to another configuration.
        """
        state = self.run.load()
        missing = self.state_dict().keys() - state.keys() - {"environment", "observation"}
        if missing:
            raise PilotError(f"the state in {self.run.path} is of another version: it has no {min(missing)!r}")
        if not torch.equal(state["action_scale"], self.environment.action_scale.cpu()):
            raise PilotError(f"{self.run.path} was trained with other action scales than those of these gains")
        try:
            self.ppo.load_state_dict(state["ppo"])
        except (KeyError, RuntimeError, ValueError) as error:
            # torch lists every difference in a line of its own, below a heading
            lines = [line.strip() for line in str(error).splitlines()]
            details = [line for line in lines if not line.endswith(":")] or lines
            raise PilotError(f"the training state belongs to other networks: {' '.join(details)}") from error
        try:
            self.curriculum.load_state_dict(state["curriculum"])
        except KeyError as error:
            raise PilotError(
                f"the state in {self.run.path} is of another version: its curriculum has no {error}"
            ) from error
        self.environment.correction.load_state_dict(state["correction"])
        self.steps, self.trained_seconds = int(state["steps"]), float(state["trained_seconds"])
        self._begin_stage(int(state["stage"]))
        self.stage_begin, self.waited_for = int(state["stage_begin"]), float(state["waited_for"])
        if with_environment and rank() == 0 and "environment" in state:
            self.environment.load_state_dict(state["environment"])
            self.observation = state["observation"]

    def begin_seeing(self, blind: RunFolder) -> None:
        """Begin with the networks of a ``blind`` run, whose policy this one repeats until it makes use of the map.

        Raises:
            PilotError: if that run cannot be read, or this one's networks are not those with sight.
        """
        if not self.config.network.vision:
            raise PilotError("networks that do not see cannot begin with those of a blind run: choose --preset vision")
        state = blind.load()
        if not torch.equal(state["action_scale"], self.environment.action_scale.cpu()):
            raise PilotError(f"{blind.path} was trained with other action scales than those of these gains")
        if "correction" not in state:
            raise PilotError(f"the state in {blind.path} is of another version: it has no 'correction'")
        self.environment.correction.load_state_dict(state["correction"])
        for name, network in self.ppo.learner.modules.items():
            give_sight(network, state["ppo"][name])
        self.ppo.learner.limit_noise()

    # -- progress ---------------------------------------------------------------------------------------------

    def _headline(self, figures: dict[str, float]) -> str:
        stage = self.stage
        waits = f" until {stage.waits_for} {self.waited_for:.2f} > {stage.above:g}" if stage.waits_for else ""
        return (
            f"{stage.name}{waits}  falls every {figures['curriculum/steps_between_falls']:.0f} steps"
            f"  E_v {figures['tracking/E_v']:.2f}  {figures['speed/steps_per_second']:.0f} steps/s"
        )

    def _request_stop(self) -> None:
        """End the run at the next safe point, with its work saved."""
        self._stop_requested = True


def _tracking(result: StepResult) -> dict[str, Tensor]:
    return {name: function(result.measured, result.command) for name, (_, function) in TRACKING_FIGURES.items()}
