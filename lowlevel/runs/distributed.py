"""Data parallelism under ``torchrun``: every rank steps its own robots, all ranks share one learner.

There is no wrapper around the networks. Parameters are broadcast once, gradients are averaged in one flat
all-reduce per minibatch, and every statistic that steers learning (advantage moments, KL, normalizer moments,
prototype assignments) is taken over all ranks, so that the ranks' parameters stay identical. Every function
here does nothing when only one process runs.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence

import torch
import torch.distributed as dist
from torch import Tensor

from robots.errors import PilotError


def start(device: str = "cpu") -> torch.device:
    """Join the process group that ``torchrun`` describes in the environment and return this rank's device.

    Without ``WORLD_SIZE`` in the environment, or with 1, nothing is joined. CUDA tensors travel over
    NCCL, one GPU per local rank, and CPU tensors over gloo.

    Raises:
        PilotError: if ``WORLD_SIZE`` is not an integer, or ``device`` is unknown or not there.
    """
    try:
        chosen = torch.device(device)
    except RuntimeError as error:
        raise PilotError(f"unknown device {device!r}; use 'cpu' or 'cuda'") from error
    if chosen.type == "cuda" and not torch.cuda.is_available():
        raise PilotError("a CUDA device was asked for but PyTorch finds none; use device 'cpu'")
    announced = os.environ.get("WORLD_SIZE", "1")
    if not announced.isdigit():
        raise PilotError(f"WORLD_SIZE is {announced!r} but must be the number of processes; start with torchrun")
    if int(announced) > 1 and chosen.type == "cuda":
        chosen = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
        torch.cuda.set_device(chosen)
    if int(announced) > 1 and not dist.is_initialized():
        dist.init_process_group("cpu:gloo,cuda:nccl" if chosen.type == "cuda" else "gloo")
    return chosen


def stop() -> None:
    """Leave the process group, if one was joined."""
    if dist.is_available() and dist.is_initialized():
        dist.destroy_process_group()


def world_size() -> int:
    """Number of processes that learn together."""
    return dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1


def rank() -> int:
    """Index of this process, 0 for the one that logs and saves."""
    return dist.get_rank() if dist.is_available() and dist.is_initialized() else 0


def sum_over_ranks(values: Tensor) -> Tensor:
    """The sum of ``values`` over all ranks, in a new tensor (the same tensor when there is one rank)."""
    if world_size() == 1:
        return values
    total = values.detach().clone()
    dist.all_reduce(total)
    return total


def any_rank(flag: bool) -> bool:
    """Whether ``flag`` is true on at least one rank; all ranks must ask."""
    return bool(sum_over_ranks(torch.tensor(float(flag))) > 0)


def average_over_ranks(tensors: Sequence[Tensor]) -> None:
    """Replace each tensor, in place, by its mean over ranks, with one all-reduce of their concatenation."""
    if world_size() == 1 or not tensors:
        return
    flat = torch.cat([tensor.detach().reshape(-1) for tensor in tensors])
    dist.all_reduce(flat)
    flat /= world_size()
    parts = torch.split(flat, [tensor.numel() for tensor in tensors])
    for tensor, part in zip(tensors, parts, strict=True):
        tensor.copy_(part.view_as(tensor))


def broadcast(tensors: Iterable[Tensor]) -> None:
    """Overwrite every tensor with rank 0's values."""
    if world_size() == 1:
        return
    for tensor in tensors:
        dist.broadcast(tensor.detach(), src=0)


def gathered(rows: Tensor) -> Tensor:
    """The ``rows`` (n, ...) of all ranks, of which each may have another number, one rank's after the other's."""
    if world_size() == 1:
        return rows
    counts = [torch.zeros((), dtype=torch.long) for _ in range(world_size())]
    dist.all_gather(counts, torch.tensor(len(rows)))
    most = int(max(counts))
    padded = torch.cat([rows, rows.new_zeros(most - len(rows), *rows.shape[1:])])
    parts = [torch.empty_like(padded) for _ in counts]
    dist.all_gather(parts, padded)
    return torch.cat([part[:count] for part, count in zip(parts, counts, strict=True)])
