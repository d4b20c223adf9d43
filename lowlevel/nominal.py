"""What the action is a residual on: reference filter, gait clock, and nominal joint targets.

The paper adds the policy's arm output to the commanded arm joints (III-B-2). Here the same is done for legs and
waist, as additions to the paper: their nominal target comes from the nominal-pose table; a feed-forward march lifts
the swing leg in time with a gait clock; and ankles and steps lean against tilt, so that the zero action already
stands and marches. The march outlasts a command to stop until the robot has slowed down, and a standing robot that
tips over marches to catch itself. The training environment and the frozen controller share this module, so they
cannot drift apart.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from lowlevel.commands import ARMS, COMMAND_SIZE, HEIGHT, POSTURE, TORSO, VELOCITY, is_walking
from lowlevel.rotations import about_axis, conjugate, from_roll_pitch_yaw, multiply, rotate, rotate_inverse
from robots.g1.arm_mass import ArmMass
from robots.g1.constants import (
    ARM_JOINTS,
    DEFAULT_POSITION,
    LEG_JOINTS,
    LOWER_JOINTS,
    NUM_JOINTS,
    SIDES,
    TOTAL_MASS,
    WAIST_JOINTS,
    Gains,
    joint_index,
)
from robots.g1.nominal_pose import NominalPose

GRAVITY = 9.81
"""[m/s^2]"""
_HIP_PITCH = [joint_index(f"{side}_hip_pitch_joint") for side in SIDES]
_WAIST_AGAINST_LEAN = ("waist_pitch_joint", "waist_roll_joint")
"""Waist joints that undo a lean along x (forwards) and along y (to the left)."""


@dataclass(frozen=True)
class NominalConfig:
    """Nominal motion that the policy's action corrects."""

    kind: Literal["default", "pose", "march"] = "march"
    """``default``: legs and waist around the default pose; ``pose``: around the nominal-pose table;
    ``march``: the table plus a feed-forward march while walking."""
    gait_clock: bool = True
    """Show the gait clock to the policy (sine and cosine, zero while standing); an addition to the paper."""
    gait_frequency: float = 2.0
    """Steps of one foot per second [Hz]."""
    velocity_rate: float = 1.0
    """Slew rate of the velocity reference [m/s^2] and [rad/s^2]: steps go on until the robot has slowed down."""
    height_rate: float = 0.25
    """Slew rate of the base height reference [m/s]."""
    torso_rate: float = 1.0
    """Slew rate of the torso attitude reference [rad/s]."""
    arm_rate: float = 4.0
    """Slew rate of the arm reference [rad/s]."""
    walking_ramp: float = 0.3
    """Time over which the march fades in and out [s]."""
    knee_lift: float = 0.76
    """Knee flexion at mid-swing [rad]; hip and ankle take half of it back."""
    lateral_shift: float = 0.035
    """Amplitude of the hip roll that moves the pelvis over the stance foot [rad]."""
    stride: tuple[float, float, float] = (0.1, 0.14, 0.18)
    """Hip swing per commanded vx, vy [rad per m/s] and yaw rate [rad per rad/s]. A foot that lands half a step ahead
    of the hip keeps the speed; one further ahead brakes."""
    carry_arms: bool = True
    """Shift the pelvis against the arms' weight and bear its moment; False: as if the arms hung at their default."""
    largest_shift: float = 0.08
    """Largest such shift along x and along y [m]."""
    balance_stiffness: float = 2.5
    """Ankle correction per tilt of the pelvis off its nominal attitude [rad/rad]; 0 switches the strategy off."""
    balance_damping: float = 0.2
    """Ankle correction per tilt rate [rad per rad/s]."""
    step_stiffness: float = 1.5
    """While marching: hip correction per tilt [rad/rad]; the swing foot steps towards the fall, the stance hip
    rights the body."""
    step_damping: float = 0.27
    """Hip correction per tilt rate [rad per rad/s]; 0.27 s is the time constant of a 0.7 m inverted pendulum."""
    lean: tuple[float, float] = (0.28, 0.52)
    """Lean of the pelvis that counts as upright while walking, per commanded vx and vy [rad per m/s]: steps that
    chase it carry the robot along."""
    largest_lean: float = 0.33
    """Largest lean along x and along y [rad]."""
    stepping_threshold: float = 0.3
    """Unbalance (:meth:`NominalMotion.joint_targets`) from which a standing robot marches to catch itself [rad]."""
    stepping_time: float = 0.8
    """How long it then marches [s]."""
    stepping_height: float = 0.55
    """Lowest base height reference at which it does: a deep squat leaves the legs no room [m]."""
    stepping_torso: tuple[float, float, float] = (0.2, 0.5, 0.5)
    """Largest torso roll, pitch and yaw references at which it does [rad]."""


