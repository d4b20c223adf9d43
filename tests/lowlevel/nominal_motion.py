"""What the tests of the nominal motion share."""

from dataclasses import replace

import torch

from lowlevel.commands import CommandSpace, command_space
from lowlevel.nominal import NominalMotion
from lowlevel.nominal_config import NominalConfig
from robots.g1.constants import DEFAULT_POSITION, GAINS
from robots.g1.model import build_spec, joint_limits

LIMITS = joint_limits(build_spec().compile())
UPRIGHT = torch.tensor([[0.0, 0.0, -1.0]])
STILL = torch.zeros(1, 3)
DEFAULT = torch.tensor(DEFAULT_POSITION, dtype=torch.float32)[None]


def g1_command_space() -> CommandSpace:
    return command_space(LIMITS[:, 0].tolist(), LIMITS[:, 1].tolist())


def motion(**changes: object) -> NominalMotion:
    config = replace(NominalConfig(), **changes)  # type: ignore[arg-type]
    return NominalMotion(config, GAINS["stiff"], control_period=0.02)
