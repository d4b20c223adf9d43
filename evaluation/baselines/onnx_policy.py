"""A stranger's ONNX file, run as its card says."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import torch
from google.protobuf.message import DecodeError
from torch import Tensor

from evaluation.baselines.card import (
    CardError,
    Input,
    PolicyCard,
    Range,
    Ranges,
    Term,
    by_joint,
    joint_names,
    read_card,
)
from evaluation.baselines.terms import TERMS, Seen, commanded_targets
from lowlevel.commands import is_walking
from lowlevel.control.controller import CONFIG_FILE, ONNX_FILE, Controller, content_hash
from lowlevel.control.observation import Proprioception
from lowlevel.control.whole_body import Bounds, Supports, WholeBodyController
from robots.errors import PilotError
from robots.g1.constants import ARM_JOINTS, DEFAULT_POSITION, JOINT_NAMES, Gains, joint_index
from robots.g1.model import build_spec, joint_limits

CARDS = Path(__file__).parent / "cards"
"""Cards of published policies; their ONNX files are fetched by whoever runs them."""


class OnnxPolicy:
    """A :class:`lowlevel.control.whole_body.WholeBodyController` made of an ONNX file and its card."""

    def __init__(self, card: PolicyCard, onnx_file: Path, arm_limits: tuple[Tensor, Tensor]) -> None:
        """Check ``card`` against the file; ``arm_limits`` are the lower and upper arm joint limits (14,) [rad].

        Raises:
            CardError: naming the first thing that does not fit.
        """
        self.card = card
        self._default = torch.tensor(by_joint(card.default_position, "default_position"), dtype=torch.float32)
        self._acting = joint_numbers(card.action.joints)
        self._commanded = joint_numbers(card.commanded_joints)
        self._scale = torch.tensor(card.action.scale)
        stiffness, damping = by_joint(card.stiffness, "stiffness"), by_joint(card.damping, "damping")
        self.supports = supports_of(card.command, arm_limits)
        self._session = _session(onnx_file)
        self._shapes = {tensor.name: list(tensor.shape) for tensor in self._session.get_inputs()}
        self._check(onnx_file.name)
        self.batched = all(isinstance(shape[0], str) for shape in self._shapes.values())
        """Whether the graph takes any number of robots at once; otherwise it is run for one after the other."""
        # Every control step goes by these numbers and not by the names.
        self._columns = {term: self._joints(term) for entry in card.inputs for term in entry.terms}
        action_scale = np.zeros(len(JOINT_NAMES))
        action_scale[self._acting] = card.action.scale if len(card.action.scale) > 1 else card.action.scale[0]
        self.gains = Gains(stiffness, damping, action_scale)
        self._memory: dict[str, Tensor] = {}

    # -- control ----------------------------------------------------------------------------------------------

    def reset(self, num_robots: int, ids: Tensor | None = None) -> None:
        """Forget everything about robots ``ids`` (n,), all ``num_robots`` by default."""
        fresh = self._first_memory(num_robots)
        if ids is None or not self._memory:
            self._memory = fresh
            return
        for name, cleared in fresh.items():
            self._memory[name][ids] = cleared[ids]

    def act(self, proprioception: Proprioception, elevation_map: Tensor, command: Tensor, flag: Tensor) -> Tensor:
        """PD targets (N, 29) [rad]; the policy sees neither map nor flag."""
        walks = is_walking(command)
        phase = self._phase(walks)
        seen = Seen(proprioception, command, self._default, self._memory["action"], phase)
        fed = {entry.name: self._filled(entry, seen) for entry in self.card.inputs}
        fed |= {name: self._memory[f"state {name}"] for name in self.card.states}
        self._memory["begins"] = torch.zeros(len(command), dtype=torch.bool)
        outputs = self._run({name: value.reshape(-1, *self._shapes[name][1:]) for name, value in fed.items()})
        for name, output in self.card.states.items():
            self._memory[f"state {name}"] = outputs[output]
        action = outputs[self.card.action.output]
        self._memory["action"] = action
        targets = self._default.repeat(len(command), 1)
        targets[:, self._commanded] = commanded_targets(command, self._default)[:, self._commanded]
        offset = action * self._scale
        targets[:, self._acting] = offset if self.card.action.about == "zero" else targets[:, self._acting] + offset
        return targets

    def _phase(self, walks: Tensor) -> Tensor:
        """Phase of each foot (N, feet) [rad] now; the clock then goes on, and starts anew after standing."""
        clock = self.card.clock
        if clock is None:
            return torch.zeros(len(walks), 0)
        now = self._memory["time"][:, None]
        phase = 2.0 * math.pi * now / clock.period + torch.tensor(clock.offsets)
        self._memory["time"] = torch.where(walks, self._memory["time"] + self.card.control_period, 0.0)
        phase = torch.remainder(phase + math.pi, 2.0 * math.pi) - math.pi
        return torch.where(walks[:, None], phase, torch.full_like(phase, clock.standing))

    def _filled(self, entry: Input, seen: Seen) -> Tensor:
        """What an input of the file is given (N, width), with its history."""
        terms = [self._term(term, seen) for term in entry.terms]
        frame = torch.cat(terms, dim=1)
        if entry.history == 1:
            return frame
        past = self._memory[f"history {entry.name}"]
        begins = self._memory["begins"][:, None, None] & (entry.first == "first frame")
        past = torch.where(begins, frame[:, None], torch.cat([past[:, 1:], frame[:, None]], dim=1))
        self._memory[f"history {entry.name}"] = past
        if entry.layout == "frames":
            return past.flatten(1)
        return torch.cat([part.flatten(1) for part in past.split([term.shape[1] for term in terms], dim=2)], dim=1)

    def _term(self, term: Term, seen: Seen) -> Tensor:
        kind = TERMS[term.name]
        values = kind.read(seen)
        if kind.per_joint:
            values = values[:, self._columns[term]]
        return (values + term.offset) * torch.tensor(term.scale)

    def _run(self, fed: dict[str, Tensor]) -> dict[str, Tensor]:
        names = [self.card.action.output, *self.card.states.values()]
        arrays = {name: value.numpy() for name, value in fed.items()}
        if self.batched:
            outputs = self._session.run(names, arrays)
        else:
            count = len(next(iter(arrays.values())))
            rows = [
                self._session.run(names, {name: array[row : row + 1] for name, array in arrays.items()})
                for row in range(count)
            ]
            outputs = [np.concatenate(column) for column in zip(*rows, strict=True)]
        return {name: torch.from_numpy(output) for name, output in zip(names, outputs, strict=True)}

    def _first_memory(self, num_robots: int) -> dict[str, Tensor]:
        memory = {
            "action": torch.zeros(num_robots, len(self._acting)),
            "begins": torch.ones(num_robots, dtype=torch.bool),
            "time": torch.zeros(num_robots),
        }
        for entry in self.card.inputs:
            memory[f"history {entry.name}"] = torch.zeros(num_robots, entry.history, self._width(entry))
        for name in self.card.states:
            memory[f"state {name}"] = torch.zeros(num_robots, *self._shapes[name][1:])
        return memory

    # -- checks -----------------------------------------------------------------------------------------------

    def _width(self, entry: Input) -> int:
        """Numbers of one frame of an input."""
        return sum(self._size(term) for term in entry.terms)

    def _joints(self, term: Term) -> list[int]:
        """Numbers of the joints that a term has, if it has one number for each."""
        return joint_numbers(term.joints or self.card.observed_joints)

    def _size(self, term: Term) -> int:
        kind = TERMS[term.name]
        if kind.per_joint:
            return len(self._joints(term))
        if kind.size is not None:
            return kind.size
        if term.name == "last_action":
            return len(self._acting)
        _require(self.card.clock is not None, f"the term {term.name!r} of {self.card.name} needs a clock")
        return len(self.card.clock.offsets) if self.card.clock else 0

    def _check(self, file: str) -> None:
        """Raise a CardError about the first thing in the card that does not fit the file called ``file``."""
        card, inputs = self.card, self._shapes
        outputs = {tensor.name: list(tensor.shape) for tensor in self._session.get_outputs()}
        told = {entry.name for entry in card.inputs} | set(card.states)
        for name in inputs:
            _require(
                name in told,
                f"{file} has an input {name!r}, which the card of {card.name} neither fills nor has as a state",
            )
        for name in told:
            _require(
                name in inputs,
                f"the card of {card.name} fills {name!r}, but the inputs of {file} are {', '.join(inputs)}",
            )
        for name in (card.action.output, *card.states.values()):
            _require(
                name in outputs,
                f"the card of {card.name} reads {name!r}, but the outputs of {file} are {', '.join(outputs)}",
            )
        for name, shape in {**inputs, **outputs}.items():
            rows, rest = shape[:1], shape[1:]
            _require(
                len(rows) == 1 and (rows[0] == 1 or isinstance(rows[0], str)) and all(isinstance(n, int) for n in rest),
                f"{file} has a tensor {name!r} of shape {shape}: the first number must be 1 or free, the others fixed",
            )
        for name, output in card.states.items():
            fits = inputs[name][1:] == outputs[output][1:]
            _require(
                fits,
                f"the state {name!r} of {card.name} has shape {inputs[name]}, its output {output!r} {outputs[output]}",
            )
        for entry in card.inputs:
            for term in entry.terms:
                _require(
                    term.name in TERMS,
                    f"the card of {card.name} has a term {term.name!r}; the terms are {', '.join(TERMS)}",
                )
                _require_scales(f"the term {term.name!r} of {card.name}", term.scale, self._size(term))
            width, expected = self._width(entry), math.prod(inputs[entry.name][1:])
            _require(
                width * entry.history == expected,
                f"the card of {card.name} fills {entry.name!r} with {entry.history} frames of {width} numbers, "
                f"{file} takes {expected} numbers",
            )
        acting = len(self._acting)
        _require_scales(f"the action of {card.name}", card.action.scale, acting)
        shape = outputs[card.action.output]
        _require(
            shape[1:] == [acting],
            f"the action of {card.name} has {acting} joints, {card.action.output!r} has shape {shape}",
        )


def _require(condition: bool, otherwise: str) -> None:
    if not condition:
        raise CardError(otherwise)


def _require_scales(what: str, scales: tuple[float, ...], size: int) -> None:
    _require(len(scales) in (1, size), f"{what} has {size} numbers, but {len(scales)} scales")


def joint_numbers(patterns: tuple[str, ...]) -> list[int]:
    """Numbers in Unitree's order of the joints that ``patterns`` stand for."""
    return [joint_index(name) for name in joint_names(patterns)]


