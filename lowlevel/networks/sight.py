"""From a blind policy to one that sees: the same networks, whose new inputs begin at zero weight.

What a blind robot has learned is not lost: until the new weights have grown, one that sees does what it did.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from robots.errors import PilotError

_MAP_COMES_FIRST = ("head.",)
"""Parameters whose new inputs stand before those that were there; everywhere else they stand behind them."""


@torch.no_grad()
def give_sight(network: nn.Module, blind: Mapping[str, Tensor]) -> None:
    """Let ``network``, which sees, begin with the weights of a ``blind`` one of the same class and sizes.

    Raises:
        PilotError: if these are not the weights of such a network.
    """
    state = network.state_dict()
    unfitting = state.keys() ^ blind.keys()
    if unfitting:
        raise PilotError(f"a network cannot begin with the weights of another architecture: {min(unfitting)!r}")
    for name, weight in state.items():
        weight.copy_(_widened(name, blind[name].to(weight.device), weight))
    network.load_state_dict(state)


def _widened(name: str, old: Tensor, new: Tensor) -> Tensor:
    """``old`` as wide as ``new``: weights of further inputs are zero, moments of further columns those of ``new``."""
    if old.shape == new.shape:
        return old
    if old.dim() != new.dim() or old.shape[:-1] != new.shape[:-1] or old.shape[-1] > new.shape[-1]:
        shapes = f"{tuple(old.shape)} and {tuple(new.shape)}"
        raise PilotError(f"a network cannot begin with the weights of another architecture: {name!r} has {shapes}")
    wide = torch.zeros_like(new) if new.dim() > 1 else new.clone()
    width = old.shape[-1]
    kept = slice(-width, None) if name.startswith(_MAP_COMES_FIRST) else slice(width)
    wide[..., kept] = old
    return wide
