"""Tell a policy what makes it walk as it should, and clone that.

A trained policy walks at a velocity of its own for every command, the same whenever it is given: of 237 commands the
lasting errors in two tries agree to 0.015 m/s, of 0.12 m/s. So it does not lack a reaction; it has a wrong answer to
the command, which 135 million steps of PPO had not mended. The error is measured for some ten thousand commands, and
fitted as a function of the command. The policy that is told what takes it away is cloned into the policy itself, which
needs no fit afterwards (iterative learning control; Bristow et al., IEEE Control Systems 26(3), 2006). The clone keeps
a part of it only: it comes as near to its teacher as that one is to the policy.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor, nn

from lowlevel.commands import ARMS, COMMAND_SIZE, MIRROR, VELOCITY, CommandSpace, is_walking
from lowlevel.control.observation import FRAME, FRAME_SIZE, HISTORY_LENGTH, columns
from lowlevel.environment import PilotEnvironment
from lowlevel.imitation.cloning import CloningConfig, clone
from lowlevel.imitation.upright import UprightConfig, UprightTeacher
from lowlevel.learning.ppo import PPO
from lowlevel.networks.actor import CAPTURE_POINT
from lowlevel.runs.distributed import broadcast, gathered, rank, world_size
from lowlevel.runs.precision import coarse_products
from lowlevel.world.measures import velocity_error
from lowlevel.world.randomization import RandomizationConfig
from robots.errors import PilotError

_COMMAND, _SLEWED = columns(FRAME, "command"), columns(FRAME, "slewed_command")
_TOLD = [slice(block.start, block.start + VELOCITY.stop) for block in (_COMMAND, _SLEWED)]
"""Where a frame tells the policy a velocity: the command's and the slewed command's, both scaled by its bounds."""
_FEWEST = 100
"""Commands without which there is no calibration."""


@dataclass(frozen=True)
class CalibrationConfig:
    """How the told velocity is corrected."""

    commands: int = 12_000
    """Commands that are given, over all ranks together; six in ten are to walk. With 2,000 of these the fit explains
    half of their errors' variance, with 8,000 six tenths."""
    duration: float = 4.5
    """Time that each is given [s]."""
    averaged: float = 1.5
    """Time at its end over which the error is averaged [s]: three steps of one foot."""
    limit: float = 0.5
    """Largest correction [m/s, m/s, rad/s]."""
    epochs: int = 120
    """Passes of the fit over the commands that were measured."""
    upright: UprightConfig = field(default_factory=UprightConfig)

    def __post_init__(self) -> None:
        if self.commands < 1:
            raise PilotError(f"a calibration takes at least one command, not {self.commands}")
        if not 0.0 < self.averaged <= self.duration:
            raise PilotError(
                f"a calibration averages over a part of the {self.duration} s of a command, not {self.averaged} s"
            )


class Correction(nn.Module):
    """Correction of the told velocity as a function of the command; a mirrored command has the mirrored one."""

    def __init__(self, space: CommandSpace, limit: float) -> None:
        super().__init__()
        self.space, self.limit = space, limit
        last = nn.Linear(128, 3)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.known: Tensor
        self.register_buffer("known", torch.ones(3))
        """1 for each velocity about which the fit knows something, else 0 (3,)."""
        self.net = nn.Sequential(nn.Linear(COMMAND_SIZE, 128), nn.ELU(), nn.Linear(128, 128), nn.ELU(), last)

    def forward(self, command: Tensor) -> Tensor:
        """(..., 3) [m/s, m/s, rad/s] for ``command`` (..., 21); zero for one to stand."""
        index, sign = torch.as_tensor(MIRROR.index), torch.as_tensor(MIRROR.sign, dtype=command.dtype)
        mirrored = self.net(self.space.scaled(command[..., index] * sign)) * sign[VELOCITY]
        mean = 0.5 * (self.net(self.space.scaled(command)) + mirrored)
        return mean.clamp(-self.limit, self.limit) * self.known * is_walking(command)[..., None]


class ToldTeacher:
    """A copy of the policy that is told a corrected velocity."""

    def __init__(self, ppo: PPO, space: CommandSpace, correction: Correction) -> None:
        self._policy = copy.deepcopy(ppo.actor).eval().requires_grad_(False)
        self._correction = correction
        self._lower, self._upper = space.bounds(ppo.device)

    @torch.no_grad()
    def label(self, observation: dict[str, Tensor]) -> Tensor:
        """Mean action (N, A) [action scales]."""
        history = observation["history"].view(-1, HISTORY_LENGTH + 1, FRAME_SIZE).clone()
        half, middle = 0.5 * (self._upper - self._lower), 0.5 * (self._upper + self._lower)
        command = history[..., _COMMAND] * half + middle
        slewed = history[..., _SLEWED] * half[: ARMS.start] + middle[: ARMS.start]
        for told, meant in zip(_TOLD, (command, torch.cat([slewed, command[..., ARMS]], dim=-1)), strict=True):
            history[..., told] += self._correction(meant.cpu()).to(history.device) / half[VELOCITY]
        return self._policy(history.flatten(1), observation["elevation_map"], observation["flag"]).mean

    def forget(self, robots: Tensor) -> None:
        """A policy remembers nothing."""