def supports_of(ranges: Ranges, arm_limits: tuple[Tensor, Tensor]) -> Supports:
    """What a policy with these ranges can be told; if its arms do not listen, they are told to stay at the default."""
    still = torch.tensor(DEFAULT_POSITION[ARM_JOINTS], dtype=torch.float32)
    arms = arm_limits if ranges.arms else (still, still)

    def bounds(velocity: tuple[Range, Range, Range], height: Range) -> Bounds:
        told = (*velocity, height, ranges.torso_roll, ranges.torso_pitch, ranges.torso_yaw)
        return Bounds(*(torch.cat([end, arm]) for end, arm in zip(torch.tensor(told).T, arms, strict=True)))

    walking_height = ranges.walking_height or ranges.height
    return Supports(
        standing=bounds(((0.0, 0.0),) * 3, ranges.height),
        walking=bounds((ranges.vx, ranges.vy, ranges.yaw_rate), walking_height),
    )


def load_controller(path: Path) -> tuple[str, WholeBodyController]:
    """PILOT's controller in a folder, or somebody else's in an ONNX file, and what to call it.

    Raises:
        PilotError: if it cannot be used.
    """
    if path.suffix != ".onnx":
        return content_hash(path), Controller.load(path)
    if path.name == ONNX_FILE and path.with_name(CONFIG_FILE).is_file():
        raise CardError(f"{path} is part of a controller of PILOT: give its folder")
    limits = torch.tensor(joint_limits(build_spec().compile()), dtype=torch.float32)[ARM_JOINTS]
    policy = load_policy(path, (limits[:, 0], limits[:, 1]))
    return policy.card.name, policy


