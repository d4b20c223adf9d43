"""Configurations back from JSON: the inverse of ``dataclasses.asdict``."""

from __future__ import annotations

from dataclasses import MISSING, fields, is_dataclass
from types import UnionType
from typing import Any, Literal, get_args, get_origin, get_type_hints

_ACCEPTED: dict[type, tuple[type, ...]] = {bool: (bool,), int: (int,), float: (int, float), str: (str,)}
"""What JSON may hold for a field of each plain type; True and False are numbers to Python, but not here."""


def from_plain(kind: type, value: Any, name: str = "the configuration", complete: bool = True) -> Any:
    """Rebuild nested dataclasses, tuples and dictionaries from what ``dataclasses.asdict`` and JSON made of them.

    The only unions are those with None, written ``X | None``.

    Args:
        kind: what to build.
        value: what JSON holds.
        name: what messages call ``value``.
        complete: whether fields that have a default must be there too: it may not be today what it was then.

    Raises:
        KeyError: naming a field that is unknown or absent.
        TypeError: naming a field whose value is of another type than the field.
        ValueError: naming a field whose value is none of its choices.
    """
    if is_dataclass(kind):
        if not isinstance(value, dict):
            raise TypeError(f"{name} must hold the fields of {kind.__name__}, not {value!r}")
        hints = get_type_hints(kind)
        required = {f.name for f in fields(kind) if complete or (f.default is f.default_factory is MISSING)}
        for unknown in sorted(set(value) - set(hints)):
            raise KeyError(f"{kind.__name__} has no field {unknown!r}")
        for absent in sorted(required - set(value)):
            raise KeyError(f"{kind.__name__} lacks its field {absent!r}")
        return kind(**{field: from_plain(hints[field], item, field, complete) for field, item in value.items()})
    if get_origin(kind) is UnionType:
        return None if value is None else from_plain(get_args(kind)[0], value, name, complete)
    if get_origin(kind) is dict:
        if not isinstance(value, dict):
            raise TypeError(f"{name} must be an object, not {value!r}")
        inner = get_args(kind)[1]
        return {key: from_plain(inner, item, f"{name}[{key!r}]", complete) for key, item in value.items()}
    if get_origin(kind) is tuple:
        inner = get_args(kind)
        if not isinstance(value, (list, tuple)):
            raise TypeError(f"{name} must be a list, not {value!r}")
        kinds = [inner[0]] * len(value) if len(inner) == 2 and inner[1] is Ellipsis else inner
        if len(kinds) != len(value):
            raise TypeError(f"{name} must have {len(kinds)} entries, not {len(value)}")
        return tuple(from_plain(k, item, name, complete) for k, item in zip(kinds, value, strict=True))
    if get_origin(kind) is Literal and value not in get_args(kind):
        raise ValueError(f"{name} must be one of {', '.join(get_args(kind))}, not {value!r}")
    if kind in _ACCEPTED and (not isinstance(value, _ACCEPTED[kind]) or isinstance(value, bool) is not (kind is bool)):
        raise TypeError(f"{name} must be of type {kind.__name__}, not {value!r}")
    return value
