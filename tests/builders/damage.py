"""Seeded damage of what a conversion reads: frames, payloads, files, texts."""

from __future__ import annotations

import json
import random
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import TypeAlias

from tests.builders.captures import pcap_bytes
from tests.builders.traffic import Datagram, Records
from tests.builders.two_lidars import COLUMNS_PER_PACKET

SHARE = 0.1
# How far a network or a capture host may swap packets.
REACH = 20

Kind: TypeAlias = Callable[[random.Random, bytes], Sequence[bytes]]


def flipped(rng: random.Random, data: bytes) -> bytes:
    """One to four bits flipped, anywhere or among the first bytes, where headers are."""
    changed = bytearray(data)
    reach = rng.choice([len(data), len(data), 64])
    for _ in range(rng.randint(1, 4) if data else 0):
        changed[rng.randrange(min(reach, len(data)))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def cut(rng: random.Random, data: bytes) -> bytes:
    """A part from the start on."""
    return data[: rng.choice([0, rng.randrange(len(data) + 1), max(len(data) - 1, 0)])]


KINDS: dict[str, Kind] = {
    "removed": lambda rng, data: [],
    "duplicated": lambda rng, data: [data] * rng.choice([2, 2, 3]),
    "truncated": lambda rng, data: [cut(rng, data)],
    "flipped": lambda rng, data: [flipped(rng, data)],
}
NAMES = (*KINDS, "reordered", "all")


def damaged(rng: random.Random, parts: Iterable[bytes], name: str) -> list[list[bytes]]:
    """What takes the place of each part: usually itself."""
    kinds = list(KINDS) if name == "all" else [name]
    out = []
    for part in parts:
        hit = name != "reordered" and rng.random() < SHARE
        out.append(list(KINDS[rng.choice(kinds)](rng, part)) if hit else [part])
    return _reordered(rng, out) if name in ("reordered", "all") else out


def _reordered(rng: random.Random, parts: list[list[bytes]]) -> list[list[bytes]]:
    keys = [
        place + (rng.uniform(-REACH, REACH) if rng.random() < SHARE else 0.0)
        for place in range(len(parts))
    ]
    return [parts[place] for place in sorted(range(len(parts)), key=keys.__getitem__)]


def damaged_frames(rng: random.Random, records: Sequence[tuple[int, bytes]], name: str) -> Records:
    """Frames on their way to the capture host; receive times stay in order."""
    parts = damaged(rng, [frame for _, frame in records], name)
    return [
        (host_ns, frame)
        for (host_ns, _), frames in zip(records, parts, strict=True)
        for frame in frames
    ]


def damaged_payloads(rng: random.Random, sent: Sequence[Datagram], name: str) -> Records:
    """Payloads in sound frames: what a faulty sensor or relay sends."""
    parts: list[tuple[int, Datagram, bytes]] = []
    for one, payloads in zip(sent, damaged(rng, [d.payload for d in sent], name), strict=True):
        parts += [(one.host_ns, one, payload) for payload in payloads]
    return [replace(one, host_ns=host_ns, payload=data).frame() for host_ns, one, data in parts]


# Timestamps at the limits of accepted values, and of 8 bytes.
STAMPS_NS = (0, 1, (1 << 31) * 10**9 - 1, (1 << 31) * 10**9, (1 << 63) - 1, 1 << 63, (1 << 64) - 1)
STEPS_NS = (10**6, 15 * 10**6, 10**8, 999 * 10**6, 10**9, 2 * 10**9, 10**12)


def damaged_heads(rng: random.Random, sent: Sequence[Datagram]) -> Records:
    """Lidar packets with odd stamps, measurement ids and status words in some columns."""
    kind = rng.randrange(4)
    share = rng.choice([0.02, 0.1, 0.4])
    return [
        (_odd_columns(rng, one, kind) if one.port == 7502 and rng.random() < share else one).frame()
        for one in sent
    ]


def _odd_columns(rng: random.Random, one: Datagram, kind: int) -> Datagram:
    """Column headers (docs/sources/ouster.md): stamp u64, measurement id u16, status u16."""
    data = bytearray(one.payload)
    record = (len(data) - 64) // COLUMNS_PER_PACKET
    for _ in range(rng.choice([1, 1, COLUMNS_PER_PACKET])):
        at = 32 + rng.randrange(COLUMNS_PER_PACKET) * record
        stamp_ns = int.from_bytes(data[at : at + 8], "little")
        stepped_ns = stamp_ns + rng.choice([-1, 1]) * rng.choice(STEPS_NS)
        new_ns = (stamp_ns, rng.choice(STAMPS_NS), stepped_ns, stamp_ns)[kind]
        data[at : at + 8] = (new_ns % (1 << 64)).to_bytes(8, "little")
        if kind in (0, 3):
            first = 0 if kind == 0 else 8
            data[at + rng.randrange(first, 12)] ^= 1 << rng.randrange(8)
    return replace(one, payload=bytes(data))


def with_jumps(rng: random.Random, records: Records) -> Records:
    """The same frames with a clock step of the capture host, for one frame or all later ones."""
    seconds = (0.001, 0.5, 2, 40, 10**6)
    out = []
    shift_ns = 0
    for host_ns, frame in records:
        jump_ns = int(rng.choice([-1, 1]) * rng.choice(seconds) * 10**9)
        chance = rng.random()
        once_ns = jump_ns if chance < 0.02 else 0
        shift_ns += jump_ns if chance > 0.995 else 0
        out.append((host_ns + shift_ns + once_ns, frame))
    return out


def damaged_file(rng: random.Random, records: Iterable[tuple[int, bytes]]) -> bytes:
    """A pcap with flipped bits in its headers, holes, or a cut end."""
    data = bytearray(pcap_bytes(records))
    for _ in range(rng.choice([1, 3, 30])):
        at = rng.randrange(len(data))
        what = rng.randrange(4)
        if what == 0:
            data[at] ^= 1 << rng.randrange(8)
        elif what == 1:
            del data[at : at + rng.choice([1, 16, 1000])]
        elif what == 2:
            data[at:at] = bytes(rng.choice([1, 16, 1000]))
        else:
            data[rng.randrange(200)] ^= 1 << rng.randrange(8)
    return bytes(data[: rng.randrange(len(data))] if rng.random() < 0.3 else data)


# -- texts ----------------------------------------------------------------------------------------

WORDS = ("", "null", "-1", "0", "1e308", "NaN", "[]", "{}", '"x"', "1" * 30, "true", "\x00", "é")


def damaged_text(rng: random.Random, text: str) -> str:
    """Characters flipped, removed, repeated, replaced by odd words, or the end cut off."""
    for _ in range(rng.choice([1, 1, 2, 5])):
        at = rng.randrange(max(len(text), 1))
        length = rng.choice([1, 1, 3, 20])
        middle = rng.choice(
            [
                chr(rng.choice([9, 10, 32, 34, 44, 58, 91, 93, 123, 125, rng.randrange(33, 127)])),
                "",
                text[at : at + length] * 2,
                rng.choice(WORDS),
            ]
        )
        text = text[:at] + middle + text[at + length :]
    return text if rng.random() < 0.9 else text[: rng.randrange(len(text) + 1)]


Json: TypeAlias = bool | int | float | str | list["Json"] | dict[str, "Json"] | None
# Each is a document of its own: a replaced value may be changed again.
VALUES = (
    "null",
    "true",
    "-1",
    "0",
    "1",
    "3",
    "17",
    "65536",
    "2147483648",
    "1180591620717411303424",
    "0.5",
    "1e308",
    "NaN",
    "Infinity",
    '""',
    '"x"',
    '"512x10"',
    '"LEGACY"',
    "[]",
    "[0]",
    "[1, 2, 3, 4]",
    "{}",
    '{"a": 1}',
)


def damaged_json(rng: random.Random, text: str) -> str:
    """A document whose values, one to three of them, are replaced, removed or repeated."""
    document: Json = json.loads(text)
    for _ in range(rng.choice([1, 1, 2, 3])):
        _change_one(rng, document)
    return json.dumps(document)


def _change_one(rng: random.Random, document: Json) -> None:
    places: list[tuple[Json, str | int]] = []
    _walk(document, places)
    holder, key = rng.choice(places)
    if isinstance(holder, dict) and isinstance(key, str):
        if rng.random() < 0.2:
            del holder[key]
        else:
            holder[key] = json.loads(rng.choice(VALUES))
    elif isinstance(holder, list) and isinstance(key, int):
        if rng.random() < 0.3:
            del holder[key]
        elif rng.random() < 0.3:
            holder.insert(key, holder[key])
        else:
            holder[key] = json.loads(rng.choice(VALUES))


def _walk(value: Json, places: list[tuple[Json, str | int]]) -> None:
    keys: Iterable[str | int] = ()
    if isinstance(value, dict):
        keys = list(value)
        places += [(value, key) for key in keys]
        for item in value.values():
            _walk(item, places)
    elif isinstance(value, list):
        # Long lists would otherwise take all the damage.
        places += [(value, key) for key in range(min(len(value), 2))]
        for item in value[:2]:
            _walk(item, places)