def load_controllers(paths: Sequence[Path]) -> dict[str, WholeBodyController]:
    """Several controllers by what they are called, as :func:`load_controller` has it.

    Raises:
        PilotError: if one of them cannot be used, or two are the same.
    """
    controllers = dict(load_controller(path) for path in paths)
    if len(controllers) < len(paths):
        raise PilotError("two of the controllers have the same name or are the same: leave one out")
    return controllers


def load_policy(onnx_file: Path, arm_limits: tuple[Tensor, Tensor]) -> OnnxPolicy:
    """The policy in an ONNX file, by the card beside it, ``x.json`` for ``x.onnx``, or else the shipped card for it.

    Raises:
        CardError: if there is no such file, no card for it, or the card does not fit.
    """
    if not onnx_file.is_file():
        raise CardError(f"there is no file {onnx_file}")
    beside = onnx_file.with_suffix(".json")
    if beside.is_file():
        return OnnxPolicy(read_card(beside), onnx_file, arm_limits)
    digest = hashlib.sha256(onnx_file.read_bytes()).hexdigest()
    for path in sorted(CARDS.glob("*.json")):
        card = read_card(path)
        if card.source.sha256 == digest:
            return OnnxPolicy(card, onnx_file, arm_limits)
    raise CardError(
        f"no card is known for {onnx_file} (sha256 {digest}): write one as {beside.name} beside it, see docs/compare.md"
    )


def _session(onnx_file: Path) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    try:
        # ONNX Runtime's own errors are private to it.
        onnx.checker.check_model(str(onnx_file))
    except (DecodeError, onnx.checker.ValidationError) as error:
        raise CardError(f"{onnx_file} is no valid ONNX file: {str(error).splitlines()[0]}") from error
    return onnxruntime.InferenceSession(str(onnx_file), options, providers=["CPUExecutionProvider"])
