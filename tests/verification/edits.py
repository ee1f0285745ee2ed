"""Edits that damage outputs, by their names and words in `damage.txt`.

A function with a decorator is the edit of its name: it changes arrays, bytes or messages.
"""

from __future__ import annotations

import ast
import csv
import io
import json
import shlex
import shutil
import struct
import warnings
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tests.builders.rewritten_outputs import Change, Records, Sent, bag, mcap, only, points
from tests.builders.verify_outputs import Arrays, Edit, arrays

# Of a PointCloud2 on `base_link`: seconds and nanoseconds.
STAMP = 4
EDITS: dict[str, Callable[..., Edit]] = {}
CHANGES: dict[str, Callable[..., Change]] = {}


def edit_of(words: str) -> Edit:
    """The edits in a line of `damage.txt`."""
    return both(*(_one(part) for part in words.split("; ")))


def _one(words: str) -> Edit:
    name, *values = shlex.split(words)
    return EDITS[name](*values)


def both(*edits: Edit) -> Edit:
    """Several edits."""

    def edit(path: Path) -> None:
        for one in edits:
            one(path)

    return edit


def _value(word: str) -> Any:
    """A number or literal; anything else is a text."""
    if word in ("nan", "inf"):
        return float(word)
    try:
        return ast.literal_eval(word)
    except (SyntaxError, ValueError):
        return word


def _changed(old: Any, word: str) -> Any:
    """A new value, or with a sign a sum with the old one."""
    return int(old) + int(word) if word[:1] in ("+", "-") else _value(word)


# -- npz --------------------------------------------------------------------------------------


def of_arrays(change: Callable[..., None]) -> None:
    """An edit of the arrays of a scan; its words begin with the name of the file."""
    name = change.__name__.strip("_")
    EDITS[name] = lambda file, *words: arrays(file, lambda found: change(found, *words))


@of_arrays
def be(found: Arrays, key: str, expression: str) -> None:
    """Replace an array; expression: of the old one, `v`."""
    found[key] = np.array(eval(expression, {"v": found[key], "nan": np.nan}))


@of_arrays
def _set(found: Arrays, key: str, place: str, value: str) -> None:
    """Put a value at a place."""
    found[key][_value(place)] = _value(value)


@of_arrays
def add(found: Arrays, key: str, place: str, value: str) -> None:
    """Add a value at a place."""
    old = found[key][_value(place)]
    # Differences may be negative.
    old = old.astype(np.int64) if old.dtype.kind in "iu" else old
    found[key][_value(place)] = old + _value(value)


@of_arrays
def swap(found: Arrays, key: str, first: str, second: str) -> None:
    """Exchange two values."""
    pair = [int(first), int(second)]
    found[key][pair] = found[key][pair[::-1]]


@of_arrays
def without(found: Arrays, key: str) -> None:
    """Remove a key."""
    del found[key]


@of_arrays
def slot(found: Arrays, which: str, key: str, value: str, axis: str = "...") -> None:
    """Put a value into a slot of an organized scan, which is empty or full."""
    empty = np.isnan(found["xyz"]).all(axis=2)
    place = tuple(np.argwhere(empty == (which == "empty"))[5])
    found[key][place if found[key].ndim == 2 else (*place, _value(axis))] = _value(value)


def _rows_of(found: Arrays) -> list[str]:
    """Keys with a row for each point."""
    return [key for key in found if len(found[key].shape) and len(found[key]) == len(found["ring"])]


@of_arrays
def drop_column(found: Arrays) -> None:
    """Remove the last column and its points."""
    last = len(found["column_stamp_ns"]) - 1
    keep = found["column"] < last
    for key in _rows_of(found):
        found[key] = found[key][keep]
    for key in ("column_stamp_ns", "column_lidar_id"):
        found[key] = found[key][:last]


