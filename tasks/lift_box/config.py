"""Everything about lift-box that can be chosen. The paper states none of it, so all of it is a choice."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

Range = tuple[float, float]


@dataclass(frozen=True)
class SpawnConfig:
    """What an episode begins with; ranges are drawn uniformly."""

    edge: Range = (0.25, 0.35)
    """Each edge of the box, independently [m]."""
    mass: Range = (0.5, 2.0)
    """[kg]"""
    center_of_mass: float = 0.02
    """Half range of the offset of the center of mass, per axis [m]."""
    friction: Range = (0.5, 1.2)
    """Sliding friction of the palms."""
    floor_share: float = 0.5
    """Share of episodes with the box on the floor; in the others it stands on a block."""
    support_height: Range = (0.10, 0.30)
    """Height of the block [m]."""
    distance: Range = (0.8, 2.0)
    """From the pelvis to the near face of the box [m]."""
    bearing: Range = (-0.785, 0.785)
    """Heading of the robot against its line of sight to the box [rad]."""
    box_yaw: float = 0.52
    """Half range of the box's yaw against the line of sight [rad]."""


@dataclass(frozen=True)
class NoiseConfig:
    """Error of the observed box pose: half of it stays for an episode, half is new at every decision."""

    position: float = 0.02
    """Half range, per axis [m]."""
    angle: float = 0.05
    """Half range, about each axis [rad]."""


@dataclass(frozen=True)
class PushConfig:
    """Pushes during an episode; none by default."""

    velocity: float = 0.0
    """Change of the pelvis' velocity, in a random horizontal direction [m/s]."""
    interval: float = 3.0
    """Time between pushes [s]."""


@dataclass(frozen=True)
class StageConfig:
    """When a stage counts as passed."""

    approach_distance: float = 0.45
    """Largest distance of the near face ahead of the pelvis [m]."""
    approach_lateral: float = 0.10
    """Largest lateral offset of its center [m]."""
    approach_yaw: float = 0.26
    """Largest yaw between robot and box [rad]."""
    approach_speed: float = 0.15
    """Largest speed of the pelvis [m/s]."""
    reach_distance: float = 0.04
    """Largest distance of a palm from its own side face [m]."""
    contact_on: float = 5.0
    """Normal force at which a palm begins to count as touching [N]."""
    contact_off: float = 2.0
    """Normal force at which it stops [N]."""
    contact_time: float = 0.2
    """Both palms must touch this long [s]."""
    lift_clearance: float = 0.10
    """Bottom of the box above its support [m]."""
    upright_height: float = 0.68
    """Least base height [m]."""
    upright_pitch: float = 0.25
    """Largest torso pitch [rad]."""
    carry_clearance: float = 0.30
    """Bottom of the box above its support when upright [m]."""
    hold_tilt: float = 0.52
    """Largest tilt of the held box [rad]."""
    hold_speed: float = 0.2
    """Largest speed of the pelvis while holding [m/s]."""
    hold_time: float = 1.5
    """Success: upright and held this long [s]."""
    drop_time: float = 0.4
    """A lifted box is dropped when it has lacked a palm this long [s]."""


@dataclass(frozen=True)
class RewardConfig:
    """Weights of the potential's terms and of the costs; costs are per decision of 0.1 s."""

    approach: float = 1.0
    posture: float = 0.5
    reach: float = 2.0
    grasp: float = 2.0
    lift: float = 4.0
    lift_margin: float = 0.08
    """Clearance beyond :attr:`StageConfig.carry_clearance` up to which a higher box is better [m]: with none, planners
    hold it on the threshold and let it sink."""
    upright: float = 3.0
    stream: float = 0.02
    """Share of the potential that is paid at every decision, beside its progress."""
    success: float = 20.0
    fall: float = -5.0
    drop: float = -2.0
    command_rate: float = -0.02
    """On the mean square of the command's change in units of the largest change, times 21."""
    over_force: float = -0.02
    """Per newton of palm force above :attr:`force_limit`."""
    force_limit: float = 60.0
    """[N]"""
    box_moved: float = -1.0
    """Per meter beyond 5 cm that the box has moved before it is grasped."""
    box_tilt: float = -0.5
    """Per radian of tilt beyond 0.5."""
    grasp_force: float = 15.0
    """Normal force per palm at which the grasp is complete [N]."""


@dataclass(frozen=True)
class LiftBoxConfig:
    """The task. ``control`` selects a negative control, which must make success impossible."""

    episode_length: float = 15.0
    """[s]"""
    control: Literal["none", "frictionless", "no_hands"] = "none"
    """``frictionless``: palms without friction; ``no_hands``: palms that touch nothing."""
    spawn: SpawnConfig = field(default_factory=SpawnConfig)
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    push: PushConfig = field(default_factory=PushConfig)
    stages: StageConfig = field(default_factory=StageConfig)
    rewards: RewardConfig = field(default_factory=RewardConfig)
