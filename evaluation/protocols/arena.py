"""Runs any controller through scripted episodes and hands out every control step.

An episode is fixed by its seed and its command schedule alone. Friction, start and observation noise come
from the episode's own generator, and every batch has the same number of rows, so that an episode's outcome
depends neither on how many others are evaluated nor on which ones. Every command counts: a robot that falls lies
there until its next command begins, and is stood up for it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from lowlevel.commands import COMMAND_SIZE, VELOCITY, clamp_posture, command_space
from lowlevel.control.elevation_map import MAP_SIZE
from lowlevel.control.observation import MAP_REFRESH_STEPS, NoiseConfig
from lowlevel.control.whole_body import HasExperts, Supports, WholeBodyController
from lowlevel.runs.draws import require_seed
from lowlevel.world.measures import Measurement
from lowlevel.world.randomization import RandomizationConfig, Randomizer, hand_forces
from lowlevel.world.terrain import TerrainConfig
from lowlevel.world.world import World
from robots.g1.constants import NUM_JOINTS
from robots.g1.model import ModelOptions

BATCH = 32
"""Robots side by side. The last digits of a matrix product, and with them a fall, depend on its row count."""
START_SPREAD = 1.0
"""Largest distance of a start from its tile's center, per axis [m]."""
COURSE_SPREAD = 0.5
"""Largest distance of a start to the left or right of a course [m]."""
STEERING, MOST_STEERING = 1.0, 0.5
"""Yaw rate told per radian off a course [1/s], and the largest one [rad/s]."""
JOINT_SPREAD = 0.02
"""Largest deviation of a joint from the standing pose at the start [rad]."""
_PROPRIOCEPTION_SIZE = 2 * NUM_JOINTS + 6
_NOT_DRAWN = (
    "joint_offset",
    "hand_load_probability",
    "start_velocity",
    "push_velocity",
    "standing_push_velocity",
    "map_offset",
    "map_drift",
    "map_delay",
)
"""Randomization of training that episodes have no part in."""


@dataclass(frozen=True)
class Push:
    """A sudden change of the pelvis's velocity."""

    time: float
    """[s]"""
    velocity_change: tuple[float, float, float]
    """World frame [m/s]."""


@dataclass(frozen=True)
class HandLoad:
    """What a box squeezed between the palms does to the hands: it pushes them apart and hangs from them."""

    outward: float
    """Force on each hand along the line between the palms, away from the other hand [N]."""
    downward: float
    """Force on each hand [N]."""
    begin: float = 0.0
    """When it sets in, for the rest of the episode [s]."""


@dataclass(frozen=True)
class Course:
    """A straight way along the x axis of the world, kept by somebody who steers."""

    start: tuple[float, float]
    """From the center of the tile [m]; the robot starts there up to COURSE_SPREAD beside it, facing along its way."""


@dataclass(frozen=True)
class Episode:
    """What happens to one robot: it starts standing at rest and is given piecewise constant commands."""

    seed: int
    """Seed of friction, start and noise."""
    duration: float
    """[s]"""
    starts: tuple[float, ...]
    """When each command begins [s], ascending, the first at 0."""
    commands: Tensor
    """(len(starts), 21); cut to what the controllers support, and clamped to what the robot can hold."""
    flags: Tensor
    """Tracking flag I of each command (len(starts),)."""
    tile: int = 0
    """Index of the terrain tile to start on."""
    pushes: tuple[Push, ...] = ()
    load: HandLoad | None = None
    stands_up: bool = True
    """Whether a robot that has fallen is stood up for its next command."""
    course: Course | None = None
    """How it crosses its tile; without one it starts near the middle of it, facing anywhere, and is not steered."""


@dataclass(frozen=True)
class Moment:
    """One control step of a batch of N rows; rows where ``active`` is false mean nothing."""

    step: int
    """Control steps before this one."""
    measured: Measurement
    """At the end of the step."""
    targets: Tensor
    """PD targets of the step (N, 29) [rad]."""
    command: Tensor
    """The clamped command that the step tracked (N, 21)."""
    flag: Tensor
    """(N, 1)"""
    elevation: Tensor
    """The noisy elevation map that the controller saw (N, 121) [m]."""
    gate: Tensor
    """Expert activations (N, experts); without columns for a controller that has none."""
    work: Tensor
    """Of all motors in the step, both signs counted positive (N,) [J]."""
    number: Tensor
    """Which command of its episode is tracked (N,)."""
    active: Tensor
    """Robots that were up when the step began, in episodes that were running (N,)."""
    fell: Tensor
    """Active robots that fell in this step (N,)."""
    failed: Tensor
    """Active robots whose controller gave targets that are not finite (N,); they are out like those that fell."""


