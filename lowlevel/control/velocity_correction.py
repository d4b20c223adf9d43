"""What the policy is told instead of the commanded velocity, so that it walks at that.

A trained policy walks at a velocity of its own for every command, the same whenever it is given. What takes the
difference away is a function of the command, fitted in training (:mod:`lowlevel.imitation.calibration`) and part of the
controller from then on. Reference, gait clock and rewards know the commanded velocity alone.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import torch
from torch import Tensor, nn

from lowlevel.commands import COMMAND_SIZE, HEIGHT, MIRROR, VELOCITY, CommandSpace, is_walking
from lowlevel.control.observation import FrameView

LARGEST = 0.5
"""Largest correction [m/s, m/s, rad/s]."""
_WIDTH = 128

View = TypeVar("View", bound=FrameView)


class VelocityCorrection(nn.Module):
    """Correction of the told velocity as a function of the command; a mirrored command has the mirrored one.

    It corrects nothing until it is fitted. No gradient of PPO reaches it.
    """

    known: Tensor
    """1 for each velocity about which the fit knows something, else 0 (3,)."""
    _index: Tensor
    _sign: Tensor

    def __init__(self, space: CommandSpace) -> None:
        super().__init__()
        self.space = space
        self.register_buffer("known", torch.zeros(VELOCITY.stop))
        self.register_buffer("_index", torch.as_tensor(MIRROR.index), persistent=False)
        self.register_buffer("_sign", torch.as_tensor(MIRROR.sign, dtype=torch.float32), persistent=False)
        last = nn.Linear(_WIDTH, VELOCITY.stop)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.net = nn.Sequential(nn.Linear(COMMAND_SIZE, _WIDTH), nn.ELU(), nn.Linear(_WIDTH, _WIDTH), nn.ELU(), last)

    def forward(self, command: Tensor) -> Tensor:
        """What is added to the velocity of ``command`` (..., 21): (..., 3) [m/s, m/s, rad/s]; zero for one to stand."""
        mirrored = command[..., self._index] * self._sign
        found, found_mirrored = self.net(self.space.scaled(torch.stack([command, mirrored]))).unbind()
        mean = 0.5 * (found + found_mirrored * self._sign[VELOCITY])
        return mean.clamp(-LARGEST, LARGEST) * self.known * is_walking(command)[..., None]

    @torch.no_grad()
    def tell(self, view: View) -> View:
        """``view`` as the policy is told it: with corrected velocities in its command and in its slewed command."""
        command, slewed = view.command, view.reference.command
        told, told_slewed = self._told(torch.stack([command, slewed])).unbind()
        return replace(view, command=told, reference=view.reference._replace(command=told_slewed))

    def _told(self, command: Tensor) -> Tensor:
        """``command`` (..., 21) with the corrected velocity, which lies within the bounds, as in all of training."""
        meant = command[..., VELOCITY]
        lower, upper = (bound[VELOCITY] for bound in self.space.bounds(command.device))
        corrected = (meant + self(command)).clamp(torch.minimum(meant, lower), torch.maximum(meant, upper))
        return torch.cat([corrected, command[..., HEIGHT:]], dim=-1)