@of_arrays
def repeat_column(found: Arrays) -> None:
    """Insert a copy of a column with points after it."""
    column = int(found["column"][len(found["column"]) // 2])
    rows = np.flatnonzero(found["column"] == column)
    found["column"][found["column"] > column] += 1
    for key in _rows_of(found):
        copy = found[key][rows] + (1 if key == "column" else 0)
        found[key] = np.insert(found[key], rows[-1] + 1, copy, axis=0)
    for key in ("column_stamp_ns", "column_lidar_id"):
        found[key] = np.insert(found[key], column, found[key][column])


# -- bytes ------------------------------------------------------------------------------------


def of_bytes(change: Callable[..., bytes | bytearray]) -> None:
    """An edit of the bytes of a file; its words begin with the name, "" is the output itself."""

    def edit_by(file: str, *words: Any) -> Edit:
        def edit(path: Path) -> None:
            place = path / file if file else path
            place.write_bytes(change(bytearray(place.read_bytes()), *words))

        return edit

    EDITS[change.__name__.strip("_")] = edit_by


def of_output(change: Callable[..., bytes | bytearray]) -> None:
    """An edit of the bytes of an output that is a file."""
    of_bytes(change)
    of_file = EDITS[change.__name__]
    EDITS[change.__name__] = lambda *words: of_file("", *words)


@of_bytes
def cut(data: bytearray, size: str) -> bytearray:
    """Keep the first bytes; a negative number: drop the last ones."""
    return data[: len(data) // 2 if size == "half" else int(size)]


@of_bytes
def text(data: bytearray, old: str, new: str, ones: str = "0") -> bytes:
    """Replace the first occurrence of a text; ones: digits after the new one."""
    before, after = (word.replace("\\n", "\n").replace("\\t", "\t") for word in (old, new))
    assert before.encode() in data, old
    return bytes(data).replace(before.encode(), (after + "1" * int(ones)).encode(), 1)


@of_bytes
def flip(data: bytearray, place: str) -> bytearray:
    """Another byte at a place."""
    data[int(place)] ^= 0x55
    return data


@of_bytes
def write(data: bytearray, content: str) -> bytes:
    """Another content."""
    return content.encode()


@of_bytes
def zeros(data: bytearray, kept: str, count: str) -> bytearray:
    """Zeros after the first bytes."""
    return data[: int(kept)] + bytes(int(count))


@of_bytes
def member(
    old: bytearray, key: str, data: bytes | str, method: str = "0", size: str = ""
) -> bytearray:
    """Add a member to the zip; size: declared size, if not the true one."""
    file = io.BytesIO(old)
    with zipfile.ZipFile(file, "a") as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        archive.writestr(key, data, int(method))
    new = bytearray(file.getvalue())
    if size:
        struct.pack_into("<I", new, new.rindex(b"PK\x01\x02") + 24, int(size))
    return new


def npy(name: str, descr: str, fortran: str, shape: str) -> Edit:
    """Add an array with this header and 8 bytes of data."""
    head = f"{{'descr': '{descr}', 'fortran_order': {fortran}, 'shape': {shape}, }}".encode()
    data = b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head + bytes(8)
    return EDITS["member"](name, "x.npy", data)


# -- table and report ---------------------------------------------------------------------------


def _part(output: Path, name: str) -> Path:
    return output / name if output.is_dir() else output.with_name(f"{output.name}.{name}")


def _with_cell(text: str, line: str, column: str, value: str) -> str:
    """A table with another cell; lines are counted from the first scan."""
    rows = list(csv.reader(io.StringIO(text)))
    where = rows[0].index(column)
    old = rows[int(line) + 1][where]
    rows[int(line) + 1][where] = str(_changed(old, value)) if value[:1] in ("+", "-") else value
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows(rows)
    return out.getvalue()


def _with_value(text: str, path: str, value: str, power: str = "0") -> str:
    """A JSON text with another value; power: of ten, as a factor."""
    root = place = json.loads(text)
    steps: list[Any]
    last: Any
    *steps, last = (int(step) if step.isdecimal() else step for step in path.split("."))
    for step in steps:
        place = place[step]
    old = place[last] if isinstance(place, list) else place.get(last)
    new = _changed(old, value)
    place[last] = new * 10 ** int(power) if power != "0" else new
    return json.dumps(root)


def _of_part(name: str, change: Callable[..., str]) -> Callable[..., Edit]:
    """An edit of the table, or of the report, in or next to an output."""

    def edit_by(*words: str) -> Edit:
        def edit(output: Path) -> None:
            file = _part(output, name)
            file.write_text(change(file.read_text(), *words))

        return edit

    return edit_by


def _inner_report(notes: dict[str, dict[str, str]], path: str, value: str) -> None:
    record = notes["mlbatch.report"]
    record["json"] = _with_value(record["json"], path, value)


def _inner_cell(files: dict[str, bytes], *words: str) -> None:
    files["scans.csv"] = _with_cell(files["scans.csv"].decode(), *words).encode()


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
    return EDITS["record"](name, name, key, place, value)


@of_bytes
def record(data: bytearray, name: str, key: str, place: str, value: str) -> bytearray:
    """Put a value into a field of a point of a record, by the name of the file or its header."""
    begin, kind = 0, next((kind for end, kind in _ROWS.items() if name.endswith(end)), [])
    for head, found in _RECORDS.items():
        if not kind and head in data:
            begin, kind = data.index(head) + len(head), found
    np.frombuffer(data, np.dtype(kind), offset=begin)[key][int(place)] = _value(value)
    return data


def _las(name: str, change: Callable[[Any], object]) -> Edit:
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
    return lambda path: (bag if path.suffix == ".bag" else mcap)(change)(path)


def of_message(change: Callable[..., Sent]) -> None:
    """A change of a message: to another one."""
    name = change.__name__.removesuffix("_in")
    CHANGES[name] = lambda *words: lambda sent: [change(sent, *words)]


@of_message
def later(sent: Sent, by_ns: str) -> Sent:
    """Another log time than the header's."""
    return replace(sent, log_ns=sent.log_ns + int(by_ns))


@of_message
def published(sent: Sent, at_ns: str) -> Sent:
    """Another publish time."""
    return replace(sent, publish_ns=int(at_ns))


@of_message
def moved(sent: Sent, by_ns: str) -> Sent:
    """Another time, the same in the log and in the header."""
    data, log_ns = bytearray(sent.data), sent.log_ns + int(by_ns)
    struct.pack_into("<iI", data, STAMP, *divmod(log_ns, 10**9))
    return replace(sent, data=bytes(data), log_ns=log_ns, publish_ns=log_ns)


@of_message
def words_in(sent: Sent, old: str, new: str) -> Sent:
    """Other words of the same length."""
    return replace(sent, data=sent.data.replace(old.encode(), new.encode(), 1))


@of_message
def patched(sent: Sent, place: str, form: str, value: str) -> Sent:
    """A number at a place."""
    data = bytearray(sent.data)
    struct.pack_into(form, data, int(place), _value(value))
    return replace(sent, data=bytes(data))


@of_message
def shortened(sent: Sent, count: str) -> Sent:
    """Without the last bytes."""
    return replace(sent, data=sent.data[: -int(count)])


def _put(layout: str, name: str, place: str, value: str) -> Change:
    """Put a value into a field of a point."""

    def change(records: Records) -> None:
        records[name][int(place)] = _value(value)

    return points(layout, change)


def _slot_of_cloud(which: str, name: str, expression: str) -> Change:
    """Another value in an empty or full slot; expression: of the old one, `v`."""

    def change(records: Records) -> None:
        place = np.flatnonzero(np.isnan(records["x"]) == (which == "empty"))[7]
        records[name][place] = eval(expression, {"v": records[name][place], "nan": np.nan})

    return points("standard", change)


CHANGES |= {
    "twice": lambda: lambda sent: [sent, sent],
    "gone": lambda: lambda sent: [],
    "as_imu": lambda: lambda sent: [replace(sent, kind="sensor_msgs/msg/Imu")],
    "on": lambda topic: lambda sent: [replace(sent, topic=topic)],
    "put": _put,
    "slot": _slot_of_cloud,
}

# -- records of containers ----------------------------------------------------------------------

# Magic of an MCAP file; opcode and length of a record; what a chunk has before its compression.
_MAGIC_BYTES, _HEAD, _CHUNK = 8, struct.Struct("<BQ"), struct.Struct("<QQQII")


class Chunk(NamedTuple):
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


def _put_number(data: bytearray, at: int, value: str) -> bytearray:
    """A number at a place; without one another byte."""
    if value:
        struct.pack_into("<I", data, at, int(value))
    else:
        data[at] ^= 1
    return data


@of_output
def chunk(data: bytearray, part: str, change: str = "0") -> bytearray:
    """Change a declared size of the first chunk, or a byte of it."""
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


@of_output
def message_index(data: bytearray, place: str, value: str = "") -> bytearray:
    """Change a number of the first message index, or a byte of it."""
    return _put_number(
        data, next(at for opcode, at in records(data) if opcode == 7) + int(place), value
    )


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


@of_output
def bag_number(data: bytearray, op: str, part: str, place: str, value: str = "") -> bytearray:
    """Change a number of the first record of a type, or a byte; part: 0 header, 1 data."""
    return _put_number(data, bag_record(data, int(op))[int(part)] + int(place), value)


@of_output
def repeated_index(data: bytearray) -> bytes:
    """Thousands of entries of the index of a bag are one chunk."""
    begin, _, end = bag_record(data, 6)
    count_at = data.index(b"chunk_count=") + 12
    (count,) = struct.unpack_from("<I", data, count_at)
    struct.pack_into("<I", data, count_at, count + 5000)
    return bytes(data) + bytes(data[begin:end]) * 5000


@of_output
def chunk_position(data: bytearray) -> bytearray:
    """The index of a bag names a position inside a chunk."""
    data[data.index(b"chunk_pos=") + 10] ^= 0x55
    return data


EDITS |= {
    "npy": npy,
    "rename": lambda old, new: lambda folder: (folder / old).rename(folder / new),
    "remove": lambda *names: lambda folder: [(folder / name).unlink() for name in names],
    "remove_all": lambda: shutil.rmtree,
    "copy": lambda source, target: lambda folder: shutil.copy(folder / source, folder / target),
    "report": _of_part("report.json", _with_value),
    "cell": _of_part("scans.csv", _with_cell),
    "field": field,
    "las_comments": lambda name: _las(name, _drop_comments),
    "las_scale": lambda name: _las(name, lambda las: las.change_scaling(scales=[0.001] * 3)),
    "message": message,
    "profile": lambda name: mcap(profile=name),
    "grid": lambda key, value: mcap(
        notes=lambda notes, _: notes["mlbatch.grid"].update({key: value})
    ),
    "no_note": lambda name: mcap(notes=lambda *notes: [one.pop(name, 0) for one in notes]),
    "inner_report": lambda *words: mcap(notes=lambda notes, _: _inner_report(notes, *words)),
    "inner_cell": lambda *words: mcap(notes=lambda _, files: _inner_cell(files, *words)),
}
