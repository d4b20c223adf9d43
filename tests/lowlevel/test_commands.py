"""The command space and its sampling (paper III-B-5)."""

import math

import numpy as np
import pytest
import torch

from lowlevel.commands import (
    ARMS,
    HEIGHT,
    KINDS,
    PROTOCOL,
    STANDING_SPEED,
    TORSO,
    VELOCITY,
    CommandSampler,
    CommandSpace,
    Mixture,
    command_space,
    is_walking,
    shares,
)
from robots.g1.mirror import ARMS_MIRROR
from robots.g1.model import build_spec, joint_limits


@pytest.fixture(scope="module")
def space() -> CommandSpace:
    limits = joint_limits(build_spec().compile())
    return command_space(limits[:, 0].tolist(), limits[:, 1].tolist())


def draw(
    space: CommandSpace, mixture: Mixture = PROTOCOL, opening: float = 1.0, count: int = 4000
) -> tuple[torch.Tensor, torch.Tensor]:
    sampler, generator = CommandSampler(space), torch.Generator().manual_seed(0)
    kinds = sampler.draw_kinds(count, shares(mixture), generator)
    return sampler.sample(kinds, torch.full((len(KINDS),), opening), generator)


def test_has_a_name_unit_and_ordered_bounds_for_each_of_21_numbers(space: CommandSpace) -> None:
    assert {len(space.names), len(space.units), len(space.lower), len(space.upper)} == {21}
    assert all(low < high for low, high in zip(space.lower, space.upper, strict=True))


def test_samples_stay_inside_the_bounds_and_fill_them(space: CommandSpace) -> None:
    command, _ = draw(space)
    lower, upper = space.bounds()
    assert (command >= lower - 1e-6).all() and (command <= upper + 1e-6).all()
    span = command.amax(0) - command.amin(0)
    assert (span[: ARMS.start] > 0.9 * (upper - lower)[: ARMS.start]).all()


def test_shares_of_the_mixture(space: CommandSpace) -> None:
    command, flag = draw(space)
    walks = is_walking(command)
    assert flag.mean().item() == pytest.approx(0.8, abs=0.03)
    assert (walks & (flag[:, 0] == 0)).float().mean().item() == pytest.approx(0.2, abs=0.03)
    assert (~walks).float().mean().item() == pytest.approx(0.4, abs=0.04)


def test_steering_is_left_out_as_often_as_stated(space: CommandSpace) -> None:
    command, _ = draw(space, (("steer", 1.0),))
    still = (command[:, 1:3] == 0.0).float().mean(dim=0)
    assert still.tolist() == pytest.approx([0.5, 0.5], abs=0.04)


def test_every_kind_stays_in_its_box(space: CommandSpace) -> None:
    for name, kind in KINDS.items():
        command, flag = draw(space, ((name, 1.0),))
        boxes = torch.tensor([*kind.velocity, kind.height, *kind.torso])
        assert (command[:, :7] >= boxes[:, 0] - 1e-6).all() and (command[:, :7] <= boxes[:, 1] + 1e-6).all(), name
        assert (flag == float(kind.tracks)).all()
        assert torch.equal(command[:, ARMS], space.neutral()[ARMS].expand(4000, -1)) is not kind.arms


def test_arms_that_hold_are_mirror_images_of_each_other_and_others_are_not(space: CommandSpace) -> None:
    for name, kind in KINDS.items():
        if kind.arms:
            arms = draw(space, ((name, 1.0),))[0][:, ARMS].numpy()
            assert np.allclose(ARMS_MIRROR(arms), arms) is (kind.left_arm is not None), name
            assert arms[:, 0].std() > 0.3
            if kind.left_arm is not None:
                low, high = np.array(kind.left_arm).T
                assert (arms[:, :7] >= low - 1e-6).all() and (arms[:, :7] <= high + 1e-6).all()


def test_unknown_kinds_and_wrong_shares_are_refused() -> None:
    with pytest.raises(ValueError, match="unknown kind of command 'moonwalk'"):
        shares((("moonwalk", 1.0),))
    with pytest.raises(ValueError, match=r"add up to 0\.500"):
        shares((("walk", 0.5),))


def test_walking_commands_keep_to_the_walking_posture(space: CommandSpace) -> None:
    command, flag = draw(space)
    walking = command[is_walking(command)]
    assert walking[:, HEIGHT].min() >= 0.55
    assert walking[:, TORSO].abs().max(dim=0).values.tolist() == pytest.approx([0.2, 0.5, 0.5], abs=0.01)
    neutral = space.neutral()
    assert torch.equal(command[flag[:, 0] == 0][:, HEIGHT:], neutral[HEIGHT:].expand(int((flag == 0).sum()), -1))


def test_slow_commands_become_exact_stops(space: CommandSpace) -> None:
    command, _ = draw(space)
    speed = command[:, VELOCITY].norm(dim=-1)
    assert ((speed == 0) | (speed >= STANDING_SPEED)).all()


@pytest.mark.parametrize("openness", [0.1, 0.5, 1.0])
def test_arm_radius_follows_equation_two(space: CommandSpace, openness: float) -> None:
    """The mean of U(0, r) with r from Equation 2, against a numerical integral of the closed form."""
    command, flag = draw(space, (("stand_and_work", 0.8), ("walk", 0.2)), openness, count=20000)
    arms = command[flag[:, 0] == 1][:, ARMS]
    lower, upper = (bound[ARMS] for bound in space.bounds())
    away = arms - space.neutral()[ARMS]
    distance = torch.where(away > 0, away / (upper - space.neutral()[ARMS]), away / (lower - space.neutral()[ARMS]))
    rate = 20.0 * (1.0 - 0.99 * openness)
    uniform = (torch.arange(100000) + 0.5) / 100000
    radius = -torch.log(1.0 - uniform * (1.0 - math.exp(-rate))) / rate
    assert distance.mean().item() == pytest.approx(radius.mean().item() / 2.0, rel=0.02)


def test_closed_ranges_give_the_neutral_posture(space: CommandSpace) -> None:
    command, _ = draw(space, opening=0.0)
    assert torch.equal(command[:, : ARMS.start], space.neutral()[: ARMS.start].expand(len(command), -1))