def measure(ppo: PPO, environment: PilotEnvironment, config: CalibrationConfig, rounds: int) -> tuple[Tensor, Tensor]:
    """Let the policy of ``ppo`` act in ``environment`` without noise, on ``rounds`` commands per robot.

    Returns the commands to walk during which it did not fall (n, 21), and their lasting velocity errors (n, 3) [m/s,
    m/s, rad/s], measured - commanded.
    """
    steps, averaged = (round(time / environment.control_period) for time in (config.duration, config.averaged))
    commands, errors = [], []
    for _ in range(rounds):
        observation = environment.reset()
        command = environment.buffers.command.clone()
        walks, error = is_walking(command), torch.zeros(len(command), VELOCITY.stop)
        for step in range(steps):
            with torch.no_grad(), coarse_products():
                output = ppo.learner.policy({name: values.to(ppo.device) for name, values in observation.items()})
            result = environment.step(output.mean.cpu(), output.motion[:, CAPTURE_POINT].cpu())
            observation = result.observation
            walks &= ~result.terminated
            if step >= steps - averaged:
                error += velocity_error(result.measured, command)
        commands.append(command[walks])
        errors.append(error[walks] / averaged)
    return torch.cat(commands), torch.cat(errors)


def fit(
    correction: Correction, commands: Tensor, wanted: Tensor, epochs: int, generator: torch.Generator
) -> tuple[float, ...]:
    """Fit ``correction`` to what is ``wanted`` (n, 3) for ``commands`` (n, 21), all but a sixth of them.

    Returns the share of the variance about zero that it explains of that sixth, one per column. Where it explains
    nothing it corrects nothing.
    """
    order = torch.randperm(len(commands), generator=generator)
    held_out, used = order[: len(order) // 6], order[len(order) // 6 :]
    optimizer = torch.optim.AdamW(correction.parameters(), lr=2e-3, weight_decay=0.1)
    slowing = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.01, epochs)
    for _ in range(epochs):
        for batch in used[torch.randperm(len(used), generator=generator)].split(256):
            loss = nn.functional.smooth_l1_loss(correction(commands[batch]), wanted[batch], beta=0.1)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        slowing.step()
    with torch.no_grad():
        rest = (wanted[held_out] - correction(commands[held_out])).square().mean(dim=0)
        explained = 1.0 - rest / wanted[held_out].square().mean(dim=0)
        correction.known.copy_(explained > 0.0)
    return tuple(explained.tolist())


def calibrate(
    ppo: PPO,
    environment: PilotEnvironment,
    config: CalibrationConfig,
    cloning: CloningConfig,
    report: Callable[[str], None],
) -> dict[str, Tensor]:
    """Make the policy of ``ppo`` walk at the velocities that it is told in ``environment``, and hold its torso upright.

    ``report`` is told how it goes. Returns the observation to go on from. All ranks take rank 0's fit.
    """
    report("calibrating the told velocity")
    correction = Correction(environment.command_space, config.limit)
    rounds = math.ceil(config.commands / (environment.num_robots * world_size()))
    commands, errors = measure(ppo, _measuring(environment, config, ppo.seed), config, rounds)
    commands, errors = gathered(commands), gathered(errors)
    if len(commands) < _FEWEST:
        report(f"no calibration: in {len(commands)} commands no robot fell, and it takes {_FEWEST}")
        return environment.reset(spread_episodes=True)
    explained = fit(correction, commands, -errors, config.epochs, torch.Generator().manual_seed(ppo.seed))
    broadcast([*correction.parameters(), correction.known])
    shares = ", ".join(f"{share:.2f}" for share in explained)
    report(f"calibrated by {len(commands)} commands; shares of vx, vy, yaw rate explained: {shares}")
    teacher = ToldTeacher(ppo, environment.command_space, correction)
    return clone(ppo, environment, UprightTeacher(teacher, environment, config.upright), cloning, report)


def _measuring(environment: PilotEnvironment, config: CalibrationConfig, seed: int) -> PilotEnvironment:
    """As ``environment``, but in the conditions of the evaluation, and with a command that lasts as long as a robot."""
    longer = 2.0 * config.duration
    conditions = replace(environment.config, command_interval=(longer, longer), episode_length=longer, start_moving=1.0)
    task = replace(environment.task, randomization=RandomizationConfig.for_evaluation())
    measuring = PilotEnvironment(conditions, task, seed + 7919 * rank())
    measuring.opening, measuring.kind_probability = environment.opening, environment.kind_probability
    return measuring
