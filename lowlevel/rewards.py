"""Rewards: the paper's Table I as a table of pure functions, and additions listed as additions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cached_property

import torch
from torch import Tensor

from lowlevel.checks import NonFiniteError
from lowlevel.commands import STANDING_SPEED, is_walking
from lowlevel.measures import Measurement, arm_error, height_error, stumbles, torso_error, velocity_error
from robots.g1.constants import joint_index


@dataclass(frozen=True)
class RewardWeights:
    """Weight per second of each term; names are those of :data:`REWARD_TERMS`."""

    # Table I, task rewards; the paper's own weights are PAPER_WEIGHTS
    linear_velocity: float = 6.0
    angular_velocity: float = 6.0
    base_height: float = 3.5
    torso_orientation: float = 3.0
    upper_body_position: float = 2.0
    termination: float = -200.0
    # Table I, regularisation
    action_rate: float = -0.01
    energy: float = -0.001
    joint_deviation: float = -0.2
    feet_stumble: float = -1.0
    feet_air_time: float = 2.0
    feet_slippage: float = -1.0
    large_feet_force: float = -0.005
    no_fly: float = 0.75
    # Additions to the paper
    foot_phase: float = 2.0
    """Feet follow the gait clock: swing foot up, stance foot down."""
    base_motion: float = -0.05
    """Tumbling motion of the pelvis."""
    velocity_progress: float = 4.0
    """Share of the commanded horizontal velocity that is reached, up to all of it."""


PAPER_WEIGHTS = RewardWeights(
    linear_velocity=1.5,
    angular_velocity=2.0,
    base_height=1.0,
    torso_orientation=1.0,
    upper_body_position=1.0,
    velocity_progress=1.0,
)
"""The paper's weights where the defaults are others: tracking counts for more here, and with it what is added to it."""


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
    foot_air_time: Tensor
    foot_contact_time: Tensor
    fallen: Tensor

    @cached_property
    def torso_error(self) -> Tensor:
        """As :func:`lowlevel.measures.torso_error` has it (N, 3) [rad]."""
        return torso_error(self.measured, self.command)


def linear_velocity(t: Transition) -> Tensor:
    """Laplace kernel on the horizontal velocity error, scale 0.3 m/s.

    A Gaussian of standard deviation 0.5 m/s pays 0.7 to a robot that marches in place when told to walk at 0.3 m/s.
    """
    return torch.exp(-velocity_error(t.measured, t.command)[:, :2].norm(dim=-1) / 0.3)


def angular_velocity(t: Transition) -> Tensor:
    """Laplace kernel on the yaw rate error, scale 0.5 rad/s: it still has a slope for a robot that shakes."""
    return torch.exp(-velocity_error(t.measured, t.command)[:, 2].abs() / 0.5)


def base_height(t: Transition) -> Tensor:
    """Laplace kernel on the base height error, scale 5 cm: it keeps its slope down to the last millimetre."""
    return torch.exp(-height_error(t.measured, t.command).abs() / 0.05)


def torso_orientation(t: Transition) -> Tensor:
    """Laplace kernel on the torso attitude error, scale 0.3 rad."""
    return torch.exp(-t.torso_error.abs().sum(-1) / 0.3)


def upper_body_position(t: Transition) -> Tensor:
    """Laplace kernel on the summed arm error, scale 1 rad; a third of the error counts when I = 0."""
    strictness = 0.3 + 0.7 * t.flag[:, 0]
    return torch.exp(-strictness * arm_error(t.measured, t.command).abs().sum(-1))


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
    """A loaded foot is pushed sideways harder than upwards."""
    return stumbles(t.measured).float()


def feet_air_time(t: Transition) -> Tensor:
    """Time both feet have kept their roles in single support, up to 0.4 s (Isaac Lab's biped form)."""
    single_support = t.measured.foot_contact.sum(-1) == 1
    in_role = torch.where(t.measured.foot_contact, t.foot_contact_time, t.foot_air_time).amin(dim=1)
    return in_role.clamp(max=0.4) * single_support * is_walking(t.command)


def feet_slippage(t: Transition) -> Tensor:
    """Horizontal speed of loaded feet [m/s]."""
    return (t.measured.robot.foot_velocity[..., :2].norm(dim=-1) * t.measured.foot_contact).sum(-1)


def large_feet_force(t: Transition) -> Tensor:
    """Contact force beyond 1.5 times the body weight [N], at most 400 N a foot."""
    return (t.measured.robot.foot_force.norm(dim=-1) - 500.0).clamp(0.0, 400.0).sum(-1)


def no_fly(t: Transition) -> Tensor:
    """Exactly one foot on the ground while marching, both while standing."""
    return (t.measured.foot_contact.sum(-1) == torch.where(t.walking > 0.0, 1, 2)).float()


SWING_HEIGHT = 0.08
"""Height of the sole at mid-swing that :func:`foot_phase` asks for [m]."""


def foot_phase(t: Transition) -> Tensor:
    """Kernel on the sole heights against the gait clock, variance 0.005 m^2."""
    lift = torch.stack([torch.sin(t.phase), -torch.sin(t.phase)], dim=-1).clamp_min(0.0).square()
    wanted = SWING_HEIGHT * lift * t.walking[:, None]
    return torch.exp(-(t.measured.foot_clearance - wanted).square().sum(-1) / 0.005)


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
    term.__name__: term
    for term in (
        linear_velocity,
        angular_velocity,
        base_height,
        torso_orientation,
        upper_body_position,
        termination,
        action_rate,
        energy,
        joint_deviation,
        feet_stumble,
        feet_air_time,
        feet_slippage,
        large_feet_force,
        no_fly,
        foot_phase,
        base_motion,
        velocity_progress,
    )
}


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
