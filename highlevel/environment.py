"""N robots under one frozen controller, driven by whole-body commands. Read :meth:`CommandEnvironment.step`
first.

One decision of the planner (10 Hz) is an option of five control steps (50 Hz), each of ten physics steps (500
Hz): the command is interpolated, the controller acts on fresh measurements at every control step, rewards add
up, and an episode may end inside the option.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import torch
import tyro
from torch import Tensor

from highlevel.action import ActionMap, interpolate
from highlevel.task import Decision, ObservationBlock, Task, rows
from lowlevel.commands import COMMAND_SIZE
from lowlevel.control.controller import Controller
from lowlevel.runs.checks import require_finite
from lowlevel.runs.draws import uniform
from lowlevel.runs.precision import single_precision
from lowlevel.world.measures import Measurement
from lowlevel.world.randomization import RandomizationConfig, Randomizer
from lowlevel.world.terrain import TerrainConfig
from lowlevel.world.world import World
from robots.errors import PilotError
from robots.g1.constants import DEFAULT_POSITION, NUM_JOINTS
from robots.g1.model import ModelOptions

ROBOT_BLOCKS = (
    ObservationBlock("base_angular_velocity", 3, 1.0),
    ObservationBlock("projected_gravity", 3, 1.0),
    ObservationBlock("joint_position", NUM_JOINTS, 0.5),
    ObservationBlock("joint_velocity", NUM_JOINTS, 5.0),
    ObservationBlock("previous_command", COMMAND_SIZE, 1.0),
)
"""The robot's part of the paper's planner observation: joint positions relative to the default pose, and the
limited command in units of the action."""

_ROBOT_STREAM = 2**20
"""Of the random numbers of an episode; tasks count theirs from zero."""


ControlObserver = Callable[[Measurement, Decision], None]
"""Called after every control step, once the task has judged it, with what was measured and the decision it is part of.
"""


@dataclass(frozen=True)
class PhysicsConfig:
    """How finely the scene is simulated; contact between palms and objects needs more than walking does."""

    timestep: float = 0.002
    """Physics step [s]."""
    solver_iterations: int = 12
    """Newton iterations per step."""
    line_search_iterations: int = 20
    """Of the line search in each of them."""
    impratio: float = 10.0
    """How much stiffer friction is than contact."""
    num_threads: int = 2
    """Physics threads."""
    mjcf: Annotated[Path | None, tyro.conf.Suppress] = None
    """Somebody else's MJCF of the robot, for evaluation."""


@dataclass(frozen=True)
class StepResult:
    """What one decision brought; tensors have one row per robot."""

    observation: Tensor
    """After resets (N, D)."""
    reward: Tensor
    """Sum over the control steps of the option (N,)."""
    done: Tensor
    """Episodes that ended (N,): success, failure, fall or out of time. The time left is observed, so that running out
    of it ends an episode like a failure and does not truncate it (Pardo et al., ICML 2018)."""
    success: Tensor
    """(N,)"""
    fallen: Tensor
    """(N,)"""
    final_observation: Tensor
    """Before resets (N, D); what an episode that ended saw last."""
    final_stage: Tensor
    """Stages passed, before resets (N,)."""
    failures: dict[int, str]
    """Robot -> why its episode failed, for the episodes that ended without success."""
    episode: Tensor
    """Number of the episode that this decision belongs to (N,)."""
    duration: Tensor
    """Time since that episode began (N,) [s]."""


