"""A scripted expert: a state machine per robot, run for all robots at once, that produces planner actions.

It shows that the controller can do the task before anything is learnt, gives the demonstrations, and is the
baseline. It sees the true state, including contact forces.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from highlevel.environment import CommandEnvironment
from highlevel.task import rows
from lowlevel.commands import ARMS, HEIGHT, TORSO, VELOCITY
from lowlevel.world.measures import Measurement
from robots.g1.constants import ARM_JOINTS, PALM_HALF_THICKNESS, SOLE_CENTER, WAIST_JOINTS
from robots.g1.mirror import both_arms
from robots.rotations import (
    conjugate,
    from_roll_pitch_yaw,
    multiply,
    rotate,
    rotate_about_vertical,
    rotate_inverse,
    yaw_of,
)
from tasks.lift_box.arms import ArmKinematics, palm_rotation
from tasks.lift_box.expert_config import CLOSE, DESCEND, HOLD, LIFT, STOP, WALK, ExpertConfig
from tasks.lift_box.geometry import Situation
from tasks.lift_box.reward import PALM_BELOW_TOP, grasp_posture
from tasks.lift_box.task import LiftBox


@dataclass
class _Memory:
    """State of N state machines."""

    phase: Tensor
    time: Tensor
    """Since the phase began (N,) [s]."""
    descent: Tensor
    """0 upright, 1 in the grasp posture (N,)."""
    depth: Tensor
    """Palms inside their faces, negative outside (N,) [m]."""
    correction: Tensor
    """Added to the palms' targets (N, 2, 3) [m], world axes."""
    grasp_point: Tensor
    """Middle between the palms when the lift began (N, 3) [m], world frame."""
    grasp_yaw: Tensor
    """Yaw of the box when the lift began (N,) [rad]."""
    pitch_error: Tensor
    """Torso pitch measured - commanded, filtered (N,) [rad]."""
    raised: Tensor
    """Added to the palms' height once upright (N,) [m]."""
    level: Tensor
    """Added to the pitch of the fingers to level the box (N,) [rad]."""
    loaded_time: Tensor
    """(N,) [s]"""
    arms: Tensor
    """Last solution of the inverse kinematics (N, 14) [rad]."""


