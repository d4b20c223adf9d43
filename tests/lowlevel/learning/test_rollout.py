from __future__ import annotations

import pytest
import torch

from lowlevel.learning.rollout import RolloutStorage, generalized_advantages, normalized_by_task


def _row(*values: float) -> torch.Tensor:
    return torch.tensor([[float(value)] for value in values])


def test_advantages_match_a_calculation_by_hand() -> None:
    # gamma = 0.5, lambda = 0.5; one robot, three steps, nothing ends.
    # errors: 1 + 0.5 * 4 - 2 = 1;  2 + 0.5 * 6 - 4 = 1;  3 + 0.5 * 8 - 6 = 1
    # advantages, from the last: 1;  1 + 0.25 * 1 = 1.25;  1 + 0.25 * 1.25 = 1.3125
    none = torch.zeros(3, 1, dtype=torch.bool)
    advantages = generalized_advantages(_row(1, 2, 3), _row(2, 4, 6), _row(4, 6, 8), none, none, 0.5, 0.5)
    torch.testing.assert_close(advantages, _row(1.3125, 1.25, 1.0))


def test_failure_is_worth_nothing_afterwards_and_timeout_is_bootstrapped() -> None:
    # Robot 0 fails at step 1, robot 1 runs out of time there; the value before the reset is 10 for both.
    rewards = torch.tensor([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]])
    values = torch.full((3, 2), 2.0)
    next_values = torch.tensor([[2.0, 2.0], [10.0, 10.0], [4.0, 4.0]])
    terminated = torch.tensor([[False, False], [True, False], [False, False]])
    truncated = torch.tensor([[False, False], [False, True], [False, False]])
    advantages = generalized_advantages(rewards, values, next_values, terminated, truncated, 0.5, 0.5)
    # step 2: 3 + 0.5 * 4 - 2 = 3.  step 1: 2 - 2 = 0 and 2 + 0.5 * 10 - 2 = 5, neither sees step 2.
    # step 0: 1 + 0.5 * 2 - 2 = 0, plus 0.25 times step 1.
    torch.testing.assert_close(advantages, torch.tensor([[0.0, 1.25], [0.0, 5.0], [3.0, 3.0]]))


def test_lambda_one_gives_discounted_returns() -> None:
    generator = torch.Generator().manual_seed(0)
    rewards, values = torch.randn(2, 30, 4, generator=generator)
    last = torch.randn(1, 4, generator=generator)
    none = torch.zeros(30, 4, dtype=torch.bool)
    next_values = torch.cat([values[1:], last])
    advantages = generalized_advantages(rewards, values, next_values, none, none, 0.9, 1.0)
    powers = 0.9 ** torch.arange(30.0)
    expected = (powers[:, None] * rewards).sum(dim=0) + 0.9**30 * last[0]
    torch.testing.assert_close((advantages + values)[0], expected, rtol=1e-4, atol=1e-5)


def test_storage_keeps_steps_in_order() -> None:
    storage = RolloutStorage(2, 3, {"x": (2,), "reward": ()}, torch.device("cpu"))
    for step in range(2):
        storage.write({"x": torch.full((3, 2), float(step)), "reward": torch.arange(3.0) + 10 * step})
        storage.finish_step(
            torch.tensor([False, True, False]), torch.zeros(3, dtype=torch.bool), torch.tensor([4, 0, 2])
        )
    assert storage.full
    assert storage.flat("reward").tolist() == [0, 1, 2, 10, 11, 12]
    assert storage.data["reward"].tolist() == [[0, 1, 2], [10, 11, 12]]
    assert storage.task.tolist() == [[4, 0, 2]] * 2
    assert storage.terminated.tolist() == [[False, True, False]] * 2


def test_storage_refuses_wrong_shapes_and_overflow() -> None:
    storage = RolloutStorage(1, 3, {"x": (2,)}, torch.device("cpu"))
    with pytest.raises(ValueError, match=r"x has shape \(3, 4\), expected \(3, 2\)"):
        storage.write({"x": torch.zeros(3, 4)})
    never = torch.zeros(3, dtype=torch.bool)
    storage.finish_step(never, never, never.long())
    with pytest.raises(ValueError, match="already holds its 1 steps"):
        storage.write({"x": torch.zeros(3, 2)})
    storage.clear()
    storage.write({"x": torch.zeros(3, 2)})


def test_advantages_are_normalized_within_each_task() -> None:
    task = torch.tensor([[0, 2, 0, 2], [0, 2, 0, 0]])
    advantages = torch.tensor([[1.0, 100.0, 3.0, 300.0], [1.0, 200.0, 3.0, 2.0]])
    values = normalized_by_task(advantages, task, tasks=3)
    one, hundred = 5**0.5 / 2, 1.5**0.5  # deviations 0.8**0.5 and 100 * (2 / 3)**0.5
    expected = torch.tensor([[-one, -hundred, one, hundred], [-one, 0.0, one, 0.0]])
    torch.testing.assert_close(values, expected)