class CommandEnvironment:
    """Batched environment with auto-reset: the planner's action in, observations and rewards out.

    The controller's elevation map shows flat ground: what a task puts there, such as a block under a box, is not in
    it.

    Args:
        task: a fresh task, which this environment takes over.
        controller: the frozen controller, or its folder. The environment uses a copy, because a controller
            remembers its robots.
        num_envs: robots side by side.
        seed: seed of the episodes; robot i runs episodes i, i + N, i + 2 N, ...
        physics: accuracy and threads.
        randomization: feet, motors and latency, drawn anew for every episode; the model's own by default. Loads,
            pushes and errors of sensors have no part in it.

    Raises:
        PilotError: if another environment has the task.
    """

    @single_precision()
    def __init__(
        self,
        task: Task,
        controller: Controller | Path | str,
        num_envs: int = 1,
        seed: int = 0,
        physics: PhysicsConfig | None = None,
        randomization: RandomizationConfig | None = None,
    ) -> None:
        if task.is_taken:
            raise PilotError(f"this task {task.name!r} belongs to another environment already: make a task for each")
        task.is_taken = True
        self.task = task
        given = controller if isinstance(controller, Controller) else Controller.load(controller)
        self.controller = given.twin(num_envs)
        physics = PhysicsConfig() if physics is None else physics
        options = ModelOptions(
            gains=self.controller.gains,
            timestep=physics.timestep,
            elliptic_friction=True,
            solver_iterations=physics.solver_iterations,
            line_search_iterations=physics.line_search_iterations,
            impratio=physics.impratio,
            mjcf=physics.mjcf,
        )
        self.world = World(options, TerrainConfig(), num_envs, physics.num_threads, add_objects=task.add_to)
        self.simulation = self.world.simulation
        self.control_period = self.simulation.control_period
        self.action_map = ActionMap(task.action, self.control_period)
        self.decision_period = task.action.decision_steps * self.control_period
        self.max_decisions = round(task.episode_length / self.decision_period)
        self.blocks = (*task.object_blocks, *ROBOT_BLOCKS, *task.added_blocks)
        self.observation_size = sum(block.size for block in self.blocks)
        task.attach(self.simulation)
        self._randomizer: Randomizer | None = None
        if randomization is not None:
            self._randomizer = Randomizer(randomization, self.simulation, torch.Generator())

        self._default = torch.tensor(DEFAULT_POSITION, dtype=torch.float32)
        self._flag = torch.ones(num_envs, 1)
        self.seed = seed
        self.episode = rows(num_envs)
        self.decisions = torch.zeros(num_envs, dtype=torch.long)
        self.command = self.controller.command_space.neutral().repeat(num_envs, 1)
        """Limited command (N, 21) that the last decision ended with."""
        self.measured: Measurement | None = None
        """Measurement after the last control step, after resets."""

    @property
    def num_envs(self) -> int:
        return self.simulation.num_robots

    # -- episodes --------------------------------------------------------------------------------------------

    @torch.no_grad()
    @single_precision()
    def reset(self, seed: int | None = None) -> Tensor:
        """Begin new episodes everywhere: the next ones, or, with a ``seed``, the first ones of that seed.

        Returns:
            observation (N, D).
        """
        everyone = rows(self.num_envs)
        if seed is not None:
            self.seed, self.episode = seed, everyone.clone()
        elif self.measured is not None:
            self.episode = self.episode + self.num_envs
        self._begin(everyone)
        return self.observe()

    def _begin(self, ids: Tensor) -> None:
        """Start the current episode number of robots ``ids`` (n,)."""
        neutral = self.controller.command_space.neutral().repeat(len(ids), 1)
        self.simulation.restart(ids)
        start = self.task.reset(ids, self.seed, self.episode[ids])
        self._draw(ids)
        joints = self.world.stand(ids, start.position, start.heading, neutral)
        if self._randomizer is not None:
            self._randomizer.start(ids, joints)
        self.controller.reset(self.num_envs, ids)
        self.command = self.command.clone()
        self.command[ids] = neutral
        self.decisions[ids] = 0
        self.measured = self.world.measure()

    def _draw(self, ids: Tensor) -> None:
        """Draw what robots ``ids`` (n,) are like in their episodes."""
        if self._randomizer is None:
            return
        seeds = 2**24 * uniform(self.seed, self.episode[ids], _ROBOT_STREAM, 1)
        for robot, seed in zip(ids.split(1), seeds[:, 0].tolist(), strict=True):
            self._randomizer.generator.manual_seed(int(seed))
            self._randomizer.draw(robot)

    # -- stepping --------------------------------------------------------------------------------------------

    @torch.no_grad()
    @single_precision()
    def step(self, action: Tensor, auto_reset: bool = True, observers: Sequence[ControlObserver] = ()) -> StepResult:
        """One decision: ``action`` (N, 21) in [-1, 1], held as an option of several control steps.

        With ``auto_reset``, robots whose episode ended begin their next one before this returns. ``observers`` see
        every control step.

        Raises:
            RuntimeError: if :meth:`reset` was not called.
            ValueError: if the action has another shape or is not finite.
        """
        if self.measured is None:
            raise RuntimeError("call reset() before step()")
        if action.shape != self.command.shape or not bool(torch.isfinite(action).all()):
            raise ValueError(f"the action must be finite and of shape {tuple(self.command.shape)}")
        previous = self.command
        goal = self.controller.clamp_command(self.action_map.limit(previous, action.float()))
        decision = Decision(previous, goal, (goal - previous) / self.action_map.largest_change)
        self.command, self.decisions = goal, self.decisions + 1

        count, steps = self.num_envs, self.task.action.decision_steps
        reward = torch.zeros(count)
        ended, success, fallen = (torch.zeros(count, dtype=torch.bool) for _ in range(3))
        observation = torch.zeros(count, self.observation_size)
        stage = torch.zeros(count, dtype=torch.long)
        failures: dict[int, str] = {}

        def close(these: Tensor) -> None:
            """Take down what the episodes in ``these`` (N,) saw last."""
            observation[these] = self.observe()[these]
            stage[these] = self.task.stage[these]

        def explain(these: Tensor) -> None:
            names = self.task.failures(fallen)
            failures.update({robot: names[robot] for robot in torch.nonzero(these)[:, 0].tolist()})

        # The planner and the elevation map share their rate of 10 Hz.
        elevation = self.world.elevation(self.measured)
        for number in range(1, steps + 1):
            command = interpolate(previous, goal, number / steps)
            targets = self.controller.act(self.measured.proprioception, elevation, command, self._flag)
            arriving = targets if self._randomizer is None else self._randomizer.delayed(targets)
            self.measured = self.world.advance(arriving)
            falls = self.world.fallen(self.measured)
            outcome = self.task.step(self.measured, decision)
            for observe in observers:
                observe(self.measured, decision)
            reward += torch.where(ended, 0.0, torch.where(falls, self.task.fall_penalty, outcome.reward))
            now = (falls | outcome.success | outcome.failure) & ~ended
            if bool(now.any()):
                fallen |= now & falls
                success |= now & outcome.success & ~falls
                close(now)
                explain(now & ~success)
                ended |= now
        close(~ended)
        late = ~ended & (self.decisions >= self.max_decisions)
        if bool(late.any()):
            explain(late)
        result = StepResult(
            observation=observation,
            reward=reward,
            done=ended | late,
            success=success,
            fallen=fallen,
            final_observation=observation,
            final_stage=stage,
            failures=failures,
            episode=self.episode,
            duration=self.decisions * self.decision_period,
        )
        over = torch.nonzero(result.done)[:, 0]
        if len(over) == 0 or not auto_reset:
            return result
        self.episode = self.episode.clone()
        self.episode[over] += count
        self._begin(over)
        fresh = observation.clone()
        fresh[over] = self.observe()[over]
        return replace(result, observation=fresh)

    @single_precision()
    def observe(self) -> Tensor:
        """Observation (N, D) in physical units: the paper's blocks, then the task's additions.

        Raises:
            RuntimeError: if :meth:`reset` was not called.
            NonFiniteError: if a number is not finite. A simulation that diverged is put back to the model's initial
                pose before it is seen.
        """
        measured = self.measured
        if measured is None:
            raise RuntimeError("call reset() before observe()")
        robot = measured.robot
        time_left = 1.0 - self.decisions / self.max_decisions
        seen = self.task.observe(measured, time_left) | {
            "base_angular_velocity": robot.base_angular_velocity,
            "projected_gravity": measured.projected_gravity,
            "joint_position": robot.joint_position - self._default,
            "joint_velocity": robot.joint_velocity,
            "previous_command": self.action_map.normalize(self.command),
        }
        observation = torch.cat([seen[block.name] for block in self.blocks], dim=-1)
        require_finite("observation", observation)
        return observation
