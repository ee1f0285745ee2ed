"""The decoding kernel: columns of one kind, from raw records to points in their final rows.

All that a column needs lies in scratch that fits into the first cache; each of its pixels is read
once and written once. The frame is that of `frame.py`; the result is the row after the last point.
"""

from __future__ import annotations

from collections.abc import Callable

from mlbatch.decode.kernels import frame as at
from mlbatch.decode.kernels._emit_source import emitting
from mlbatch.decode.kernels._keep_source import labelling, marking
from mlbatch.decode.kernels._points_source import projecting
from mlbatch.decode.kernels._primitives import (
    Pointer,
    as_c16,
    as_u1,
    as_u4,
    f4_scratch,
    i8_at,
    i8_scratch,
    moved,
    u1_scratch,
    u2_scratch,
)
from mlbatch.decode.kernels._read_source import reader_of
from mlbatch.decode.kernels._records_source import AHEAD, NO_RECORD, asking

_TABLE_AT = 56


def build(
    word: str, step: int, pad: int, returns: int, kind: str, lanes: int
) -> Callable[[Pointer], int]:
    """word, step: of the pixels; pad: channels, up to a power of 2; kind: see `projecting`.

    lanes: see `emitting`.
    """
    read, project = reader_of(word, step, pad), projecting(kind, pad, returns)
    mark, label, emit = marking(pad, returns), labelling(pad, returns), emitting(lanes)
    elements, four, eight = returns * pad, 4 * returns * pad, 8 * pad
    whole = step * pad
    ask = asking()
    as_parts = as_u4 if word == "<u4" else as_u1

    def kernel(frame: Pointer) -> int:
        ranges, levels, keep = f4_scratch(elements), f4_scratch(elements), u1_scratch(elements)
        points, labels, scratch = f4_scratch(four), i8_scratch(elements), f4_scratch(eight)
        others = u2_scratch(elements)
        for element in range(elements):
            others[element] = 0
        # Beams that there are not hold no return.
        pixels = u1_scratch(whole)
        for byte in range(whole):
            pixels[byte] = 0
        planes = as_parts(pixels)
        members, sensors = i8_at(frame[at.MEMBER]), i8_at(frame[at.SENSOR])
        stamps_ns, words = i8_at(frame[at.STAMP_NS]), i8_at(frame[at.ENCODER])
        begin, end, row = frame[at.BEGIN], frame[at.END], frame[at.ROW]
        number, last_table = frame[at.NUMBER], frame[at.TABLES] - 1
        records = i8_scratch(AHEAD)
        for column in range(begin, min(begin + AHEAD, end)):
            records[column % AHEAD] = ask(frame, column)
        for column in range(begin, end):
            record = records[column % AHEAD]
            if column + AHEAD < end:
                records[column % AHEAD] = ask(frame, column + AHEAD)
            if record == NO_RECORD:
                continue
            member = members[sensors[column]]
            for which in range(returns):
                read(frame, record, which, planes, ranges, levels, others)
            table = min(max(words[column] >> _TABLE_AT, 0), last_table)
            known = member * frame[at.TABLES] + table
            place = (member, words[column], known, number)
            project(frame, place, ranges, levels, points, scratch)
            mark(frame, member, ranges, points, keep)
            offset_ns = stamps_ns[column] - frame[at.START_NS]
            if frame[at.ORDER] != 0 or frame[at.WIDTH] != 0:
                label(frame, known, offset_ns, ranges, levels, labels)
            words_of = moved(i8_at(frame[at.LABELS]), known * elements)
            ready = as_c16(points), labels, ranges, others, keep
            row = emit(frame, column, table, row, ready, (words_of, offset_ns))
            number += 1
        frame[at.NUMBER] = number
        return int(row)

    return kernel
