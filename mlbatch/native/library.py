"""The compiled library, its functions and structs: what `native.h` declares."""

from __future__ import annotations

import ctypes
import re
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from mlbatch.native import library_path

_WORD = ctypes.c_int64
_ADDRESS = ctypes.c_void_p
_C_TYPES: dict[str, Any] = {"int64_t": _WORD, "double": ctypes.c_double, "float": ctypes.c_float}
# Takes every buffer; types of numpy name the protocol from Python 3.12 on.
_from_buffer: Callable[[Any], Any] = ctypes.c_char.from_buffer
_HEADER = re.sub(
    r"/\*.*?\*/",
    "",
    Path(__file__).with_name("native.h").read_text(encoding="utf-8"),
    flags=re.DOTALL,
)
_ABI = int(re.findall(r"#define MLBATCH_ABI (\d+)", _HEADER)[0])
# What pointers lead to besides arrays.
_IN_MEMORY = (ctypes.Structure, ctypes.Array)
_FUNCTION = re.compile(r"EXPORT (\w+) (mlbatch_\w+)\((.*?)\);", re.DOTALL)
_STRUCT = r"typedef struct {([^}]*)} %s;"
_MEMBER = re.compile(r"(?:const )?(\w+) (\*?)(\w+)(?:\[(\d+)\])?;")


def members(struct: str) -> list[tuple[str, Any]]:
    """Return the names and types of the members of a struct of the header; arrays are pointers."""
    (body,) = re.findall(_STRUCT % struct, _HEADER)
    return [
        (name, _ADDRESS if pointer else _C_TYPES[kind] * int(count) if count else _C_TYPES[kind])
        for kind, pointer, name, count in _MEMBER.findall(body)
    ]


class Struct(ctypes.Structure):
    """A struct of the header: pointers take arrays and structs, which live as long as it."""

    def __init__(self, *values: int | None, **named: Any) -> None:
        super().__init__(*values)
        for name, value in named.items():
            setattr(self, name, value)

    def __setattr__(self, name: str, value: Any) -> None:
        """Point to an array or a struct, and keep it; or set a number."""
        # Members are descriptors of the class: they hide entries of the same name.
        if isinstance(value, np.ndarray):
            self.__dict__[name] = value
            value = address(value)
        elif isinstance(value, _IN_MEMORY):
            self.__dict__[name] = value
            value = ctypes.addressof(value)
        super().__setattr__(name, value)


class _Pointer:
    """A pointer in the arguments of a function: an array, a struct, an address or None."""

    @staticmethod
    def from_param(value: Any) -> Any:
        """Return what ctypes passes."""
        if isinstance(value, np.ndarray):
            return _ADDRESS.from_param(address(value))
        if isinstance(value, ctypes.Structure):
            return ctypes.byref(value)
        return _ADDRESS.from_param(value)


class Ring(Struct):
    """Where the columns of a sensor are."""

    _fields_: ClassVar = members("Ring")


class Field(Struct):
    """An integer in a word of a pixel."""

    _fields_: ClassVar = members("Field")


class Group(Struct):
    """Sensors that are decoded alike."""

    _fields_: ClassVar = members("Group")


class Piece(Struct):
    """A piece of a packed record."""

    _fields_: ClassVar = members("Piece")


class Scan(Struct):
    """A scan under construction."""

    _fields_: ClassVar = members("Scan")


class Totals(Struct):
    """Totals of all points in a LAS header."""

    _fields_: ClassVar = members("Totals")


class Rows(Struct):
    """Values of points to be packed."""

    _fields_: ClassVar = members("Rows")


class Part(Struct):
    """Columns of a sensor that wait for their window."""

    _fields_: ClassVar = members("Part")


class Reader(Struct):
    """How the headers of a sensor's packets are read."""

    _fields_: ClassVar = members("Reader")


class Numbers(Struct):
    """Sequence numbers of the packets of a sensor."""

    _fields_: ClassVar = members("Numbers")


class Intake(Struct):
    """The intake of a sensor, from batch to batch."""

    _fields_: ClassVar = members("Intake")


class Arrival(Struct):
    """Packets of a sensor in a batch."""

    _fields_: ClassVar = members("Arrival")


class Accepted(Struct):
    """Accepted packets of a sensor in a batch."""

    _fields_: ClassVar = members("Accepted")


class Dissection(Struct):
    """State of reading a capture, kept from frame to frame."""

    _fields_: ClassVar = members("Dissection")


def address(array: npt.NDArray[Any]) -> int:
    """Return the address of a C-contiguous array; the caller keeps the array."""
    try:
        # A third of the time of the other way, and a window needs many addresses.
        return ctypes.addressof(_from_buffer(array))
    except (TypeError, ValueError) as err:
        # Arrays without elements, or that are read only, have no such buffer.
        if not array.flags.c_contiguous:
            raise ValueError("expected a C-contiguous array") from err
        return int(array.ctypes.data)


@lru_cache(maxsize=1)
def library() -> Any:
    """Return the loaded library; OSError if it is missing, or was built from other sources."""
    path = library_path()
    if path is None:
        raise OSError("none, since it was not compiled when mlbatch was installed")
    loaded = ctypes.CDLL(str(path))
    for result, name, arguments in _FUNCTION.findall(_HEADER):
        function = getattr(loaded, name)
        function.restype = None if result == "void" else _WORD
        if arguments != "void":
            function.argtypes = [_Pointer if "*" in one else _WORD for one in arguments.split(",")]
    if loaded.mlbatch_abi() != _ABI:
        raise OSError(f"{path.name} of another version")
    return loaded


@lru_cache(maxsize=1)
def trouble() -> str:
    """Return why the library cannot be used; "" if it can."""
    try:
        library()
    except (OSError, AttributeError) as err:
        return " ".join(str(err).split())
    return ""
