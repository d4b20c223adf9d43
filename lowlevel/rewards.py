"""Rewards: the paper's Table I as a table of pure functions, and additions listed as additions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cached_property

import torch
from torch import Tensor

from lowlevel.commands import STANDING_SPEED, is_walking
from lowlevel.runs.checks import NonFiniteError
from lowlevel.world.measures import Measurement, arm_error, height_error, stumbles, torso_error, velocity_error
from robots.g1.constants import EFFORT, joint_index


@dataclass(frozen=True)
class RewardWeights:
    """Weight per second of each term; names are those of :data:`REWARD_TERMS`. Zero: the term is not computed."""

    # Table I, task rewards
    linear_velocity: float = 1.5
    angular_velocity: float = 2.0
    base_height: float = 1.0
    torso_orientation: float = 1.0
    upper_body_position: float = 1.0
    termination: float = -200.0
    # Table I, regularization
    action_rate: float = -0.01
    energy: float = -0.001
    joint_deviation: float = -0.5
    feet_stumble: float = -1.0
    feet_air_time: float = 1.0
    feet_slippage: float = -0.25
    large_feet_force: float = -0.005
    no_fly: float = 0.75
    # Additions to the paper: tracking near its goal
    linear_velocity_fine: float = 0.0
    angular_velocity_fine: float = 0.0
    velocity_progress: float = 0.0
    mean_linear_velocity: float = 0.0
    mean_angular_velocity: float = 0.0
    capture_point: float = 0.0
    # Additions: the shape of a gait
    foot_phase: float = 0.0
    contact_schedule: float = 0.0
    swing_height: float = 0.0
    foot_placement: float = 0.0
    alive: float = 0.0
    # Additions: what nothing above forbids
    vertical_velocity: float = 0.0
    base_motion: float = 0.0
    low_swing: float = 0.0
    feet_close: float = 0.0
    stand_still: float = 0.0
    torque_limits: float = 0.0


@dataclass(frozen=True)
class Transition:
    """Everything a reward term may look at; tensors have one row per robot."""

    measured: Measurement
    command: Tensor
    flag: Tensor
    action: Tensor
    previous_action: Tensor
    nominal_target: Tensor
    phase: Tensor
    walking: Tensor
    """Whether the gait clock runs (N,)."""
    gait_frequency: float
    foot_air_time: Tensor
    foot_contact_time: Tensor
    mean_velocity_error: Tensor
    """Running mean of the velocity error (N, 3) [m/s, m/s, rad/s]."""
    fallen: Tensor

    @cached_property
    def torso_error(self) -> Tensor:
        """As :func:`lowlevel.world.measures.torso_error` has it (N, 3) [rad]."""
        return torso_error(self.measured, self.command)


def laplace(error: Tensor, width: float) -> Tensor:
    """1 without error, 1/e at ``width``. Unlike a Gaussian it keeps its slope down to the goal."""
    return torch.exp(-error.abs() / width)


def gaussian(squared_error: Tensor, variance: float) -> Tensor:
    """1 without error, 1/e at a squared error of ``variance``."""
    return torch.exp(-squared_error / variance)


def linear_velocity(t: Transition, width: float = 0.3) -> Tensor:
    """Tracking of the commanded vx and vy; ``width`` [m/s].

    A Gaussian of standard deviation 0.5 m/s pays 0.7 to a robot that marches in place when told to walk at 0.3 m/s.
    """
    return laplace(velocity_error(t.measured, t.command)[:, :2].norm(dim=-1), width)


def angular_velocity(t: Transition, width: float = 0.5) -> Tensor:
    """Tracking of the commanded yaw rate; ``width`` [rad/s]: it still has a slope for a robot that shakes."""
    return laplace(velocity_error(t.measured, t.command)[:, 2], width)


def base_height(t: Transition, width: float = 0.05) -> Tensor:
    """Tracking of the commanded pelvis height; ``width`` [m]."""
    return laplace(height_error(t.measured, t.command), width)


def torso_orientation(t: Transition, width: float = 0.3) -> Tensor:
    """Tracking of the commanded torso attitude; ``width`` [rad], of the three errors' sum."""
    return laplace(t.torso_error.abs().sum(-1), width)


def upper_body_position(t: Transition, width: float = 1.0) -> Tensor:
    """Tracking of the commanded arms; ``width`` [rad], of all errors' sum, a third of which counts when I = 0."""
    strictness = 0.3 + 0.7 * t.flag[:, 0]
    return laplace(strictness * arm_error(t.measured, t.command).abs().sum(-1), width)


def termination(t: Transition) -> Tensor:
    """One on a fall."""
    return t.fallen.float()


def action_rate(t: Transition) -> Tensor:
    """Squared change of the action."""
    return (t.action - t.previous_action).square().sum(-1)


def energy(t: Transition) -> Tensor:
    """Mechanical power of all joints [W]."""
    return (t.measured.robot.joint_torque * t.measured.robot.joint_velocity).abs().sum(-1)


