"""When a robot that is told to stand must step, and how its gait clock then runs."""

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
