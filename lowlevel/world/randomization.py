"""Domain randomization: every randomized quantity with its range, in one place."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lowlevel.world.simulation import BatchSimulation, RobotState
from robots.g1.constants import FOOT_BODIES, NUM_JOINTS, PELVIS_BODY, TORSO_BODY
from robots.rotations import rotate_about_vertical

_RANDOMIZED_BODIES = (PELVIS_BODY, TORSO_BODY)
_WAIST_MOTORS = ("waist_roll_joint", "waist_pitch_joint")
MOST_DELAY = 2
"""Longest latency from sensor to motor [control steps of 20 ms]."""
MOST_MAP_DELAY = 2
"""Longest age of an elevation map that arrives [refreshes of 100 ms]."""
DRIFT_STEP = 0.005
"""Largest step of the wandering map error from one refresh to the next, per axis [m]."""


@dataclass(frozen=True)
class RandomizationConfig:
    """Ranges are drawn uniformly at every reset of a robot, unless stated otherwise."""

    friction: tuple[float, float] = (0.25, 1.2)
    """Sliding friction of the feet."""
    added_mass: tuple[float, float] = (-1.0, 2.0)
    """Added to the pelvis and, independently, to the torso [kg]."""
    center_of_mass_shift: float = 0.02
    """Half-width of the shift of pelvis and torso centers of mass, per axis [m]."""
    gain_scale: tuple[float, float] = (0.9, 1.1)
    """Factor on stiffness and damping, per joint."""
    joint_offset: float = 0.01
    """Half-width of the calibration error of each joint encoder [rad]."""
    delay: tuple[float, float, float] = (0.4, 0.4, 0.2)
    """Chances that a robot's targets arrive 0, 20 and 40 ms late for the whole episode."""
    effort_scale: float = 1.0
    """Factor on the largest torque of all motors."""
    waist_effort: tuple[float, float] = (35.0, 50.0)
    """Largest torque of the waist's roll and pitch motors [N m]. The URDF says 35, Unitree's MJCF of the same robot
    50."""
    hand_load_probability: float = 0.4
    """Chance that the hands carry a load in an episode."""
    hand_payload: tuple[float, float] = (0.0, 12.0)
    """Downward force on each hand [N]."""
    hand_squeeze: tuple[float, float] = (-30.0, 10.0)
    """Force on each hand towards the other one [N]; negative pushes outwards, as a squeezed box does."""
    start_velocity: float = 0.1
    """Largest velocity of the base at the start of an episode, per axis [m/s]."""
    push_velocity: float = 0.4
    """Largest horizontal velocity change of a push, per axis, of robots whose gait clock runs [m/s]; 0.5 in mjlab."""
    standing_push_velocity: float = 0.8
    """The same of those that stand [m/s]: what they must learn beside standing still."""
    push_interval: tuple[float, float] = (4.0, 8.0)
    """Time between pushes [s]."""
    map_offset: float = 0.05
    """Half-width of the vertical error of an episode's elevation maps [m] (as jalenzz/AME_Locomotion)."""
    map_drift: float = 0.05
    """Largest horizontal error of the maps, per axis [m]: that of the estimated position, which wanders."""
    map_delay: tuple[float, float, float] = (0.4, 0.4, 0.2)
    """Chances that a robot's maps are 0, 100 and 200 ms old when they arrive: those of a LiDAR are 120 to 280 ms old in
    InternRobotics/Gallant."""

    @property
    def pushes(self) -> bool:
        """Whether robots are pushed."""
        return max(self.push_velocity, self.standing_push_velocity) > 0.0

    @classmethod
    def for_evaluation(cls) -> RandomizationConfig:
        """The evaluation protocol: friction 0.6 to 1.0 and nothing else."""
        return cls(
            friction=(0.6, 1.0),
            added_mass=(0.0, 0.0),
            center_of_mass_shift=0.0,
            gain_scale=(1.0, 1.0),
            joint_offset=0.0,
            delay=(1.0, 0.0, 0.0),
            waist_effort=(50.0, 50.0),
            hand_load_probability=0.0,
            start_velocity=0.0,
            push_velocity=0.0,
            standing_push_velocity=0.0,
            map_offset=0.0,
            map_drift=0.0,
            map_delay=(1.0, 0.0, 0.0),
        )


def between(easy: RandomizationConfig, hard: RandomizationConfig, hardness: float) -> RandomizationConfig:
    """Ranges on the way from ``easy``, at a ``hardness`` of 0, to ``hard``, at 1."""

    def mix(begin: float, end: float) -> float:
        return begin + hardness * (end - begin)

    mixed: dict[str, Any] = {}
    for field in fields(easy):
        begin, end = getattr(easy, field.name), getattr(hard, field.name)
        mixed[field.name] = tuple(map(mix, begin, end)) if isinstance(begin, tuple) else mix(begin, end)
    return RandomizationConfig(**mixed)


