"""A control step as ONNX: export, and running it with ONNX Runtime.

The file holds the whole controller, nominal motion included: whoever runs it on a robot needs nothing but the file.
For one robot ONNX Runtime takes a fraction of torch's time, most of which goes into calling operators.
"""

from __future__ import annotations

from pathlib import Path

import onnxruntime
import torch
from torch import Tensor, nn

from lowlevel.commands import CommandSpace
from lowlevel.control_step import MEMORY_NAMES, ControlStep, Memory, StepResult
from lowlevel.files import atomic_write
from lowlevel.observation import Proprioception
from lowlevel.terrain import MAP_SIZE
from robots.g1.constants import NUM_JOINTS

INPUTS = (
    "joint_position",
    "joint_velocity",
    "base_angular_velocity",
    "projected_gravity",
    "elevation_map",
    "command",
    "flag",
    *MEMORY_NAMES,
)
"""Of the file; shapes and units are those of :meth:`lowlevel.controller.Controller.act` and :class:`Memory`."""
OUTPUTS = ("targets", "gate", *(f"next_{name}" for name in MEMORY_NAMES))


class _Flat(nn.Module):
    """A control step with tensors for arguments and results."""

    def __init__(self, step: ControlStep) -> None:
        super().__init__()
        self.step = step

    def forward(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        result = self.step(Proprioception(*tensors[:4]), *tensors[4:7], Memory.from_tensors(tensors[7:]))
        return result.targets, result.gate, *result.memory.tensors


def export_step(step: ControlStep, space: CommandSpace, path: Path) -> None:
    """Write :data:`INPUTS` to :data:`OUTPUTS` as an ONNX file, for any number of robots."""
    count = 2
    measured = [torch.zeros(count, size) for size in (NUM_JOINTS, NUM_JOINTS, 3, 3, MAP_SIZE)]
    memory = Memory.fresh(count, space, step.motion.config.settling_time).tensors
    inputs = (*measured, space.neutral().repeat(count, 1), torch.ones(count, 1), *memory)
    rows = torch.export.Dim("robots")
    program = torch.onnx.export(
        _Flat(step).eval(),
        inputs,
        dynamo=True,
        verbose=False,
        input_names=INPUTS,
        output_names=OUTPUTS,
        dynamic_shapes=(tuple({0: rows} for _ in inputs),),
    )
    assert program is not None
    atomic_write(path, lambda file: file.write(program.model_proto.SerializeToString()))


class OnnxStep:
    """A control step in ONNX Runtime on one CPU core, called like :class:`ControlStep`."""

    def __init__(self, path: Path) -> None:
        """Read the file; whatever ONNX Runtime raises is passed on."""
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        self._session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])

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
        values = zip(INPUTS, (*proprioception, elevation_map, command, flag, *memory.tensors), strict=True)
        outputs = self._session.run(OUTPUTS, {name: value.numpy() for name, value in values})
        targets, gate, *remembered = (torch.from_numpy(output) for output in outputs)
        return StepResult(targets, gate, Memory.from_tensors(remembered))
