"""What the action is a residual on: reference filter, gait clock, and nominal joint targets.

The paper adds the policy's arm output to the commanded arm joints (III-B-2). Here the same is done for legs and
waist, as additions to the paper: their nominal target comes from the nominal-pose table; a feed-forward march lifts
the swing leg in time with a gait clock; and ankles and steps lean against tilt, so that the zero action already
stands and marches. The march outlasts a command to stop until the robot has slowed down, and only then does it move
to the posture that it is to stand in; a standing robot that tips over marches to catch itself. The training
environment and the frozen controller share this module, so they cannot drift apart.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from lowlevel.commands import ARMS, COMMAND_SIZE, HEIGHT, POSTURE, TORSO, VELOCITY, is_walking
from lowlevel.rotations import about_axis, conjugate, from_roll_pitch_yaw, multiply
from robots.g1.arm_mass import ArmMass
from robots.g1.constants import (
    ARM_JOINTS,
    DEFAULT_POSITION,
    LEG_JOINTS,
    LOWER_JOINTS,
    NUM_JOINTS,
    TOTAL_MASS,
    WAIST_JOINTS,
    Gains,
    joint_index,
)
from robots.g1.nominal_pose import NominalPose, NominalStance
from robots.g1.turns import blend, turn_basis

GRAVITY = 9.81
"""[m/s^2]"""
_TORSO_AXES, _WAIST_AXES = (0, 1, 2), (2, 0, 1)
"""Axes that roll, pitch, yaw of the torso and the waist joints yaw, roll, pitch turn about."""

_MARCH: tuple[dict[str, float], ...] = (
    # Lift of the left foot, of the right foot: the knee flexes, hip and ankle take half of it back.
    {"left_hip_pitch": -0.5, "left_knee": 1.0, "left_ankle_pitch": -0.5},
    {"right_hip_pitch": -0.5, "right_knee": 1.0, "right_ankle_pitch": -0.5},
    # Shift of the pelvis over the stance foot.
    {"left_hip_roll": 1.0, "right_hip_roll": 1.0, "left_ankle_roll": -1.0, "right_ankle_roll": -1.0},
    # Stride forwards, sideways and around: both legs swing against each other and the feet stay level.
    {"left_hip_pitch": 1.0, "right_hip_pitch": -1.0, "left_ankle_pitch": -1.0, "right_ankle_pitch": 1.0},
    {"left_hip_roll": -1.0, "right_hip_roll": 1.0, "left_ankle_roll": 1.0, "right_ankle_roll": -1.0},
    {"left_hip_yaw": -1.0, "right_hip_yaw": 1.0},
)
_BALANCE: tuple[dict[str, float], ...] = (
    # Ankle strategy in roll and pitch.
    {"left_ankle_roll": 1.0, "right_ankle_roll": 1.0},
    {"left_ankle_pitch": 1.0, "right_ankle_pitch": 1.0},
    # Capture steps in roll and pitch, positive while the left foot swings.
    {"left_hip_roll": -1.0, "right_hip_roll": 1.0},
    {"left_hip_pitch": -1.0, "right_hip_pitch": 1.0},
    # Lean along x and y: the waist takes it back, so that the torso keeps its commanded attitude.
    {"waist_pitch": -1.0},
    {"waist_roll": 1.0},
)
_BEARING: tuple[dict[str, float], ...] = (
    # Moment of the arms' weight about the waist's yaw, roll and pitch axes, and about the heading frame's y axis.
    {"waist_yaw": -1.0},
    {"waist_roll": -1.0},
    {"waist_pitch": -1.0},
    {"left_hip_pitch": 0.5, "right_hip_pitch": 0.5},
)


def _joints_moved(rows: tuple[dict[str, float], ...], device: torch.device | str) -> Tensor:
    """Matrix (rows, 29) from how much there is of each row to joints."""
    matrix = torch.zeros(len(rows), NUM_JOINTS)
    for row, joints in zip(matrix, rows, strict=True):
        for joint, share in joints.items():
            row[joint_index(f"{joint}_joint")] = share
    return matrix.to(device)


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
    walking_ramp: float = 0.2
    """Time over which the march fades in and out [s]."""
    settling_time: float = 0.5
    """A robot told to stand keeps its posture until its march has been over for this long [s]; 0: it does not wait
    for the march either."""
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
    lean: tuple[float, float] = (0.33, 0.62)
    """Lean of the pelvis that counts as upright while walking, per commanded vx and vy [rad per m/s]: steps that
    chase it carry the robot along."""
    largest_lean: float = 0.4
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
    settling: Tensor
    """Time for which a robot told to stand still keeps its posture (N,) [s]."""


class _Attitude(NamedTuple):
    """Rotation matrices of N nominal postures."""

    torso: Tensor
    """Torso in the heading frame (N, 3, 3)."""
    waist: Tensor
    """Torso in the pelvis frame (N, 3, 3)."""
    waist_pitch: Tensor
    """Turn of the waist pitch joint alone, the last of the three (N, 3, 3)."""


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
        self._turn_basis = torch.tensor(turn_basis(_TORSO_AXES + _WAIST_AXES), dtype=torch.float32, device=device)
        self._stepping_torso = torch.tensor(config.stepping_torso, device=device)
        self._stride = torch.tensor(config.stride, device=device)
        self._lean = torch.tensor([*config.lean, 0.0], device=device)
        self._march_joints = _joints_moved(_MARCH, device)
        self._balance_joints = _joints_moved(_BALANCE, device)
        self._bearing_joints = _joints_moved(_BEARING, device)[:, LOWER_JOINTS]
        self._largest_change = rate * control_period

    def initial_state(self, command: Tensor) -> NominalState:
        """References at their goal, phase zero, standing."""
        count = len(command)
        zeros = torch.zeros(count, device=command.device)
        return NominalState(command.clone(), zeros, zeros.clone(), zeros.clone(), zeros.clone())

    def clamp(self, command: Tensor) -> Tensor:
        """Move the posture of ``command`` (N, 21) into the feasible region; everything else is unchanged."""
        clamped = command.clone()
        clamped[:, POSTURE] = self.pose.clamp(command[:, POSTURE])
        return clamped

    def tracked_command(self, state: NominalState, command: Tensor) -> Tensor:
        """What of ``command`` (N, 21) is to be tracked in ``state``: what the policy sees and is rewarded for.

        Its velocity is the reference's: a policy that sees another one brakes while the nominal motion still leans
        forwards. Its posture waits until a robot told to stop has settled: most falls of standing robots came from a
        change of posture while they still swayed from their last steps.
        """
        return torch.cat([state.reference[:, VELOCITY], self._posture(state, command), command[:, ARMS]], dim=1)

    def _posture(self, state: NominalState, command: Tensor) -> Tensor:
        """Posture of ``command`` (N, 21), or of the reference while the robot settles (N, 4)."""
        settles = (state.settling > 0.0) & ~is_walking(command)
        return torch.where(settles[:, None], state.reference[:, POSTURE], command[:, POSTURE])

    def advance(self, state: NominalState, command: Tensor, unbalance: Tensor) -> NominalState:
        """One control step of reference filter and gait clock towards ``command`` (N, 21).

        ``unbalance`` (N,) [rad]: as the last :meth:`joint_targets` found it.
        """
        goal = torch.cat([command[:, VELOCITY], self._posture(state, command), command[:, ARMS]], dim=1)
        change = (goal - state.reference).clamp(-self._largest_change, self._largest_change)
        reference = state.reference + change
        # A march sways by as much, so only one that fades out starts anew; so does a move to another posture.
        loses_balance = (unbalance > self.config.stepping_threshold) & (state.walking <= 0.5)
        rests = (reference[:, POSTURE] == goal[:, POSTURE]).all(dim=1)
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
        settling = torch.where(moves, self.config.settling_time, (state.settling - self.control_period).clamp_min(0.0))
        return NominalState(reference, phase, walking, stepping, settling)

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
        arms = state.reference[:, ARMS]
        unbalance = torch.zeros_like(state.phase)
        if self.config.kind == "default":
            return torch.cat([self.default[LOWER_JOINTS].expand(len(arms), -1), arms], dim=1), unbalance
        stance = self.pose.lookup(state.reference[:, POSTURE])
        attitude = self._attitude(state.reference, stance.position)
        if self.config.carry_arms:
            stance = self._carry_arms(arms, stance, attitude)
        targets = torch.cat([stance.position + stance.torque * self._inverse_stiffness, arms], dim=1)
        if self.config.kind == "march":
            targets = torch.addmm(targets, self._march(state), self._march_joints)
        if self.config.balance_stiffness > 0.0:
            balance, unbalance = self._balance(state, attitude, projected_gravity, base_angular_velocity)
            targets = torch.addmm(targets, balance, self._balance_joints)
        return targets, unbalance

    def _attitude(self, reference: Tensor, position: Tensor) -> _Attitude:
        angles = torch.cat([reference[:, TORSO], position[:, WAIST_JOINTS]], dim=1)
        turns = blend(self._turn_basis, angles[:, :, None, None])
        roll, pitch, yaw, waist_yaw, waist_roll, waist_pitch = turns.unbind(1)
        return _Attitude(yaw @ pitch @ roll, waist_yaw @ waist_roll @ waist_pitch, waist_pitch)

    def _carry_arms(self, arms: Tensor, stance: NominalStance, attitude: _Attitude) -> NominalStance:
        """The stance for arms (N, 14) [rad] that are not at their default, as the table assumes.

        The pelvis moves until the centre of mass is back where the table has it; waist and hips bear the moment.
        """
        moment = self.arm_mass.first_moment(arms) - self._default_moment
        offset = (attitude.torso @ moment[:, :, None])[:, :2] / -TOTAL_MASS
        offset = offset.clamp(-self.config.largest_shift, self.config.largest_shift)
        legs = torch.baddbmm(stance.position[:, LEG_JOINTS, None], stance.shift, offset)[:, :, 0]
        position = torch.cat([legs, stance.position[:, WAIST_JOINTS]], dim=1)

        # Weight in the torso frame is along the third row of the rotation that turns it upright. The waist's axes
        # there: pitch turns last, so its axis is the torso's own; roll's is seen through pitch, yaw's through both.
        load = torch.linalg.cross(moment, -GRAVITY * attitude.torso[:, 2])
        about_yaw, about_roll = (attitude.waist[:, 2] * load).sum(-1), (attitude.waist_pitch[:, 0] * load).sum(-1)
        sideways = (attitude.torso[:, 1] * load).sum(-1)
        borne = torch.stack([about_yaw, about_roll, load[:, 1], sideways], dim=1)
        return NominalStance(position, torch.addmm(stance.torque, borne, self._bearing_joints), stance.shift)

    def _march(self, state: NominalState) -> Tensor:
        """How much of each row of ``_MARCH`` there is (N, 6) [rad]."""
        sine, cosine = torch.sin(state.phase) * state.walking, torch.cos(state.phase) * state.walking
        raised = torch.stack([sine, -sine], dim=1).clamp_min(0.0)
        stride = cosine[:, None] * state.reference[:, VELOCITY] * self._stride
        return torch.cat([self.config.knee_lift * raised, self.config.lateral_shift * sine[:, None], stride], dim=1)

    def _balance(
        self, state: NominalState, attitude: _Attitude, gravity: Tensor, angular_velocity: Tensor
    ) -> tuple[Tensor, Tensor]:
        """How much of each row of ``_BALANCE`` there is (N, 6) [rad], and the unbalance (N,).

        Ankles and, marching, steps lean against the pelvis' tilt off its nominal attitude. The capture point of a
        falling pendulum lies in the direction of tilt + rate * sqrt(height / g) (Pratt et al., Humanoids 2006), so
        the swing hip moves the foot that way.
        """
        config, walking = self.config, state.walking[:, None]
        lean = state.reference[:, VELOCITY] * self._lean
        lean = lean.clamp(-config.largest_lean, config.largest_lean) * walking
        wanted = lean - (attitude.waist @ attitude.torso[:, 2, :, None])[:, :, 0]
        tilt = torch.linalg.cross(gravity, wanted)[:, :2]
        rate = angular_velocity[:, :2]
        ankle = config.balance_stiffness * tilt + config.balance_damping * rate
        capture = config.step_stiffness * tilt + config.step_damping * rate
        swing = torch.sin(state.phase)[:, None] * walking
        unbalance = (tilt + config.step_damping * rate).norm(dim=1)
        return torch.cat([ankle, swing * capture, lean[:, :2]], dim=1), unbalance
