"""The integrator at the waist brings the torso to where it is told to be, and forgets robots that begin anew."""

import pytest
import torch
from torch import Tensor

from lowlevel.environment import EnvironmentConfig, PilotEnvironment
from lowlevel.imitation.upright import UprightConfig, UprightTeacher
from lowlevel.task import TaskConfig
from lowlevel.world.measures import Measurement
from robots.g1.constants import joint_index

WAIST = joint_index("waist_pitch_joint")
SAG = 0.15
"""By which the torso of this test is pitched too far, unless the waist is turned [rad]."""


class Still:
    """A teacher that adds nothing to the reference."""

    def label(self, observation: dict[str, Tensor]) -> Tensor:
        return torch.zeros(len(observation["flag"]), 29)

    def forget(self, robots: Tensor) -> None:
        """Nothing is remembered."""


@pytest.fixture
def environment(monkeypatch: pytest.MonkeyPatch) -> PilotEnvironment:
    """Two robots that stand as they are told, but for torsos that sag."""
    environment = PilotEnvironment(
        EnvironmentConfig(num_robots=2, num_threads=1), TaskConfig(mixture=(("stand", 1.0),))
    )
    environment.reset()
    environment.buffers.command = environment.buffers.reference.command.clone()
    turned = torch.zeros(2)

    def torso_error(measured: Measurement, command: Tensor) -> Tensor:
        return torch.stack([torch.zeros(2), SAG + turned, torch.zeros(2)], dim=1)

    monkeypatch.setattr("lowlevel.imitation.upright.torso_error", torso_error)
    environment.turned = turned  # type: ignore[attr-defined]
    return environment


def act(teacher: UprightTeacher, environment: PilotEnvironment, seconds: float) -> Tensor:
    """Turn of the waist that the teacher asks for in the end (2,) [rad], each robot's torso following it."""
    for _ in range(round(seconds / environment.control_period)):
        action = teacher.label({"flag": torch.ones(2, 1)})
        assert (action[:, torch.arange(29) != WAIST] == 0.0).all()
        environment.turned[:] = action[:, WAIST] * environment.action_scale[WAIST]  # type: ignore[attr-defined]
    return environment.turned.clone()  # type: ignore[attr-defined,no-any-return]


def test_a_torso_that_sags_is_brought_up(environment: PilotEnvironment) -> None:
    teacher = UprightTeacher(Still(), environment, UprightConfig(rate=1.0, leak=0.25, settling=0.5))
    assert (act(teacher, environment, 0.48) == 0.0).all()  # not settled yet
    # It approaches 1 / (1 + 0.25) of the way as exp(-1.25 t).
    assert torch.allclose(act(teacher, environment, 0.8), torch.full((2,), -0.8 * 0.63 * SAG), atol=0.01)
    assert torch.allclose(act(teacher, environment, 5.0), torch.full((2,), -0.8 * SAG), atol=0.01)


def test_a_correction_is_limited_and_forgotten_with_its_episode(environment: PilotEnvironment) -> None:
    teacher = UprightTeacher(Still(), environment, UprightConfig(limit=0.06, settling=0.0))
    assert torch.allclose(act(teacher, environment, 5.0), torch.full((2,), -0.06))
    teacher.forget(torch.tensor([True, False]))
    # Nobody has arrived any more, so that nothing is added.
    environment.buffers.command = environment.buffers.command + 1.0
    assert act(teacher, environment, 0.1).tolist() == pytest.approx([0.0, -0.06])