def episode_seeds(seed: int, index: int) -> tuple[int, int]:
    """Two independent seeds for episode ``index`` of an evaluation: for its commands and for its world.

    Raises:
        PilotError: if ``seed`` is none.
    """
    require_seed(seed)
    commands, world = np.random.SeedSequence([seed, index]).generate_state(2)
    return int(commands), int(world)


def constant(seed: int, duration: float, command: Tensor, flag: float, tile: int = 0) -> Episode:
    """An episode with one ``command`` (21,) throughout."""
    return Episode(seed, duration, (0.0,), command[None], torch.tensor([flag]), tile)


class Arena:
    """One controller on one terrain.

    Args:
        controller: on the CPU; its memory is reset by every batch.
        terrain: tiles to start on.
        conditions: friction, masses, gains, torque limits and latency; the protocol's by default. Pushes and loads are
            those of an episode.
        noise: observation noise.
        num_threads: physics threads.
        batch: robots simulated side by side (N).
        supports: what commands are cut to; by default what the controller can be told.
        options: the robot's model; its gains are the controller's.
    """

    def __init__(
        self,
        controller: WholeBodyController,
        terrain: TerrainConfig,
        conditions: RandomizationConfig | None = None,
        noise: NoiseConfig = NoiseConfig(),  # noqa: B008 (frozen)
        num_threads: int = 2,
        batch: int = BATCH,
        supports: Supports | None = None,
        options: ModelOptions = ModelOptions(),  # noqa: B008 (frozen)
    ) -> None:
        self.controller = controller
        self.batch = batch
        self.world = World(replace(options, gains=controller.gains), terrain, batch, num_threads)
        self.simulation = self.world.simulation
        self.period = self.simulation.control_period
        lower, upper = self.simulation.joint_lower, self.simulation.joint_upper
        self.space = command_space(lower.tolist(), upper.tolist())
        self.supports = controller.supports if supports is None else supports
        self._neutral = self.supports.cut(self.space.neutral()[None])
        self.experts = controller.experts if isinstance(controller, HasExperts) else 0
        protocol = RandomizationConfig.for_evaluation()
        drawn = protocol if conditions is None else conditions
        for name in _NOT_DRAWN:
            if getattr(drawn, name) != getattr(protocol, name):
                raise ValueError(f"an arena does not draw {name!r}: leave it as it is in the protocol")
        self._randomizer = Randomizer(drawn, self.simulation, torch.Generator())
        self._proprioception_noise = noise.proprioception()
        self._elevation_noise = noise.elevation

    @property
    def friction(self) -> Tensor:
        """Sliding friction of the feet that was drawn for each row (N,)."""
        return self._randomizer.state.friction[:, 0]

    def run(self, episodes: Sequence[Episode]) -> Iterator[Moment]:
        """Yield the control steps of up to ``batch`` episodes until all are over; row i is episode i.

        The simulation's state after the step can be read from :attr:`simulation` between two moments.
        """
        if not 1 <= len(episodes) <= self.batch:
            raise ValueError(f"a batch takes 1 to {self.batch} episodes, not {len(episodes)}")
        rows = torch.arange(self.batch)
        lengths = torch.zeros(self.batch, dtype=torch.long)
        lengths[: len(episodes)] = torch.tensor([self._steps(episode.duration) for episode in episodes])
        stands_up = torch.zeros(self.batch, dtype=torch.bool)
        stands_up[: len(episodes)] = torch.tensor([episode.stands_up for episode in episodes])
        starts, commands, flags = self._schedules(episodes)
        pushes = self._pushes(episodes)
        load_begin, outward, downward = self._loads(episodes)
        steered = torch.tensor([episode.course is not None for episode in episodes])
        frame_noise, map_noise, starting = self._start(episodes)
        self.controller.reset(self.batch)
        up = torch.ones(self.batch, dtype=torch.bool)
        measured = self.world.measure()
        elevation = torch.zeros(self.batch, MAP_SIZE)
        for step in range(int(lengths.max())):
            current = (starts <= step).sum(dim=1) - 1
            rising = torch.nonzero(~up & stands_up & (starts[rows, current] == step) & (step < lengths))[:, 0]
            if len(rising):
                self._stand(rising, *(values[rising] for values in starting))
                self.controller.reset(self.batch, rising)
                up[rising] = True
                measured = self.world.measure()
            active = up & (step < lengths)
            waiting = stands_up & ((starts > step) & (starts < lengths[:, None])).any(dim=1) & (step < lengths)
            if not (active | waiting).any():
                return
            command, flag = commands[rows, current], flags[rows, current]
            command = self._steered(command, measured, steered)
            seeing = rows if step % MAP_REFRESH_STEPS == 0 else rising
            if len(seeing):
                noisy = self.world.elevation(measured) + map_noise[step // MAP_REFRESH_STEPS]
                elevation[seeing] = noisy[seeing]
            proprioception = measured.proprioception.with_noise(frame_noise[step])
            targets = self.controller.act(proprioception, elevation, command, flag)
            failed = active & ~torch.isfinite(targets).all(dim=1)
            if step in pushes:
                self.simulation.push(pushes[step])
            bears = load_begin <= step
            if bears.any():
                palms = measured.robot.palm_position
                self.simulation.set_hand_force(hand_forces(palms, bears * outward, bears * downward))
            moving = torch.nonzero(active & ~failed)[:, 0]
            applied = self._randomizer.delayed(torch.nan_to_num(targets))
            work = self.simulation.step_with_work(applied, moving)
            measured = self.world.measure()
            fell = active & ~failed & self.world.fallen(measured)
            yield Moment(
                step=step,
                measured=measured,
                targets=targets,
                command=command,
                flag=flag,
                elevation=elevation.clone(),
                gate=self._gate(),
                work=work,
                number=current,
                active=active,
                fell=fell,
                failed=failed,
            )
            up = up & ~fell & ~failed

    def _steered(self, command: Tensor, measured: Measurement, steered: Tensor) -> Tensor:
        """``command`` (N, 21), in which the first rows that are ``steered`` are told to turn back to their course."""
        (ids,) = torch.nonzero(steered, as_tuple=True)
        if len(ids):
            off = torch.atan2(torch.sin(measured.heading[ids]), torch.cos(measured.heading[ids]))
            command[ids, VELOCITY.stop - 1] = (-STEERING * off).clamp(-MOST_STEERING, MOST_STEERING)
            command[ids] = self.supports.cut(command[ids])
        return command

    def _gate(self) -> Tensor:
        return self.controller.gate if isinstance(self.controller, HasExperts) else torch.zeros(self.batch, 0)

    # -- preparing a batch -----------------------------------------------------------------------------------

    def _steps(self, seconds: float) -> int:
        return round(seconds / self.period)

    def _schedules(self, episodes: Sequence[Episode]) -> tuple[Tensor, Tensor, Tensor]:
        """First step (N, S), clamped command (N, S, 21) and flag (N, S, 1) of every command."""
        most = max(len(episode.starts) for episode in episodes)
        starts = torch.full((self.batch, most), torch.iinfo(torch.long).max)
        starts[:, 0] = 0
        commands = self._neutral.repeat(self.batch, most, 1)
        flags = torch.ones(self.batch, most, 1)
        for row, episode in enumerate(episodes):
            count = len(episode.starts)
            starts[row, :count] = torch.tensor([self._steps(start) for start in episode.starts])
            commands[row, :count] = episode.commands
            flags[row, :count, 0] = episode.flags
        clamped = clamp_posture(self.supports.cut(commands.flatten(0, 1)), self.world.pose)
        return starts, clamped.reshape(self.batch, most, COMMAND_SIZE), flags

    def _pushes(self, episodes: Sequence[Episode]) -> dict[int, Tensor]:
        """Velocity changes (N, 3) by control step."""
        pushes: dict[int, Tensor] = {}
        for row, episode in enumerate(episodes):
            for push in episode.pushes:
                change = pushes.setdefault(self._steps(push.time), torch.zeros(self.batch, 3))
                change[row] += torch.tensor(push.velocity_change)
        return pushes

    def _loads(self, episodes: Sequence[Episode]) -> tuple[Tensor, Tensor, Tensor]:
        """First step with a load (N,), and its outward and downward force per hand (N,) [N]."""
        begin = torch.full((self.batch,), torch.iinfo(torch.long).max)
        outward, downward = torch.zeros(self.batch), torch.zeros(self.batch)
        for row, episode in enumerate(episodes):
            if episode.load is not None:
                begin[row] = self._steps(episode.load.begin)
                outward[row], downward[row] = episode.load.outward, episode.load.downward
        return begin, outward, downward

    def _start(self, episodes: Sequence[Episode]) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor, Tensor]]:
        """Draw everything random and put all robots on their feet.

        Returns:
            noise of the proprioception (steps, N, 64) and of the elevation map (refreshes, N, 121), and where and how
            each robot stands: xy (N, 2) [m], heading (N,) [rad], deviation of its joints (N, 29) [rad].
        """
        steps = max(self._steps(episode.duration) for episode in episodes)
        refreshes = -(-steps // MAP_REFRESH_STEPS)
        frame_noise = torch.zeros(steps, self.batch, _PROPRIOCEPTION_SIZE)
        map_noise = torch.zeros(refreshes, self.batch, MAP_SIZE)
        offset, heading = torch.zeros(self.batch, 2), torch.zeros(self.batch)
        joint_spread = torch.zeros(self.batch, NUM_JOINTS)
        tiles = torch.zeros(self.batch, dtype=torch.long)
        for row, episode in enumerate(episodes):
            # Apart from each other, so that conditions that draw more leave place and noise as they are.
            self._randomizer.generator = torch.Generator().manual_seed(episode.seed)
            self._randomizer.draw(torch.tensor([row]))
            generator = torch.Generator().manual_seed(episode.seed + 1)
            place = _symmetric(generator, 3)
            joint_spread[row] = JOINT_SPREAD * _symmetric(generator, NUM_JOINTS)
            # Drawn step by step, so that the noise does not depend on how long the episode lasts.
            for refresh in range(refreshes):
                when = slice(refresh * MAP_REFRESH_STEPS, min((refresh + 1) * MAP_REFRESH_STEPS, steps))
                noise = _symmetric(generator, MAP_REFRESH_STEPS, _PROPRIOCEPTION_SIZE)
                frame_noise[when, row] = self._proprioception_noise * noise[: when.stop - when.start]
                map_noise[refresh, row] = self._elevation_noise * _symmetric(generator, MAP_SIZE)
            tiles[row] = episode.tile
            offset[row], heading[row] = START_SPREAD * place[:2], torch.pi * place[2]
            if episode.course is not None:
                offset[row] = torch.tensor(episode.course.start) + COURSE_SPREAD * torch.tensor([0.0, 1.0]) * place[1]
                heading[row] = 0.0
        starting = (self.world.terrain.tile_centers[tiles] + offset, heading, joint_spread)
        self._stand(torch.arange(self.batch), *starting)
        return frame_noise, map_noise, starting

    def _stand(self, ids: Tensor, xy: Tensor, heading: Tensor, joint_spread: Tensor) -> None:
        """Put robots ``ids`` (n,) at rest in the nominal pose of the neutral command, feet just above the ground."""
        neutral = self._neutral.repeat(len(ids), 1)
        self.simulation.restart(ids)
        joints = self.world.stand(ids, xy, heading, neutral, joint_spread)
        self._randomizer.start(ids, joints)


def batch_steps(arena: Arena, episodes: Sequence[Episode]) -> int:
    """Control steps that all batches of ``episodes`` take if nobody falls."""
    size = arena.batch
    batches = [episodes[first : first + size] for first in range(0, len(episodes), size)]
    return sum(max(round(episode.duration / arena.period) for episode in batch) for batch in batches)


def _symmetric(generator: torch.Generator, *shape: int) -> Tensor:
    """Uniform numbers in [-1, 1]."""
    return 2.0 * torch.rand(*shape, generator=generator) - 1.0
