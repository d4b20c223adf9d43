"""Bounds, rate limits and their inverse."""

from __future__ import annotations

import pytest
import torch

from highlevel.action import ActionConfig, ActionMap, interpolate
from lowlevel.commands import ARMS, HEIGHT, VELOCITY


@pytest.fixture
def action_map() -> ActionMap:
    return ActionMap(ActionConfig(), 0.02)


def test_extreme_actions_give_the_bounds_of_the_table(action_map: ActionMap) -> None:
    lowest = action_map.command(torch.full((1, 21), -3.0))[0]
    highest = action_map.command(torch.full((1, 21), 3.0))[0]
    torch.testing.assert_close(lowest[:7], torch.tensor([-0.3, -0.3, -0.8, 0.33, -0.15, -0.1, -0.3]))
    torch.testing.assert_close(highest[:7], torch.tensor([0.6, 0.3, 0.8, 0.76, 0.15, 1.4, 0.3]))


def test_commands_change_no_faster_than_their_rates(action_map: ActionMap) -> None:
    generator = torch.Generator().manual_seed(0)
    command = action_map.command(torch.zeros(64, 21))
    # Rates per second from the table, times one decision of 0.1 s.
    rates = [0.1, 0.1, 0.2, 0.04, 0.05, 0.12, 0.05, *([0.2] * 14)]
    for _ in range(30):
        action = 4.0 * torch.rand(64, 21, generator=generator) - 2.0
        following = action_map.limit(command, action)
        assert ((following - command).abs() <= torch.tensor(rates) + 1e-6).all()
        assert (following >= action_map.lower - 1e-6).all() and (following <= action_map.upper + 1e-6).all()
        command = following


def test_a_held_action_is_reached(action_map: ActionMap) -> None:
    action = 2.0 * torch.rand(8, 21, generator=torch.Generator().manual_seed(1)) - 1.0
    command = action_map.command(torch.zeros(8, 21))
    for _ in range(25):
        command = action_map.limit(command, action)
    torch.testing.assert_close(command, action_map.command(action))
    torch.testing.assert_close(action_map.action(command), action, atol=1e-5, rtol=0)


def test_arms_of_equal_actions_mirror_each_other(action_map: ActionMap) -> None:
    middle = action_map.command(torch.zeros(1, 21))[0, ARMS]
    sign = torch.tensor([1.0, -1, -1, 1, -1, 1, -1])
    torch.testing.assert_close(middle[7:], middle[:7] * sign)


def test_interpolation_is_linear_and_never_creeps() -> None:
    previous, goal = torch.zeros(1, 21), torch.zeros(1, 21)
    previous[0, HEIGHT], goal[0, HEIGHT] = 0.7, 0.6
    goal[0, VELOCITY] = torch.tensor([0.2, 0.0, 0.0])
    halfway = interpolate(previous, goal, 0.5)
    torch.testing.assert_close(halfway[0, HEIGHT], torch.tensor(0.65))
    torch.testing.assert_close(halfway[0, 0], torch.tensor(0.1))
    assert interpolate(previous, goal, 0.4)[0, 0] == 0.0
