"""A policy card: everything that it takes to run a stranger's policy, as one JSON file beside its ONNX file."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from lowlevel.control.observation import CONTROL_PERIOD
from lowlevel.runs.configs import from_plain
from robots.errors import PilotError
from robots.g1.constants import JOINT_NAMES

ByJoint = dict[str, float]
"""Values by regular expression over joint names; the first one that matches a joint counts for it."""
Joints = tuple[str, ...]
"""Regular expressions over joint names, each standing for all joints that match it, in Unitree's order."""
Range = tuple[float, float]


class CardError(PilotError):
    """A card that cannot be used; the message names the card, what is wrong in it and what to do."""


@dataclass(frozen=True)
class Source:
    """Where the ONNX file is found."""

    repository: str
    commit: str
    file: str
    """Path in the repository."""
    sha256: str
    license: str


@dataclass(frozen=True)
class Ranges:
    """What a policy can be told."""

    vx: Range
    """[m/s]"""
    vy: Range
    """[m/s]"""
    yaw_rate: Range
    """[rad/s]"""
    height: Range
    """[m]; of a policy without such a command twice 0.76, what it means to stand upright."""
    walking_height: Range | None = None
    """While it walks; the same by default [m]."""
    torso_roll: Range = (0.0, 0.0)
    """[rad]"""
    torso_pitch: Range = (0.0, 0.0)
    """[rad]"""
    torso_yaw: Range = (0.0, 0.0)
    """[rad]"""
    arms: bool = False
    """Whether its arms go where they are told."""


@dataclass(frozen=True)
class Term:
    """A part of an observation, by a name of :data:`evaluation.baselines.terms.TERMS`."""

    name: str
    scale: tuple[float, ...] = (1.0,)
    """Factor of each number, or one for all."""
    offset: float = 0.0
    """Added before it is scaled, where the policy measures from elsewhere."""
    joints: Joints = ()
    """Which joints, for terms that have one number for each; the card's ``observed_joints`` by default."""


@dataclass(frozen=True)
class Input:
    """An input of the ONNX file that is made from terms."""

    name: str
    terms: tuple[Term, ...]
    history: int = 1
    """Frames that it holds, the oldest first."""
    layout: Literal["frames", "terms"] = "frames"
    """Whether whole frames follow one another, or every term's history the one of the term before."""
    first: Literal["zeros", "first frame"] = "zeros"
    """What fills the history before there is any."""


@dataclass(frozen=True)
class Action:
    """How the ONNX file's output becomes PD targets."""

    output: str
    joints: Joints
    scale: tuple[float, ...]
    """[rad] per unit, for each joint in order, or one for all."""
    about: Literal["base", "zero"] = "base"
    """What it is added to: the joint's base target, or nothing."""


@dataclass(frozen=True)
class Clock:
    """A gait clock that the policy sees."""

    period: float
    """[s]"""
    offsets: tuple[float, ...]
    """Phase of each foot at the start [rad]."""
    standing: float
    """Phase of both feet while it stands [rad]."""


@dataclass(frozen=True)
class PolicyCard:
    """Facts about one policy."""

    name: str
    source: Source
    command: Ranges
    default_position: ByJoint
    """[rad]: base targets of joints that are not ``commanded_joints``, and what observed positions are relative to."""
    stiffness: ByJoint
    """[N m/rad]"""
    damping: ByJoint
    """[N m s/rad]"""
    inputs: tuple[Input, ...]
    action: Action
    observed_joints: Joints = (".*",)
    commanded_joints: Joints = ()
    """Joints whose base target is what the command says: arms, or the waist's yaw."""
    states: dict[str, str] = field(default_factory=dict)
    """Inputs that hold what the output of the other name was one step before, zero at first."""
    clock: Clock | None = None
    control_period: float = CONTROL_PERIOD
    """[s]"""
    verified: dict[str, float] = field(default_factory=dict)
    """What ``verify-policy`` measured when the card was written, by the name of its test."""


def joint_names(patterns: Joints) -> tuple[str, ...]:
    """All joints that ``patterns`` stand for.

    Raises:
        CardError: naming a pattern that is none or matches no joint.
    """
    found: list[str] = []
    for pattern in patterns:
        try:
            matches = [name for name in JOINT_NAMES if re.fullmatch(pattern, name)]
        except re.error as error:
            raise CardError(f"{pattern!r} is no regular expression: {error}") from error
        if not matches:
            raise CardError(f"no joint of the G1 matches {pattern!r}; its joints are {', '.join(JOINT_NAMES)}")
        found += matches
    return tuple(found)


def by_joint(values: ByJoint, what: str) -> np.ndarray:
    """One value per joint of the G1 (29,).

    Raises:
        CardError: naming a joint that no pattern matches, or a pattern that matches none; ``what`` names the table.
    """
    for pattern in values:
        joint_names((pattern,))
    result = []
    for name in JOINT_NAMES:
        matching = [value for pattern, value in values.items() if re.fullmatch(pattern, name)]
        if not matching:
            raise CardError(f"{what} has no value for {name}")
        result.append(matching[0])
    return np.array(result)


def read_card(path: Path) -> PolicyCard:
    """The card in a JSON file.

    Raises:
        CardError: if the file is missing or damaged, or lacks a field or has one that is unknown or of another type.
    """
    try:
        card: PolicyCard = from_plain(PolicyCard, json.loads(path.read_text()), "the card", complete=False)
    except FileNotFoundError as error:
        raise CardError(f"there is no card {path}") from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise CardError(f"{path} is no JSON file: {error}") from error
    except (KeyError, TypeError, ValueError) as error:
        raise CardError(f"{path}: {error.args[0]}") from error
    if abs(card.control_period - CONTROL_PERIOD) > 1e-9:
        raise CardError(f"{path}: policies are run every {CONTROL_PERIOD} s, not every {card.control_period} s")
    return card
