"""Dataclasses and named tuples as JSON values, and back, by the types of their fields."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import MISSING, fields, is_dataclass
from functools import lru_cache
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np

from mlbatch.arrays import F64Array


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


def from_json(kind: Any, found: object, *, tolerant: bool = False) -> Any:
    """The value of a type that `to_json` gave; ValueError for another.

    tolerant: of another version, or damaged: what is unknown is left out, and a value that is
    absent or of another type is the default of its field, else 0, "", None or empty.
    """
    try:
        return _reader(kind, tolerant)(found)
    except (TypeError, OverflowError) as err:
        raise ValueError(str(err)) from err


Read = Callable[[Any], Any]


@lru_cache(maxsize=1024)
def _reader(kind: Any, tolerant: bool) -> Read:
    """Return what reads values of a type."""
    origin = get_origin(kind)
    arguments = get_args(kind)
    if origin in (Union, UnionType):
        (inner,) = (one for one in arguments if one is not NoneType)
        inside = _reader(inner, tolerant)
        return lambda found: None if found is None else inside(found)
    if kind == F64Array:
        return lambda found: np.array(_of(list, found), np.float64)
    if origin is tuple and arguments[-1] is not Ellipsis:
        readers = [_reader(one, tolerant) for one in arguments]
        return lambda found: tuple(
            [each(one) for each, one in zip(readers, _of(list, found), strict=True)]
        )
    if origin in (tuple, list):
        inside = _reader(arguments[0], tolerant)
        return lambda found: origin([inside(one) for one in _of(list, found)])
    if origin is dict:
        inside = _reader(arguments[1], tolerant)
        return lambda found: {name: inside(one) for name, one in _of(dict, found).items()}
    if kind in (bool, int, float, str):
        return lambda found: kind(_of(kind, found))
    return _tolerant_record(kind) if tolerant else _record(kind)


def _of(kind: type, found: Any) -> Any:
    """A value of a type; a float may be written as a whole number, and True is no number."""
    if type(found) is not kind and (kind, type(found)) != (float, int):
        raise ValueError(f"{found!r} instead of {kind.__name__}")
    return found


def _record(kind: Any) -> Read:
    readers = {name: _reader(one, False) for name, one in get_type_hints(kind).items()}

    def read(found: object) -> object:
        given = _of(dict, found)
        if set(given) != set(readers):
            raise ValueError(f"fields {', '.join(given)} of a {kind.__name__}")
        return kind(**{name: each(given[name]) for name, each in readers.items()})

    return read


def _tolerant_record(kind: Any) -> Read:
    hints = get_type_hints(kind)
    readers = {name: _reader(one, True) for name, one in hints.items()}
    known = getattr(kind, "_field_defaults", None)
    if known is None:
        known = {one.name for one in fields(kind) if one.default_factory is not MISSING}
        known |= {one.name for one in fields(kind) if one.default is not MISSING}
    needed = [name for name in hints if name not in known]

    def read(found: object) -> object:
        given = found if isinstance(found, dict) else {}
        values = {name: _nothing(hints[name]) for name in needed}
        for name in readers.keys() & given.keys():
            with contextlib.suppress(ValueError, TypeError, OverflowError):
                values[name] = readers[name](given[name])
        return kind(**values)

    return read


def _nothing(kind: Any) -> object:
    """The value of a field that is absent."""
    origin = get_origin(kind)
    if origin in (Union, UnionType):
        return None
    if kind == F64Array:
        return np.zeros(0)
    if (origin or kind) in (tuple, list, dict, bool, int, float, str):
        return (origin or kind)()
    return _reader(kind, True)(None)
