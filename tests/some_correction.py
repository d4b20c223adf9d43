"""A correction of the told velocity that says something, shared by tests."""

from __future__ import annotations

import torch

from lowlevel.control.velocity_correction import VelocityCorrection


def fill(correction: VelocityCorrection, std: float = 0.2) -> VelocityCorrection:
    """Give ``correction`` random weights."""
    generator = torch.Generator().manual_seed(5)
    for values in correction.parameters():
        values.data = std * torch.randn(values.shape, generator=generator)
    correction.known.fill_(1.0)
    return correction