def hand_forces(palm_position: Tensor, outward: Tensor, downward: Tensor) -> Tensor:
    """Forces on left and right hand (N, 2, 3) [N], world frame.

    ``palm_position`` (N, 2, 3) [m]; ``outward`` (N,) along the line between the palms and ``downward`` (N,) are
    per hand [N].
    """
    across = palm_position[:, 0] - palm_position[:, 1]
    to_the_left = across / across.norm(dim=-1, keepdim=True).clamp_min(1e-3)
    force = torch.stack([to_the_left, -to_the_left], dim=1) * outward[:, None, None]
    force[..., 2] -= downward[:, None]
    return force


@dataclass
class RandomizationState:
    """What was drawn for each robot's episode."""

    friction: Tensor
    """(N, 1)"""
    added_mass: Tensor
    """Pelvis, torso (N, 2) [kg]."""
    joint_offset: Tensor
    """(N, 29) [rad]"""
    delay: Tensor
    """Latency of the targets (N,) [control steps], integer."""
    past_targets: Tensor
    """Targets of the steps before, the last one first (N, MOST_DELAY, 29) [rad]."""
    hand_load: Tensor
    """Downward and inward force per hand (N, 2) [N]."""
    push_countdown: Tensor
    """Time to the next push (N,) [s]."""
    map_error: Tensor
    """Where the maps are taken, from where they should be (N, 3) [m], world frame."""
    map_delay: Tensor
    """Age of the maps when they arrive (N,) [refreshes], integer."""


