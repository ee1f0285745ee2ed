"""Members of a small zip and the npy arrays in them, read without the standard library's detours.

PKWARE APPNOTE 6.3 (no zip64: a scan is far below 4 GB), NEP 1. Every checksum is held against its
bytes. A folder of scans has twenty small arrays in each of thousands of files.
"""

from __future__ import annotations

import re
import struct
import zlib
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mlbatch.verify.verdict import DamageError

_END = struct.Struct("<4s4H2IH")
_ENTRY = struct.Struct("<4s6H3I5H2I")
_LOCAL = struct.Struct("<4s5H3I2H")
_END_MARK, _ENTRY_MARK, _LOCAL_MARK = b"PK\x05\x06", b"PK\x01\x02", b"PK\x03\x04"
_STORED, _DEFLATED = 0, 8
_NPY = re.compile(
    rb"\x93NUMPY\x01\x00..\{'descr': '([<>|=]?[a-zA-Z]\d+)', 'fortran_order': (True|False), "
    rb"'shape': \(([\d, ]*)\), \} *\n",
    re.DOTALL,
)


def members(data: bytes) -> dict[str, memoryview]:
    """All members by name; DamageError where one is not whole."""
    at = data.rfind(_END_MARK, max(0, len(data) - 65557))
    if at < 0 or at + _END.size > len(data):
        raise DamageError("a zip with a directory at its end", "none, as if it was cut off")
    _, _, _, _, count, size, begin, _ = _END.unpack_from(data, at)
    if begin + size > at:
        raise DamageError("a zip directory inside the file", f"one up to byte {begin + size}")
    found: dict[str, memoryview] = {}
    view = memoryview(data)
    for _ in range(count):
        if begin + _ENTRY.size > at:
            raise DamageError(f"{count} members", str(len(found)))
        entry = _ENTRY.unpack_from(data, begin)
        if entry[0] != _ENTRY_MARK:
            raise DamageError("an entry of the zip directory", f"other bytes at {begin}")
        name_end = begin + _ENTRY.size + entry[10]
        name = data[begin + _ENTRY.size : name_end].decode("utf-8", "replace")
        if name in found:
            raise DamageError(f"one member {name}", "two")
        found[name] = _member(view, name, entry)
        begin = name_end + entry[11] + entry[12]
    return found


def _member(view: memoryview, name: str, entry: tuple[int, ...]) -> memoryview:
    method, crc, stored, size, at = entry[4], entry[7], entry[8], entry[9], entry[16]
    if at + _LOCAL.size > len(view):
        raise DamageError(f"member {name} inside the file", f"a place at byte {at}")
    local = _LOCAL.unpack_from(view, at)
    begin = at + _LOCAL.size + local[9] + local[10]
    content = view[begin : begin + stored]
    if local[0] != _LOCAL_MARK or len(content) != stored:
        raise DamageError(f"{stored} bytes of member {name}", f"{len(content)}")
    if method == _DEFLATED:
        try:
            # No more than it says it holds, whatever it would unpack to.
            content = memoryview(zlib.decompressobj(-15).decompress(content, max(size, 1)))
        except zlib.error as err:
            raise DamageError(f"deflated bytes of member {name}", str(err)) from err
    elif method != _STORED:
        raise DamageError(f"member {name} stored or deflated", f"method {method}")
    if len(content) != size or zlib.crc32(content) != crc:
        raise DamageError(f"checksum {crc:08x} of member {name}", f"{zlib.crc32(content):08x}")
    return content


@dataclass(frozen=True, slots=True)
class Array:
    """An array of a member; kind: its type as numpy writes it."""

    kind: str
    values: npt.NDArray[np.generic]


def array(name: str, member: memoryview) -> Array:
    """The array in an npy; DamageError where its bytes do not fit its head."""
    head = _NPY.match(member)
    if head is None or head[2] == b"True":
        raise DamageError(f"{name} as an npy of version 1.0 in C order", "other bytes")
    kind = head[1].decode()
    try:
        shape = tuple(int(part) for part in head[3].split(b",") if part.strip())
        dtype = np.dtype(kind)
        count = 1
        for length in shape:
            count *= length
        if head.end() + count * dtype.itemsize != len(member) or dtype.hasobject:
            raise DamageError(f"{name}: {count} values of {kind}", f"{len(member)} bytes in all")
        values = np.frombuffer(member, dtype, count, head.end())
    except (TypeError, ValueError) as err:
        raise DamageError(f"{name} as an array", str(err)) from err
    return Array(kind, values.reshape(shape))
