"""Edits that damage outputs, by their names and words in `damage.txt`."""

from __future__ import annotations

import ast
import io
import shlex
import shutil
import struct
import warnings
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tests.builders.rewritten_outputs import (
    Change,
    Notes,
    Records,
    Sent,
    bag,
    gone,
    later,
    mcap,
    on,
    only,
    patched,
    points,
    put,
    twice,
)
from tests.builders.verify_outputs import (
    Arrays,
    Edit,
    arrays,
    both,
    flipped,
    raw,
    removed,
    renamed,
    report,
    row,
    text,
    with_cell,
    with_value,
)

# Of a PointCloud2 on `base_link`: seconds and nanoseconds.
STAMP = 4


def edit_of(words: str) -> Edit:
    """The edits in a line of `damage.txt`."""
    return both(*(_one(part) for part in words.split("; ")))


def _one(words: str) -> Edit:
    name, *values = shlex.split(words)
    return EDITS[name](*values)


def _value(word: str) -> Any:
    """A number or literal; anything else is a text."""
    if word in ("nan", "inf"):
        return float(word)
    try:
        return ast.literal_eval(word)
    except (SyntaxError, ValueError):
        return word


def _changed(word: str) -> Any:
    """A new value, or with a sign a function of the old one."""
    if word[:1] in ("+", "-"):
        return lambda old: old + int(word)
    return _value(word)


# -- npz --------------------------------------------------------------------------------------


def be(name: str, key: str, expression: str) -> Edit:
    """Replace an array; expression: of the old one, `v`."""

    def change(found: Arrays) -> None:
        names = {"v": found[key], "nan": np.nan}
        found[key] = np.array(eval(expression, names))

    return arrays(name, change)


def put_at(name: str, key: str, place: str, value: str) -> Edit:
    """Put a value at a place."""

    def change(found: Arrays) -> None:
        found[key][_value(place)] = _value(value)

    return arrays(name, change)


def add_at(name: str, key: str, place: str, value: str) -> Edit:
    """Add a value at a place."""

    def change(found: Arrays) -> None:
        old = found[key][_value(place)]
        # Differences may be negative.
        old = old.astype(np.int64) if old.dtype.kind in "iu" else old
        found[key][_value(place)] = old + _value(value)

    return arrays(name, change)


def swap(name: str, key: str, first: str, second: str) -> Edit:
    """Exchange two values."""
    pair = [int(first), int(second)]

    def change(found: Arrays) -> None:
        found[key][pair] = found[key][pair[::-1]]

    return arrays(name, change)


def without(name: str, key: str) -> Edit:
    """Remove a key."""

    def change(found: Arrays) -> None:
        del found[key]

    return arrays(name, change)


def slot(name: str, which: str, key: str, value: str, axis: str = "...") -> Edit:
    """Put a value into a slot of an organized scan, which is empty or full."""

    def change(found: Arrays) -> None:
        empty = np.isnan(found["xyz"]).all(axis=2)
        place = tuple(np.argwhere(empty == (which == "empty"))[5])
        found[key][place if found[key].ndim == 2 else (*place, _value(axis))] = _value(value)

    return arrays(name, change)


def _rows_of(found: Arrays) -> list[str]:
    """Keys with a row for each point."""
    return [key for key in found if len(found[key].shape) and len(found[key]) == len(found["ring"])]


def drop_column(name: str) -> Edit:
    """Remove the last column and its points."""

    def change(found: Arrays) -> None:
        last = len(found["column_stamp_ns"]) - 1
        keep = found["column"] < last
        for key in _rows_of(found):
            found[key] = found[key][keep]
        for key in ("column_stamp_ns", "column_lidar_id"):
            found[key] = found[key][:last]

    return arrays(name, change)