class Randomizer:
    """Draws episode parameters and writes them into the simulation."""

    def __init__(self, config: RandomizationConfig, simulation: BatchSimulation, generator: torch.Generator) -> None:
        self.config = config
        """May change between two steps."""
        self.simulation = simulation
        self.generator = generator
        model, count, device = simulation.model, simulation.num_robots, simulation.device
        self._bodies = [model.body(name).id for name in _RANDOMIZED_BODIES]
        self._foot_geoms = [
            geom
            for geom in range(model.ngeom)
            if model.body(model.geom_bodyid[geom]).name in FOOT_BODIES and model.geom_contype[geom]
        ]
        self._actuators = slice(0, NUM_JOINTS)
        self._waist_motors = [model.actuator(name).id for name in _WAIST_MOTORS]
        self._nominal_mass = model.body_mass[self._bodies].copy()
        self._nominal_inertia = model.body_inertia[self._bodies].copy()
        self._nominal_center = model.body_ipos[self._bodies].copy()
        self._effort = model.actuator_forcerange.copy()
        self._gain, self._bias = model.actuator_gainprm.copy(), model.actuator_biasprm.copy()
        self.state = RandomizationState(
            friction=torch.ones(count, 1, device=device),
            added_mass=torch.zeros(count, 2, device=device),
            joint_offset=torch.zeros(count, NUM_JOINTS, device=device),
            delay=torch.zeros(count, dtype=torch.long, device=device),
            past_targets=torch.zeros(count, MOST_DELAY, NUM_JOINTS, device=device),
            hand_load=torch.zeros(count, 2, device=device),
            push_countdown=torch.full((count,), np.inf, device=device),
            map_error=torch.zeros(count, 3, device=device),
            map_delay=torch.zeros(count, dtype=torch.long, device=device),
        )

    def _uniform(self, low: float, high: float, *shape: int) -> Tensor:
        random = torch.rand(*shape, generator=self.generator, device=self.generator.device)
        return (low + (high - low) * random).to(self.simulation.device)

    def _choice(self, chances: tuple[float, ...], count: int) -> Tensor:
        """Numbers (count,) drawn by their chances."""
        drawn = torch.multinomial(torch.tensor(chances), count, replacement=True, generator=self.generator)
        return drawn.to(self.simulation.device)

    def wander(self) -> None:
        """Let the horizontal error of the maps wander from one refresh to the next."""
        error, limit = self.state.map_error, self.config.map_drift
        step = min(DRIFT_STEP, limit) * self._uniform(-1.0, 1.0, len(error), 2)
        error[:, :2] = (error[:, :2] + step).clamp(-limit, limit)

    def delayed(self, target: Tensor) -> Tensor:
        """The targets (N, 29) [rad] that reach the motors now, of ``target`` (N, 29) and the ones before it."""
        sent = torch.cat([target[:, None], self.state.past_targets], dim=1)
        self.state.past_targets = sent[:, :-1]
        return sent[torch.arange(len(sent), device=sent.device), self.state.delay]

    def start(self, ids: Tensor, joint_position: Tensor) -> None:
        """Let robots ``ids`` (n,) begin with motors that hold ``joint_position`` (n, 29) [rad]."""
        self.state.past_targets[ids] = joint_position[:, None]

    def draw(self, ids: Tensor) -> None:
        """New parameters for the robots ``ids`` (n,)."""
        config, state, count = self.config, self.state, len(ids)
        rows = ids.cpu().numpy()
        state.friction[ids] = self._uniform(*config.friction, count, 1)
        state.added_mass[ids] = self._uniform(*config.added_mass, count, 2)
        state.joint_offset[ids] = self._uniform(-config.joint_offset, config.joint_offset, count, NUM_JOINTS)
        state.delay[ids] = self._choice(config.delay, count)
        carries = (self._uniform(0.0, 1.0, count, 1) < config.hand_load_probability).float()
        load = [self._uniform(*config.hand_payload, count), self._uniform(*config.hand_squeeze, count)]
        state.hand_load[ids] = torch.stack(load, -1) * carries
        if config.pushes:
            state.push_countdown[ids] = self._uniform(*config.push_interval, count)

        friction = self.simulation.per_robot("geom_friction")
        friction[rows[:, None], self._foot_geoms, 0] = state.friction[ids].cpu().numpy()
        if config.gain_scale != (1.0, 1.0):
            stiffness = self._uniform(*config.gain_scale, count, NUM_JOINTS).cpu().numpy()
            damping = self._uniform(*config.gain_scale, count, NUM_JOINTS).cpu().numpy()
            gain, bias = (
                self.simulation.per_robot("actuator_gainprm"),
                self.simulation.per_robot("actuator_biasprm"),
            )
            gain[rows, self._actuators, 0] = self._gain[None, self._actuators, 0] * stiffness
            bias[rows, self._actuators, 1] = self._bias[None, self._actuators, 1] * stiffness
            bias[rows, self._actuators, 2] = self._bias[None, self._actuators, 2] * damping
        limit = self.simulation.per_robot("actuator_forcerange")
        limit[rows, self._actuators] = config.effort_scale * self._effort[self._actuators]
        effort = self._uniform(*config.waist_effort, count, len(self._waist_motors)).cpu().numpy()
        effort *= config.effort_scale
        limit[rows[:, None], self._waist_motors, 0] = -effort
        limit[rows[:, None], self._waist_motors, 1] = effort
        if config.added_mass != (0.0, 0.0) or config.center_of_mass_shift > 0.0:
            self._write_inertia(ids, rows)
        spread = torch.tensor([config.map_drift, config.map_drift, config.map_offset], device=ids.device)
        state.map_error[ids] = spread * self._uniform(-1.0, 1.0, count, 3)
        state.map_delay[ids] = self._choice(config.map_delay, count)

    def _write_inertia(self, ids: Tensor, rows: np.ndarray) -> None:
        mass = self._nominal_mass + self.state.added_mass[ids].cpu().numpy()
        shift = self.config.center_of_mass_shift
        moved = self._uniform(-shift, shift, len(rows), len(self._bodies), 3).cpu().numpy()
        cells = (rows[:, None], self._bodies)
        self.simulation.per_robot("body_mass")[cells] = mass
        ratio = (mass / self._nominal_mass)[..., None]
        self.simulation.per_robot("body_inertia")[cells] = self._nominal_inertia * ratio
        self.simulation.per_robot("body_ipos")[cells] = self._nominal_center + moved
        self.simulation.update_constants(ids)

    def disturb(self, robot: RobotState, heading: Tensor, walking: Tensor) -> tuple[Tensor, Tensor]:
        """Apply hand loads and due pushes for the next step; ``walking`` (N,): whether the gait clock runs.

        Returns:
            hand forces (N, 2, 3) [N], heading frame, and which robots were pushed (N,).
        """
        state, config = self.state, self.config
        force = torch.zeros(len(heading), 2, 3, device=heading.device)
        pushed = torch.zeros(len(heading), dtype=torch.bool, device=heading.device)
        # Those of an episode that began under other conditions too.
        if config.hand_load_probability > 0.0 or bool((state.hand_load != 0.0).any()):
            force = hand_forces(robot.palm_position, outward=-state.hand_load[:, 1], downward=state.hand_load[:, 0])
            self.simulation.set_hand_force(force)
        if config.pushes:
            state.push_countdown -= self.simulation.control_period
            due = state.push_countdown <= 0.0
            if due.any():
                largest = torch.where(walking, config.push_velocity, config.standing_push_velocity) * due
                change = self._uniform(-1.0, 1.0, len(due), 3) * largest[:, None]
                change[:, 2] = 0.0
                self.simulation.push(change)
                pushed = due
                state.push_countdown = torch.where(
                    due, self._uniform(*config.push_interval, len(due)), state.push_countdown
                )
        return rotate_about_vertical(-heading[:, None], force), pushed
