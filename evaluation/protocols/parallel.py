"""Several runs of episodes side by side: one process and one thread per core; a single run gets all threads."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path

import torch

from evaluation.protocols.policies import make_policy
from highlevel.environment import CommandEnvironment, PhysicsConfig
from highlevel.episodes import EpisodeRecord, run_episodes
from highlevel.task import Task
from lowlevel.world.randomization import RandomizationConfig
from robots.errors import PilotError


@dataclass(frozen=True)
class Run:
    """Episodes 0 to ``count`` - 1 of a task that no environment has taken over yet."""

    name: str
    task: Task
    count: int


@dataclass(frozen=True)
class Setting:
    """What all runs of an evaluation share."""

    planner: str
    """Planner folder, or "scripted"."""
    controller: Path
    seed: int
    robots: int
    """Robots side by side in a run."""
    mjcf: Path | None = None
    """Somebody else's MJCF of the robot."""
    randomization: RandomizationConfig | None = None
    """Of the robots; None for what the model has."""


def run_all(
    runs: Sequence[Run], setting: Setting, threads: int, on_progress: Callable[[str, int], None]
) -> list[list[EpisodeRecord]]:
    """Records of every run, in the order of ``runs``; the same ones for any number of ``threads``.

    Physics is the only part of a simulation that uses several threads, so that independent simulations on one thread
    each keep the cores busier than one after the other on all of them.

    Args:
        runs: what to run.
        setting: with whom.
        threads: threads to keep busy.
        on_progress: told the name of a run that goes on or has ended, and how many episodes are over in all.
    """
    processes = min(threads, len(runs))
    finished = 0
    if processes < 2:
        records = []
        for run in runs:

            def report(over: int, name: str = run.name, before: int = finished) -> None:
                on_progress(name, before + over)

            records.append(_run(run, setting, threads, report))
            finished += run.count
        return records

    # A forked child of a process that has run torch's threads may hang.
    context = multiprocessing.get_context("spawn")
    executor = ProcessPoolExecutor(processes, context, initializer=_begin_worker)
    try:
        futures = {executor.submit(_run, run, setting, threads // processes): run for run in runs}
        for future in as_completed(futures):
            future.result()
            finished += futures[future].count
            on_progress(futures[future].name, finished)
    except BrokenProcessPool as error:
        raise PilotError("a worker process was killed, perhaps for want of memory: try fewer --threads") from error
    except BaseException:
        # Their results are lost either way; a run that goes on would keep this process waiting for minutes.
        for process in multiprocessing.active_children():
            process.terminate()
        raise
    finally:
        executor.shutdown(cancel_futures=True)
    return [future.result() for future in futures]


def _run(
    run: Run, setting: Setting, threads: int, on_progress: Callable[[int], None] | None = None
) -> list[EpisodeRecord]:
    physics = PhysicsConfig(num_threads=threads, mjcf=setting.mjcf)
    environment = CommandEnvironment(
        run.task, setting.controller, setting.robots, physics=physics, randomization=setting.randomization
    )
    policy = make_policy(setting.planner, environment, setting.controller)
    return run_episodes(environment, policy, run.count, setting.seed, on_progress=on_progress)


def _begin_worker() -> None:
    # Ctrl-C reaches the whole group; the parent alone decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