_HIPS = [joint_index(f"{side}_hip_{axis}_joint") for side in ("left", "right") for axis in ("roll", "yaw")]


def joint_deviation(t: Transition) -> Tensor:
    """Distance of hip roll and yaw joints from their nominal targets [rad]."""
    return (t.measured.robot.joint_position - t.nominal_target)[:, _HIPS].abs().sum(-1)


def feet_stumble(t: Transition) -> Tensor:
    """A loaded foot is pushed sideways at least as hard as upwards."""
    return stumbles(t.measured).float()


def feet_air_time(t: Transition) -> Tensor:
    """Time both feet have kept their roles in single support, up to 0.4 s (Isaac Lab's biped form)."""
    single_support = t.measured.foot_contact.sum(-1) == 1
    in_role = torch.where(t.measured.foot_contact, t.foot_contact_time, t.foot_air_time).amin(dim=1)
    return in_role.clamp(max=0.4) * single_support * is_walking(t.command)


def feet_slippage(t: Transition) -> Tensor:
    """Horizontal speed of loaded feet [m/s]."""
    return (t.measured.foot_velocity[..., :2].norm(dim=-1) * t.measured.foot_contact).sum(-1)


def large_feet_force(t: Transition) -> Tensor:
    """Contact force beyond 1.5 times the body weight [N], at most 400 N a foot."""
    return (t.measured.foot_force.norm(dim=-1) - 500.0).clamp(0.0, 400.0).sum(-1)


def no_fly(t: Transition) -> Tensor:
    """Exactly one foot on the ground while the gait clock runs, both while standing."""
    return (t.measured.foot_contact.sum(-1) == torch.where(t.walking, 1, 2)).float()


SWING_HEIGHT = 0.08
"""Height of the sole at mid-swing [m]. With 12 cm the pelvis turned more with every step, and walking cost more."""
STANCE_WIDTH = 0.18
"""Distance of the feet across the heading [m]; that of the hips is 0.24, but the pelvis sways with it."""


def _lift(t: Transition) -> Tensor:
    """Sine of each foot's swing (N, 2): 1 at mid-swing, negative in stance, 0 while standing."""
    sine = torch.sin(t.phase)
    return torch.stack([sine, -sine], dim=-1) * t.walking[:, None]


def _feet_apart(t: Transition) -> Tensor:
    """Left foot minus right foot in the heading frame (N, 2) [m]."""
    feet = t.measured.foot_position[..., :2]
    return feet[:, 0] - feet[:, 1]


def foot_phase(t: Transition, variance: float = 0.005) -> Tensor:
    """Kernel on the sole heights against the gait clock, ``variance`` [m^2]: swing foot up, stance foot down."""
    wanted = SWING_HEIGHT * _lift(t).clamp_min(0.0).square()
    return gaussian((t.measured.foot_clearance - wanted).square().sum(-1), variance)


def contact_schedule(t: Transition) -> Tensor:
    """Share of the feet that are loaded when the gait clock has them in stance, and only then."""
    return (t.measured.foot_contact != (_lift(t) > 0.0)).float().mean(-1)


def swing_height(t: Transition, height: float = SWING_HEIGHT) -> Tensor:
    """How far swinging feet are lifted, as a share of ``height`` [m]."""
    return ((t.measured.foot_clearance / height).clamp(0.0, 1.0) * (_lift(t) > 0.3)).sum(-1)


def _sweep(phase: Tensor) -> Tensor:
    """Where a foot is along its step, -1 behind to 1 ahead: it swings in (0, pi) and stays in (pi, 2 pi)."""
    phase = torch.remainder(phase, 2.0 * torch.pi)
    return torch.where(phase < torch.pi, -torch.cos(phase), 3.0 - 2.0 * phase / torch.pi)


def foot_placement(t: Transition, variance: float = 0.02) -> Tensor:
    """Kernel on the distance of the feet against the one that the told velocity needs, ``variance`` [m^2]."""
    stride = (_sweep(t.phase) - _sweep(t.phase + torch.pi)) / (4.0 * t.gait_frequency)
    wanted = t.command[:, :2] * stride[:, None]
    wanted[:, 1] += STANCE_WIDTH
    error = (_feet_apart(t) - wanted).square().sum(-1)
    return torch.where(t.walking, gaussian(error, variance), 1.0)


def alive(t: Transition) -> Tensor:
    """One unless the robot falls."""
    return 1.0 - t.fallen.float()


def linear_velocity_fine(t: Transition, variance: float = 0.04) -> Tensor:
    """Narrow Gaussian kernel on the horizontal velocity error, ``variance`` [m^2/s^2]."""
    return gaussian(velocity_error(t.measured, t.command)[:, :2].square().sum(-1), variance)


def angular_velocity_fine(t: Transition, variance: float = 0.04) -> Tensor:
    """Narrow Gaussian kernel on the yaw rate error, ``variance`` [rad^2/s^2]."""
    return gaussian(velocity_error(t.measured, t.command)[:, 2].square(), variance)


