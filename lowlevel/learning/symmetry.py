"""Left-right mirroring of observation and action tensors."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from lowlevel.networks.actor import ObservationSizes
from robots.g1.mirror import Mirror

MIRRORED_KEYS = ("history", "elevation_map", "privileged", "action")
"""Vectors that change under mirroring; the tracking flag does not."""


class TensorMirrors:
    """The mirrors of the observation and action vectors, as tensors on one device."""

    def __init__(self, mirrors: Mapping[str, Mirror], sizes: ObservationSizes, device: torch.device) -> None:
        """Copy ``mirrors`` to ``device``.

        Raises:
            ValueError: if a mirror is missing or has another width than the vector it acts on.
        """
        widths = {key: int(getattr(sizes, key)) for key in MIRRORED_KEYS}
        missing = [key for key in MIRRORED_KEYS if key not in mirrors]
        if missing:
            raise ValueError(f"no mirror was given for {', '.join(missing)}")
        self._maps: dict[str, tuple[Tensor, Tensor]] = {}
        for key, width in widths.items():
            mirror = mirrors[key]
            if len(mirror.index) != width:
                raise ValueError(f"the mirror of {key} has {len(mirror.index)} entries, expected {width}")
            index = torch.as_tensor(mirror.index, dtype=torch.long, device=device)
            sign = torch.as_tensor(mirror.sign, dtype=torch.float32, device=device)
            self._maps[key] = (index, sign)

    def __call__(self, key: str, values: Tensor) -> Tensor:
        """Mirror ``values`` (N, D) of the vector called ``key``."""
        if key == "flag":
            return values
        index, sign = self._maps["privileged" if key == "next_privileged" else key]
        return values.index_select(1, index) * sign
