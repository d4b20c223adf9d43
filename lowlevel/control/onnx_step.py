"""A control step as an ONNX file, and computing it with ONNX Runtime.

The file holds the whole controller, reference and nominal-pose table included, and says what its memory is at first:
whoever runs it on a robot needs nothing but the file.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import onnx
import onnxruntime
import torch
from torch import Tensor, nn

from lowlevel.commands import CommandSpace
from lowlevel.control.control_step import ControlStep, Memory, StepResult
from lowlevel.control.elevation_map import MAP_SIZE
from lowlevel.control.observation import Proprioception
from lowlevel.runs.files import atomic_write
from robots.g1.constants import NUM_JOINTS

INPUTS = (
    "joint_position",
    "joint_velocity",
    "base_angular_velocity",
    "projected_gravity",
    "elevation_map",
    "command",
    "flag",
)
"""Of the file, before its memory; shapes and units are those of :meth:`lowlevel.control.controller.Controller.act`."""
FIRST_MEMORY = "first_memory"
"""Metadata entry of the file: JSON, name of each memory input to its value for one robot that has not acted yet. Every
memory input x has an output next_x."""
CONVENTIONS = "conventions"
"""Metadata entry of the file: JSON, the "config" of ``controller.json``, such as joint names, default pose, gains,
control period and command space."""
IR_VERSION = 10
"""Of the file: that of ONNX 1.16 and 1.17, so that runtimes of 2024 read it."""


class _Flat(nn.Module):
    """A control step with tensors for arguments and results."""

    def __init__(self, step: ControlStep, memory: tuple[str, ...]) -> None:
        super().__init__()
        self.step, self.memory = step, memory

    def forward(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        remembered = dict(zip(self.memory, tensors[len(INPUTS) :], strict=True))
        result = self.step(Proprioception(*tensors[:4]), *tensors[4:7], remembered)
        return result.targets, result.gate, *(result.memory[name] for name in self.memory)


def export_step(step: ControlStep, space: CommandSpace, conventions: dict[str, Any], path: Path) -> None:
    """Write ``step`` as an ONNX file, for any number of robots, with the ``conventions`` as plain data."""
    count = 2
    measured = [torch.zeros(count, size) for size in (NUM_JOINTS, NUM_JOINTS, 3, 3, MAP_SIZE)]
    memory = step.first_memory(count)
    inputs = (*measured, space.neutral().repeat(count, 1), torch.ones(count, 1), *memory.values())
    rows = torch.export.Dim("robots")
    program = torch.onnx.export(
        _Flat(step, tuple(memory)).eval(),
        inputs,
        dynamo=True,
        verbose=False,
        input_names=[*INPUTS, *memory],
        output_names=["targets", "gate", *(f"next_{name}" for name in memory)],
        dynamic_shapes=(tuple({0: rows} for _ in inputs),),
    )
    assert program is not None
    model = program.model_proto
    first = {name: value[0].tolist() for name, value in memory.items()}
    onnx.helper.set_model_props(model, {FIRST_MEMORY: json.dumps(first), CONVENTIONS: json.dumps(conventions)})
    model.ir_version = IR_VERSION
    # The exporter writes down which line of which source file every node is from.
    for part in (*model.graph.node, *model.graph.value_info, *model.graph.input, *model.graph.output):
        part.ClearField("metadata_props")
        part.ClearField("doc_string")
    atomic_write(path, lambda file: file.write(model.SerializeToString()))


class OnnxStep:
    """A control step in ONNX Runtime, called like :class:`ControlStep`. It can be copied and pickled."""

    def __init__(self, model: bytes) -> None:
        """Take the contents of the file; whatever ONNX Runtime raises is passed on.

        Raises:
            KeyError: if the file does not say what its first memory is.
        """
        self._model = model
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        self._session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        first = json.loads(self._session.get_modelmeta().custom_metadata_map[FIRST_MEMORY])
        self._first = {name: torch.tensor(value) for name, value in first.items()}
        self._outputs = ["targets", "gate", *(f"next_{name}" for name in self._first)]

    def __reduce__(self) -> tuple[type[OnnxStep], tuple[bytes]]:
        return OnnxStep, (self._model,)

    @property
    def experts(self) -> int:
        """Entries of the gate."""
        return int(self._session.get_outputs()[1].shape[1])

    def first_memory(self, num_robots: int) -> Memory:
        """The memory of robots that have not acted yet."""
        return {name: value.expand(num_robots, *value.shape).clone() for name, value in self._first.items()}

    def __call__(
        self, measured: Proprioception, elevation_map: Tensor, command: Tensor, flag: Tensor, memory: Memory
    ) -> StepResult:
        """One control period; shapes as :class:`ControlStep` has them."""
        proprioception = (
            measured.joint_position,
            measured.joint_velocity,
            measured.base_angular_velocity,
            measured.projected_gravity,
        )
        values = dict(zip(INPUTS, (*proprioception, elevation_map, command, flag), strict=True)) | memory
        outputs = self._session.run(self._outputs, {name: value.numpy() for name, value in values.items()})
        targets, gate, *remembered = (torch.from_numpy(output) for output in outputs)
        return StepResult(targets, gate, dict(zip(self._first, remembered, strict=True)))
