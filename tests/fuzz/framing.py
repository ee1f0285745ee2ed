"""Inputs of several parts as one string of bytes, so that each can be shown and given again."""

from __future__ import annotations

import random
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from tests.fuzz.mutation import CHANGES, Seeds

_PART = struct.Struct("<HqI")


@dataclass(frozen=True, slots=True)
class Part:
    """A datagram (or a text) of an input; kind: its port, or another distinction."""

    kind: int
    host_ns: int
    data: bytes


def joined(parts: Iterable[Part]) -> bytes:
    """The parts as one string."""
    return b"".join(
        _PART.pack(part.kind, part.host_ns, len(part.data)) + part.data for part in parts
    )


def parts_of(data: bytes) -> list[Part]:
    """The parts of a string made by `joined`."""
    found, at = [], 0
    while at < len(data):
        kind, host_ns, size = _PART.unpack_from(data, at)
        at += _PART.size
        found.append(Part(kind, host_ns, data[at : at + size]))
        at += size
    return found


def mutated_parts(rng: random.Random, seeds: Seeds) -> bytes:
    """Change one part, all of a kind in the same way, or their order and times."""
    parts = parts_of(rng.choice(seeds))
    for _ in range(rng.choice((1, 1, 2, 4))):
        if not parts:
            break
        chance = rng.random()
        if chance < 0.4:
            parts = _alike(rng, parts, seeds)
        elif chance < 0.8:
            at = rng.randrange(len(parts))
            parts[at] = replace(parts[at], data=_changed(rng, parts[at].data, parts, seeds))
        else:
            parts = _rearranged(rng, parts)
    return joined(parts)


def _alike(rng: random.Random, parts: Sequence[Part], seeds: Seeds) -> list[Part]:
    """The same change to all parts of a kind: a sensor that always sends wrong values."""
    kind, state = rng.choice(parts).kind, rng.getstate()
    changed = []
    for part in parts:
        if part.kind == kind:
            rng.setstate(state)
            part = replace(part, data=_changed(rng, part.data, parts, seeds))
        changed.append(part)
    return changed


def _changed(rng: random.Random, data: bytes, parts: Sequence[Part], seeds: Seeds) -> bytes:
    """Sizes stay mostly as they are: they choose the decoder."""
    changed, size = bytearray(data), len(data)
    for _ in range(rng.choice((1, 1, 3))):
        rng.choice(CHANGES)(rng, changed, [part.data for part in parts])
    if rng.random() < 0.9:
        changed = changed[:size] + bytes(max(size - len(changed), 0))
    return bytes(changed[:65_000])


_TIMES_NS = (0, 1, -1, 10**9, -(10**9), 3600 * 10**9, 2**62, -(2**62), 2**32 * 10**9)


def _rearranged(rng: random.Random, parts: list[Part]) -> list[Part]:
    at, kind = rng.randrange(len(parts)), rng.randrange(5)
    if kind == 0:
        return [part for number, part in enumerate(parts) if number != at]
    if kind == 1:
        return [*parts[:at], parts[at], *parts[at:]]
    if kind == 2:
        return rng.sample(parts, len(parts))
    step_ns = rng.choice(_TIMES_NS)
    late = [number >= at if kind == 3 else number == at for number in range(len(parts))]
    return [
        replace(part, host_ns=max(0, min(part.host_ns + step_ns * is_late, 2**62)))
        for part, is_late in zip(parts, late, strict=True)
    ]
