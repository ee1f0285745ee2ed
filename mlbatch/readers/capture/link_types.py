"""Link types of captures: place and family of the network packet in a frame.

Numbers and headers: tcpdump.org/linktypes.html; ethertypes: IEEE 802 numbers of IANA; address
families of NULL and LOOP: 2 everywhere, IPv6 differs with the system (10, 24, 28, 30).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mlbatch.arrays import I64Array, U8Array
from mlbatch.readers.byte_records import records

# Families. CUT: the capture ends before the packet; _TAG: a VLAN tag.
CUT = 0
NOT_IP = 1
IPV4 = 4
IPV6 = 6
_TAG = 7
# No network adds more tags; the bound keeps the loop short.
_MOST_TAGS = 8
_WORD = np.dtype([("ethertype", ">u2")])


def _table(size: int, families: dict[int, int]) -> U8Array:
    table = np.full(size, NOT_IP, np.uint8)
    table[list(families)] = list(families.values())
    return table


_BY_ETHERTYPE = _table(
    1 << 16, {0x0800: IPV4, 0x86DD: IPV6, 0x8100: _TAG, 0x88A8: _TAG, 0x9100: _TAG}
)
_BY_VERSION = _table(1 << 8, {v << 4 | low: v for v in (IPV4, IPV6) for low in range(16)})
_ADDRESS_FAMILY = _table(1 << 8, {2: IPV4, 10: IPV6, 24: IPV6, 28: IPV6, 30: IPV6})


class Link(NamedTuple):
    """A link header of `header` bytes; ethertype_at: place of the ethertype, if it has one.

    has_family: the header is an address family of four bytes, in either byte order.
    """

    header: int
    ethertype_at: int | None = None
    has_family: bool = False


_RAW = Link(0)
LINKS = {
    0: Link(4, has_family=True),
    1: Link(14, ethertype_at=12),
    12: _RAW,
    14: _RAW,
    101: _RAW,
    108: Link(4, has_family=True),
    113: Link(16, ethertype_at=14),
    228: _RAW,
    229: _RAW,
    276: Link(20, ethertype_at=0),
}
# Frames of a pcapng interface that the file does not describe.
NO_LINK = -1
_NAMES = {
    NO_LINK: "no interface block",
    9: "PPP",
    105: "IEEE 802.11",
    127: "IEEE 802.11 radiotap",
    189: "USB",
    192: "PPI",
    220: "USB",
    227: "CAN",
    239: "NFLOG",
}


def unknown_link(number: int) -> str:
    """Text of an error about frames of this link type."""
    name = _NAMES.get(number, "unknown")
    known = ", ".join(map(str, sorted(LINKS)))
    return (
        f"expected frames of link type {known}, found {number} ({name}); "
        "capture on the network interface that the sensors are connected to"
    )


def locate(
    data: U8Array, start: I64Array, stop: I64Array, link: I64Array
) -> tuple[I64Array, U8Array]:
    """Place of the network packet of each frame, and its family.

    start, stop: (n,) first byte of each frame and the one after its last captured byte.
    Family: IPV4, IPV6, NOT_IP, or CUT where the capture ends before the packet.
    """
    kinds = sorted(set(link.tolist()))
    if len(kinds) == 1:
        return _locate_one(data, start, stop, kinds[0])
    network = start.copy()
    family = np.full(len(start), NOT_IP, np.uint8)
    for kind in kinds:
        rows = np.flatnonzero(link == kind)
        network[rows], family[rows] = _locate_one(data, start[rows], stop[rows], kind)
    return network, family


def _locate_one(
    data: U8Array, start: I64Array, stop: I64Array, kind: int
) -> tuple[I64Array, U8Array]:
    link = LINKS.get(kind)
    if link is None:
        return start, np.full(len(start), NOT_IP, np.uint8)
    network = start + link.header
    if link.ethertype_at is not None:
        family = _BY_ETHERTYPE[records(data, _WORD, start + link.ethertype_at)["ethertype"]]
        network, family = _skip_tags(data, network, stop, family)
    else:
        family = _BY_VERSION[data[network]]
        if link.has_family:
            family[_families(data, start) != family] = NOT_IP
    # An IP packet needs at least one captured byte; anything else only its link header.
    family[network + (family != NOT_IP) > stop] = CUT
    return network, family


def _skip_tags(
    data: U8Array, network: I64Array, stop: I64Array, family: U8Array
) -> tuple[I64Array, U8Array]:
    """Skip VLAN tags: two bytes of tag, then the ethertype of the next header."""
    for _ in range(_MOST_TAGS):
        tagged = np.flatnonzero(family == _TAG)
        if not len(tagged):
            return network, family
        # Never read beyond the buffer for a frame that ends here.
        at = np.minimum(network[tagged], stop[tagged])
        family[tagged] = _BY_ETHERTYPE[records(data, _WORD, at + 2)["ethertype"]]
        network[tagged] = at + 4
    return network, np.where(family == _TAG, np.uint8(NOT_IP), family)


def _families(data: U8Array, start: I64Array) -> U8Array:
    """Family of 4-byte address families, written by a host of either byte order."""
    word = data[start[:, None] + np.arange(4)]
    family: U8Array = _ADDRESS_FAMILY[word[:, 0] | word[:, 3]]
    family[(word[:, 1] | word[:, 2]) != 0] = NOT_IP
    return family
