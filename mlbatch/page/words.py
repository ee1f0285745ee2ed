"""Words for the keys of a report, as pages print them."""

from __future__ import annotations

# Outcomes of packets, columns and points.
MEANINGS = {
    "accepted": "accepted",
    "written": "in the output",
    "lost": "never received",
    "no_return": "no return",
    "range": "outside the range limits",
    "box": "in an excluded box",
    "repeated": "repeated return",
    "head": "before the first whole window",
    "tail": "after the last whole window",
    "before_start": "before all sensors had started",
    "outside_time": "outside --start and --end",
    "late": "late",
    "invalid": "marked invalid by the sensor",
    "incomplete": "in a window left out as incomplete",
    "bad_size": "bad size",
    "bad_header": "bad header",
    "bad_crc": "bad checksum",
    "bad_stamp": "bad timestamp",
    "duplicate": "duplicate",
}
# Costs of a run.
COSTS = {
    "wall_s": "total, s",
    "cpu_s": "processor, s",
    "read_s": "reading, s",
    "decode_s": "decoding, s",
    "merge_s": "merging, s",
    "write_s": "writing, s",
    "peak_rss_mb": "memory, MB",
}
# Senders that are no lidars, by port. Source: IANA, Service Name and Transport Protocol Port
# Number Registry.
SERVICES = {
    53: "DNS",
    67: "DHCP",
    68: "DHCP",
    123: "NTP",
    137: "NetBIOS names",
    138: "NetBIOS datagrams",
    319: "PTP events",
    320: "PTP general messages",
    1900: "SSDP",
    3702: "WS-Discovery",
    5353: "mDNS",
    5355: "LLMNR",
}
