"""``verify-policy``: whether somebody else's policy does here what its card says that it does."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from torch import Tensor

from evaluation.baselines.onnx_policy import OnnxPolicy, load_controller
from evaluation.protocols.arena import Arena, constant
from evaluation.protocols.skills import FLAT
from evaluation.protocols.trace import Channel, record, time_mean
from evaluation.reporting.reports import markdown_table
from lowlevel.commands import VELOCITY, CommandSpace
from lowlevel.control.whole_body import WholeBodyController
from lowlevel.runs.command_line import command_line
from robots.errors import PilotError

EPISODES = 16
"""Robots in each test."""
TOLERANCE = 0.05
"""Largest difference from the card: share of robots, [m/s] or [rad/s]."""


@dataclass(frozen=True)
class Test:
    """A velocity told from standing, and what is measured of it."""

    told: tuple[float, float, float]
    """vx, vy, yaw rate [m/s, m/s, rad/s]; cut to what the policy can be told."""
    duration: float
    """[s]"""
    component: int | None = None
    """Which component's mean is measured, from 2 s on; None for the share of robots that do not fall."""
    unit: str = "1"


TESTS: dict[str, Test] = {
    "stands": Test((0.0, 0.0, 0.0), 20.0),
    "walks at 0.5 m/s": Test((0.5, 0.0, 0.0), 10.0, 0, "m/s"),
    "walks at 0.9 m/s": Test((0.9, 0.0, 0.0), 10.0, 0, "m/s"),
    "steps sideways at 0.3 m/s": Test((0.0, 0.3, 0.0), 10.0, 1, "m/s"),
    "turns at 0.6 rad/s": Test((0.0, 0.0, 0.6), 10.0, 2, "rad/s"),
    "walks and turns": Test((0.5, 0.0, 0.4), 10.0),
}
"""By the names that they have in the ``verified`` of a card."""

_SETTLED = 2.0
_VELOCITY = {
    "velocity": Channel(
        lambda moment: torch.cat([moment.measured.linear_velocity[:, :2], moment.measured.yaw_rate[:, None]], dim=1),
        (3,),
    )
}


@dataclass(frozen=True)
class Arguments:
    """Let a policy stand, walk and turn, and compare with its card; the exit status is 1 if it does otherwise."""

    policy: tyro.conf.Positional[Path]
    """ONNX file that has a card beside it or here (docs/compare.md), or a controller folder."""


def main(arguments: list[str] | None = None) -> None:
    """Entry point of ``verify-policy``."""
    parsed = tyro.cli(Arguments, args=arguments)
    with command_line("verify-policy", "interrupted"):
        _run(parsed)


def _run(arguments: Arguments) -> None:
    name, controller = load_controller(arguments.policy)
    torch.set_num_threads(1)
    measured = measure(controller)
    stated = controller.card.verified if isinstance(controller, OnnxPolicy) else {}
    unknown = stated.keys() - TESTS.keys()
    if unknown:
        raise PilotError(f"the card of {name} states {min(unknown)!r}, which is no test; these are: {', '.join(TESTS)}")
    print(table(name, told_speeds(controller), measured, stated))
    if not stated:
        print(f'The card states nothing. As it is now:\n\n"verified": {json.dumps(measured, indent=2)}')
        return
    wrong = deviations(measured, stated)
    if wrong:
        raise PilotError(f"{name} does not do what its card says: it {'; it '.join(wrong)}")


def measure(controller: WholeBodyController) -> dict[str, float]:
    """Result of every test by its name."""
    arena = Arena(controller, FLAT, batch=EPISODES)
    return {name: round(_result(arena, test), 3) for name, test in TESTS.items()}


def _result(arena: Arena, test: Test) -> float:
    command = told(test, arena.space)
    trace = record(arena, [constant(seed, test.duration, command, flag=1.0) for seed in range(EPISODES)], _VELOCITY)
    if test.component is None:
        return float(1.0 - trace.has_fallen.mean())
    velocity = time_mean(trace["velocity"][:, trace.steps(_SETTLED, test.duration), test.component])
    return float(np.nan_to_num(velocity).mean())


def told(test: Test, space: CommandSpace) -> Tensor:
    """The command (21,) of a ``test``."""
    command = space.neutral()
    command[VELOCITY] = torch.tensor(test.told)
    return command


def told_speeds(controller: WholeBodyController) -> dict[str, float]:
    """What is left of what is measured in each test once the command is cut to what ``controller`` can be told."""
    supports, space = controller.supports, Arena(controller, FLAT, batch=1).space
    cut = {name: supports.cut(told(test, space)[None])[0, VELOCITY] for name, test in TESTS.items()}
    components = {name: test.component for name, test in TESTS.items()}
    return {name: float(cut[name][component]) for name, component in components.items() if component is not None}


def deviations(measured: dict[str, float], stated: dict[str, float]) -> list[str]:
    """Tests whose results differ from what is ``stated`` by more than TOLERANCE, in words."""
    return [
        f"{name}: {measured[name]:.3f} instead of {value:.3f} {TESTS[name].unit}".removesuffix(" 1")
        for name, value in stated.items()
        if abs(measured[name] - value) > TOLERANCE
    ]


def table(name: str, told: dict[str, float], measured: dict[str, float], stated: dict[str, float]) -> str:
    """What was told, measured and stated, side by side, in Markdown."""

    def written(values: dict[str, float], test: str) -> str:
        return f"{values[test]:.3f}" if test in values else "–"

    rows = [[test, TESTS[test].unit, *(written(v, test) for v in (told, measured, stated))] for test in measured]
    return markdown_table([name, "unit", "told", "here", "card"], rows)


if __name__ == "__main__":
    main(sys.argv[1:])
