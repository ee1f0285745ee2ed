"""Seeded mutations of bytes and texts that know what parsers trust: lengths, counts, numbers."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from typing import Literal, TypeAlias

Seeds: TypeAlias = Sequence[bytes]
Order: TypeAlias = Literal["little", "big"]
Change: TypeAlias = Callable[[random.Random, bytearray, Seeds], None]

# Headers are where the lengths are.
_HEAD_BYTES = 96
_WIDTHS = (1, 2, 2, 4, 4, 4, 8)
_ORDERS: tuple[Order, ...] = ("little", "little", "big")
# How many places are tried for one whose value may be a length.
_TRIES = 12
_SPLICE_BYTES = 2000
# What grows no further: a case that doubles again and again says nothing new.
MOST_BYTES = 400_000


def mutated(rng: random.Random, seeds: Seeds) -> bytes:
    """One of the seeds with a few changes."""
    data = bytearray(rng.choice(seeds))
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        rng.choice(CHANGES)(rng, data, seeds)
    return bytes(data[:MOST_BYTES])


def _place(rng: random.Random, data: bytearray, width: int = 1) -> int:
    """Where to change something, often in the head; 0 where there is no room."""
    reach = len(data) - width + 1
    if reach <= 0:
        return 0
    return rng.randrange(min(reach, _HEAD_BYTES) if rng.random() < 0.4 else reach)


def _flip(rng: random.Random, data: bytearray, seeds: Seeds) -> None:
    for _ in range(rng.choice((1, 1, 2, 16)) if data else 0):
        data[_place(rng, data)] ^= 1 << rng.randrange(8)


def _set(rng: random.Random, data: bytearray, seeds: Seeds) -> None:
    if data:
        data[_place(rng, data)] = rng.choice((0, 1, 0x7F, 0x80, 0xFE, 0xFF, rng.randrange(256)))


def _extreme(rng: random.Random, data: bytearray, seeds: Seeds) -> None:
    """A number that nobody writes, or one next to the present one."""
    width = rng.choice(_WIDTHS)
    at = _place(rng, data, width)
    _write(data, at, width, rng.choice(_ORDERS), _odd_number(rng, data, at, width))


def _lie(rng: random.Random, data: bytearray, seeds: Seeds) -> None:
    """Change what may be a length: a number that fits into what follows it."""
    for _ in range(_TRIES):
        width, order = rng.choice((2, 4, 8)), rng.choice(_ORDERS)
        at = _place(rng, data, width)
        if 0 < _read(data, at, width, order) <= len(data) - at - width:
            _write(data, at, width, order, _odd_number(rng, data, at, width))
            return


def _odd_number(rng: random.Random, data: bytearray, at: int, width: int) -> int:
    left, top = len(data) - at - width, 1 << 8 * width
    now = _read(data, at, width, "little")
    ends = (0, 1, 2, top - 1, top - 2, top >> 1, (top >> 1) - 1, top >> 8, (1 << 24) + 1)
    near = (left, left + 1, left - 1, len(data), now + 1, now - 1, now * 2, now + 256, now ^ 0x80)
    return rng.choice((*ends, *near))


def _read(data: bytearray, at: int, width: int, order: Order) -> int:
    return int.from_bytes(data[at : at + width], order)


def _write(data: bytearray, at: int, width: int, order: Order, value: int) -> None:
    if at + width <= len(data):
        data[at : at + width] = (value % (1 << 8 * width)).to_bytes(width, order)


def _remove(rng: random.Random, data: bytearray, seeds: Seeds) -> None:
    at = _place(rng, data)
    del data[at : at + rng.choice((1, 2, 4, 16, 100, 1000))]


def _insert(rng: random.Random, data: bytearray, seeds: Seeds) -> None:
    at, size = _place(rng, data), rng.choice((1, 2, 4, 16, 100, 1000))
    fill = rng.choice((b"\0", b"\xff", b"A", rng.randbytes(1)))
    data[at:at] = fill * size if rng.random() < 0.7 else rng.randbytes(size)


def _repeat(rng: random.Random, data: bytearray, seeds: Seeds) -> None:
    at = _place(rng, data)
    part = data[at : at + rng.choice((4, 16, 100, 3000))]
    data[at:at] = part * rng.choice((1, 1, 5))


def _move(rng: random.Random, data: bytearray, seeds: Seeds) -> None:
    """Copy a part over another one."""
    begin, at = _place(rng, data), _place(rng, data)
    part = data[begin : begin + rng.choice((2, 8, 64, 1000))]
    data[at : at + len(part)] = part


def _splice(rng: random.Random, data: bytearray, seeds: Seeds) -> None:
    """A part of another seed."""
    other = rng.choice(seeds)
    begin, at = rng.randrange(len(other) + 1), _place(rng, data)
    part = other[begin : begin + rng.randrange(1, _SPLICE_BYTES)]
    if rng.random() < 0.5:
        data[at:at] = part
    else:
        data[at : at + len(part)] = part


def _fill(rng: random.Random, data: bytearray, seeds: Seeds) -> None:
    """One value alone, after the bytes that identify a vendor."""
    keep = rng.choice((0, 8, 16, 64))
    data[keep:] = bytes([rng.choice((0, 0x7F, 0x80, 0xFF))]) * max(len(data) - keep, 0)


def _cut(rng: random.Random, data: bytearray, seeds: Seeds) -> None:
    if rng.random() < 0.5:
        del data[_place(rng, data) :]
    else:
        del data[max(len(data) - rng.choice((1, 2, 8, 64)), 0) :]


CHANGES: tuple[Change, ...] = (
    *(_flip, _set, _extreme, _extreme, _lie, _lie, _lie),
    *(_remove, _insert, _repeat, _move, _splice, _cut, _fill),
)

# -- texts ----------------------------------------------------------------------------------------

NUMBERS = (
    *(".nan", "NaN", "nan", "inf", "-inf", ".inf", "Infinity", "1e308", "-1e308", "1e999"),
    *("0", "-0.0", "-1", "1", "4294967295", "4294967296", "-2147483649", "9" * 25, "1e-320"),
    *("0x10", "1_000", "1,5", "00", "+1", "1e", "2**31", "\u0663", "1/0", "0/1", "1e999999999"),
)
WORDS = (
    *("", " ", "\t", "null", "~", "true", "[]", "{}", "[[[[", "}}", '"', "'", "\0", "\r", "\n\n"),
    *("!!python/object/apply:os.system [ls]", "!!binary AAAA", "&a [*a]", "*a", "<<: *a", "%TAG"),
    *("---", "...", "- ", "? ", ": ", "# ", "| ", "> ", ",", ";", "=", "<!DOCTYPE a>", "&amp;"),
    *("../../etc/passwd", "/dev/zero", "/dev/stdin", "file:///etc/passwd", "~", ".", "é", "\ufeff"),
    *("<![CDATA[", "<!--", "&x;", "\U0001f600", "\x1b[31m", "\u202e", "\x85", "\u2028"),
)
_NUMBER_BYTES = frozenset(b"0123456789+-.eE")


def mutated_text(rng: random.Random, seeds: Seeds) -> bytes:
    """One of the seeds with lines, words and numbers changed; now and then with bytes changed."""
    if rng.random() < 0.15:
        return mutated(rng, seeds)
    data = bytearray(rng.choice(seeds))
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        rng.choice(_TEXT_CHANGES)(rng, data, seeds)
    return bytes(data[:MOST_BYTES])


def _number(rng: random.Random, data: bytearray, seeds: Seeds) -> None:
    """Put an odd number in place of another."""
    for _ in range(_TRIES):
        at = rng.randrange(len(data)) if data else 0
        if data[at : at + 1].isdigit():
            begin = end = at
            while begin and data[begin - 1] in _NUMBER_BYTES:
                begin -= 1
            while end < len(data) and data[end] in _NUMBER_BYTES:
                end += 1
            data[begin:end] = rng.choice(NUMBERS).encode()
            return


def _word(rng: random.Random, data: bytearray, seeds: Seeds) -> None:
    at = rng.randrange(len(data) + 1)
    data[at : at + rng.choice((0, 0, 1, 3))] = rng.choice(WORDS).encode()


def _line(rng: random.Random, data: bytearray, seeds: Seeds) -> None:
    """Remove, repeat or move a line, or take one of another seed."""
    lines = bytes(data).splitlines(keepends=True)
    others = rng.choice(seeds).splitlines(keepends=True)
    if not lines or not others:
        return
    at, kind = rng.randrange(len(lines)), rng.randrange(5)
    if kind == 0:
        del lines[at]
    elif kind == 1:
        lines[at:at] = [lines[at]] * rng.choice((1, 2, 300))
    elif kind == 2:
        lines.insert(rng.randrange(len(lines)), lines.pop(at))
    elif kind == 3:
        lines[at] = rng.choice((b" ", b"  ", b"\t", b"- ")) + lines[at]
    else:
        lines.insert(at, rng.choice(others))
    data[:] = b"".join(lines)


def _nest(rng: random.Random, data: bytearray, seeds: Seeds) -> None:
    """Brackets or elements, more deeply than any parser of ours follows them."""
    opened, closed = rng.choice(
        ((b"[", b"]"), (b"{a: ", b"}"), (b'{"a":', b"}"), (b"<a>", b"</a>"))
    )
    depth = rng.choice((3, 60, 1500, 30_000))
    at = rng.randrange(len(data) + 1)
    data[at:at] = opened * depth + b"1" + (closed * depth if rng.random() < 0.7 else b"")


def _bytes(rng: random.Random, data: bytearray, seeds: Seeds) -> None:
    rng.choice((_flip, _set, _remove, _cut, _repeat))(rng, data, seeds)


_TEXT_CHANGES: tuple[Change, ...] = (
    *(_number, _number, _number, _word, _word, _word),
    *(_line, _line, _nest, _bytes),
)
