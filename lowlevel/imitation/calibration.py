"""Measure what a policy answers to the commands that it is told, and tell it what makes it walk as it should.

A trained policy walks at a velocity of its own for every command, the same whenever it is given: of 237 commands the
lasting errors in two tries agree to 0.015 m/s, of 0.12 m/s. So it does not lack a reaction; it has a wrong answer to
the command, which 135 million steps of PPO had not mended. The error is measured for some ten thousand commands, and
what takes it away is fitted as a function of the command (iterative learning control; Bristow et al., IEEE Control
Systems 26(3), 2006). The lasting lean of torso and robot, which depends on what it carries, is cloned away.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor, nn

from lowlevel.commands import VELOCITY, is_walking
from lowlevel.control.velocity_correction import VelocityCorrection
from lowlevel.environment import PilotEnvironment
from lowlevel.imitation.cloning import CloningConfig, PolicyTeacher, clone
from lowlevel.imitation.upright import UprightConfig, UprightTeacher
from lowlevel.learning.ppo import PPO
from lowlevel.networks.actor import CAPTURE_POINT
from lowlevel.runs.distributed import broadcast, gathered, rank, world_size
from lowlevel.runs.precision import coarse_products
from lowlevel.world.measures import velocity_error
from lowlevel.world.randomization import RandomizationConfig
from robots.errors import PilotError

_FEWEST = 100
"""Commands without which there is no calibration."""


@dataclass(frozen=True)
class CalibrationConfig:
    """How the correction of the told velocity is found."""

    commands: int = 12_000
    """Commands that are given, over all ranks together; six in ten are to walk. With 2,000 of these the fit explains
    half of their errors' variance, with 8,000 six tenths."""
    duration: float = 4.5
    """Time that each is given [s]."""
    averaged: float = 1.5
    """Time at its end over which the error is averaged [s]: three steps of one foot."""
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
    correction: VelocityCorrection, commands: Tensor, wanted: Tensor, epochs: int, generator: torch.Generator
) -> tuple[float, ...]:
    """Fit ``correction`` to what is ``wanted`` (n, 3) for ``commands`` (n, 21), all but a sixth of them.

    Returns the share of the variance about zero that it explains of that sixth, one per column. Where it explains
    nothing it corrects nothing.
    """
    order = torch.randperm(len(commands), generator=generator)
    held_out, used = order[: len(order) // 6], order[len(order) // 6 :]
    optimizer = torch.optim.AdamW(correction.parameters(), lr=2e-3, weight_decay=0.1)
    slowing = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.01, epochs)
    correction.known.fill_(1.0)
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


def correct(ppo: PPO, environment: PilotEnvironment, config: CalibrationConfig, report: Callable[[str], None]) -> bool:
    """Make the policy of ``ppo`` walk at the velocities that are commanded in ``environment``.

    ``report`` is told how it goes. Returns whether there was enough to fit. All ranks take rank 0's fit.
    """
    report("calibrating the told velocity")
    rounds = math.ceil(config.commands / (environment.num_robots * world_size()))
    commands, errors = measure(ppo, _measuring(environment, config, ppo.seed), config, rounds)
    commands, errors = gathered(commands), gathered(errors)
    if len(commands) < _FEWEST:
        report(f"no calibration: in {len(commands)} commands no robot fell, and it takes {_FEWEST}")
        return False
    correction = VelocityCorrection(environment.command_space)
    with torch.no_grad():
        wanted = environment.correction(commands) - errors
    explained = fit(correction, commands, wanted, config.epochs, torch.Generator().manual_seed(ppo.seed))
    environment.correction.load_state_dict(correction.state_dict())
    broadcast(list(environment.correction.state_dict().values()))
    shares = ", ".join(f"{share:.2f}" for share in explained)
    report(f"calibrated by {len(commands)} commands; shares of vx, vy, yaw rate explained: {shares}")
    return True


def calibrate(
    ppo: PPO,
    environment: PilotEnvironment,
    config: CalibrationConfig,
    cloning: CloningConfig,
    report: Callable[[str], None],
) -> dict[str, Tensor]:
    """Correct the velocity that the policy of ``ppo`` is told, and clone into it what holds it upright under loads.

    ``report`` is told how it goes. Returns the observation to go on from.
    """
    if not correct(ppo, environment, config, report):
        return environment.reset(spread_episodes=True)
    teacher = UprightTeacher(PolicyTeacher(ppo), environment, config.upright)
    return clone(ppo, environment, teacher, cloning, report)


def _measuring(environment: PilotEnvironment, config: CalibrationConfig, seed: int) -> PilotEnvironment:
    """As ``environment``, but in the conditions of the evaluation, and with a command that lasts as long as a robot."""
    longer = 2.0 * config.duration
    conditions = replace(environment.config, command_interval=(longer, longer), episode_length=longer, start_moving=1.0)
    task = replace(environment.task, randomization=RandomizationConfig.for_evaluation())
    measuring = PilotEnvironment(conditions, task, seed + 7919 * rank(), correction=environment.correction)
    measuring.opening, measuring.kind_probability = environment.opening, environment.kind_probability
    return measuring
