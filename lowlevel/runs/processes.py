"""Cores and threads of processes. Child processes compute on one thread: importing this module sees to it.

The threads of torch's pool are not forked with a process, and its child waits for them for ever in the first operation
that is large enough to be shared out. And where every worker of a vectorized environment takes all cores, they run at a
third of their speed.
"""

from __future__ import annotations

import multiprocessing
import os

import torch


def _compute_on_one_thread() -> None:
    torch.set_num_threads(1)


if hasattr(os, "register_at_fork"):  # not on Windows, which does not fork
    os.register_at_fork(after_in_child=_compute_on_one_thread)
# One that was spawned has its name before anything else, and its parent only afterwards.
if multiprocessing.current_process().name != "MainProcess":
    _compute_on_one_thread()


def available_cores() -> int:
    """Cores that this process may use: taskset and containers allow some of the machine's."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
