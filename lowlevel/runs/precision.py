"""Single precision, whatever torch's default is, and matrix products that may be coarser where speed counts."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def single_precision() -> Iterator[None]:
    """Make new tensors float32 inside the context, although a caller may compute in double precision; as a decorator,
    inside the function."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


@contextmanager
def coarse_products() -> Iterator[None]:
    """Let networks multiply in bfloat16 inside the context, on CPUs and GPUs that are faster at it.

    Nothing else may: poses and attitudes are matrix products, too, and would be wrong by 0.01 rad.
    """
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("medium")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)
