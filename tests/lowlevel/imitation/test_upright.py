"""Integrators bring the torso to where it is told to be and the robot over its feet, and forget who begins anew."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from lowlevel.control.stepping import FARTHEST
from lowlevel.environment import EnvironmentConfig, PilotEnvironment
from lowlevel.imitation.upright import UprightConfig, UprightTeacher
from lowlevel.task import TaskConfig
from lowlevel.world.measures import Measurement
from robots.g1.constants import joint_index

WAIST = joint_index("waist_pitch_joint")
ANKLES = [joint_index("left_ankle_pitch_joint"), joint_index("right_ankle_pitch_joint")]
SAG = 0.15
"""By which the torso of this test is pitched too far, unless the waist is turned [rad]."""
AHEAD = 0.05
"""By which its capture point is ahead, unless the ankles are turned [m]."""
FALL_PER_TURN = 1.0
"""By which it comes back per turn of the ankles [m/rad]."""


class Still:
    """A teacher that adds nothing to the reference."""

    def label(self, observation: dict[str, Tensor]) -> Tensor:
        return torch.zeros(len(observation["flag"]), 29)

    def forget(self, robots: Tensor) -> None:
        """Nothing is remembered."""


class Leaning:
    """Two robots that stand as they are told, but lean forwards: torsos from the waist, and all of them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.environment = PilotEnvironment(
            EnvironmentConfig(num_robots=2, num_threads=1), TaskConfig(mixture=(("stand", 1.0),))
        )
        self.environment.reset()
        self.environment.buffers.command = self.environment.buffers.reference.command.clone()
        self.waist, self.ankles, self.push = torch.zeros(2), torch.zeros(2), 0.0
        measured = self.environment.world.measure()

        def measure() -> Measurement:
            ahead = AHEAD - FALL_PER_TURN * self.ankles + self.push
            return replace(measured, capture_point=torch.stack([ahead, torch.zeros(2)], dim=1))

        def torso_error(measured: Measurement, command: Tensor) -> Tensor:
            return torch.stack([torch.zeros(2), SAG + self.waist, torch.zeros(2)], dim=1)

        monkeypatch.setattr(self.environment.world, "measure", measure)
        monkeypatch.setattr("lowlevel.imitation.upright.torso_error", torso_error)

    def act(self, teacher: UprightTeacher, seconds: float) -> None:
        """Turn waists and ankles as ``teacher`` says, which the robots follow at once."""
        scale = self.environment.action_scale
        for _ in range(round(seconds / self.environment.control_period)):
            action = teacher.label({"flag": torch.ones(2, 1)})
            others = [joint for joint in range(29) if joint not in (WAIST, *ANKLES)]
            assert (action[:, others] == 0.0).all() and torch.equal(action[:, ANKLES[0]], action[:, ANKLES[1]])
            self.waist, self.ankles = action[:, WAIST] * scale[WAIST], action[:, ANKLES[0]] * scale[ANKLES[0]]


@pytest.fixture
def robots(monkeypatch: pytest.MonkeyPatch) -> Leaning:
    return Leaning(monkeypatch)


def test_a_torso_that_sags_is_brought_up_and_a_robot_that_leans_over_its_feet(robots: Leaning) -> None:
    config = UprightConfig(waist_rate=1.0, ankle_rate=3.0, leak=0.25, settling=0.5)
    teacher = UprightTeacher(Still(), robots.environment, config)
    robots.act(teacher, 0.48)
    assert (robots.waist == 0.0).all() and (robots.ankles == 0.0).all()  # not settled yet
    # Waists approach 1 / (1 + 0.25) of the way as exp(-1.25 t), ankles 3 / (3 + 0.25) of it as exp(-3.25 t).
    robots.act(teacher, 0.8)
    assert torch.allclose(robots.waist, torch.full((2,), -0.8 * 0.63 * SAG), atol=0.01)
    assert torch.allclose(robots.ankles, torch.full((2,), 0.92 * 0.93 * AHEAD), atol=0.003)
    robots.act(teacher, 5.0)
    assert torch.allclose(robots.waist, torch.full((2,), -0.8 * SAG), atol=0.01)
    assert torch.allclose(robots.ankles, torch.full((2,), 0.92 * AHEAD), atol=0.003)


def test_ankles_wait_while_a_robot_topples_and_are_let_go_when_it_steps(robots: Leaning) -> None:
    teacher = UprightTeacher(Still(), robots.environment, UprightConfig(settling=0.0))
    robots.act(teacher, 5.0)
    held = robots.ankles.clone()
    assert (held > 0.8 * AHEAD).all()
    robots.push = 1.1 * FARTHEST
    robots.act(teacher, 1.0)
    assert torch.equal(robots.ankles, held)
    buffers = robots.environment.buffers
    buffers.reference = buffers.reference._replace(phase=torch.tensor([1.0, 0.0]))
    robots.act(teacher, 0.02)
    assert robots.ankles.tolist() == pytest.approx([0.0, float(held[1])])


def test_a_correction_is_limited_and_forgotten_with_its_episode(robots: Leaning) -> None:
    teacher = UprightTeacher(Still(), robots.environment, UprightConfig(limit=0.03, settling=0.0))
    robots.act(teacher, 5.0)
    assert torch.allclose(robots.waist, torch.full((2,), -0.03)) and torch.allclose(robots.ankles, -robots.waist)
    teacher.forget(torch.tensor([True, False]))
    # Nobody has arrived any more, so that nothing is added.
    robots.environment.buffers.command = robots.environment.buffers.command + 1.0
    robots.act(teacher, 0.1)
    assert robots.waist.tolist() == pytest.approx([0.0, -0.03])
    assert robots.ankles.tolist() == pytest.approx([0.0, 0.03])