@dataclass
class NominalState:
    """State of the reference filter and gait clock; one row per robot."""

    reference: Tensor
    """Slewed command (N, 21)."""
    phase: Tensor
    """Gait phase (N,) [rad]; the left foot swings in (0, pi), the right one in (pi, 2 pi)."""
    walking: Tensor
    """Fade-in of the march (N,) in [0, 1]."""
    stepping: Tensor
    """Time for which a robot told to stand still marches to catch itself (N,) [s]."""


class NominalMotion:
    """Advances references and turns them into nominal joint targets; holds no per-robot state itself."""

    def __init__(
        self,
        config: NominalConfig,
        gains: Gains,
        control_period: float,
        device: torch.device | str = "cpu",
        pose: NominalPose | None = None,
    ) -> None:
        """``pose`` is the nominal-pose table, the package's own by default."""
        self.config = config
        self.control_period = control_period
        self.pose = NominalPose.load(device) if pose is None else pose
        self.default = torch.tensor(DEFAULT_POSITION, dtype=torch.float32, device=device)
        stiffness = torch.tensor(gains.stiffness[LOWER_JOINTS], dtype=torch.float32, device=device)
        self._inverse_stiffness = 1.0 / stiffness
        rate = torch.full((COMMAND_SIZE,), math.inf, device=device)
        rate[VELOCITY], rate[HEIGHT] = config.velocity_rate, config.height_rate
        rate[TORSO], rate[ARMS] = config.torso_rate, config.arm_rate
        self.arm_mass = ArmMass(device)
        self._default_moment = self.arm_mass.first_moment(self.default[None, ARM_JOINTS])
        self._unit = torch.eye(3, device=device)
        self._stepping_torso = torch.tensor(config.stepping_torso, device=device)
        self._stride = torch.tensor(config.stride, device=device)
        self._largest_change = rate * control_period

    def initial_state(self, command: Tensor) -> NominalState:
        """References at their goal, phase zero, standing."""
        count = len(command)
        zeros = torch.zeros(count, device=command.device)
        return NominalState(command.clone(), zeros, zeros.clone(), zeros.clone())

    def clamp(self, command: Tensor) -> Tensor:
        """Move the posture of ``command`` (N, 21) into the feasible region; everything else is unchanged."""
        clamped = command.clone()
        clamped[:, POSTURE] = self.pose.clamp(command[:, POSTURE])
        return clamped

    def advance(self, state: NominalState, command: Tensor, unbalance: Tensor) -> NominalState:
        """One control step of reference filter and gait clock towards ``command`` (N, 21).

        ``unbalance`` (N,) [rad]: as the last :meth:`joint_targets` found it.
        """
        change = (command - state.reference).clamp(-self._largest_change, self._largest_change)
        reference = state.reference + change
        # A march sways by as much, so only one that fades out starts anew; so does a move to another posture.
        loses_balance = (unbalance > self.config.stepping_threshold) & (state.walking <= 0.5)
        rests = (reference[:, POSTURE] == command[:, POSTURE]).all(dim=1)
        is_upright = (reference[:, TORSO].abs() <= self._stepping_torso).all(dim=1)
        is_tall = reference[:, HEIGHT] >= self.config.stepping_height
        steps = loses_balance & rests & is_upright & is_tall
        remaining = (state.stepping - self.control_period).clamp_min(0.0)
        stepping = torch.where(steps, self.config.stepping_time, remaining)
        walks = is_walking(command) | is_walking(reference) | (stepping > 0.0)
        fade = self.control_period / self.config.walking_ramp
        walking = (state.walking + torch.where(walks, fade, -fade)).clamp(0.0, 1.0)
        step = 2.0 * math.pi * self.config.gait_frequency * self.control_period
        moves = walking > 0.0
        phase = torch.where(moves, (state.phase + step) % (2.0 * math.pi), torch.zeros_like(state.phase))
        return NominalState(reference, phase, walking, stepping)

    def clock(self, state: NominalState) -> Tensor:
        """Gait clock as the policy sees it (N, 2): sine and cosine of the phase, faded out at rest."""
        if not self.config.gait_clock:
            return torch.zeros(len(state.phase), 2, device=state.phase.device)
        return torch.stack([torch.sin(state.phase), torch.cos(state.phase)], -1) * state.walking[:, None]

    def pelvis_attitude(self, torso: Tensor, waist: Tensor) -> Tensor:
        """Pelvis quaternion (N, 4) in the heading frame that puts the torso at ``torso`` (N, 3; roll, pitch, yaw).

        ``waist`` (N, 3): waist joints in the order of the joint table, yaw, roll, pitch [rad].
        """
        yaw, roll, pitch = waist.unbind(-1)
        tilted = multiply(about_axis(0, roll), about_axis(1, pitch))
        return multiply(from_roll_pitch_yaw(torso), conjugate(multiply(about_axis(2, yaw), tilted)))

    def joint_targets(
        self, state: NominalState, projected_gravity: Tensor, base_angular_velocity: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Nominal PD targets (N, 29) [rad], gravity compensated by the table's static torques, and unbalance (N,).

        Unbalance [rad] is the tilt off the nominal attitude plus ``step_damping`` times the tilt rate: where the body
        is heading. It is zero without the balance strategy.

        They may lie beyond the joint limits: a joint that rests at its limit needs such a target to push against it.

        ``projected_gravity`` (N, 3) and ``base_angular_velocity`` (N, 3) [rad/s] as measured, pelvis frame.
        """
        targets = self.default.expand(len(state.phase), NUM_JOINTS).clone()
        targets[:, ARM_JOINTS] = state.reference[:, ARMS]
        unbalance = torch.zeros_like(state.phase)
        if self.config.kind == "default":
            return targets, unbalance
        position, torque, shift = self.pose.lookup(state.reference[:, POSTURE])
        if self.config.carry_arms:
            position, torque = self._carry_arms(state.reference, position, torque, shift)
        targets[:, LOWER_JOINTS] = position + torque * self._inverse_stiffness
        if self.config.kind == "march":
            self._add_march(targets, state)
        if self.config.balance_stiffness > 0.0:
            attitude = self.pelvis_attitude(state.reference[:, TORSO], position[:, WAIST_JOINTS])
            unbalance = self._add_balance(targets, state, attitude, projected_gravity, base_angular_velocity)
        return targets, unbalance

    def _carry_arms(self, reference: Tensor, position: Tensor, torque: Tensor, shift: Tensor) -> tuple[Tensor, Tensor]:
        """Positions and gravity torques (N, 15) for arms that are not at their default, as the table assumes.

        The pelvis moves until the centre of mass is back where the table has it; waist and hips bear the moment.
        """
        moment = self.arm_mass.first_moment(reference[:, ARMS]) - self._default_moment
        torso = from_roll_pitch_yaw(reference[:, TORSO])
        offset = -rotate(torso, moment)[:, :2] / TOTAL_MASS
        offset = offset.clamp(-self.config.largest_shift, self.config.largest_shift)
        position = position.clone()
        position[:, LEG_JOINTS] += torch.einsum("njk,nk->nj", shift, offset)

        weight = torch.zeros_like(moment)
        weight[:, 2] = -GRAVITY
        load = torch.linalg.cross(moment, rotate_inverse(torso, weight))
        _, roll, pitch = position[:, WAIST_JOINTS].unbind(1)
        to_torso = about_axis(1, -pitch)
        roll_axis = rotate(to_torso, self._unit[0].expand_as(load))
        yaw_axis = rotate(to_torso, rotate(about_axis(0, -roll), self._unit[2].expand_as(load)))
        torque = torque.clone()
        torque[:, WAIST_JOINTS] -= torch.stack(
            [(yaw_axis * load).sum(-1), (roll_axis * load).sum(-1), load[:, 1]], dim=1
        )
        torque[:, _HIP_PITCH] += 0.5 * rotate(torso, load)[:, 1:2]
        return position, torque

    def _add_march(self, targets: Tensor, state: NominalState) -> None:
        config = self.config
        sine, cosine = torch.sin(state.phase), torch.cos(state.phase)
        forwards, sideways, turn = (state.reference[:, VELOCITY] * self._stride).unbind(-1)
        for side, sign in (("left", 1.0), ("right", -1.0)):
            lift = config.knee_lift * (sign * sine).clamp_min(0.0) * state.walking
            # The swing foot travels from behind to ahead of the hip: its offset goes with -cos(phase).
            swing = -sign * cosine * state.walking
            pitch = -swing * forwards - 0.5 * lift
            roll = config.lateral_shift * sine * state.walking
            offsets = {
                "hip_pitch": pitch,
                "hip_roll": roll + swing * sideways,
                "hip_yaw": swing * turn,
                "knee": lift,
                "ankle_pitch": -pitch - lift,
                "ankle_roll": -roll - swing * sideways,
            }
            for joint, offset in offsets.items():
                targets[:, joint_index(f"{side}_{joint}_joint")] += offset

    def _add_balance(
        self,
        targets: Tensor,
        state: NominalState,
        attitude: Tensor,
        gravity: Tensor,
        angular_velocity: Tensor,
    ) -> Tensor:
        """Lean against the pelvis' tilt off its nominal ``attitude`` with the ankles and, marching, with steps.

        The capture point of a falling pendulum lies in the direction of tilt + rate * sqrt(height / g) (Pratt et al.,
        Humanoids 2006), so the swing hip moves the foot that way. Returns the unbalance (N,), see
        :meth:`joint_targets`.
        """
        config = self.config
        down = torch.zeros_like(gravity)
        down[:, 2] = -1.0
        wanted = rotate_inverse(attitude, down)
        for axis, lean in enumerate(config.lean):
            angle = (lean * state.reference[:, axis]).clamp(-config.largest_lean, config.largest_lean) * state.walking
            wanted[:, axis] += angle
            # The waist takes the lean back, so that the torso keeps its commanded attitude.
            targets[:, joint_index(_WAIST_AGAINST_LEAN[axis])] += (-angle, angle)[axis]
        tilt = torch.linalg.cross(gravity, wanted)
        ankle = config.balance_stiffness * tilt + config.balance_damping * angular_velocity
        capture = config.step_stiffness * tilt + config.step_damping * angular_velocity
        swing = torch.sin(state.phase) * state.walking
        for side, sign in (("left", 1.0), ("right", -1.0)):
            for axis, direction in ((0, "roll"), (1, "pitch")):
                targets[:, joint_index(f"{side}_ankle_{direction}_joint")] += ankle[:, axis]
                targets[:, joint_index(f"{side}_hip_{direction}_joint")] -= sign * swing * capture[:, axis]
        return (tilt + config.step_damping * angular_velocity)[:, :2].norm(dim=-1)
