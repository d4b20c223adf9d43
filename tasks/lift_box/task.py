"""Lift-box as the planner's environment sees it: scene, episodes, observation, reward and judgment."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from typing import Any

import mujoco
import torch
from torch import Tensor

from highlevel.action import ActionConfig
from highlevel.task import Decision, ObservationBlock, Outcome, Start, Task, rows
from lowlevel.runs.draws import uniform
from lowlevel.world.measures import Measurement
from lowlevel.world.simulation import BatchSimulation
from robots.rotations import from_roll_pitch_yaw, multiply, rotate
from tasks.lift_box.config import LiftBoxConfig
from tasks.lift_box.episode import Episode, draw
from tasks.lift_box.geometry import Situation, observe_situation, relative_pose, rotation_6d
from tasks.lift_box.reward import costs, potential
from tasks.lift_box.scene import BOX, FORCE_SENSORS, BoxProperties, add_box_scene
from tasks.lift_box.stages import HOLD, STAGES, Progress, advance, failure_name, lasted
from tasks.lift_box.sweeps import SWEEPS

_NOISE_STREAM, _PUSH_STREAM = 2, 4


class LiftBox(Task):
    """Walk to a box, squeeze it between the palms, lift it, stand upright and hold it.

    Args:
        config: ranges, thresholds and weights.
    """

    name = "lift_box"
    stages = STAGES
    sweeps = SWEEPS
    object_blocks = (
        ObservationBlock("box_position", 3, 1.0),
        ObservationBlock("box_rotation", 6, 1.0),
    )
    added_blocks = (
        ObservationBlock("box_size", 3, 0.1),
        ObservationBlock("palm_to_face", 6, 0.3),
        ObservationBlock("palm_contact", 2, 1.0),
        ObservationBlock("stage", len(STAGES), 1.0),
        ObservationBlock("time_left", 1, 1.0),
        ObservationBlock("best_potential", 1, 5.0),
    )

    def __init__(self, config: LiftBoxConfig | None = None) -> None:
        self.config = LiftBoxConfig() if config is None else config
        self.action = ActionConfig()
        self.episode_length = self.config.episode_length
        self.fall_penalty = self.config.rewards.fall

    def describe(self) -> dict[str, Any]:
        plain: dict[str, Any] = json.loads(json.dumps(asdict(self.config)))
        return plain

    def add_to(self, spec: mujoco.MjSpec) -> None:
        add_box_scene(spec)

    def attach(self, simulation: BatchSimulation) -> None:
        count = simulation.num_robots
        self._simulation = simulation
        self._properties = BoxProperties(simulation)
        self.episode = Episode.empty(count)
        self.progress = Progress.empty(count)
        self.situation: Situation | None = None
        self._number = rows(count)
        self._seed = 0
        self._control_steps = torch.zeros(count, dtype=torch.long)

    # -- episodes --------------------------------------------------------------------------------------------

    def reset(self, ids: Tensor, seed: int, episode: Tensor) -> Start:
        drawn, start = draw(self.config, seed, episode)
        self._seed, self._number[ids] = seed, episode
        self._control_steps[ids] = 0
        self.episode.assign(ids, drawn)
        self.progress.clear(ids)
        self._properties.write(
            rows=ids.cpu().numpy(),
            size=drawn.size.numpy(),
            mass=drawn.mass.numpy(),
            center_of_mass=drawn.center_of_mass.numpy(),
            friction=drawn.friction.numpy(),
            support_height=drawn.support_height.numpy(),
            hands=self.config.control != "no_hands",
        )
        self._simulation.update_constants(ids)
        pose = torch.zeros(len(ids), 7)
        pose[:, 2] = drawn.support_height + 0.5 * drawn.size[:, 2]
        pose[:, 3] = 1.0
        self._simulation.set_object_pose(ids, BOX, pose)
        self.progress.start_position[ids] = pose[:, :2]
        return start

    def step(self, measured: Measurement, decision: Decision) -> Outcome:
        rewards, stages, period = self.config.rewards, self.config.stages, self._simulation.control_period
        self._control_steps += 1
        self._push()
        situation = self.situation = self.look(measured)
        support = self.episode.support_height
        advance(self.progress, situation, support, stages, period)
        success = self.progress.stage >= HOLD
        dropped = self._dropped() & ~success

        value = potential(situation, self.progress, self.episode.size, support, rewards, stages)
        gained = (value - self.progress.best_potential).clamp_min(0.0)
        self.progress.best_potential = torch.maximum(self.progress.best_potential, value)
        per_decision = rewards.stream * value + costs(situation, self.progress, decision.change, rewards)
        reward = gained + per_decision / self.action.decision_steps
        reward = reward + rewards.success * success + rewards.drop * dropped
        return Outcome(reward, success, dropped)

    def _push(self) -> None:
        push = self.config.push
        if push.velocity == 0.0:
            return
        due = self._control_steps % round(push.interval / self._simulation.control_period) == 0
        angle = 2.0 * math.pi * uniform(self._seed, self._moment(), _PUSH_STREAM, 1)[:, 0]
        change = push.velocity * torch.stack([torch.cos(angle), torch.sin(angle), torch.zeros_like(angle)], dim=1)
        self._simulation.push(change * due[:, None])

    def _moment(self) -> Tensor:
        """A number for every control step of every episode (N,), to draw by."""
        return self._number * 100_000 + self._control_steps

    def look(self, measured: Measurement) -> Situation:
        """The situation as it is."""
        return self._look_at(measured, self._simulation.object_pose(BOX))

    def _look_at(self, measured: Measurement, box_pose: Tensor) -> Situation:
        """The situation, were the box at the world pose ``box_pose`` (N, 7)."""
        # The force that each hand exerts on the box; the tests pin the sign.
        force = torch.stack([self._simulation.sensor(name) for name in FORCE_SENSORS], dim=1)
        return observe_situation(measured, box_pose, self.episode.size, force)

    def _dropped(self) -> Tensor:
        return lasted(self.progress.lost_time, self.config.stages.drop_time, self._simulation.control_period)

    @property
    def stage(self) -> Tensor:
        return self.progress.stage

    def failures(self, fallen: Tensor) -> list[str]:
        columns = zip(self.progress.stage.tolist(), fallen.tolist(), self._dropped().tolist(), strict=True)
        return [failure_name(*row) for row in columns]

    def conditions(self) -> dict[str, Tensor]:
        episode = self.episode
        edges = dict(zip(("depth [m]", "width [m]", "height [m]"), episode.size.unbind(1), strict=True))
        support = {"support [m]": episode.support_height}
        return edges | support | {"mass [kg]": episode.mass, "friction": episode.friction}

    # -- observation -----------------------------------------------------------------------------------------

    def observe(self, measured: Measurement, time_left: Tensor) -> dict[str, Tensor]:
        robot, box = measured.robot, self._observed_box(measured)
        pelvis = torch.cat([robot.base_position, robot.base_quaternion], -1)
        position, quaternion = relative_pose(pelvis, box)
        stage = self.progress.stage.clamp(max=len(STAGES) - 1)
        return {
            "box_position": position,
            "box_rotation": rotation_6d(quaternion),
            "box_size": self.episode.size,
            "palm_to_face": self._look_at(measured, box).palm_offset.flatten(1),
            "palm_contact": self.progress.touching.float(),
            "stage": torch.nn.functional.one_hot(stage, len(STAGES)).float(),
            "time_left": time_left[:, None],
            "best_potential": self.progress.best_potential[:, None],
        }

    def _observed_box(self, measured: Measurement) -> Tensor:
        """World pose (N, 7) at which the robot sees the box: off by the noise, in the axes of its pelvis."""
        true = self._simulation.object_pose(BOX)
        shift, turn = self._pose_noise()
        position = true[:, :3] + rotate(measured.robot.base_quaternion, shift)
        return torch.cat([position, multiply(true[:, 3:], from_roll_pitch_yaw(turn))], -1)

    def _pose_noise(self) -> tuple[Tensor, Tensor]:
        """Errors of the observed box position in the pelvis frame [m], and of its attitude in its own [rad], each
        (N, 3); new at every decision."""
        noise = self.config.noise
        fresh = 2.0 * uniform(self._seed, self._moment(), _NOISE_STREAM, 6) - 1.0
        shift = 0.5 * noise.position * (fresh[:, :3] + self.episode.position_bias)
        turn = 0.5 * noise.angle * (fresh[:, 3:] + self.episode.angle_bias)
        return shift, turn
