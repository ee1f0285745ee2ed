"""IP packets in frames that `native/capture.c` does not read: PPP, PPPoE, MPLS, GRE, IP in IP.

dpkt reads the headers around the packet; the packet itself is read like any other, since dpkt cuts
it at its IP length, which some sensors announce wrongly, sees an IPv6 fragment only directly behind
the fixed header, and does not skip the headers 135, 139 and 140. It gets few bytes, since it copies
the rest for every header, and may raise anything on damaged ones.
"""

from __future__ import annotations

import dpkt

# More than the headers of any tunnel.
MAX_HEADER_BYTES = 512
# Packets in packets; no network has more.
MAX_DEPTH = 4
_PPP_OVER_ETHERNET = 51
_PPP_FRAMING = b"\xff\x03"
_LEAST_ETHERTYPE = 1536


def find_ip(data: bytes, kind: int) -> int | None:
    """Place of the first IP packet in `data`, at most MAX_HEADER_BYTES; None if there is none.

    kind: ethertype or protocol, or less than 0 a link type.
    """
    try:
        layer = _opened(data, kind)
        while isinstance(layer, dpkt.Packet):
            if isinstance(layer, dpkt.ip.IP | dpkt.ip6.IP6):
                # dpkt does not check the version.
                is_version = layer.v == (4 if isinstance(layer, dpkt.ip.IP) else 6)
                return data.find(layer.pack_hdr()) if is_version else None
            layer = layer.data
    except Exception:
        return None
    return None


def _opened(data: bytes, kind: int) -> object:
    if kind >= _LEAST_ETHERTYPE:
        return dpkt.ethernet.Ethernet(bytes(12) + kind.to_bytes(2, "big") + data)
    if kind >= 0:
        return dpkt.ip.IP.get_proto(kind)(data)
    if -kind == _PPP_OVER_ETHERNET:
        return dpkt.pppoe.PPPoE(data)
    # Without address and control where peers agreed so.
    return (dpkt.ppp if data.startswith(_PPP_FRAMING) else dpkt.pppoe).PPP(data)
