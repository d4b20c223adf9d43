"""From a blind policy to one that sees: the same networks, whose new inputs begin at zero weight.

What a blind robot has learned is not lost: until the new weights have grown, one that sees does what it did.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from robots.errors import PilotError

_MAP_ENCODER = "map_encoder."
"""Prefix of what a blind policy does not use and has never trained."""


@torch.no_grad()
def give_sight(network: nn.Module, blind: Mapping[str, Tensor]) -> None:
    """Let ``network``, which sees, begin with the weights of a ``blind`` one of the same class and sizes.

    Raises:
        PilotError: if these are not the weights of such a network.
    """
    state = network.state_dict()
    given, wanted = (
        {name: weight for name, weight in weights.items() if not name.startswith(_MAP_ENCODER)}
        for weights in (blind, state)
    )
    unfitting = wanted.keys() ^ given.keys()
    if unfitting:
        raise PilotError(f"a network cannot begin with the weights of another architecture: {min(unfitting)!r}")
    widened = {name: _widened(name, given[name].to(weight.device), weight) for name, weight in wanted.items()}
    network.load_state_dict(state | widened)


def _widened(name: str, old: Tensor, new: Tensor) -> Tensor:
    """``old`` as wide as ``new``: weights of further inputs are zero, moments of further columns those of ``new``."""
    if old.shape == new.shape:
        return old
    if old.dim() != new.dim() or old.shape[:-1] != new.shape[:-1] or old.shape[-1] > new.shape[-1]:
        shapes = f"{tuple(old.shape)} and {tuple(new.shape)}"
        raise PilotError(f"a network cannot begin with the weights of another architecture: {name!r} has {shapes}")
    wide = torch.zeros_like(new) if new.dim() > 1 else new.clone()
    wide[..., : old.shape[-1]] = old  # what is seen comes last everywhere
    return wide