class LiftBoxExpert:
    """Scripted expert for the robots of one environment.

    Args:
        environment: of a :class:`tasks.lift_box.task.LiftBox`.
        config: how it moves.
    """

    def __init__(self, environment: CommandEnvironment, config: ExpertConfig | None = None) -> None:
        self.config = ExpertConfig() if config is None else config
        task = environment.task
        assert isinstance(task, LiftBox)
        self._environment, self._task = environment, task
        self._period = environment.decision_period
        self._arms = ArmKinematics()
        self._neutral = environment.controller.command_space.neutral()
        count = environment.num_envs
        self._memory = _Memory(
            phase=torch.zeros(count, dtype=torch.long),
            time=torch.zeros(count),
            descent=torch.zeros(count),
            depth=torch.zeros(count),
            correction=torch.zeros(count, 2, 3),
            grasp_point=torch.zeros(count, 3),
            grasp_yaw=torch.zeros(count),
            pitch_error=torch.zeros(count),
            raised=torch.zeros(count),
            level=torch.zeros(count),
            loaded_time=torch.zeros(count),
            arms=torch.zeros(count, 14),
        )
        self.reset(rows(count))

    @property
    def phase(self) -> Tensor:
        """Current phase of each robot (N,), from ``WALK`` to ``HOLD``."""
        return self._memory.phase

    def reset(self, ids: Tensor) -> None:
        """Begin new episodes in rows ``ids``."""
        memory = self._memory
        for item in fields(memory):
            getattr(memory, item.name)[ids] = 0
        memory.depth[ids] = -self.config.clearance
        memory.arms[ids] = self._neutral[ARMS]

    @torch.no_grad()
    def act(self, observation: Tensor) -> Tensor:
        """The next action (N, 21); it depends on the state of the environment, not on ``observation``."""
        measured = self._environment.measured
        if measured is None:
            raise RuntimeError("reset the environment before asking the expert")
        situation = self._task.look(measured)
        self._advance(measured, situation)
        command = self._neutral.repeat(len(self.phase), 1)
        command[:, VELOCITY] = self._velocity(measured, situation)
        height, pitch = self._posture()
        command[:, HEIGHT] = height
        command[:, TORSO.start + 1] = pitch
        self._adapt(measured, situation)
        command[:, ARMS] = self._arm_targets(measured, situation)
        return self._environment.action_map.action(command)

    # -- state machine ---------------------------------------------------------------------------------------

    def _advance(self, measured: Measurement, situation: Situation) -> None:
        config, memory, period = self.config, self._memory, self._period
        phase = memory.phase
        position_error, yaw_error = self._stand_error(measured, situation)
        in_box_frame = rotate_about_vertical(-yaw_error, position_error)
        off = torch.maximum(
            in_box_frame[:, 0].abs() / config.position_tolerance,
            in_box_frame[:, 1].abs() / config.lateral_tolerance,
        )
        off = torch.maximum(off, yaw_error.abs() / config.yaw_tolerance)
        memory.time = memory.time + period
        loaded = (situation.palm_force > 0.6 * config.force).all(dim=1)
        memory.loaded_time = torch.where(loaded & (phase == CLOSE), memory.loaded_time + period, 0.0)
        ready = situation.palm_distance.amax(dim=1) < config.clearance + config.ready_tolerance

        following = phase.clone()
        following[(phase == WALK) & (off < 1.0)] = STOP
        stopped = (phase == STOP) & (memory.time > config.settle_time) & (situation.speed < 0.15)
        following[stopped & (off < config.loose)] = DESCEND
        following[(phase == STOP) & (off >= config.loose)] = WALK
        down = (phase == DESCEND) & (memory.descent >= 1.0)
        following[down & (ready | (memory.time > config.descend_time + 2.0))] = CLOSE
        grasped = (phase == CLOSE) & ((memory.loaded_time > config.grasp_time) | (memory.time > 4.0))
        following[grasped] = LIFT
        following[(phase == LIFT) & (memory.descent <= 0.0)] = HOLD
        changed = following != phase
        memory.time = torch.where(changed, 0.0, memory.time)
        memory.phase = following

        midpoint = measured.robot.palm_position.mean(dim=1)
        memory.grasp_point = torch.where(grasped[:, None], midpoint, memory.grasp_point)
        memory.grasp_yaw = torch.where(grasped, yaw_of(situation.box_pose[:, 3:]), memory.grasp_yaw)

        down_step, up_step = period / config.descend_time, period / config.lift_time
        change = torch.where(
            following == DESCEND,
            down_step,
            torch.where(following == LIFT, -up_step, torch.zeros_like(memory.descent)),
        )
        memory.descent = (memory.descent + change).clamp(0.0, 1.0)
        closing = (following == CLOSE).float() * config.close_speed * period
        pushing = (situation.palm_force > 3.0).all(dim=1) | (following >= LIFT)
        by_force = config.force_gain * (config.force - situation.palm_force.amin(dim=1))
        step = torch.where(pushing, by_force.clamp(-0.01, 0.01), closing)
        step = torch.where(following >= CLOSE, step, torch.zeros_like(step))
        memory.depth = (memory.depth + step).clamp(-config.clearance, config.deepest)

    # -- legs ------------------------------------------------------------------------------------------------

    def _stand_error(self, measured: Measurement, situation: Situation) -> tuple[Tensor, Tensor]:
        """Where to stand from the feet: position (N, 2) [m] in the heading frame, and yaw (N,) [rad]."""
        box_yaw = situation.yaw_error
        back = rotate_about_vertical(box_yaw, torch.tensor([-self.config.stand_off, 0.0]).expand(len(box_yaw), 2))
        return self._near_face_from_feet(measured, situation) + back, box_yaw

    def _near_face_from_feet(self, measured: Measurement, situation: Situation) -> Tensor:
        robot = measured.robot
        feet = robot.foot_position.mean(dim=1) - robot.base_position
        feet = rotate_about_vertical(-measured.heading, feet)[:, :2] - torch.tensor([SOLE_CENTER, 0.0])
        return situation.near_face[:, :2] - feet

    def _velocity(self, measured: Measurement, situation: Situation) -> Tensor:
        """Velocity command (N, 3) towards the stand-off, by way of the gate when it is off to the side."""
        config = self.config
        error, yaw_error = self._stand_error(measured, situation)
        in_box_frame = rotate_about_vertical(-yaw_error, error)
        extra = config.gate_distance - config.stand_off
        aside = (in_box_frame[:, 1].abs() > config.gate_lateral) | (yaw_error.abs() > 0.5)
        gate = torch.stack([-extra * torch.ones_like(yaw_error), torch.zeros_like(yaw_error)], -1)
        to_gate = error + rotate_about_vertical(yaw_error, gate)
        target = torch.where(aside[:, None], to_gate, error)
        distance = target.norm(dim=-1, keepdim=True)
        speed = (config.position_gain * distance).clamp(max=1.0)
        velocity = target / distance.clamp_min(1e-6) * speed
        # Far away it faces where it goes, near the box it faces the box.
        bearing = torch.atan2(target[:, 1], target[:, 0])
        turn = torch.where(distance[:, 0] > 0.8, bearing, yaw_error)
        upper = self._environment.action_map.upper[VELOCITY]
        lower = self._environment.action_map.lower[VELOCITY]
        facing = torch.cos(bearing).clamp_min(0.0)
        slow_down = torch.where(distance[:, 0] > 0.8, facing, 1.0)
        command = torch.cat([velocity * slow_down[:, None], (config.yaw_gain * turn)[:, None]], -1)
        command = torch.maximum(torch.minimum(command, upper), lower)
        norm = command.norm(dim=-1, keepdim=True)
        command = command * (config.slowest / norm.clamp_min(1e-6)).clamp_min(1.0)
        return command * (self.phase == WALK)[:, None]

    def _posture(self) -> tuple[Tensor, Tensor]:
        """Base height and torso pitch (N,)."""
        episode, memory = self._task.episode, self._memory
        low, bent = grasp_posture(episode.support_height + episode.size[:, 2] - PALM_BELOW_TOP)
        share = _smooth(memory.descent)
        height = self.config.stand_height + share * (low - self.config.stand_height)
        height = torch.where(memory.phase <= STOP, self._neutral[HEIGHT], height)
        return height, share * bent

    # -- arms ------------------------------------------------------------------------------------------------

    def _adapt(self, measured: Measurement, situation: Situation) -> None:
        """Move what the script integrates; :meth:`_wanted_palms` and :meth:`_arm_targets` only read it."""
        config, memory, bottom = self.config, self._memory, self._task.episode.support_height
        lifting, holding = memory.phase >= LIFT, memory.phase == HOLD

        # The arms sink under a box that is held.
        missing = config.carry_clearance - (situation.bottom - bottom)
        memory.raised = (memory.raised + config.raise_gain * missing * holding).clamp(0.0, config.largest_raise)

        # A box swings between the palms: the fingers turn against its pitch.
        forward = self._forward(situation)
        upright = rotate(situation.box_pose[:, 3:], torch.tensor([0.0, 0.0, 1.0]).expand_as(forward))
        pitch = torch.atan2((upright * forward).sum(-1), upright[:, 2])
        level = memory.level - config.level_gain * pitch * lifting
        memory.level = level.clamp(-config.largest_level, config.largest_level)

        gain = torch.where(lifting, config.pitch_filter, 1.0)
        gain = torch.where(holding, config.hold_filter, gain)
        error = situation.torso_pitch - self._posture()[1]
        memory.pitch_error = memory.pitch_error + gain * (error - memory.pitch_error)

        # Gravity and tracking keep the palms off their place beside the box.
        arrived = (memory.phase == DESCEND) & (memory.descent >= 1.0)
        error = self._wanted_palms(measured, situation, 0.0) - measured.robot.palm_position
        limit = config.largest_correction
        change = config.correction_gain * error * arrived[:, None, None]
        memory.correction = (memory.correction + change).clamp(-limit, limit)

    def _forward(self, situation: Situation) -> Tensor:
        """Horizontal direction (N, 3) across the box, away from the robot; kept from the lift on."""
        memory = self._memory
        yaw = torch.where(memory.phase >= LIFT, memory.grasp_yaw, yaw_of(situation.box_pose[:, 3:]))
        return torch.stack([torch.cos(yaw), torch.sin(yaw), torch.zeros_like(yaw)], -1)

    def _wanted_palms(self, measured: Measurement, situation: Situation, thickness: float) -> Tensor:
        """Where the phase wants the palms (N, 2, 3) [m], ``thickness`` [m] outside the surfaces that touch."""
        config, memory, episode = self.config, self._memory, self._task.episode
        lifting = memory.phase >= LIFT
        forward = self._forward(situation)
        left = torch.stack([-forward[:, 1], forward[:, 0], forward[:, 2]], -1)

        at_box = situation.box_pose[:, :3] + config.palm_ahead * forward
        at_box[:, 2] = episode.support_height + episode.size[:, 2] - PALM_BELOW_TOP
        feet = measured.robot.foot_position.mean(dim=1)
        carry = feet + (config.carry_ahead - SOLE_CENTER) * forward
        carry_height = episode.support_height + config.carry_clearance + episode.size[:, 2] - PALM_BELOW_TOP
        carry[:, 2] = carry_height.clamp_min(config.carry_height) + memory.raised
        # Up first, then back: the box must clear the knees.
        rise = _smooth(1.0 - memory.descent)
        back = _smooth((1.5 * (1.0 - memory.descent) - 0.5).clamp(0.0, 1.0))
        share = torch.stack([back, back, rise], -1)
        path = memory.grasp_point + share * (carry - memory.grasp_point)
        middle = torch.where(lifting[:, None], path, at_box)

        wide = config.wide * _smooth((4.0 * (1.0 - memory.descent)).clamp(0.0, 1.0)) * ~lifting
        apart = 0.5 * episode.size[:, 1] - memory.depth + wide
        side = torch.tensor([1.0, -1.0])
        return middle[:, None] + side[None, :, None] * (apart + thickness)[:, None, None] * left[:, None]

    def _arm_targets(self, measured: Measurement, situation: Situation) -> Tensor:
        """Arm joints (N, 14) that put the palms where the phase wants them, given the torso as it is."""
        config, memory, robot = self.config, self._memory, measured.robot
        # The kinematic palm center lies inside the hand, behind the surface that touches.
        target = self._within_reach(self._wanted_palms(measured, situation, PALM_HALF_THICKNESS), measured)
        pelvis = self._pelvis_attitude(measured)
        both = pelvis[:, None].expand(-1, 2, -1)
        position = rotate_inverse(both, target + memory.correction - robot.base_position[:, None])
        toe_in = config.toe_in + config.toe_in_per_depth * memory.depth.clamp_min(0.0)
        axes = palm_rotation(self._forward(situation), config.finger_pitch + memory.level, toe_in)
        columns = axes.transpose(-1, -2)
        in_pelvis = rotate_inverse(pelvis[:, None, None].expand(-1, 2, 3, -1), columns)
        rest = self._rest_posture(situation.torso_pitch)
        waist = robot.joint_position[:, WAIST_JOINTS]
        solution, _ = self._arms.inverse(waist, memory.arms, rest, position, in_pelvis.transpose(-1, -2))
        at_work = (memory.phase >= DESCEND)[:, None]
        memory.arms = torch.where(at_work, solution, rest)
        return torch.where(at_work, solution, self._neutral[ARMS])

    def _pelvis_attitude(self, measured: Measurement) -> Tensor:
        """Attitude of the pelvis (N, 4) that the arms reckon with.

        Before the grasp it is the measured one. With a box in the hands the arms must not follow every swing of
        the torso, which would swing it further: they reckon with the commanded torso pitch and its slowly
        filtered error.
        """
        memory, robot = self._memory, measured.robot
        pitch = self._posture()[1] + memory.pitch_error
        torso = from_roll_pitch_yaw(torch.stack([torch.zeros_like(pitch), pitch, measured.heading], -1))
        # The pelvis that carries the torso like this, with the waist joints as they are.
        waist = multiply(conjugate(robot.base_quaternion), robot.torso_quaternion)
        lifting = (memory.phase >= LIFT)[:, None]
        return torch.where(lifting, multiply(torso, conjugate(waist)), robot.base_quaternion)

    def _rest_posture(self, torso_pitch: Tensor) -> Tensor:
        """Arms hanging ahead of the torso (N, 14), hands half open to the box."""
        rest = torch.tensor(both_arms((-0.2, 0.2, 0.15, 0.5, -0.1, 0.2, 0.0)), dtype=torch.float32)
        rest = rest.repeat(len(torso_pitch), 1)
        rest[:, 0] -= 0.8 * torso_pitch
        rest[:, 7] -= 0.8 * torso_pitch
        return rest

    def _within_reach(self, target: Tensor, measured: Measurement) -> Tensor:
        """Draw targets (N, 2, 3) that lie farther from the shoulders than the arms are long towards them.

        They keep their distance from the sagittal plane of the target, so that the hands come down beside the
        box.
        """
        robot = measured.robot
        pose = self._arms.forward(robot.joint_position[:, WAIST_JOINTS], robot.joint_position[:, ARM_JOINTS])
        both = robot.base_quaternion[:, None].expand(-1, 2, -1)
        shoulder = rotate(both, pose.shoulder) + robot.base_position[:, None]
        offset = rotate_about_vertical(-measured.heading[:, None], target - shoulder)
        lateral = offset[..., 1].abs().clamp(max=0.9 * self.config.reach_length)
        room = (self.config.reach_length**2 - lateral.square()).sqrt()
        in_plane = offset[..., [0, 2]].norm(dim=-1)
        share = (room / in_plane.clamp_min(1e-6)).clamp(max=1.0)
        offset = torch.stack([offset[..., 0] * share, offset[..., 1], offset[..., 2] * share], -1)
        return shoulder + rotate_about_vertical(measured.heading[:, None], offset)


def _smooth(share: Tensor) -> Tensor:
    """Smooth step from 0 to 1 with zero slope at both ends."""
    return share * share * (3.0 - 2.0 * share)
