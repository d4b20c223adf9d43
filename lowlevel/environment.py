"""The low-level environment: N robots that track whole-body commands. Read :meth:`PilotEnvironment.step` first."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import torch
from torch import Tensor

from lowlevel.buffers import Buffers
from lowlevel.commands import HEIGHT, KINDS, VELOCITY, CommandSampler, command_space, shares
from lowlevel.control.observation import (
    FRAME,
    MAP_REFRESH_STEPS,
    NoiseConfig,
    build,
    map_observation,
    push_history,
    start_history,
)
from lowlevel.control.reference import Reference, ReferenceConfig, ReferenceState
from lowlevel.control.stepping import swing_first
from lowlevel.control.velocity_correction import VelocityCorrection
from lowlevel.gait_prior import GaitPrior
from lowlevel.rewards import Transition, compute_rewards, tracking_quality
from lowlevel.task import TaskConfig
from lowlevel.world.levels import Levels
from lowlevel.world.measures import Measurement, is_lost, velocity_error, with_rows
from lowlevel.world.privileged import PRIVILEGED, PrivilegedView
from lowlevel.world.randomization import Randomizer
from lowlevel.world.terrain import tile_shares
from lowlevel.world.world import World
from robots.g1.constants import ARM_JOINTS, NUM_JOINTS, gain_set
from robots.g1.model import ModelOptions
from robots.rotations import rotate_about_vertical

AVERAGING = 0.4
"""Time constant of the averaged velocity error [s]: the sway of one step is averaged out, a drift is not."""


@dataclass(frozen=True)
class EnvironmentConfig:
    """How robots are simulated, and how their episodes begin and end, whatever their task."""

    num_robots: int = 1024
    """Robots simulated side by side."""
    num_threads: int = 2
    """Physics threads."""
    timestep: float = 0.02 / 3
    """Physics step [s]; divides the control period of 0.02 s."""
    gains: str = "stiff"
    """PD gain set, a key of robots.g1.constants.GAINS."""
    episode_length: float = 10.0
    """Longest episode [s]."""
    command_interval: tuple[float, float] = (2.0, 6.0)
    """Time between new commands, uniform [s]."""
    start_in_posture: float = 0.25
    """Share of episodes that start in the commanded posture instead of standing upright."""
    start_moving: float = 0.3
    """Share of episodes that start at the commanded velocity."""
    action_limit: float = 12.0
    """Actions are clipped to +- this many action scales; the lift of a knee takes 10."""
    noise: NoiseConfig = field(default_factory=NoiseConfig)


@dataclass(frozen=True)
class StepResult:
    """What one step returns; tensors have one row per robot."""

    observation: dict[str, Tensor]
    """After resets: "history", "elevation_map", "flag", "privileged"."""
    reward: Tensor
    terminated: Tensor
    truncated: Tensor
    next_privileged: Tensor
    """Privileged observation before resets: the true successor state."""
    terms: dict[str, Tensor]
    """Unweighted reward terms."""
    quality: Tensor
    """Quality of tracking (N,), in [0, 1]."""
    measured: Measurement
    """Before resets."""
    command: Tensor
    """The clamped command that the step tracked (N, 21)."""
    kind: Tensor
    """Number of its kind in KINDS (N,)."""
    tile_kind: Tensor
    """Number of the kind of tile on which the episode began in TILES (N,)."""
    surprised: Tensor
    """Whether a new command or a push follows (N,), which neither policy nor critic could foresee."""


class PilotEnvironment:
    """Batched environment with auto-reset.

    Args:
        config: robots, physics and episodes.
        task: what they are to do.
        seed: seed of commands, noise, randomization and resets.
        device: where tensors live.
        correction: what the policy is told instead of the commanded velocity; nothing else by default.
    """

    def __init__(
        self,
        config: EnvironmentConfig,
        task: TaskConfig = TaskConfig(),  # noqa: B008 (frozen)
        seed: int = 0,
        device: torch.device | str = "cpu",
        correction: VelocityCorrection | None = None,
    ) -> None:
        self.config, self.task = config, task
        self.device = torch.device(device)
        self.generator = torch.Generator(device=self.device).manual_seed(seed)
        gains = gain_set(config.gains)
        options = ModelOptions(gains=gains, timestep=config.timestep)
        self.world = World(options, task.terrain, config.num_robots, config.num_threads, device)
        self.simulation = self.world.simulation
        self.control_period = self.simulation.control_period
        self.max_steps = round(config.episode_length / self.control_period)
        lower, upper = self.simulation.joint_lower, self.simulation.joint_upper
        self.command_space = command_space(lower.tolist(), upper.tolist())
        self.sampler = CommandSampler(self.command_space, device)
        self.correction = VelocityCorrection(self.command_space).to(device) if correction is None else correction
        followed = ReferenceConfig(gait_frequency=task.gait_frequency)
        self.reference = Reference(followed, gains, self.control_period, device)
        self.prior = None if task.prior is None else GaitPrior(task.prior, device)
        self.action_scale = torch.tensor(gains.action_scale, dtype=torch.float32, device=device)
        self.randomizer = Randomizer(task.randomization, self.simulation, self.generator)
        self.kind_probability = shares(task.mixture, device)
        """Chance of each kind of command (kinds,); the curriculum moves it."""
        self.opening = torch.ones(len(KINDS), device=device)
        """How far each kind is open (kinds,), in [0, 1]; the curriculum moves it."""
        self.tile_probability = tile_shares(task.terrain, device)
        """Chance of each kind of tile (kinds of tile,); the curriculum moves it."""
        self.levels = Levels(self.world.terrain, config.num_robots, device)
        self._noise = config.noise.proprioception().to(device)
        self._step_count = 0
        self._everyone = torch.arange(config.num_robots, device=self.device)
        neutral = self.command_space.neutral(self.device)
        self.buffers = Buffers.empty(neutral.repeat(config.num_robots, 1))

    @property
    def num_robots(self) -> int:
        return self.config.num_robots

    def _uniform(self, low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=self.generator, device=self.device)

    # -- stepping ---------------------------------------------------------------------------------------------

    def reset(self, spread_episodes: bool = False) -> dict[str, Tensor]:
        """Reset all robots; with ``spread_episodes`` time limits are spread so that they do not coincide."""
        self._reset_robots(self._everyone)
        if spread_episodes:
            self.buffers.episode_step = torch.randint(
                self.max_steps, (self.num_robots,), generator=self.generator, device=self.device
            )
            self.buffers.velocity_error_sum[:] = torch.inf  # what is left of these episodes proves nothing
        self._advance_reference()
        measured = self.world.measure()
        return self._observe(measured, self._seen_ground(measured), self._everyone)

    def step(self, action: Tensor, believed_capture_point: Tensor | None = None) -> StepResult:
        """Apply residual ``action`` (N, 29), in action scales, for one control step of 0.02 s.

        ``believed_capture_point`` (N, 2) [m], heading frame, decides whether robots that rest step, as in the frozen
        controller: the policy's own estimate, or by default the true one.
        """
        buffers = self.buffers
        action = action.clamp(-self.config.action_limit, self.config.action_limit)
        if not self.task.arms_act:
            action[:, ARM_JOINTS] = 0.0
        nominal_target = self.reference.joint_targets(buffers.reference)
        target = nominal_target + action * self.action_scale - self.randomizer.state.joint_offset
        if self.prior is not None:
            target += self.prior(buffers.reference, buffers.capture_point, buffers.mean_velocity_error)
        measured = self.world.advance(self.randomizer.delayed(target))
        ground = self._seen_ground(measured)
        buffers.previous_action, buffers.action = buffers.action, action
        buffers.episode_step += 1
        self._update_foot_times(measured)
        error = velocity_error(measured, buffers.reference.command)
        buffers.mean_velocity_error = torch.lerp(buffers.mean_velocity_error, error, self.control_period / AVERAGING)
        self._update_progress(measured)
        fallen = is_lost(measured, buffers.reference.command) | self.simulation.diverged()
        truncated = (buffers.episode_step >= self.max_steps) & ~fallen
        transition = Transition(
            measured=measured,
            command=self._tracked_command,
            flag=buffers.flag,
            action=action,
            previous_action=buffers.previous_action,
            nominal_target=nominal_target,
            phase=buffers.reference.phase,
            walking=buffers.reference.walking,
            gait_frequency=self.task.gait_frequency,
            foot_air_time=buffers.foot_air_time,
            foot_contact_time=buffers.foot_contact_time,
            mean_velocity_error=buffers.mean_velocity_error,
            fallen=fallen,
        )
        reward, terms = compute_rewards(transition, self.task.rewards, self.control_period)
        quality = tracking_quality(transition)
        command, kind, tile_kind = buffers.command, buffers.kind.clone(), buffers.tile_kind.clone()
        believed = measured.capture_point if believed_capture_point is None else believed_capture_point
        buffers.reference = self.reference.begin_step(buffers.reference, swing_first(believed))
        next_privileged = build(PRIVILEGED, self._view(measured, ground))

        done, now = torch.nonzero(fallen | truncated)[:, 0], measured
        if len(done):
            self._judge(done, fallen[done])
            self._reset_robots(done)
            fresh = self.world.measure(done)
            now = with_rows(measured, done, fresh)
            ground = ground.index_copy(0, done, self._seen_ground(fresh))
        buffers.hand_force, pushed = self.randomizer.disturb(now.robot, now.heading, buffers.reference.walking)
        surprised = self._resample_due_commands() | pushed
        self._advance_reference()
        self._step_count += 1
        return StepResult(
            observation=self._observe(now, ground, done),
            reward=reward,
            terminated=fallen,
            truncated=truncated,
            next_privileged=next_privileged,
            terms=terms,
            quality=quality,
            measured=measured,
            command=command,
            kind=kind,
            tile_kind=tile_kind,
            surprised=surprised,
        )

    def set_command(self, ids: Tensor, command: Tensor, flag: Tensor) -> None:
        """Give robots ``ids`` (n,) a ``command`` (n, 21), clamped here, until it is set again."""
        self.buffers.command = self.buffers.command.clone()
        self.buffers.command[ids] = self.reference.clamp(command)
        self.buffers.flag[ids] = flag
        self.buffers.command_countdown[ids] = torch.inf

    # -- parts of a step --------------------------------------------------------------------------------------

    @property
    def _tracked_command(self) -> Tensor:
        """What the policy is rewarded for (N, 21): the command, of whose velocity the slewed part is due by now."""
        return torch.cat([self.buffers.reference.command[:, VELOCITY], self.buffers.command[:, HEIGHT:]], dim=1)

    def _advance_reference(self) -> None:
        self.buffers.reference = self.reference.advance(self.buffers.reference, self.buffers.command)

    def _update_foot_times(self, measured: Measurement) -> None:
        contact, period = measured.foot_contact, self.control_period
        self.buffers.foot_contact_time = torch.where(contact, self.buffers.foot_contact_time + period, 0.0)
        self.buffers.foot_air_time = torch.where(contact, 0.0, self.buffers.foot_air_time + period)

    def _update_progress(self, measured: Measurement) -> None:
        buffers = self.buffers
        buffers.velocity_error_sum += buffers.mean_velocity_error[:, :2].norm(dim=1)
        ground = self.world.terrain.height(measured.robot.base_position[:, :2])
        buffers.climbed += (ground - buffers.ground).abs()
        buffers.ground = ground

    def _judge(self, ids: Tensor, fallen: Tensor) -> None:
        """Let robots ``ids`` (n,), whose episodes are over, change their level."""
        buffers = self.buffers
        error = buffers.velocity_error_sum[ids] / buffers.episode_step[ids]
        kind, tile, climbed = buffers.tile_kind[ids], buffers.tile[ids], buffers.climbed[ids]
        self.levels.judge(ids, kind, tile, fallen, error, climbed, self.generator)

    def _resample_due_commands(self) -> Tensor:
        """Give new commands to robots whose time with the old one is over; returns which (N,)."""
        self.buffers.command_countdown -= self.control_period
        due = self.buffers.command_countdown <= 0.0
        ids = torch.nonzero(due)[:, 0]
        if len(ids):
            self._sample_commands(ids)
        return due

    def _sample_commands(self, ids: Tensor) -> None:
        kinds = self.sampler.draw_kinds(len(ids), self.kind_probability, self.generator)
        command, flag = self.sampler.sample(kinds, self.opening, self.generator)
        self.set_command(ids, command, flag)
        self.buffers.kind[ids] = kinds
        self.buffers.command_countdown[ids] = self._uniform(*self.config.command_interval, len(ids))

    def _reset_robots(self, ids: Tensor) -> None:
        """Start new episodes on tiles of the robots' levels, at random places, headings and commands."""
        buffers, count = self.buffers, len(ids)
        self._sample_commands(ids)
        in_posture = self._uniform(0.0, 1.0, count, 1) < self.config.start_in_posture
        moving = self._uniform(0.0, 1.0, count, 1) < self.config.start_moving
        posture = torch.where(in_posture, buffers.command[ids], self.sampler.neutral)
        velocity = buffers.command[ids, VELOCITY] * moving
        reference = torch.cat([velocity, posture[:, HEIGHT:]], dim=1)
        for remembered, fresh in zip(buffers.reference, ReferenceState.standing(reference), strict=True):
            remembered[ids] = fresh

        heading = self._uniform(-torch.pi, torch.pi, count)
        joint_spread = self._uniform(-0.02, 0.02, count, NUM_JOINTS)
        tile_kind, tile = self.levels.draw(ids, self.tile_probability, self.generator)
        reach = 0.5 * self.task.terrain.tile_size - 1.0
        xy = self.world.terrain.tile_centers[tile] + self._uniform(-reach, reach, count, 2)
        base_velocity = torch.zeros(count, 6, device=self.device)
        fastest = self.randomizer.config.start_velocity
        base_velocity[:, :3] = self._uniform(-fastest, fastest, count, 3)
        base_velocity[:, :2] += rotate_about_vertical(heading, velocity[:, :2])
        self.randomizer.draw(ids)
        self.simulation.restart(ids)
        joints = self.world.stand(ids, xy, heading, reference, joint_spread, base_velocity)
        self.randomizer.start(ids, joints + joint_spread)
        buffers.action[ids], buffers.previous_action[ids] = 0.0, 0.0
        buffers.foot_air_time[ids], buffers.foot_contact_time[ids] = 0.0, 0.0
        buffers.mean_velocity_error[ids] = 0.0
        buffers.episode_step[ids] = 0
        buffers.tile_kind[ids], buffers.tile[ids] = tile_kind, tile
        buffers.velocity_error_sum[ids], buffers.climbed[ids] = 0.0, 0.0
        buffers.ground[ids] = self.world.terrain.height(xy)

    # -- observation ------------------------------------------------------------------------------------------

    def _seen_ground(self, measured: Measurement) -> Tensor:
        """The elevation map as observed, without noise (n, 121) [m]."""
        return map_observation(self.world.elevation(measured))

    def _view(self, measured: Measurement, ground: Tensor) -> PrivilegedView:
        buffers, drawn, exact = self.buffers, self.randomizer.state, measured.proprioception
        return PrivilegedView(
            proprioception=replace(exact, joint_position=exact.joint_position + drawn.joint_offset),
            command=buffers.command,
            last_action=buffers.action,
            reference=buffers.reference,
            space=self.command_space,
            measured=measured,
            elevation=ground,
            mean_velocity_error=buffers.mean_velocity_error,
            hand_force=buffers.hand_force,
            flag=buffers.flag,
            drawn=drawn,
        )

    def _observe(self, measured: Measurement, ground: Tensor, new_episodes: Tensor) -> dict[str, Tensor]:
        """The observation, after pushing a noisy frame, restarting new histories and refreshing the map (10 Hz)."""
        buffers, view = self.buffers, self._view(measured, ground)
        noise = self._noise * self._uniform(-1.0, 1.0, self.num_robots, len(self._noise))
        told = self.correction.tell(replace(view, proprioception=view.proprioception.with_noise(noise)))
        frame = build(FRAME, told)
        buffers.history, buffers.capture_point = push_history(buffers.history, frame), measured.capture_point
        if len(new_episodes):
            buffers.history[new_episodes] = start_history(frame[new_episodes])
        if self._step_count % MAP_REFRESH_STEPS == 0:
            self.randomizer.wander()
            newest = self._take_maps(measured, self._everyone)
            buffers.maps = torch.cat([newest[:, None], buffers.maps[:, :-1]], dim=1)
        if len(new_episodes):
            buffers.maps[new_episodes] = self._take_maps(measured, new_episodes)[:, None]
        return {
            "history": buffers.history.flatten(1),
            "elevation_map": buffers.maps[self._everyone, self.randomizer.state.map_delay],
            "flag": buffers.flag.clone(),
            "privileged": build(PRIVILEGED, view),
        }

    def _take_maps(self, measured: Measurement, ids: Tensor) -> Tensor:
        """Elevation maps of this moment (n, 121) of robots ``ids`` (n,): from where they think they are, with noise."""
        position = measured.robot.base_position[ids] + self.randomizer.state.map_error[ids]
        elevation = map_observation(self.world.terrain.elevation_map(position, measured.heading[ids]))
        return elevation + self.config.noise.elevation * self._uniform(-1.0, 1.0, *elevation.shape)

    # -- saving -----------------------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, object]:
        """Everything needed to continue bit-exactly on a CPU."""
        return {
            "simulation": self.simulation.state_dict(),
            "buffers": {f.name: getattr(self.buffers, f.name) for f in fields(Buffers) if f.name != "reference"},
            "reference": self.buffers.reference._asdict(),
            "randomization": {f.name: getattr(self.randomizer.state, f.name) for f in fields(self.randomizer.state)},
            "levels": self.levels.reached,
            "generator": self.generator.get_state(),
            "step_count": self._step_count,
        }

    def load_state_dict(self, state: dict) -> None:
        """Restore :meth:`state_dict`; raises ValueError if it belongs to another configuration."""
        self.simulation.load_state_dict(state["simulation"])
        for name, value in state["buffers"].items():
            setattr(self.buffers, name, value.clone())
        self.buffers.reference = ReferenceState(**{name: value.clone() for name, value in state["reference"].items()})
        for name, value in state["randomization"].items():
            setattr(self.randomizer.state, name, value.clone())
        self.levels.reached = state["levels"].clone()
        self.generator.set_state(state["generator"])
        self._step_count = state["step_count"]
