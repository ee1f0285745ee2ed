"""From captured frames to UDP datagrams and IP fragments, all frames of a buffer at once.

Layouts: RFC 791 (IPv4), RFC 768 (UDP); IPv6 packets are read one at a time (`ipv6`). A datagram is
as long as its UDP header says, if that many bytes were captured: some sensors announce a wrong IP
length, and Ethernet pads short frames.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from mlbatch.arrays import BoolArray, I64Array, U8Array
from mlbatch.native.capture import CaptureLoops
from mlbatch.readers.byte_records import Records, records
from mlbatch.readers.capture import ipv6, link_types
from mlbatch.types import OTHER_STREAMS, Stream, StreamTable

IPV4 = np.dtype(
    [
        ("version_words", "u1"),
        ("service", "u1"),
        ("length", ">u2"),
        ("ident", ">u2"),
        ("fragment", ">u2"),
        ("ttl", "u1"),
        ("protocol", "u1"),
        ("checksum", ">u2"),
        ("source", ">u4"),
        ("destination", ">u4"),
    ]
)
UDP = np.dtype([("source_port", ">u2"), ("port", ">u2"), ("length", ">u2"), ("checksum", ">u2")])
UDP_PROTOCOL = 17
# Ethernet, IPv4 and UDP as nearly all packets have them: no tag, no options.
_ETHERNET = 1
_USUAL = np.dtype(
    {
        "names": ["kind", "fragment", "protocol", "source", "port", "length"],
        "formats": [">u4", ">u2", "u1", ">u4", ">u2", ">u2"],
        "offsets": [12, 20, 23, 26, 36, 38],
        "itemsize": 42,
    }
)
# Ethertype 0800, version 4, five words of header, any service.
_USUAL_KIND = 0x08004500
_USUAL_MASK = 0xFFFFFF00
# Of the fragment field: more fragments follow; offset in units of 8 bytes.
_MORE = 0x2000
_OFFSET = 0x1FFF

# Verdicts on a frame; those with a name in _SKIPPED give no packet.
_WHOLE = 0
_FRAGMENT = 1
_NOT_IP = 2
_NOT_UDP = 3
_TRUNCATED = 4
_SKIPPED = {_NOT_IP: "not_ip", _NOT_UDP: "not_udp", _TRUNCATED: "truncated"}


@dataclass(slots=True)
class Frames:
    """n link-layer frames in a buffer, in file order; all fields (n,) int64.

    start: first byte; captured, original: bytes in the file and on the wire; link: link type.
    """

    start: I64Array
    captured: I64Array
    original: I64Array
    link: I64Array
    host_ns: I64Array

    @classmethod
    def none(cls) -> Frames:
        """No frames."""
        empty = np.zeros(0, np.int64)
        return cls(empty, empty, empty, empty, empty)

    def __len__(self) -> int:
        return len(self.start)

    def take(self, rows: slice | I64Array) -> Frames:
        """The frames at `rows`."""
        return Frames(
            self.start[rows],
            self.captured[rows],
            self.original[rows],
            self.link[rows],
            self.host_ns[rows],
        )


class Datagrams(NamedTuple):
    """UDP payloads, all fields (n,) int64; frame: index of the (completing) frame.

    source: an address number of `Addresses`.
    """

    frame: I64Array
    start: I64Array
    size: I64Array
    source: I64Array
    port: I64Array


@dataclass(slots=True)
class Fragments:
    """IP fragments of UDP datagrams in file order; all fields (n,), int64 but `more`.

    offset: place of the data within the datagram, bytes; start, size: of the data in the buffer.
    """

    frame: I64Array
    source: I64Array
    destination: I64Array
    ident: I64Array
    offset: I64Array
    more: BoolArray
    start: I64Array
    size: I64Array

    @classmethod
    def none(cls) -> Fragments:
        """No fragments."""
        empty = np.zeros(0, np.int64)
        more = np.zeros(0, np.bool_)
        return cls(empty, empty, empty, empty, empty, more, empty, empty)

    def __len__(self) -> int:
        return len(self.frame)

    def take(self, rows: I64Array) -> Fragments:
        """The fragments at `rows`."""
        return Fragments(*(getattr(self, name)[rows] for name in Fragments.__slots__))


@dataclass(slots=True)
class Dissection:
    """Content of the frames of a buffer; skipped: frames without, by reason."""

    datagrams: Datagrams
    fragments: Fragments
    skipped: dict[str, int]


def dissect(
    data: U8Array, frames: Frames, addresses: Addresses, loops: CaptureLoops | None = None
) -> Dissection:
    """Find the UDP content of all frames; datagrams and fragments come in file order."""
    if bool((frames.link == _ETHERNET).all()):
        found = _by_loops(loops, data, frames, addresses) if loops else _plain(data, frames)
        if found is not None:
            return found
    return _dissect(data, frames, addresses)


def _by_loops(
    loops: CaptureLoops, data: U8Array, frames: Frames, addresses: Addresses
) -> Dissection | None:
    """Content of Ethernet frames; None if some have content that the compiled loops do not read."""
    found = loops.dissect(data, frames.start, frames.captured, frames.original)
    skipped: dict[str, int] = {}
    if len(found.others):
        rest = _dissect(data, frames.take(found.others), addresses)
        if len(rest.datagrams.frame) or len(rest.fragments):
            return None
        skipped = rest.skipped
    frame, source, destination, ident, offset, more, start, size = found.fragments
    parts = Fragments(frame, source, destination, ident, offset, more != 0, start, size)
    return Dissection(Datagrams(*found.datagrams), parts, skipped)


def _plain(data: U8Array, frames: Frames) -> Dissection | None:
    """Content of Ethernet frames if all are whole datagrams with usual headers, else None."""
    header = records(data, _USUAL, frames.start)
    size = header["length"].astype(np.int64)
    is_usual = (header["kind"] & _USUAL_MASK) == _USUAL_KIND
    is_usual &= (header["fragment"] & (_MORE | _OFFSET)) == 0
    is_usual &= header["protocol"] == UDP_PROTOCOL
    is_usual &= size >= UDP.itemsize
    is_usual &= size + (_USUAL.itemsize - UDP.itemsize) <= frames.captured
    is_usual &= frames.captured >= frames.original
    if not is_usual.all():
        return None
    datagrams = Datagrams(
        frame=np.arange(len(frames)),
        start=frames.start + _USUAL.itemsize,
        size=size - UDP.itemsize,
        source=header["source"].astype(np.int64),
        port=header["port"].astype(np.int64),
    )
    return Dissection(datagrams, Fragments.none(), {})


def _dissect(data: U8Array, frames: Frames, addresses: Addresses) -> Dissection:
    """Content of frames of any kind."""
    stop = frames.start + frames.captured
    network, family = link_types.locate(data, frames.start, stop, frames.link)
    verdict = np.full(len(frames), _NOT_IP, np.uint8)
    verdict[family == link_types.CUT] = _TRUNCATED
    rows = np.flatnonzero(family == link_types.IPV4)
    header, body = _ipv4_headers(data, network[rows])
    udp = records(data, UDP, body)
    verdict[rows] = _verdicts(header, udp, network[rows], body, stop[rows])
    cut = frames.captured < frames.original
    verdict[cut & (verdict <= _FRAGMENT)] = _TRUNCATED
    whole = verdict[rows] == _WHOLE
    parts = verdict[rows] == _FRAGMENT
    datagrams = _datagrams(rows[whole], header[whole], udp[whole], body[whole])
    fragments = _fragments(rows[parts], header[parts], network[rows][parts], body[parts])
    found = Dissection(datagrams, fragments, {})
    rare = np.flatnonzero(family == link_types.IPV6)
    if len(rare):
        verdict[rare] = _add_ipv6(found, data, rare, network, stop, cut, addresses)
    count = np.bincount(verdict, minlength=len(_SKIPPED) + 2).tolist()
    found.skipped = {name: count[code] for code, name in _SKIPPED.items() if count[code]}
    return found


def _ipv4_headers(data: U8Array, at: I64Array) -> tuple[Records, I64Array]:
    """The IPv4 headers at `at`, and the places of the bytes after them."""
    header = records(data, IPV4, at)
    return header, at + (header["version_words"] & 15).astype(np.int64) * 4


def _verdicts(
    header: Records, udp: Records, at: I64Array, body: I64Array, stop: I64Array
) -> U8Array:
    """Verdicts on IPv4 packets captured from `at` to `stop`; a later rule has precedence."""
    fragment = (header["fragment"] & (_MORE | _OFFSET)) != 0
    # A fragment has no UDP length: its IP length has to be right.
    end = np.where(fragment, at + header["length"], body + udp["length"])
    least = np.where(fragment, body + 1, body + UDP.itemsize)
    verdict: U8Array = np.where(fragment, np.uint8(_FRAGMENT), np.uint8(_WHOLE))
    verdict[(end > stop) | (end < least) | (least > stop)] = _TRUNCATED
    verdict[header["protocol"] != UDP_PROTOCOL] = _NOT_UDP
    verdict[(header["version_words"] >> 4 != 4) | (body - at < IPV4.itemsize)] = _NOT_IP
    verdict[at + IPV4.itemsize > stop] = _TRUNCATED
    return verdict


def _datagrams(rows: I64Array, header: Records, udp: Records, body: I64Array) -> Datagrams:
    return Datagrams(
        frame=rows,
        start=body + UDP.itemsize,
        size=udp["length"].astype(np.int64) - UDP.itemsize,
        source=header["source"].astype(np.int64),
        port=udp["port"].astype(np.int64),
    )


def _fragments(rows: I64Array, header: Records, at: I64Array, body: I64Array) -> Fragments:
    return Fragments(
        frame=rows,
        source=header["source"].astype(np.int64),
        destination=header["destination"].astype(np.int64),
        ident=header["ident"].astype(np.int64),
        offset=(header["fragment"] & _OFFSET).astype(np.int64) * 8,
        more=(header["fragment"] & _MORE) != 0,
        start=body,
        size=at + header["length"] - body,
    )


def _add_ipv6(
    found: Dissection,
    data: U8Array,
    rows: I64Array,
    network: I64Array,
    stop: I64Array,
    cut: BoolArray,
    addresses: Addresses,
) -> U8Array:
    """Add the IPv6 packets among the frames `rows` to `found`; return the verdicts on them."""
    view = data.data
    reasons = {name: code for code, name in _SKIPPED.items()}
    verdicts = np.zeros(len(rows), np.uint8)
    whole = []
    parts = []
    for i, row in enumerate(rows.tolist()):
        packet = ipv6.dissect(view, int(network[row]), int(stop[row]))
        if isinstance(packet, str):
            verdicts[i] = reasons[packet]
        elif cut[row]:
            verdicts[i] = _TRUNCATED
        elif packet.ident is None:
            source = addresses.number(packet.source)
            whole.append((row, packet.start, packet.size, source, packet.port))
            verdicts[i] = _WHOLE
        else:
            parts.append(
                (
                    row,
                    addresses.number(packet.source),
                    addresses.number(packet.destination),
                    packet.ident,
                    packet.offset,
                    packet.more,
                    packet.start,
                    packet.size,
                )
            )
            verdicts[i] = _FRAGMENT
    found.datagrams = in_order(found.datagrams, Datagrams(*_columns(whole, 5)))
    found.fragments = _with_fragments(found.fragments, _columns(parts, 8))
    return verdicts


def in_order(first: Datagrams, *others: Datagrams) -> Datagrams:
    """All datagrams in the order of their frames."""
    every = [first, *(more for more in others if len(more.frame))]
    if len(every) == 1:
        return first
    order = np.argsort(np.concatenate([one.frame for one in every]), kind="stable")
    return Datagrams(
        *(
            np.concatenate([getattr(one, name) for one in every])[order]
            for name in Datagrams._fields
        )
    )


def _with_fragments(first: Fragments, columns: I64Array) -> Fragments:
    order = np.argsort(np.concatenate([first.frame, columns[0]]), kind="stable")
    joined = [
        np.concatenate([getattr(first, name), column])[order]
        for name, column in zip(Fragments.__slots__, columns, strict=True)
    ]
    fragments = Fragments(*joined)
    fragments.more = fragments.more != 0
    return fragments


def _columns(rows: Sequence[tuple[int, ...]], width: int) -> I64Array:
    columns: I64Array = np.array(rows, np.int64).reshape(-1, width).T
    return columns


# -- addresses and streams -------------------------------------------------------------------------

# Of a key: source address above, destination port below.
_PORT_BITS = 16
_IPV4_BYTES = 4


@dataclass(slots=True)
class Addresses:
    """Addresses as numbers, so that columns of them can be compared.

    IPv4 addresses are their value; IPv6 addresses get negative numbers in order of appearance.
    """

    _ipv6: dict[bytes, int] = field(default_factory=dict)

    def number(self, packed: bytes) -> int:
        """Number of an address of 4 or 16 bytes."""
        if len(packed) == _IPV4_BYTES:
            return int.from_bytes(packed, "big")
        return self._ipv6.setdefault(packed, -1 - len(self._ipv6))

    def packed(self, number: int) -> bytes:
        """The 4 or 16 bytes of an address."""
        if number >= 0:
            return number.to_bytes(_IPV4_BYTES, "big")
        return list(self._ipv6)[-1 - number]

    def text(self, number: int) -> str:
        """The usual notation of an address."""
        return str(ipaddress.ip_address(self.packed(number)))


@dataclass(slots=True)
class StreamNumbers:
    """Numbers of a `StreamTable` for columns of (source address, destination port)."""

    addresses: Addresses
    table: StreamTable
    _known: I64Array = field(default_factory=lambda: np.zeros(0, np.int64))
    _numbers: I64Array = field(default_factory=lambda: np.zeros(0, np.int64))

    def numbers(self, source: I64Array, port: I64Array) -> I64Array:
        """(n,) stream numbers; new streams are numbered in order of their first packets."""
        key = source << _PORT_BITS | port
        at = self._find(key)
        if at is None:
            self._learn(set(key.tolist()).difference(self._known.tolist()), key)
            return self._numbers_of_some(key)
        return self._numbers[at]

    def _find(self, key: I64Array) -> I64Array | None:
        if not len(self._known):
            return None
        at = np.minimum(np.searchsorted(self._known, key), len(self._known) - 1)
        return at if np.array_equal(self._known[at], key) else None

    def _numbers_of_some(self, key: I64Array) -> I64Array:
        """(n,) numbers where the table may have been full for some of the streams."""
        if not len(key):
            return np.zeros(0, np.int64)
        if not len(self._known):
            return np.full(len(key), self.table.number(OTHER_STREAMS))
        at = np.minimum(np.searchsorted(self._known, key), len(self._known) - 1)
        is_known = self._known[at] == key
        if is_known.all():
            return self._numbers[at]
        return np.where(is_known, self._numbers[at], self.table.number(OTHER_STREAMS))

    def _learn(self, new: Collection[int], key: I64Array) -> None:
        """Number streams in the order of their first packets, as far as the table has room."""
        learned = []
        numbers = []
        # In the order of `key`.
        for one in dict.fromkeys(key.tolist()):
            if one not in new or self.table.is_full:
                continue
            stream = Stream(self.addresses.text(one >> _PORT_BITS), one & (1 << _PORT_BITS) - 1)
            learned.append(one)
            numbers.append(self.table.number(stream))
        known = np.concatenate([self._known, np.array(learned, np.int64)])
        order = np.argsort(known)
        self._known = known[order]
        self._numbers = np.concatenate([self._numbers, np.array(numbers, np.int64)])[order]
