"""Child processes compute on one thread, however they came to be."""

import multiprocessing
from multiprocessing.queues import Queue

import pytest
import torch

import lowlevel  # noqa: F401 (which sees to it)

LARGE = 20_000_000
"""Numbers that torch shares out among its threads."""


def _sum(threads: "Queue[tuple[int, float]]") -> None:
    threads.put((torch.get_num_threads(), float(torch.ones(LARGE).sum())))


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_a_child_of_a_process_with_threads_computes_alone(method: str) -> None:
    assert float(torch.ones(LARGE).sum()) == LARGE
    context = multiprocessing.get_context(method)
    answers: Queue[tuple[int, float]] = context.Queue()
    child = context.Process(target=_sum, args=(answers,), daemon=True)
    child.start()
    try:
        assert answers.get(timeout=60.0) == (1, LARGE)
    finally:
        child.kill()
