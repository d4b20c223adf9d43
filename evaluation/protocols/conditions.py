"""Conditions under which the tracking protocol is run: what may be other than in the protocol, as data."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from evaluation.protocols.arena import Episode, Push
from lowlevel.world.randomization import RandomizationConfig
from robots.errors import PilotError
from robots.g1.model import ModelOptions


@dataclass(frozen=True)
class Condition:
    """What is other than in the protocol."""

    group: str
    """What is varied."""
    label: str
    """What it is here."""
    randomization: RandomizationConfig = RandomizationConfig.for_evaluation()  # noqa: RUF009 (frozen)
    options: ModelOptions = ModelOptions()  # noqa: RUF009 (frozen)
    push_speed: float = 0.0
    """The velocity changes by as much in a random horizontal direction, PUSH_TIMES after every start [m/s]."""

    def disturbed(self, episodes: list[Episode]) -> list[Episode]:
        """The same ``episodes`` with this condition's pushes."""
        if self.push_speed == 0.0:
            return episodes
        return [replace(episode, pushes=_pushes(episode, self.push_speed)) for episode in episodes]


PUSH_TIMES = (4.0, 8.0, 14.0, 18.0)
"""When robots are pushed [s]."""


def _pushes(episode: Episode, speed: float) -> tuple[Push, ...]:
    generator = torch.Generator().manual_seed(episode.seed + 3)
    angles = 2.0 * torch.pi * torch.rand(len(PUSH_TIMES), generator=generator)
    directions = torch.stack([angles.cos(), angles.sin(), torch.zeros_like(angles)], dim=1)
    changes = (speed * directions).tolist()
    return tuple(Push(time, (x, y, z)) for time, (x, y, z) in zip(PUSH_TIMES, changes, strict=True))


_AS_IT_IS = RandomizationConfig.for_evaluation()


def _late(milliseconds: int, chances: tuple[float, float, float]) -> Condition:
    return Condition("targets late", f"{milliseconds} ms", replace(_AS_IT_IS, delay=chances))


def _friction(value: float) -> Condition:
    return Condition("friction", f"{value:g}", replace(_AS_IT_IS, friction=(value, value)))


def _gains(low: float, high: float, label: str) -> Condition:
    return Condition("gains", label, replace(_AS_IT_IS, gain_scale=(low, high)))


def _pushed(speed: float) -> Condition:
    return Condition("pushes", f"{speed:g} m/s", push_speed=speed)


def _physics(milliseconds: float) -> Condition:
    return Condition("physics step", f"{milliseconds:g} ms", options=ModelOptions(timestep=1e-3 * milliseconds))


CONDITIONS: dict[str, Condition] = {
    "nominal": Condition("protocol", "as it is"),
    "late-20ms": _late(20, (0.0, 1.0, 0.0)),
    "late-40ms": _late(40, (0.0, 0.0, 1.0)),
    "friction-0.25": _friction(0.25),
    "slippery": _friction(0.4),
    "friction-1.2": _friction(1.2),
    "other-gains": _gains(0.8, 1.2, "each ±20 %"),
    "soft-gains": _gains(0.8, 0.8, "all -20 %"),
    "stiff-gains": _gains(1.2, 1.2, "all +20 %"),
    "weak-motors": Condition("torque limits", "80 %", replace(_AS_IT_IS, effort_scale=0.8)),
    "weak-waist": Condition("torque limits", "waist 35 N m", replace(_AS_IT_IS, waist_effort=(35.0, 35.0))),
    "heavy-rotors": Condition("armature", "x 2", options=ModelOptions(armature_scale=2.0)),
    "heavy-torso": Condition("torso", "+5 kg", options=ModelOptions(torso_mass=5.0)),
    "pushes-0.2": _pushed(0.2),
    "pushes-0.5": _pushed(0.5),
    "pushes-0.8": _pushed(0.8),
    "pushes-1.0": _pushed(1.0),
    "physics-1ms": _physics(1.0),
    "physics-4ms": _physics(4.0),
}
"""By name. Gains scale stiffness and damping, joint by joint, in every episode anew."""


def condition_of(name: str) -> Condition:
    """A condition by name.

    Raises:
        PilotError: if there is none of that name.
    """
    if name not in CONDITIONS:
        raise PilotError(f"unknown condition {name!r}; choose one of {', '.join(CONDITIONS)}")
    return CONDITIONS[name]
