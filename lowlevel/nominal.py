"""What the action is a residual on: reference filter, gait clock, and nominal joint targets.

The paper adds the policy's arm output to the commanded arm joints (III-B-2). Here the same is done for legs and
waist, as additions to the paper: their nominal target comes from the nominal-pose table; a feed-forward march lifts
the swing leg in time with a gait clock; ankles and steps lean against tilt, so that the zero action already stands
and marches; arms bear their own weight and the waist takes up what is left of the torso's error. The march outlasts
a command to stop until the robot has slowed down, and only then does it move to the posture that it is to stand in;
a standing robot that tips over marches to catch itself. The training
environment and the frozen controller share this module, so they cannot drift apart.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from lowlevel.commands import ARMS, COMMAND_SIZE, HEIGHT, POSTURE, STANDING_SPEED, TORSO, VELOCITY, is_walking
from lowlevel.nominal_config import NominalConfig
from lowlevel.nominal_state import NominalState
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
    # Turn of the torso against the pelvis.
    {"waist_yaw": 1.0},
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
    # The waist takes back a lasting error of the torso in roll and pitch.
    {"waist_roll": -1.0},
    {"waist_pitch": -1.0},
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


class _Attitude(NamedTuple):
    """Rotation matrices of N nominal postures."""

    torso: Tensor
    """Torso in the heading frame (N, 3, 3)."""
    waist: Tensor
    """Torso in the pelvis frame (N, 3, 3)."""
    waist_pitch: Tensor
    """Turn of the waist pitch joint alone, the last of the three (N, 3, 3)."""
    measured_waist: Tensor
    """As ``waist``, where the joints are and not where they should be (N, 3, 3)."""


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
        arm_stiffness = torch.tensor(gains.stiffness[ARM_JOINTS], dtype=torch.float32, device=device)
        self._inverse_arm_stiffness = 1.0 / arm_stiffness
        rate = torch.full((COMMAND_SIZE,), math.inf, device=device)
        rate[VELOCITY], rate[HEIGHT] = config.velocity_rate, config.height_rate
        rate[TORSO], rate[ARMS] = torch.tensor(config.torso_rate, device=device), config.arm_rate
        self.arm_mass = ArmMass(device)
        self._default_moment = self.arm_mass.first_moment(self.default[None, ARM_JOINTS])
        axes = _TORSO_AXES + _WAIST_AXES + _WAIST_AXES
        self._turn_basis = torch.tensor(turn_basis(axes), dtype=torch.float32, device=device)
        self._stepping_torso = torch.tensor(config.stepping_torso, device=device)
        self._stride = torch.tensor(config.stride, device=device)
        self._harmonics = torch.arange(1.0, 4.0, device=device)
        self._swing_lead = torch.tensor(config.swing_trim_lead, device=device)
        self._creep = torch.tensor([config.creep, 0.0, 0.0], device=device)
        self._lean = torch.tensor(config.lean, device=device)
        self._march_joints = _joints_moved(_MARCH, device)
        self._balance_joints = _joints_moved(_BALANCE, device)
        self._bearing_joints = _joints_moved(_BEARING, device)[:, LOWER_JOINTS]
        self._largest_change = rate * control_period

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
        """Posture of ``command`` (N, 21), or of the reference while the robot settles (N, 4).

        The torso's yaw, which hardly moves the centre of mass, only waits for the march to end. A robot that marches to
        catch itself goes on to the nearest posture in which it can.
        """
        stands, held = ~is_walking(command), state.reference[:, POSTURE]
        settles = stands & (state.settling > 0.0)
        marches = settles & (state.walking > 0.0)
        waits = torch.stack([settles, settles, settles, marches], dim=1)
        recovers = stands & (state.stepping > 0.0)
        torso = held[:, 1:].clamp(-self._stepping_torso, self._stepping_torso)
        marching = torch.cat([held[:, :1].clamp_min(self.config.recovery_height), torso], dim=1)
        return torch.where(recovers[:, None], marching, torch.where(waits, held, command[:, POSTURE]))

    def advance(self, state: NominalState, command: Tensor) -> NominalState:
        """One control step of reference filter and gait clock towards ``command`` (N, 21)."""
        config, period = self.config, self.control_period
        goal = torch.cat([command[:, VELOCITY], self._posture(state, command), command[:, ARMS]], dim=1)
        change = (goal - state.reference).clamp(-self._largest_change, self._largest_change)
        reference = state.reference + change
        # A robot that turns accelerates towards the inside of the curve.
        vx, vy, yaw_rate = reference[:, VELOCITY].unbind(1)
        acceleration = change[:, :2] / period + torch.stack([-yaw_rate * vy, yaw_rate * vx], dim=1)
        share = period / (period + config.acceleration_time)
        # A march sways by as much, so only one that fades out starts anew; so does a move to another posture, with
        # a command that jumps or one that the reference keeps up with.
        loses_balance = (state.unbalance > config.stepping_threshold) & (state.walking <= 0.5)
        rests = (change[:, POSTURE] == 0.0).all(dim=1)
        is_upright = (reference[:, TORSO].abs() <= self._stepping_torso).all(dim=1)
        is_tall = reference[:, HEIGHT] >= config.stepping_height
        falls = (state.unbalance > config.recovery_threshold) & (state.walking <= 0.5)
        steps = (loses_balance & rests & is_upright & is_tall) | falls
        stepping = torch.where(steps, config.stepping_time, (state.stepping - period).clamp_min(0.0))
        to_stop = config.stopping_time * reference[:, VELOCITY].norm(dim=1)
        stopping = torch.maximum((state.stopping - period).clamp_min(0.0), to_stop)
        slows_down = stopping > config.stopping_time * STANDING_SPEED
        walks = is_walking(command) | is_walking(reference) | slows_down | (stepping > 0.0)
        fade = period / config.walking_ramp
        walking = (state.walking + torch.where(walks, fade, -fade)).clamp(0.0, 1.0)
        step = 2.0 * math.pi * config.gait_frequency * period
        moves = walking > 0.0
        phase = torch.where(moves, (state.phase + step) % (2.0 * math.pi), torch.zeros_like(state.phase))
        settling = torch.where(moves, config.settling_time, (state.settling - period).clamp_min(0.0))
        return state._replace(
            reference=reference,
            acceleration=torch.lerp(state.acceleration, acceleration, share),
            phase=phase,
            walking=walking,
            stopping=stopping,
            stepping=stepping,
            settling=settling,
        )

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
        self,
        state: NominalState,
        joint_position: Tensor,
        projected_gravity: Tensor,
        base_angular_velocity: Tensor,
        velocity: Tensor,
    ) -> tuple[Tensor, NominalState]:
        """Nominal PD targets (N, 29) [rad], gravity compensated by static torques, and the state of the feedback.

        They may lie beyond the joint limits: a joint that rests at its limit needs such a target to push against it.

        ``joint_position`` (N, 29) [rad], ``projected_gravity`` (N, 3) and ``base_angular_velocity`` (N, 3) [rad/s] as
        measured, the last two in the pelvis frame. ``velocity`` (N, 3) [m/s]: of the base in the heading frame, as
        the policy estimates it; the third component plays no role.
        """
        config, arms = self.config, state.reference[:, ARMS]
        if config.kind == "default":
            return torch.cat([self.default[LOWER_JOINTS].expand(len(arms), -1), arms], dim=1), state
        state = self._sense(state, projected_gravity, base_angular_velocity)
        stance = self.pose.lookup(state.reference[:, POSTURE])
        attitude = self._attitude(state.reference, stance.position, joint_position)
        if config.carry_arms or config.bear_arms:
            moment, torque = self.arm_mass.first_moment_and_torque(arms, -GRAVITY * attitude.torso[:, 2])
            if config.carry_arms:
                stance = self._carry_arms(moment, stance, attitude)
            if config.bear_arms:
                arms = arms + torque * self._inverse_arm_stiffness
        targets = torch.cat([stance.position + stance.torque * self._inverse_stiffness, arms], dim=1)
        if config.kind == "march":
            yaw_rate = -(base_angular_velocity * projected_gravity).sum(dim=1, keepdim=True)
            state = self._trim_velocity(state, torch.cat([velocity[:, :2], yaw_rate], dim=1))
            state = self._trim_swing(state, yaw_rate)
            targets = torch.addmm(targets, self._march(state), self._march_joints)
        if config.balance_stiffness > 0.0:
            balance, state = self._balance(state, attitude)
            targets = torch.addmm(targets, balance, self._balance_joints)
        return targets, state

    def _sense(self, state: NominalState, gravity: Tensor, angular_velocity: Tensor) -> NominalState:
        """Filter the measured gravity direction (complementary, with the gyroscope) and tilt rate."""
        config = self.config
        carried = state.gravity - self.control_period * torch.linalg.cross(angular_velocity, state.gravity)
        taken_in = carried + config.gravity_gain * (gravity - carried)
        is_first = (state.gravity == 0.0).all(dim=1, keepdim=True)
        filtered = torch.where(is_first, gravity, taken_in / taken_in.norm(dim=1, keepdim=True).clamp_min(1e-6))
        rate = state.tilt_rate + config.rate_gain * (angular_velocity[:, :2] - state.tilt_rate)
        return state._replace(gravity=filtered, tilt_rate=rate)

    def _attitude(self, reference: Tensor, position: Tensor, measured: Tensor) -> _Attitude:
        angles = torch.cat([reference[:, TORSO], position[:, WAIST_JOINTS], measured[:, WAIST_JOINTS]], dim=1)
        turns = blend(self._turn_basis, angles[:, :, None, None])
        roll, pitch, yaw, waist_yaw, waist_roll, waist_pitch, *measured_waist = turns.unbind(1)
        measured_yaw, measured_roll, measured_pitch = measured_waist
        return _Attitude(
            yaw @ pitch @ roll,
            waist_yaw @ waist_roll @ waist_pitch,
            waist_pitch,
            measured_yaw @ measured_roll @ measured_pitch,
        )

    def _carry_arms(self, moment: Tensor, stance: NominalStance, attitude: _Attitude) -> NominalStance:
        """The stance for arms with a first moment (N, 3) [kg m] other than at their default, as the table assumes.

        The pelvis moves until the centre of mass is back where the table has it; waist and hips bear the moment.
        """
        moment = moment - self._default_moment
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

    def _trim_velocity(self, state: NominalState, velocity: Tensor) -> NominalState:
        """Integrate the error of ``velocity`` (N, 3) while the robot marches."""
        config, wanted = self.config, state.reference[:, VELOCITY]
        trim = state.velocity_trim + config.velocity_trim_rate * self.control_period * (wanted - velocity)
        constant, share = config.velocity_trim_share
        bound = constant + share * wanted.norm(dim=1, keepdim=True)
        return state._replace(velocity_trim=trim.clamp(-bound, bound) * state.walking[:, None])

    def _trim_swing(self, state: NominalState, yaw_rate: Tensor) -> NominalState:
        """Integrate the error of ``yaw_rate`` (N, 1) in time with the gait while the robot marches.

        What repeats with the gait, at any speed and posture, is taken back by a turn that repeats with it, as a
        disturbance of known frequency is cancelled by adaptive feed-forward (Bodson, Sacks and Khosla, IEEE TAC 1994).
        """
        config = self.config
        error = (yaw_rate - state.reference[:, 2:3]) * state.walking[:, None]
        waves = self._waves(state.phase, self._swing_lead)
        trim = state.swing_trim + config.swing_trim_rate * self.control_period * error * waves
        return state._replace(swing_trim=trim.clamp(-config.largest_swing_trim, config.largest_swing_trim))

    def _waves(self, phase: Tensor, lead: Tensor | float = 0.0) -> Tensor:
        """Cosines and sines (N, 6) of the harmonics of ``phase`` (N,), each ``lead`` (3,) ahead [rad]."""
        angles = phase[:, None] * self._harmonics + lead
        return torch.cat([torch.cos(angles), torch.sin(angles)], dim=1)

    def _effort(self, state: NominalState) -> Tensor:
        """Velocity (N, 3) that the march is to be made for, so that the reference's comes out."""
        return state.reference[:, VELOCITY] + state.velocity_trim - self._creep

    def _march(self, state: NominalState) -> Tensor:
        """How much of each row of ``_MARCH`` there is (N, 7) [rad]."""
        config = self.config
        sine = torch.sin(state.phase) * state.walking
        lift = torch.sin(state.phase + config.lift_lead) * state.walking
        raised = torch.stack([lift, -lift], dim=1).clamp_min(0.0)
        if config.soft_landing:
            raised = raised.square()
        vx, vy, yaw_rate = self._effort(state).unbind(1)
        velocity = torch.stack([vx, vy, yaw_rate + config.side_step_turn * vy], dim=1)
        swing = torch.cos(state.phase + config.stride_lead) * state.walking
        stride = swing[:, None] * velocity * self._stride
        swing_trim = (state.swing_trim * self._waves(state.phase)).sum(dim=1) * state.walking
        parts = (config.knee_lift * raised, config.lateral_shift * sine[:, None], stride, swing_trim[:, None])
        return torch.cat(parts, dim=1)

    def _balance(self, state: NominalState, attitude: _Attitude) -> tuple[Tensor, NominalState]:
        """How much of each row of ``_BALANCE`` there is (N, 8) [rad], and the state of the feedback.

        Ankles and, marching, steps lean against the pelvis' tilt off its nominal attitude, and against its tilt rate
        off the nominal one: a pelvis that moves to another posture as it should is not to be held back. The capture
        point of a falling pendulum lies in the direction of tilt + rate * sqrt(height / g) (Pratt et al., Humanoids
        2006), so the swing hip moves the foot that way. A pendulum that accelerates at a leans by a / g.
        """
        config, walking = self.config, state.walking[:, None]
        lean = self._effort(state)[:, :2] * self._lean + config.acceleration_lean / GRAVITY * state.acceleration
        lean = lean.clamp(-config.largest_lean, config.largest_lean) * walking
        upright = -attitude.torso[:, 2]
        state, nominal_rate = self._follow(state, (attitude.waist @ upright[:, :, None])[:, :, 0])
        wanted = torch.nn.functional.pad(lean, (0, 1)) + state.nominal_gravity
        tilt = torch.linalg.cross(state.gravity, wanted)[:, :2]
        rate = state.tilt_rate - nominal_rate
        ankle = config.balance_stiffness * tilt + config.balance_damping * rate
        capture = config.step_stiffness * tilt + config.step_damping * rate
        swing = torch.sin(state.phase + config.capture_lead)[:, None] * walking

        steady_tilt = state.steady_tilt
        if config.steady_time > 0.0:
            steady_tilt = steady_tilt + (self.control_period / config.steady_time) * (tilt - steady_tilt)
        unbalance = (tilt - steady_tilt + config.step_damping * rate).norm(dim=1)
        torso_gravity = (attitude.measured_waist.transpose(1, 2) @ state.gravity[:, :, None])[:, :, 0]
        torso_tilt = torch.linalg.cross(torso_gravity, upright)[:, :2]
        trim = state.torso_trim + config.torso_trim_rate * self.control_period * torso_tilt
        trim = trim.clamp(-config.largest_torso_trim, config.largest_torso_trim)
        balance = torch.cat([ankle, swing * capture, lean, trim], dim=1)
        return balance, state._replace(unbalance=unbalance, steady_tilt=steady_tilt, torso_trim=trim)

    def _follow(self, state: NominalState, gravity: Tensor) -> tuple[NominalState, Tensor]:
        """Let the lagging gravity direction follow the nominal one (N, 3), both in the pelvis frame.

        Returns:
            the state, and the tilt rate about x and y (N, 2) [rad/s] that goes with it.
        """
        is_first = (state.nominal_gravity == 0.0).all(dim=1, keepdim=True)
        lagging = torch.where(is_first, gravity, state.nominal_gravity)
        speed = (gravity - lagging) / (self.config.attitude_lag + self.control_period)
        lagging = lagging + self.control_period * speed
        # A direction that is fixed in the world moves by -omega x direction in the pelvis frame.
        rate = torch.linalg.cross(speed, lagging)[:, :2]
        return state._replace(nominal_gravity=lagging), rate
