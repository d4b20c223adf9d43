"""What the policy is told instead of the commanded velocity."""

from __future__ import annotations

import pytest
import torch
from some_correction import fill
from torch import Tensor

from lowlevel.commands import COMMAND_SIZE, HEIGHT, MIRROR, VELOCITY, CommandSpace, command_space
from lowlevel.control.observation import FrameView, Proprioception
from lowlevel.control.reference import ReferenceState
from lowlevel.control.velocity_correction import LARGEST, VelocityCorrection
from robots.g1.model import build_spec, joint_limits


@pytest.fixture(scope="module")
def space() -> CommandSpace:
    limits = joint_limits(build_spec().compile())
    return command_space(limits[:, 0].tolist(), limits[:, 1].tolist())


def some_commands(space: CommandSpace, count: int) -> Tensor:
    lower, upper = space.bounds()
    return lower + torch.rand(count, COMMAND_SIZE, generator=torch.Generator().manual_seed(0)) * (upper - lower)


def view(space: CommandSpace, command: Tensor, slewed: Tensor) -> FrameView:
    joints, vectors = torch.zeros(len(command), 29), torch.zeros(len(command), 3)
    measured = Proprioception(joints, joints, vectors, vectors)
    return FrameView(measured, command, joints, ReferenceState.standing(slewed), space)


def test_a_mirrored_command_has_the_mirrored_correction_and_standing_has_none(space: CommandSpace) -> None:
    correction = fill(VelocityCorrection(space), std=0.1)
    command = some_commands(space, 50)
    index, sign = torch.as_tensor(MIRROR.index), torch.as_tensor(MIRROR.sign, dtype=command.dtype)
    found = correction(command)
    assert 0.05 < found.abs().max() <= LARGEST
    assert torch.allclose(correction(command[:, index] * sign), found * sign[VELOCITY], atol=1e-6)
    command[:, VELOCITY] = 0.02
    assert not correction(command).any()


def test_command_and_slewed_command_are_each_told_with_their_own_correction(space: CommandSpace) -> None:
    correction = fill(VelocityCorrection(space), std=0.1)
    command, slewed = some_commands(space, 80).chunk(2)
    lower, upper = (bound[VELOCITY] for bound in space.bounds())
    told = correction.tell(view(space, command, slewed))
    for meant, got in ((command, told.command), (slewed, told.reference.command)):
        assert torch.equal(got[:, HEIGHT:], meant[:, HEIGHT:])
        wanted = meant[:, VELOCITY] + correction(meant)
        inside = ((wanted > lower) & (wanted < upper)).all(dim=1)
        assert inside.any() and not inside.all()
        assert torch.allclose(got[inside, VELOCITY], wanted[inside], atol=1e-6)
        assert (got[:, VELOCITY] >= lower).all() and (got[:, VELOCITY] <= upper).all()


def test_before_it_is_fitted_it_corrects_nothing(space: CommandSpace) -> None:
    correction = VelocityCorrection(space)
    command = some_commands(space, 20)
    command[0, 0] = 2.0  # beyond the bounds, as nobody should ask for
    told = correction.tell(view(space, command, command))
    assert torch.equal(told.command, command)
    assert torch.equal(told.reference.command, command)
