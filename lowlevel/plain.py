"""Configurations back from JSON: the inverse of ``dataclasses.asdict``."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any, get_args, get_origin, get_type_hints


def from_plain(kind: type, value: Any) -> Any:
    """Rebuild nested dataclasses and tuples from what ``dataclasses.asdict`` and JSON made of them."""
    if is_dataclass(kind):
        hints = get_type_hints(kind)
        unknown = set(value) - {f.name for f in fields(kind)}
        if unknown:
            raise KeyError(f"{kind.__name__} has no field {sorted(unknown)[0]!r}")
        return kind(**{name: from_plain(hints[name], item) for name, item in value.items()})
    if get_origin(kind) is tuple:
        inner = get_args(kind)
        kinds = [inner[0]] * len(value) if len(inner) == 2 and inner[1] is Ellipsis else inner
        return tuple(from_plain(k, item) for k, item in zip(kinds, value, strict=True))
    return value
