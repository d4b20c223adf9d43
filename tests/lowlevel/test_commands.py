"""The command space and its sampling (paper III-B-5)."""

import math
from dataclasses import replace

import pytest
import torch

from lowlevel.commands import (
    ARMS,
    HEIGHT,
    STANDING_SPEED,
    TORSO,
    VELOCITY,
    CommandMixture,
    CommandRange,
    CommandSampler,
    CommandSpace,
    command_space,
    is_walking,
)
from robots.g1.model import build_spec, joint_limits


@pytest.fixture(scope="module")
def space() -> CommandSpace:
    limits = joint_limits(build_spec().compile())
    return command_space(limits[:, 0].tolist(), limits[:, 1].tolist())


def draw(space: CommandSpace, open_range: CommandRange, count: int = 4000) -> tuple[torch.Tensor, torch.Tensor]:
    sampler = CommandSampler(space, CommandMixture(), "cpu")
    return sampler.sample(count, open_range, torch.Generator().manual_seed(0))


def test_has_a_name_unit_and_ordered_bounds_for_each_of_21_numbers(space: CommandSpace) -> None:
    assert {len(space.names), len(space.units), len(space.lower), len(space.upper)} == {21}
    assert all(low < high for low, high in zip(space.lower, space.upper, strict=True))


def test_samples_stay_inside_the_bounds_and_fill_them(space: CommandSpace) -> None:
    command, _ = draw(space, CommandRange())
    lower, upper = space.bounds()
    assert (command >= lower - 1e-6).all() and (command <= upper + 1e-6).all()
    span = command.amax(0) - command.amin(0)
    assert (span[: ARMS.start] > 0.9 * (upper - lower)[: ARMS.start]).all()


def test_shares_of_the_mixture(space: CommandSpace) -> None:
    command, flag = draw(space, CommandRange())
    walks = is_walking(command)
    assert flag.mean().item() == pytest.approx(0.8, abs=0.03)
    assert (walks & (flag[:, 0] == 0)).float().mean().item() == pytest.approx(0.2, abs=0.03)
    assert (~walks).float().mean().item() == pytest.approx(0.4, abs=0.04)


def test_slow_commands_are_slower_by_their_scale(space: CommandSpace) -> None:
    walking = CommandMixture(walk_and_work=1.0, stand_and_work=0.0)

    def speeds(mixture: CommandMixture) -> torch.Tensor:
        sampler = CommandSampler(space, mixture)
        return sampler.sample(4000, CommandRange(), torch.Generator().manual_seed(0))[0][:, VELOCITY].abs()

    some, none = speeds(replace(walking, slow=0.5, slow_scale=0.2)), speeds(walking)
    fast = [(speed[:, 0] > 0.2 * 1.2).float().mean().item() for speed in (some, none)]
    assert fast[0] == pytest.approx(0.5 * fast[1], abs=0.03)
    assert some.mean().item() == pytest.approx((0.5 + 0.5 * 0.2) * none.mean().item(), rel=0.05)


def test_the_stand_share_stands_in_the_neutral_posture(space: CommandSpace) -> None:
    sampler = CommandSampler(space, CommandMixture(walk_and_work=0.3, stand_and_work=0.3, stand=0.3))
    command, flag = sampler.sample(4000, CommandRange(), torch.Generator().manual_seed(0))
    neutral = (command == space.neutral()).all(dim=1)
    assert neutral.float().mean().item() == pytest.approx(0.3, abs=0.03)
    assert not flag[neutral].any()


def test_walking_commands_keep_to_the_walking_posture(space: CommandSpace) -> None:
    command, flag = draw(space, CommandRange())
    walking = command[is_walking(command)]
    assert walking[:, HEIGHT].min() >= 0.55
    assert walking[:, TORSO].abs().max(dim=0).values.tolist() == pytest.approx([0.2, 0.5, 0.5], abs=0.01)
    neutral = space.neutral()
    assert torch.equal(command[flag[:, 0] == 0][:, HEIGHT:], neutral[HEIGHT:].expand(int((flag == 0).sum()), -1))


def test_slow_commands_become_exact_stops(space: CommandSpace) -> None:
    command, _ = draw(space, CommandRange())
    speed = command[:, VELOCITY].norm(dim=-1)
    assert ((speed == 0) | (speed >= STANDING_SPEED)).all()


@pytest.mark.parametrize("openness", [0.0, 0.5, 1.0])
def test_arm_radius_follows_equation_two(space: CommandSpace, openness: float) -> None:
    """The mean of U(0, r) with r from Equation 2, against a numerical integral of the closed form."""
    command, flag = draw(space, CommandRange(arms=openness), count=20000)
    arms = command[flag[:, 0] == 1][:, ARMS]
    lower, upper = (bound[ARMS] for bound in space.bounds())
    away = arms - space.neutral()[ARMS]
    distance = torch.where(away > 0, away / (upper - space.neutral()[ARMS]), away / (lower - space.neutral()[ARMS]))
    rate = 20.0 * (1.0 - 0.99 * openness)
    uniform = (torch.arange(100000) + 0.5) / 100000
    radius = -torch.log(1.0 - uniform * (1.0 - math.exp(-rate))) / rate
    assert distance.mean().item() == pytest.approx(radius.mean().item() / 2.0, rel=0.02)


def test_closed_ranges_give_the_neutral_posture(space: CommandSpace) -> None:
    command, _ = draw(space, CommandRange(velocity=0.0, height=0.0, torso=0.0, arms=0.0))
    assert torch.equal(command[:, : ARMS.start], space.neutral()[: ARMS.start].expand(len(command), -1))
