"""Refusing numbers that are not finite before they can spread."""

from __future__ import annotations

import torch
from torch import Tensor

from robots.errors import PilotError


class NonFiniteError(PilotError):
    """A tensor holds NaN or Inf; the message names the tensor and the rows it was found in."""


def require_finite(name: str, values: Tensor) -> None:
    """Check that every entry of ``values`` is finite; rows are robots or samples, other axes are free.

    Raises:
        NonFiniteError: naming ``name``, how many rows are affected and the first few of them.
    """
    finite = torch.isfinite(values)
    if bool(finite.all()):
        return
    if values.dim() == 0:
        raise NonFiniteError(f"{name} is {float(values)}")
    rows = (~finite.reshape(len(values), -1)).any(dim=1).nonzero().squeeze(1).tolist()
    shown = ", ".join(str(row) for row in rows[:8]) + (", ..." if len(rows) > 8 else "")
    raise NonFiniteError(f"{name} is not finite in {len(rows)} of {len(values)} rows: {shown}")
