"""Configurations back from JSON: the inverse of ``dataclasses.asdict``."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any, get_args, get_origin, get_type_hints


def from_plain(kind: type, value: Any) -> Any:
    """Rebuild nested dataclasses and tuples from what ``dataclasses.asdict`` and JSON made of them.

    Raises:
        KeyError: naming a field that is unknown, or absent: today's default may not be what it was then.
    """
    if is_dataclass(kind):
        hints = get_type_hints(kind)
        names = {f.name for f in fields(kind)}
        for name in sorted(set(value) - names):
            raise KeyError(f"{kind.__name__} has no field {name!r}")
        for name in sorted(names - set(value)):
            raise KeyError(f"{kind.__name__} lacks its field {name!r}")
        return kind(**{name: from_plain(hints[name], item) for name, item in value.items()})
    if get_origin(kind) is tuple:
        inner = get_args(kind)
        kinds = [inner[0]] * len(value) if len(inner) == 2 and inner[1] is Ellipsis else inner
        return tuple(from_plain(k, item) for k, item in zip(kinds, value, strict=True))
    return value
