"""Tell a policy what makes it walk as it should, and clone that.

A trained policy walks at a velocity of its own for every command: the error differs by 0.2 m/s rms from command to
command, and by 0.05 m/s while one lasts. So it does not lack a reaction; it has a wrong answer to the command, which
135 million steps of PPO had not mended. An integrator finds the right one within three seconds: it moves the velocity
that the policy is told until the robot walks at the wanted one. What it finds is a function of the command. It is
fitted, and the policy told by it is cloned into the policy itself, which needs neither integrator nor fit afterwards
(iterative learning control; Bristow et al., IEEE Control Systems 26(3), 2006).
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from lowlevel.commands import ARMS, COMMAND_SIZE, MIRROR, VELOCITY, CommandSpace, is_walking
from lowlevel.control.observation import FRAME, FRAME_SIZE, HISTORY_LENGTH, columns
from lowlevel.environment import PilotEnvironment
from lowlevel.imitation.cloning import CloningConfig, clone
from lowlevel.imitation.upright import UprightConfig, UprightTeacher
from lowlevel.learning.ppo import PPO
from lowlevel.runs.distributed import any_rank, broadcast
from lowlevel.world.measures import velocity_error

_COMMAND, _SLEWED = columns(FRAME, "command"), columns(FRAME, "slewed_command")
_TOLD = [slice(block.start, block.start + VELOCITY.stop) for block in (_COMMAND, _SLEWED)]
"""Where a frame tells the policy a velocity: the command's and the slewed command's, both scaled by its bounds."""
_FEWEST = 100
"""Commands without which there is no calibration."""


@dataclass(frozen=True)
class CalibrationConfig:
    """How the told velocity is corrected."""

    steps: int = 2400
    """Control steps per robot over which corrections are measured."""
    rate: float = 1.5
    """Rate of the integrator [1/s]."""
    limit: float = 0.5
    """Largest correction [m/s, m/s, rad/s]."""
    settling: float = 2.5
    """Time from when the slewed velocity has reached the command until the integrator has settled [s]."""
    epochs: int = 60
    """Passes of the fit over the commands that were measured."""
    upright: UprightConfig = field(default_factory=UprightConfig)


class Correction(nn.Module):
    """Correction of the told velocity as a function of the command; a mirrored command has the mirrored one."""

    def __init__(self, space: CommandSpace, limit: float) -> None:
        super().__init__()
        self.space, self.limit = space, limit
        last = nn.Linear(64, 3)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.known: Tensor
        self.register_buffer("known", torch.ones(3))
        """1 for each velocity about which the fit knows something, else 0 (3,)."""
        self.net = nn.Sequential(nn.Linear(COMMAND_SIZE, 128), nn.ELU(), nn.Linear(128, 64), nn.ELU(), last)

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
    def label(self, observation: dict[str, Tensor], further: Tensor | None = None) -> Tensor:
        """Mean action (N, A) [action scales]; ``further`` (N, 3) [m/s, m/s, rad/s] is added to the correction."""
        history = observation["history"].view(-1, HISTORY_LENGTH + 1, FRAME_SIZE).clone()
        half, middle = 0.5 * (self._upper - self._lower), 0.5 * (self._upper + self._lower)
        command = history[..., _COMMAND] * half + middle
        slewed = history[..., _SLEWED] * half[: ARMS.start] + middle[: ARMS.start]
        for told, meant in zip(_TOLD, (command, torch.cat([slewed, command[..., ARMS]], dim=-1)), strict=True):
            moved = self._correction(meant.cpu()).to(history.device)
            if further is not None:
                moved = moved + further[:, None].to(history.device)
            history[..., told] += moved / half[VELOCITY]
        return self._policy(history.flatten(1), observation["elevation_map"], observation["flag"]).mean

    def forget(self, robots: Tensor) -> None:
        """A policy remembers nothing."""


def measure(
    teacher: ToldTeacher, environment: PilotEnvironment, device: torch.device, config: CalibrationConfig
) -> tuple[Tensor, Tensor]:
    """Let ``teacher``, whose policy computes on ``device``, act in ``environment`` without noise under an integrator.

    Returns the commands to walk that lasted long enough (n, 21), and what the integrator had added to the velocity of
    each of them, its mean over the time after it had settled (n, 3) [m/s, m/s, rad/s].
    """
    robots, period = environment.num_robots, environment.control_period
    observation = environment.reset(spread_episodes=True)
    added, total, counted, age = (torch.zeros(robots, *size) for size in ((3,), (3,), (), ()))
    commands, corrections = [], []
    for _ in range(config.steps):
        command, reference = environment.buffers.command.clone(), environment.buffers.reference
        action = teacher.label({name: values.to(device) for name, values in observation.items()}, added)
        result = environment.step(action.cpu())
        observation = result.observation
        reached = (reference.command - command)[:, VELOCITY].abs().amax(dim=1) < 1e-3
        change = config.rate * period * velocity_error(result.measured, command)
        added = torch.where(reached[:, None], added - change, added).clamp(-config.limit, config.limit)
        added *= is_walking(command)[:, None]
        age += period * reached
        settled = (age > config.settling) & is_walking(command) & ~result.terminated
        total += added * settled[:, None]
        counted += settled
        over = result.terminated | result.truncated | (environment.buffers.command != command).any(dim=1)
        # Half a second at least: the mean over two steps of one foot.
        known = over & (counted * period > 0.5)
        commands.append(command[known])
        corrections.append(total[known] / counted[known, None])
        for memory in (added, total, counted, age):
            memory[over] = 0.0
    return torch.cat(commands), torch.cat(corrections)


def fit(
    correction: Correction, commands: Tensor, wanted: Tensor, epochs: int, generator: torch.Generator
) -> tuple[float, ...]:
    """Fit ``correction`` to what is ``wanted`` (n, 3) for ``commands`` (n, 21), all but a sixth of them.

    Returns the share of the variance about zero that it explains of that sixth, one per column. Where it explains
    nothing it corrects nothing.
    """
    order = torch.randperm(len(commands), generator=generator)
    held_out, used = order[: len(order) // 6], order[len(order) // 6 :]
    optimizer = torch.optim.AdamW(correction.parameters(), lr=2e-3, weight_decay=0.02)
    for _ in range(epochs):
        for batch in used[torch.randperm(len(used), generator=generator)].split(256):
            loss = nn.functional.smooth_l1_loss(correction(commands[batch]), wanted[batch], beta=0.2)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
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
    correction = Correction(environment.command_space, config.limit)
    teacher = ToldTeacher(ppo, environment.command_space, correction)
    report("calibrating the told velocity")
    commands, wanted = measure(teacher, environment, ppo.device, config)
    if any_rank(len(commands) < _FEWEST):
        report(f"no calibration: {len(commands)} commands lasted long enough, and it takes {_FEWEST}")
        return environment.reset(spread_episodes=True)
    explained = fit(correction, commands, wanted, config.epochs, torch.Generator().manual_seed(ppo.seed))
    broadcast([*correction.parameters(), correction.known])
    shares = ", ".join(f"{share:.2f}" for share in explained)
    report(f"calibrated by {len(commands)} commands; shares of vx, vy, yaw rate explained: {shares}")
    return clone(ppo, environment, UprightTeacher(teacher, environment, config.upright), cloning, report)
