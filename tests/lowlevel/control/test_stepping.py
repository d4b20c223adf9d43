"""When a robot that is told to stand must step, and how its gait clock then runs."""

import math

import pytest
import torch

from lowlevel.commands import HEIGHT, command_space
from lowlevel.control.reference import Reference, ReferenceConfig, ReferenceState
from lowlevel.control.stepping import FARTHEST, swing_first
from robots.g1.constants import GAINS
from robots.g1.model import build_spec, joint_limits


def test_the_foot_that_is_free_swings_first() -> None:
    far, near = 1.1 * FARTHEST, 0.9 * FARTHEST
    point = torch.tensor([[0.0, -far], [0.0, far], [far, 0.0], [near, 0.0], [0.0, 0.0]])
    assert swing_first(point).abs().tolist() == [1.0, 1.0, 1.0, 0.0, 0.0]
    assert swing_first(point)[:2].tolist() == [1.0, -1.0]


def test_a_robot_at_rest_makes_two_steps_and_rests_again() -> None:
    limits = joint_limits(build_spec().compile())
    space = command_space(limits[:, 0].tolist(), limits[:, 1].tolist())
    reference = Reference(ReferenceConfig(), GAINS["stiff"], control_period=0.02)
    stand = space.neutral().repeat(4, 1)
    stand[2, HEIGHT] = 0.45  # too deep to step in: it stands up for the steps, and goes down again
    stand = reference.clamp(stand)
    state = reference.begin_step(ReferenceState.standing(stand), torch.tensor([1.0, -1.0, 1.0, 0.0]))
    assert state.walking.tolist() == [True, True, True, False]
    heights = []
    swings: list[list[str]] = [[], []]
    for _ in range(90):
        heights.append(float(state.command[2, HEIGHT]))
        for row in range(2):
            sine = float(state.clock[row, 0])
            foot = "left" if sine > 0.0 else "right"
            if abs(sine) > 0.1 and swings[row][-1:] != [foot]:
                swings[row].append(foot)
        state = reference.advance(state, stand)
        if state.walking.any():  # while the clock runs, nothing more can be asked for
            again = torch.where(state.walking, -1.0, 0.0)
            torch.testing.assert_close(reference.begin_step(state, again).phase, state.phase)
    assert swings == [["left", "right"], ["right", "left"]]
    assert not state.walking.any()
    assert max(heights) == pytest.approx(0.55, abs=1e-3)
    torch.testing.assert_close(state.command, stand)


def test_catching_steps_are_faster_and_lead_on_into_a_walk() -> None:
    limits = joint_limits(build_spec().compile())
    space = command_space(limits[:, 0].tolist(), limits[:, 1].tolist())
    config = ReferenceConfig(gait_frequency=2.0, catching_frequency=2.5)
    reference = Reference(config, GAINS["stiff"], control_period=0.02)
    stand, walk = space.neutral().repeat(2, 1), space.neutral().repeat(2, 1)
    walk[:, 0] = 0.5
    caught = reference.begin_step(ReferenceState.standing(stand), torch.tensor([1.0, -1.0]))
    state, steps = caught, 0
    while state.walking.any():
        assert state.walking.all(), "either foot's two steps take as long"
        state, steps = reference.advance(state, stand), steps + 1
    assert steps == pytest.approx(50 / 2.5, abs=1)
    told_to_walk = reference.advance(caught, walk)
    turned = torch.atan2(told_to_walk.clock[:, 0], told_to_walk.clock[:, 1]) - torch.atan2(
        caught.clock[:, 0], caught.clock[:, 1]
    )
    torch.testing.assert_close(turned, torch.full((2,), 2.0 * math.pi * 2.0 * 0.02), atol=1e-4, rtol=0.0)