def repeat_column(name: str) -> Edit:
    """Insert a copy of a column with points after it."""

    def change(found: Arrays) -> None:
        column = int(found["column"][len(found["column"]) // 2])
        rows = np.flatnonzero(found["column"] == column)
        found["column"][found["column"] > column] += 1
        for key in _rows_of(found):
            copy = found[key][rows] + (1 if key == "column" else 0)
            found[key] = np.insert(found[key], rows[-1] + 1, copy, axis=0)
        for key in ("column_stamp_ns", "column_lidar_id"):
            found[key] = np.insert(found[key], column, found[key][column])

    return arrays(name, change)


def member(name: str, key: str, data: bytes | str, method: str = "0", size: str = "") -> Edit:
    """Add a member to the zip; size: declared size, if not the true one."""

    def change(old: bytearray) -> bytearray:
        file = io.BytesIO(old)
        with zipfile.ZipFile(file, "a") as archive, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            archive.writestr(key, data, int(method))
        new = bytearray(file.getvalue())
        if size:
            struct.pack_into("<I", new, new.rindex(b"PK\x01\x02") + 24, int(size))
        return new

    return raw(name, change)


def npy(name: str, descr: str, fortran: str, shape: str) -> Edit:
    """Add an array with this header and 8 bytes of data."""
    head = f"{{'descr': '{descr}', 'fortran_order': {fortran}, 'shape': {shape}, }}".encode()
    data = b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head + bytes(8)
    return member(name, "x.npy", data)


# -- files ------------------------------------------------------------------------------------


def cut(name: str, size: str) -> Edit:
    """Keep the first bytes; a negative number: drop the last ones."""
    return raw(name, lambda data: data[: len(data) // 2 if size == "half" else int(size)])


def replaced(name: str, old: str, new: str, ones: str = "0") -> Edit:
    """Replace the first occurrence of a text; ones: digits after the new one."""
    words = [word.replace("\\n", "\n").replace("\\t", "\t") for word in (old, new)]
    return text(name, words[0], words[1] + "1" * int(ones))


def copied_over(source: str, target: str) -> Edit:
    """Copy a file over another."""

    def edit(folder: Path) -> None:
        shutil.copy(folder / source, folder / target)

    return edit


def overwritten(name: str, content: str) -> Edit:
    """Another content of a file."""
    return raw(name, lambda data: content.encode())


def of_report(path: str, value: str, power: str = "0") -> Edit:
    """Change a value of report.json; power: of ten, as a factor."""
    new = _changed(value)
    return report(*_path(path), to=new * 10 ** int(power) if power != "0" else new)


def _path(path: str) -> list[str | int]:
    return [int(step) if step.isdecimal() else step for step in path.split(".")]


def cell(line: str, column: str, value: str) -> Edit:
    """Change a cell of scans.csv; lines are counted from the first scan."""
    return row(int(line), column, _changed(value) if value[:1] in ("+", "-") else value)


# -- points -----------------------------------------------------------------------------------

_LABELS = [("return_type", "u1"), ("lidar_id", "u1")]
_XYZI = [(name, "<f4") for name in ("x", "y", "z", "intensity")]
# By the end of the header: records after it.
_RECORDS: dict[bytes, list[tuple[str, str]]] = {
    b"uchar lidar_id\nend_header\n": [*_XYZI, ("time", "<f8"), ("ring", "<i4"), *_LABELS],
    b"float time\nend_header\n": [*_XYZI[:3], ("time", "<f4")],
    b"DATA binary\n": [*_XYZI, ("time", "<f4"), ("ring", "<u2"), *_LABELS],
}
_ROWS = {
    ".pcd.bin": [*_XYZI, ("ring", "<f4")],
    ".time.bin": [("time", "<f4"), ("lidar_id", "<f4")],
    ".bin": _XYZI,
}


def field(name: str, key: str, place: str, value: str) -> Edit:
    """Put a value into a field of a point."""
    if name.endswith((".las", ".laz")):
        return _las(name, lambda las: _set_dimension(las, key, int(place), _value(value)))

    def change(data: bytearray) -> bytearray:
        begin, kind = 0, next((kind for end, kind in _ROWS.items() if name.endswith(end)), [])
        for head, found in _RECORDS.items():
            if not kind and head in data:
                begin, kind = data.index(head) + len(head), found
        np.frombuffer(data, np.dtype(kind), offset=begin)[key][int(place)] = _value(value)
        return data

    return raw(name, change)


def _las(name: str, change: Callable[[Any], None]) -> Edit:
    """Change a file by laspy."""

    def edit(folder: Path) -> None:
        import laspy

        las: Any = laspy.read(folder / name)
        change(las)
        las.write(folder / name)

    return edit


def _set_dimension(las: Any, key: str, place: int, value: float) -> None:
    values = las[key].copy()
    values[place] = value
    las[key] = values


def _drop_comments(las: Any) -> None:
    import laspy

    kept = [vlr for vlr in las.header.vlrs if vlr.user_id != "mlbatch"]
    las.header.vlrs = laspy.vlrs.vlrlist.VLRList(kept)


# -- messages ---------------------------------------------------------------------------------


def message(topic: str, number: str, name: str, *words: str) -> Edit:
    """Change one message; the file is written anew, so that indexes and checksums fit."""
    change = only(topic, int(number), CHANGES[name](*words))

    def edit(path: Path) -> None:
        (bag if path.suffix == ".bag" else mcap)(change)(path)

    return edit


def moved(by_ns: str) -> Change:
    """Another time, the same in the log and in the header."""

    def change(sent: Sent) -> list[Sent]:
        data, log_ns = bytearray(sent.data), sent.log_ns + int(by_ns)
        struct.pack_into("<iI", data, STAMP, *divmod(log_ns, 10**9))
        return [replace(sent, data=bytes(data), log_ns=log_ns, publish_ns=log_ns)]

    return change


def words_in(old: str, new: str) -> Change:
    """Other words of the same length."""
    return lambda sent: [replace(sent, data=sent.data.replace(old.encode(), new.encode(), 1))]


def slot_of_cloud(which: str, name: str, expression: str) -> Change:
    """Another value in an empty or full slot; expression: of the old one, `v`."""

    def change(records: Records) -> None:
        place = np.flatnonzero(np.isnan(records["x"]) == (which == "empty"))[7]
        values = {"v": records[name][place], "nan": np.nan}
        records[name][place] = eval(expression, values)

    return points("standard", change)


CHANGES: dict[str, Callable[..., Change]] = {
    "later": lambda ns: later(int(ns)),
    "published": lambda ns: lambda sent: [replace(sent, publish_ns=int(ns))],
    "moved": moved,
    "twice": lambda: twice,
    "gone": lambda: gone,
    "words": words_in,
    "patched": lambda place, form, value: patched(int(place), form, _value(value)),
    "shortened": lambda count: lambda sent: [replace(sent, data=sent.data[: -int(count)])],
    "as_imu": lambda: lambda sent: [replace(sent, kind="sensor_msgs/msg/Imu")],
    "on": on,
    "put": lambda layout, name, place, value: put(layout, name, int(place), _value(value)),
    "slot": slot_of_cloud,
}


def _notes(change: Callable[[dict[str, dict[str, str]], dict[str, bytes]], Any]) -> Edit:
    """Change metadata records and attachments."""
    notes: Notes = change
    return mcap(notes=notes)


def inner_report(path: str, value: str) -> Edit:
    """Change the report inside."""

    def change(metadata: dict[str, dict[str, str]], _: dict[str, bytes]) -> None:
        record = metadata["mlbatch.report"]
        record["json"] = with_value(record["json"], _path(path), _value(value))

    return _notes(change)


def inner_cell(line: str, column: str, value: str) -> Edit:
    """Change the table inside."""

    def change(_: dict[str, dict[str, str]], files: dict[str, bytes]) -> None:
        old = files["scans.csv"].decode()
        files["scans.csv"] = with_cell(old, int(line), column, value).encode()

    return _notes(change)


# -- records of containers ----------------------------------------------------------------------

# Magic of an MCAP file; opcode and length of a record; what a chunk has before its compression.
_MAGIC_BYTES, _HEAD, _CHUNK = 8, struct.Struct("<BQ"), struct.Struct("<QQQII")


@dataclass(frozen=True, slots=True)
class Chunk:
    """Where the parts of a chunk begin; size, stored: bytes of its records, and in the file."""

    size_at: int
    name_at: int
    stored_at: int
    size: int
    stored: int


def records(data: bytes | bytearray) -> Iterator[tuple[int, int]]:
    """Opcodes of the records of a file, and where their contents begin (mcap.dev/spec)."""
    at = _MAGIC_BYTES
    while at + _HEAD.size < len(data):
        opcode, length = _HEAD.unpack_from(data, at)
        yield opcode, at + _HEAD.size
        at += _HEAD.size + length


def first_chunk(data: bytes | bytearray) -> Chunk:
    """The first chunk of a file."""
    begin = next(at for opcode, at in records(data) if opcode == 6)
    _, _, size, _, letters = _CHUNK.unpack_from(data, begin)
    name_at = begin + _CHUNK.size
    (stored,) = struct.unpack_from("<Q", data, name_at + letters)
    return Chunk(begin + 16, name_at, name_at + letters + 8, size, stored)


def chunk(part: str, change: str = "0") -> Edit:
    """Change a declared size of the first chunk, or a byte of it."""

    def edit(data: bytearray) -> bytearray:
        found = first_chunk(data)
        if part == "size":
            struct.pack_into("<Q", data, found.size_at, found.size + int(change))
        elif part == "stored":
            struct.pack_into("<Q", data, found.stored_at - 8, found.stored + int(change))
        elif part == "compression":
            data[found.name_at] ^= 1
        else:
            data[found.stored_at + (found.stored // 2 if part == "middle" else 0)] ^= 0xFF
        return data

    return raw("", edit)


def message_index(place: str, value: str = "") -> Edit:
    """Change a number of the first message index, or a byte of it."""

    def edit(data: bytearray) -> bytearray:
        at = next(at for opcode, at in records(data) if opcode == 7) + int(place)
        if value:
            struct.pack_into("<I", data, at, int(value))
        else:
            data[at] ^= 1
        return data

    return raw("", edit)


def bag_record(data: bytearray, op: int) -> tuple[int, int, int]:
    """Begin, begin of the data and end of the first record of a type, in a ROS 1 bag."""
    at = len(b"#ROSBAG V2.0\n")
    while True:
        (head,) = struct.unpack_from("<I", data, at)
        (size,) = struct.unpack_from("<I", data, at + 4 + head)
        begin = at + 8 + head
        if data[data.index(b"op=", at) + 3] == op:
            return at, begin, begin + size
        at = begin + size


def bag_number(op: str, part: str, place: str, value: str = "") -> Edit:
    """Change a number of the first record of a type, or a byte; part: 0 header, 1 data."""

    def edit(data: bytearray) -> bytearray:
        at = bag_record(data, int(op))[int(part)] + int(place)
        if value:
            struct.pack_into("<I", data, at, int(value))
        else:
            data[at] ^= 1
        return data

    return raw("", edit)


def repeated_index() -> Edit:
    """Thousands of entries of the index of a bag are one chunk."""

    def edit(data: bytearray) -> bytes:
        begin, _, end = bag_record(data, 6)
        count_at = data.index(b"chunk_count=") + 12
        (count,) = struct.unpack_from("<I", data, count_at)
        struct.pack_into("<I", data, count_at, count + 5000)
        return bytes(data) + bytes(data[begin:end]) * 5000

    return raw("", edit)


def chunk_position() -> Edit:
    """The index of a bag names a position inside a chunk."""
    return raw("", lambda data: flipped(data.index(b"chunk_pos=") + 10)(data))


EDITS: dict[str, Callable[..., Edit]] = {
    "be": be,
    "set": put_at,
    "add": add_at,
    "swap": swap,
    "without": without,
    "slot": slot,
    "drop_column": drop_column,
    "repeat_column": repeat_column,
    "member": member,
    "npy": npy,
    "cut": cut,
    "flip": lambda name, place: raw(name, flipped(int(place))),
    "text": replaced,
    "write": overwritten,
    "zeros": lambda name, kept, count: raw(name, lambda d: d[: int(kept)] + bytes(int(count))),
    "rename": renamed,
    "remove": lambda *names: both(*map(removed, names)),
    "remove_all": lambda: lambda folder: shutil.rmtree(folder),
    "copy": copied_over,
    "report": of_report,
    "cell": cell,
    "field": field,
    "las_comments": lambda name: _las(name, _drop_comments),
    "las_scale": lambda name: _las(name, lambda las: las.change_scaling(scales=[0.001] * 3)),
    "message": message,
    "grid": lambda key, value: _notes(lambda notes, _: notes["mlbatch.grid"].update({key: value})),
    "no_note": lambda name: _notes(lambda notes, files: (notes.pop(name, 0), files.pop(name, 0))),
    "inner_report": inner_report,
    "inner_cell": inner_cell,
    "profile": lambda name: mcap(profile=name),
    "chunk": chunk,
    "message_index": message_index,
    "bag_number": bag_number,
    "repeated_index": repeated_index,
    "chunk_position": chunk_position,
}
