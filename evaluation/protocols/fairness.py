"""What controllers that are compared can all be told."""

from __future__ import annotations

import functools
import operator
from collections.abc import Sequence

from lowlevel.commands import CommandSpace
from lowlevel.control.whole_body import Supports, WholeBodyController
from robots.errors import PilotError


def common_supports(controllers: Sequence[WholeBodyController]) -> Supports:
    """What all of them can be told."""
    return functools.reduce(operator.and_, (controller.supports for controller in controllers))


def require_common(supports: Supports, space: CommandSpace) -> None:
    """Refuse controllers that have nothing in common.

    Raises:
        PilotError: naming what they do not share.
    """
    for doing, bounds in (("stand", supports.standing), ("walk", supports.walking)):
        for name, apart in zip(space.names, (bounds.lower > bounds.upper).tolist(), strict=True):
            if apart:
                raise PilotError(f"the controllers have no {name} in common while they {doing}: compare fewer of them")
