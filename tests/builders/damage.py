"""Seeded damage of what a conversion reads: frames and payloads."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import TypeAlias

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
