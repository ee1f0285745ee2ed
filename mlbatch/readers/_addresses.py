"""Addresses and streams of a capture as numbers, so that columns of them can be compared."""

from __future__ import annotations

import ipaddress
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from mlbatch.arrays import I64Array
from mlbatch.types import Stream, StreamTable

_PORT_BITS = 16


@dataclass(slots=True)
class Addresses:
    """IPv4 addresses are their own value; IPv6 addresses get negative numbers as they appear."""

    _ipv6: dict[bytes, int] = field(default_factory=dict)

    def number(self, packed: bytes) -> int:
        """Number of an IPv6 address of 16 bytes."""
        return self._ipv6.setdefault(packed, -1 - len(self._ipv6))

    def text(self, number: int) -> str:
        """The usual notation of an address."""
        if number >= 0:
            return str(ipaddress.IPv4Address(number))
        return str(ipaddress.IPv6Address(list(self._ipv6)[-1 - number]))


@dataclass(slots=True)
class StreamNumbers:
    """Numbers of a `StreamTable` for columns of (source address, destination port)."""

    addresses: Addresses
    table: StreamTable
    _known: I64Array = field(default_factory=lambda: np.zeros(0, np.int64))
    _numbers: I64Array = field(default_factory=lambda: np.zeros(0, np.int64))

    def numbers(self, source: I64Array, port: I64Array) -> I64Array:
        """(n,) stream numbers; new streams are numbered in the order of their first packets."""
        key = source << _PORT_BITS | port
        at = self._find(key)
        if at is None:
            self._learn(sorted(set(key.tolist()).difference(self._known.tolist())), key)
            at = np.searchsorted(self._known, key)
        return self._numbers[at]

    def _find(self, key: I64Array) -> I64Array | None:
        if not len(self._known):
            return None
        at = np.minimum(np.searchsorted(self._known, key), len(self._known) - 1)
        return at if np.array_equal(self._known[at], key) else None

    def _learn(self, new: Sequence[int], key: I64Array) -> None:
        for one in sorted(new, key=lambda one: int(np.argmax(key == one))):
            stream = Stream(self.addresses.text(one >> _PORT_BITS), one & (1 << _PORT_BITS) - 1)
            self._known = np.append(self._known, one)
            self._numbers = np.append(self._numbers, self.table.number(stream))
        order = np.argsort(self._known)
        self._known, self._numbers = self._known[order], self._numbers[order]
