"""The low-level environment: N robots that track whole-body commands. Read :meth:`PilotEnvironment.step` first."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import torch
from torch import Tensor

from lowlevel.buffers import Buffers
from lowlevel.commands import (
    ARMS,
    HEIGHT,
    POSTURE,
    TORSO,
    VELOCITY,
    CommandMixture,
    CommandRange,
    CommandSampler,
    command_space,
)
from lowlevel.measures import Measurement, has_fallen, height_error, torso_error
from lowlevel.nominal import NominalMotion
from lowlevel.nominal_config import NominalConfig
from lowlevel.nominal_state import NominalState
from lowlevel.observation import (
    PRIVILEGED_SIZE,
    FrameBuilder,
    NoiseConfig,
    push_history,
    split_frame,
    start_history,
)
from lowlevel.randomization import RandomizationConfig, Randomizer
from lowlevel.rewards import RewardWeights, Transition, compute_rewards
from lowlevel.rotations import about_axis, multiply
from lowlevel.simulation import BatchSimulation
from lowlevel.snapshot import Snapshot, take_snapshot, with_rows
from lowlevel.terrain import STANCE_REACH, Terrain, TerrainConfig
from robots.g1.constants import ARM_JOINTS, LOWER_JOINTS, NUM_JOINTS, WAIST_JOINTS, gain_set
from robots.g1.model import ModelOptions, build_spec

MAP_REFRESH_STEPS = 5
"""Control steps between refreshes of the elevation map: 10 Hz at 50 Hz control (paper IV-B)."""


@dataclass(frozen=True)
class EnvironmentConfig:
    """Everything about the low-level task except learning."""

    num_robots: int = 1024
    """Robots simulated side by side."""
    num_threads: int = 2
    """Physics threads."""
    timestep: float = 0.02 / 3
    """Physics step [s]."""
    decimation: int = 3
    """Physics steps per control step; timestep * decimation must be 0.02 s (50 Hz)."""
    gains: str = "stiff"
    """PD gain set, a key of robots.g1.constants.GAINS."""
    episode_length: float = 10.0
    """Longest episode [s]."""
    command_interval: tuple[float, float] = (4.0, 8.0)
    """Time between new commands, uniform [s]."""
    start_in_posture: float = 0.25
    """Share of episodes that start in the commanded posture instead of standing upright."""
    action_limit: float = 8.0
    """Actions are clipped to +- this many action scales."""
    nominal: NominalConfig = field(default_factory=NominalConfig)
    mixture: CommandMixture = field(
        default_factory=lambda: CommandMixture(walk_and_work=0.35, stand_and_work=0.4, stand=0.1, slow=0.25)
    )
    """Unlike the evaluation it also stands in the neutral posture, what a planner starts from and stops in, and walks
    slowly."""
    terrain: TerrainConfig = field(default_factory=TerrainConfig)
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    randomization: RandomizationConfig = field(default_factory=RandomizationConfig)
    rewards: RewardWeights = field(default_factory=RewardWeights)


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
    measured: Measurement
    """Before resets."""
    command: Tensor
    """The clamped command that the step tracked (N, 21)."""


class PilotEnvironment:
    """Batched environment with auto-reset.

    Args:
        config: the task.
        seed: seed of commands, noise, randomisation and resets.
        device: where tensors live.
    """

    def __init__(self, config: EnvironmentConfig, seed: int = 0, device: torch.device | str = "cpu") -> None:
        if abs(config.timestep * config.decimation - 0.02) > 1e-9:
            raise ValueError(
                f"timestep {config.timestep} s times decimation {config.decimation} is not the control period 0.02 s"
            )
        for name in ("num_robots", "num_threads"):
            if getattr(config, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(config, name)}")
        self.config = config
        self.device = torch.device(device)
        self.generator = torch.Generator(device=self.device).manual_seed(seed)
        self.terrain = Terrain(config.terrain, device)
        gains = gain_set(config.gains)
        spec = build_spec(ModelOptions(gains=gains, timestep=config.timestep))
        self.terrain.add_to(spec)
        self.simulation = BatchSimulation(
            spec.compile(), config.num_robots, config.decimation, config.num_threads, device
        )
        self.control_period = self.simulation.control_period
        self.max_steps = round(config.episode_length / self.control_period)
        lower, upper = self.simulation.joint_lower, self.simulation.joint_upper
        self.command_space = command_space(lower.tolist(), upper.tolist())
        self.sampler = CommandSampler(self.command_space, config.mixture, device)
        self.motion = NominalMotion(config.nominal, gains, self.control_period, device)
        self.action_scale = torch.tensor(gains.action_scale, dtype=torch.float32, device=device)
        self.build_frame = FrameBuilder(self.command_space, self.motion, device)
        self.randomizer = Randomizer(config.randomization, self.simulation, self.generator)
        self.open_range = CommandRange()
        self._noise = config.noise.frame_amplitude().to(device)
        self._step_count = 0
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
        everyone = torch.arange(self.num_robots, device=self.device)
        self._reset_robots(everyone)
        if spread_episodes:
            self.buffers.episode_step = torch.randint(
                self.max_steps, (self.num_robots,), generator=self.generator, device=self.device
            )
        self._advance_nominal()
        now = take_snapshot(self.simulation.read(), self.terrain)
        self.buffers.velocity = now.measured.linear_velocity
        return self._observe(now, everyone)

    def step(self, action: Tensor, estimated_velocity: Tensor | None = None) -> StepResult:
        """Apply residual ``action`` (N, 29) for one control step of 0.02 s.

        ``estimated_velocity`` (N, 3) [m/s]: the policy's estimate of the base velocity in the heading frame, which
        the nominal motion steers by; the true one by default.
        """
        buffers = self.buffers
        velocity = buffers.velocity if estimated_velocity is None else estimated_velocity
        action = action.clamp(-self.config.action_limit, self.config.action_limit)
        frame = split_frame(buffers.history[:, -1])
        nominal_target, buffers.nominal = self.motion.joint_targets(
            buffers.nominal,
            frame["joint_position"] + self.motion.default,
            frame["projected_gravity"],
            frame["base_angular_velocity"],
            velocity,
        )
        target = nominal_target + action * self.action_scale - self.randomizer.state.joint_offset
        applied = torch.where(self.randomizer.state.is_delayed, buffers.previous_target, target)
        buffers.previous_target = target
        self.simulation.step(applied)

        now = take_snapshot(self.simulation.read(), self.terrain)
        measured = now.measured
        buffers.previous_action, buffers.action = buffers.action, action
        buffers.episode_step += 1
        self._update_foot_times(measured)
        fallen = has_fallen(measured, buffers.nominal.reference) | self.simulation.diverged()
        truncated = (buffers.episode_step >= self.max_steps) & ~fallen
        transition = Transition(
            measured=measured,
            command=buffers.tracked_command,
            flag=buffers.flag,
            action=action,
            previous_action=buffers.previous_action,
            nominal_target=nominal_target,
            phase=buffers.nominal.phase,
            walking=buffers.nominal.walking,
            foot_air_time=buffers.foot_air_time,
            foot_contact_time=buffers.foot_contact_time,
            fallen=fallen,
        )
        reward, terms = compute_rewards(transition, self.config.rewards, self.control_period)
        command = buffers.command
        next_privileged = self._privileged(now, self._frame(measured), transition.torso_error)

        done = torch.nonzero(fallen | truncated)[:, 0]
        if len(done):
            self._reset_robots(done)
            now = with_rows(now, done, take_snapshot(self.simulation.read(done), self.terrain))
        buffers.velocity = now.measured.linear_velocity
        buffers.hand_force = self.randomizer.disturb(now.measured.robot, now.measured.heading)
        self._resample_due_commands()
        self._advance_nominal()
        self._step_count += 1
        return StepResult(
            observation=self._observe(now, done),
            reward=reward,
            terminated=fallen,
            truncated=truncated,
            next_privileged=next_privileged,
            terms=terms,
            measured=measured,
            command=command,
        )

    def set_command(self, ids: Tensor, command: Tensor, flag: Tensor, hold: float = float("inf")) -> None:
        """Give robots ``ids`` (n,) a ``command`` (n, 21), clamped here, for ``hold`` seconds."""
        self.buffers.command = self.buffers.command.clone()
        self.buffers.command[ids] = self.motion.clamp(command)
        self.buffers.flag[ids] = flag
        self.buffers.command_countdown[ids] = hold

    # -- parts of a step --------------------------------------------------------------------------------------

    def _advance_nominal(self) -> None:
        buffers = self.buffers
        buffers.nominal = self.motion.advance(buffers.nominal, buffers.command)
        buffers.tracked_command = self.motion.tracked_command(buffers.nominal, buffers.command)

    def _update_foot_times(self, measured: Measurement) -> None:
        contact, period = measured.foot_contact, self.control_period
        self.buffers.foot_contact_time = torch.where(contact, self.buffers.foot_contact_time + period, 0.0)
        self.buffers.foot_air_time = torch.where(contact, 0.0, self.buffers.foot_air_time + period)

    def _resample_due_commands(self) -> None:
        self.buffers.command_countdown -= self.control_period
        due = torch.nonzero(self.buffers.command_countdown <= 0.0)[:, 0]
        if len(due):
            self._sample_commands(due)

    def _sample_commands(self, ids: Tensor) -> None:
        command, flag = self.sampler.sample(len(ids), self.open_range, self.generator)
        self.set_command(ids, command, flag)
        self.buffers.command_countdown[ids] = self._uniform(*self.config.command_interval, len(ids))

    def _reset_robots(self, ids: Tensor) -> None:
        """Start new episodes on random tiles, headings and commands."""
        buffers, count = self.buffers, len(ids)
        self._sample_commands(ids)
        in_posture = self._uniform(0.0, 1.0, count, 1) < self.config.start_in_posture
        neutral = self.sampler.neutral.expand(count, -1)
        reference = torch.where(in_posture, buffers.command[ids], neutral).clone()
        reference[:, VELOCITY] = 0.0
        standing = NominalState.standing(reference, self.config.nominal.settling_time)
        for remembered, fresh in zip(buffers.nominal, standing, strict=True):
            remembered[ids] = fresh

        heading = self._uniform(-torch.pi, torch.pi, count)
        facing = about_axis(2, heading)
        joint_position = self.motion.default.repeat(count, 1)
        joint_position[:, ARM_JOINTS] = reference[:, ARMS]
        if self.config.nominal.kind == "default":
            height = neutral[:, HEIGHT]
            orientation = facing
        else:
            height = reference[:, HEIGHT]
            joint_position[:, LOWER_JOINTS] = self.motion.pose.lookup(reference[:, POSTURE])[0]
            waist = joint_position[:, WAIST_JOINTS]
            orientation = multiply(facing, self.motion.pelvis_attitude(reference[:, TORSO], waist))
        joint_position += self._uniform(-0.02, 0.02, count, NUM_JOINTS)

        tile = torch.randint(len(self.terrain.tile_centers), (count,), generator=self.generator, device=self.device)
        reach = 0.5 * self.config.terrain.tile_size - 1.0
        xy = self.terrain.tile_centers[tile] + self._uniform(-reach, reach, count, 2)
        ground = self.terrain.highest(xy, STANCE_REACH)
        base_position = torch.cat([xy, (ground + height + 0.005)[:, None]], -1)
        base_velocity = torch.zeros(count, 6, device=self.device)
        fastest = self.config.randomization.start_velocity
        base_velocity[:, :3] = self._uniform(-fastest, fastest, count, 3)
        self.simulation.reset(ids, base_position, orientation, joint_position, base_velocity)
        self.randomizer.draw(ids, self.open_range.arms)
        self.simulation.forward(ids)

        buffers.previous_target[ids] = joint_position
        buffers.action[ids], buffers.previous_action[ids] = 0.0, 0.0
        buffers.foot_air_time[ids], buffers.foot_contact_time[ids] = 0.0, 0.0
        buffers.episode_step[ids] = 0

    # -- observation ------------------------------------------------------------------------------------------

    def _frame(self, measured: Measurement) -> Tensor:
        robot, buffers = measured.robot, self.buffers
        return self.build_frame(
            robot.joint_position + self.randomizer.state.joint_offset,
            robot.joint_velocity,
            robot.base_angular_velocity,
            measured.projected_gravity,
            buffers.tracked_command,
            buffers.action,
            buffers.nominal,
        )

    def _observe(self, now: Snapshot, new_episodes: Tensor) -> dict[str, Tensor]:
        """The observation, after pushing a noisy frame, restarting new histories and refreshing the map (10 Hz)."""
        buffers = self.buffers
        exact_frame = self._frame(now.measured)
        frame = exact_frame.clone()
        frame[:, : len(self._noise)] += self._noise * self._uniform(-1.0, 1.0, self.num_robots, len(self._noise))
        buffers.history = push_history(buffers.history, frame)
        if len(new_episodes):
            buffers.history[new_episodes] = start_history(frame[new_episodes])
        if self._step_count % MAP_REFRESH_STEPS == 0:
            buffers.elevation = self._noisy(now.elevation)
        elif len(new_episodes):
            buffers.elevation[new_episodes] = self._noisy(now.elevation[new_episodes])
        return {
            "history": buffers.history.flatten(1),
            "elevation_map": buffers.elevation,
            "flag": buffers.flag.clone(),
            "privileged": self._privileged(now, exact_frame, torso_error(now.measured, buffers.tracked_command)),
        }

    def _noisy(self, elevation: Tensor) -> Tensor:
        return elevation + self.config.noise.elevation * self._uniform(-1.0, 1.0, *elevation.shape)

    def _privileged(self, now: Snapshot, exact_frame: Tensor, torso_error: Tensor) -> Tensor:
        measured, buffers = now.measured, self.buffers
        parts = (
            measured.linear_velocity,
            exact_frame,
            height_error(measured, buffers.tracked_command)[:, None],
            torso_error,
            now.feet,
            buffers.hand_force.flatten(1) / 20.0,
            self.randomizer.state.friction,
            self.randomizer.state.added_mass,
            buffers.flag,
            now.elevation,
        )
        privileged = torch.cat(parts, dim=-1)
        assert privileged.shape[-1] == PRIVILEGED_SIZE
        return privileged

    # -- saving -----------------------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, object]:
        """Everything needed to continue bit-exactly on a CPU."""
        return {
            "simulation": self.simulation.state_dict(),
            "buffers": {f.name: getattr(self.buffers, f.name) for f in fields(Buffers) if f.name != "nominal"},
            "nominal": self.buffers.nominal._asdict(),
            "randomization": {f.name: getattr(self.randomizer.state, f.name) for f in fields(self.randomizer.state)},
            "generator": self.generator.get_state(),
            "step_count": self._step_count,
        }

    def load_state_dict(self, state: dict) -> None:
        """Restore :meth:`state_dict`; raises ValueError if it belongs to another configuration."""
        self.simulation.load_state_dict(state["simulation"])
        for name, value in state["buffers"].items():
            setattr(self.buffers, name, value.clone())
        self.buffers.nominal = NominalState(**{name: value.clone() for name, value in state["nominal"].items()})
        for name, value in state["randomization"].items():
            setattr(self.randomizer.state, name, value.clone())
        self.generator.set_state(state["generator"])
        self._step_count = state["step_count"]