def mean_linear_velocity(t: Transition, width: float = 0.4) -> Tensor:
    """Tracking of vx and vy on average; ``width`` [m/s].

    The pelvis sways by as much with every step: at once, a drift of 0.1 m/s hardly changes the kernels above, and one
    of 0.3 m/s has left them.
    """
    return laplace(t.mean_velocity_error[:, :2].norm(dim=-1), width)


def mean_angular_velocity(t: Transition, width: float = 0.4) -> Tensor:
    """Tracking of the yaw rate on average; ``width`` [rad/s]."""
    return laplace(t.mean_velocity_error[:, 2], width)


def capture_point(t: Transition, width: float = 0.1) -> Tensor:
    """Balance of a robot told to stand: the capture point over the middle of the feet; ``width`` [m].

    A robot that topples over feet at rest drifts for a second before anything else tells that it does. The steps by
    which it catches itself count, too: else toppling would pay.
    """
    return torch.where(is_walking(t.command), 1.0, laplace(t.measured.capture_point.norm(dim=-1), width))


def vertical_velocity(t: Transition) -> Tensor:
    """Squared vertical velocity of the pelvis while walking [m^2/s^2]; a squat is no fault."""
    return t.measured.linear_velocity[:, 2].square() * t.walking


def low_swing(t: Transition, height: float = SWING_HEIGHT) -> Tensor:
    """Horizontal speed of the feet [m/s] times the squared share of ``height`` [m] that they lack.

    A kernel on heights pays a foot for being high at mid-swing; what runs into an edge is one that is still fast when
    it is low again.
    """
    lacking = (1.0 - t.measured.foot_clearance / height).clamp(0.0, 1.0)
    return (lacking.square() * t.measured.foot_velocity[..., :2].norm(dim=-1)).sum(-1)


def feet_close(t: Transition, distance: float = 0.15) -> Tensor:
    """How much closer than ``distance`` [m] the feet are across the heading [m]."""
    return (distance - _feet_apart(t)[:, 1]).clamp(0.0, 0.3)


def stand_still(t: Transition) -> Tensor:
    """Squared velocity of a robot told to stand [m^2/s^2, rad^2/s^2]: kernels have no slope at their top."""
    moving = t.measured.linear_velocity[:, :2].square().sum(-1) + t.measured.yaw_rate.square()
    return moving * ~t.walking


def torque_limits(t: Transition, share: float = 0.8) -> Tensor:
    """Torques beyond ``share`` of the motors' nominal limits, as a share of them, summed over joints."""
    effort = torch.tensor(EFFORT, dtype=torch.float32, device=t.phase.device)
    return (t.measured.robot.joint_torque.abs() / effort - share).clamp_min(0.0).sum(-1)


def base_motion(t: Transition) -> Tensor:
    """Squared roll and pitch rates of the pelvis [rad^2/s^2]."""
    return t.measured.robot.base_angular_velocity[:, :2].square().sum(-1)


def velocity_progress(t: Transition) -> Tensor:
    """Velocity along the command over the commanded speed, in [0, 1]; 1 where no horizontal velocity is commanded.

    The tracking kernels are flat far from their goal: at 0.2 m/s of commanded 1.0 they hardly pay for speed.
    """
    wanted = t.command[:, :2]
    speed = wanted.norm(dim=-1).clamp_min(STANDING_SPEED)
    along = (t.measured.linear_velocity[:, :2] * wanted).sum(-1) / speed.square()
    return torch.where(wanted.norm(dim=-1) < STANDING_SPEED, 1.0, along.clamp(0.0, 1.0))


REWARD_TERMS: dict[str, Callable[[Transition], Tensor]] = {
    field.name: globals()[field.name] for field in fields(RewardWeights)
}
"""Terms by name."""


QUALITY_TERMS = (linear_velocity, angular_velocity, base_height, torso_orientation)
"""Tracking of velocity, height and attitude as kernels in [0, 1], whatever they weigh in the reward."""


def tracking_quality(transition: Transition) -> Tensor:
    """Quality of tracking in [0, 1] (N,), by which commands open."""
    return torch.stack([term(transition) for term in QUALITY_TERMS]).mean(dim=0)


def compute_rewards(
    transition: Transition, weights: RewardWeights, control_period: float
) -> tuple[Tensor, dict[str, Tensor]]:
    """Weighted sum (N,) and the unweighted terms, each (N,).

    Raises:
        NonFiniteError: naming the term and the robot, if a term is not finite.
    """
    total = torch.zeros(len(transition.command), device=transition.command.device)
    terms = {}
    for field in fields(weights):
        weight = getattr(weights, field.name)
        if weight == 0.0:
            continue
        value = REWARD_TERMS[field.name](transition)
        terms[field.name] = value
        total += weight * control_period * value
    if not torch.isfinite(total).all():
        for name, value in terms.items():
            bad = torch.nonzero(~torch.isfinite(value))[:, 0]
            if len(bad):
                raise NonFiniteError(f"reward term {name!r} is not finite for robot {int(bad[0])}")
    return total, terms
