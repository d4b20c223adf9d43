"""Running normalization of observations with exact, mergeable moments."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lowlevel.runs.checks import require_finite
from lowlevel.runs.distributed import sum_over_ranks


class RunningNormalizer(nn.Module):
    """Maps ``x`` (..., D) to ``clip((x - mean) / (std + floor))``, column by column.

    Moments are float64 and cover everything passed to :meth:`update`, on all ranks. Columns where ``fixed``
    is true pass through unchanged: a command that the curriculum still holds constant has no variance, and
    would jump by a factor of hundreds on the day it is released. Before the first update the map is the
    identity (clipped).
    """

    mean: Tensor
    variance: Tensor
    count: Tensor
    fixed: Tensor
    scale: Tensor
    offset: Tensor

    def __init__(self, size: int, fixed: Tensor | None = None, floor: float = 1e-2, clip: float = 10.0) -> None:
        """``fixed`` (D,) bool, default none; ``floor`` is added to the deviation; ``clip`` in deviations.

        Raises:
            ValueError: if ``fixed`` does not have one entry per column.
        """
        super().__init__()
        fixed = torch.zeros(size, dtype=torch.bool) if fixed is None else fixed.detach().to("cpu", torch.bool)
        if fixed.shape != (size,):
            raise ValueError(f"the mask of fixed columns has shape {tuple(fixed.shape)}, expected ({size},)")
        self.floor = floor
        self.clip = clip
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("variance", torch.ones(size, dtype=torch.float64))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("fixed", fixed.clone())
        self.register_buffer("scale", torch.ones(size), persistent=False)
        self.register_buffer("offset", torch.zeros(size), persistent=False)
        self.register_load_state_dict_post_hook(lambda module, _: module.refresh())

    def forward(self, values: Tensor) -> Tensor:
        """Normalize ``values`` (..., D)."""
        return torch.addcmul(self.offset, values, self.scale).clamp(-self.clip, self.clip)

    @torch.no_grad()
    def refresh(self) -> None:
        """Derive scale and offset from the moments; needed after the moments are changed from outside."""
        plain = self.fixed | (self.count == 0)
        scale = torch.where(plain, 1.0, 1.0 / (self.variance.sqrt() + self.floor))
        self.scale.copy_(scale)
        self.offset.copy_(torch.where(plain, 0.0, -self.mean * scale))

    @torch.no_grad()
    def update(self, values: Tensor) -> None:
        """Merge the moments of ``values`` (..., D), of all ranks together, into the running ones.

        Every rank must call this equally often. The merge is that of Chan, Golub and LeVeque (1983).

        Raises:
            NonFiniteError: if a value is not finite; the running moments are then unchanged.
        """
        rows = values.reshape(-1, values.shape[-1])
        variance, mean = (moment.double() for moment in torch.var_mean(rows, dim=0, correction=0))
        require_finite("mean of the normalizer's input", mean)
        require_finite("variance of the normalizer's input", variance)
        count = torch.tensor([float(len(rows))], dtype=torch.float64, device=rows.device)
        total = sum_over_ranks(torch.cat([count, count * mean]))
        batch_count, batch_mean = total[0], total[1:] / total[0]
        squares = sum_over_ranks(count * (variance + (mean - batch_mean).square()))
        merged = self.count + batch_count
        delta = batch_mean - self.mean
        between = delta.square() * self.count * batch_count / merged
        self.variance.copy_((self.variance * self.count + squares + between) / merged)
        self.mean.add_(delta * batch_count / merged)
        self.count.copy_(merged)
        self.refresh()
