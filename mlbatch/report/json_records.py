"""Dataclasses and named tuples as JSON values, and back, by the types of their fields."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import lru_cache
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np


def to_json(value: object) -> object:
    """A record, or a value of its fields, as what `json.dumps` takes."""
    if is_dataclass(value) and not isinstance(value, type):
        return {one.name: to_json(getattr(value, one.name)) for one in fields(value)}
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        return {name: to_json(one) for name, one in value._asdict().items()}
    if isinstance(value, (tuple, list)):
        return [to_json(one) for one in value]
    if isinstance(value, dict):
        return {str(name): to_json(one) for name, one in value.items()}
    if isinstance(value, np.ndarray):
        return value.tolist()
    return value


def from_json(kind: Any, found: object) -> Any:
    """The value of a type that `to_json` gave; ValueError for another."""
    return _reader(kind)(found)


Read = Callable[[Any], Any]


@lru_cache(maxsize=1024)
def _reader(kind: Any) -> Read:
    """Return what reads values of a type."""
    origin = get_origin(kind)
    if origin in (Union, UnionType):
        return _optional(kind)
    if origin is np.ndarray:
        return _array
    if origin is tuple:
        return _tuple(get_args(kind))
    if origin is list:
        return _list(get_args(kind)[0])
    if origin is dict:
        return _dict(get_args(kind)[1])
    if kind in (bool, int, float, str):
        return _plain(kind)
    return _record(kind)


def _plain(kind: type) -> Read:
    # A float may be written as a whole number; True is no number.
    kinds = (int, float) if kind is float else (kind,)

    def read(found: object) -> object:
        if type(found) not in kinds:
            raise ValueError(f"{found!r} instead of {kind.__name__}")
        return kind(found)

    return read


def _optional(kind: Any) -> Read:
    (inner,) = (one for one in get_args(kind) if one is not NoneType)
    inside = _reader(inner)
    return lambda found: None if found is None else inside(found)


def _array(found: object) -> object:
    return np.array(found, np.float64)


def _tuple(kinds: tuple[Any, ...]) -> Read:
    if kinds[-1] is Ellipsis:
        inside = _reader(kinds[0])
        return lambda found: tuple([inside(one) for one in _items(found)])
    readers = [_reader(kind) for kind in kinds]

    def read(found: object) -> object:
        return tuple([each(one) for each, one in zip(readers, _items(found), strict=True)])

    return read


def _list(kind: Any) -> Read:
    inside = _reader(kind)
    return lambda found: [inside(one) for one in _items(found)]


def _dict(kind: Any) -> Read:
    inside = _reader(kind)
    return lambda found: {name: inside(one) for name, one in _fields(found).items()}


def _record(kind: Any) -> Read:
    readers = {name: _reader(one) for name, one in get_type_hints(kind).items()}

    def read(found: object) -> object:
        given = _fields(found)
        if set(given) != set(readers):
            raise ValueError(f"fields {', '.join(given)} of a {kind.__name__}")
        return kind(**{name: each(given[name]) for name, each in readers.items()})

    return read


def _items(found: object) -> list[Any]:
    if not isinstance(found, list):
        raise ValueError(f"{found!r} instead of a list")
    return found


def _fields(found: object) -> dict[str, Any]:
    if not isinstance(found, dict):
        raise ValueError(f"{found!r} instead of an object")
    return found
