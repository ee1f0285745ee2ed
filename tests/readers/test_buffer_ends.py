"""Every reader gives the same packets wherever its buffers end.

Expected values are the packets written. A row is a number of frames of equal length, since readers
step over such frames many at a time.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

import pytest
from mcap.writer import IndexType

from tests.builders import rosbag2
from tests.builders.bags import OUSTER_ROS1, Recorded, packet_message
from tests.builders.captures import Interface, Packet, Section, udp_frame, write_pcap, write_pcapng
from tests.builders.containers import Bag, database, mcap, rosbag1
from tests.builders.mcaps import LZ4, Form
from tests.builders.reading import open_bag, open_capture, read

OUSTER = "ouster_sensor_msgs/PacketMsg"
T0_NS = 1_700_000_000_000_000_000
# Not much larger than a frame.
_SMALLEST = 64
# Frames are longer than what follows the data in a buffer (`SLACK`).
_LONG = 140
# Bags are read through buffers of every size up to this one.
_MOST_OF_BAGS = 600


Packets = Sequence[tuple[int, bytes]]


def _frames(packets: Packets) -> list[tuple[int, bytes]]:
    return [(at_ns, udp_frame(payload)[0]) for at_ns, payload in packets]


def _pcap(folder: Path, packets: Packets, big_endian: bool = False) -> Path:
    return write_pcap(folder / "a", _frames(packets), big_endian=big_endian)


def _pcapng(folder: Path, packets: Packets, big_endian: bool = False) -> Path:
    blocks = [Packet(frame, at_ns) for at_ns, frame in _frames(packets)]
    return write_pcapng(folder / "a", [Section(blocks, [Interface()], big_endian=big_endian)])


def _bag(folder: Path, packets: Packets, bag: Bag) -> Path:
    kind = OUSTER if bag.encoding == "cdr" else OUSTER_ROS1
    messages = [
        Recorded("/lidar_packets", kind, at_ns, packet_message(bag.encoding, payload))
        for at_ns, payload in packets
    ]
    return bag.write(folder, messages)


_NO_INDEX = Form(chunk_bytes=700, index=IndexType.NONE, repeat=False)
BAGS = {
    "MCAP": mcap(Form(chunk_bytes=700)),
    "MCAP without chunks": mcap(Form(chunked=False)),
    "MCAP, lz4": mcap(Form(compression=LZ4, chunk_bytes=700)),
    "MCAP without index": mcap(_NO_INDEX),
    "ROS 1 bag": rosbag1("none", chunk_bytes=700),
    "ROS 1 bag, lz4": rosbag1("lz4", chunk_bytes=700),
    "ROS 2 bag": database(rosbag2.Form()),
}
# Kinds of files, written of payloads at times in ns.
FORMATS: Mapping[str, Callable[[Path, Packets], Path]] = {
    "pcap": _pcap,
    "pcap, big endian": partial(_pcap, big_endian=True),
    "pcapng": _pcapng,
    "pcapng, big endian": partial(_pcapng, big_endian=True),
    **{name: partial(_bag, bag=bag) for name, bag in BAGS.items()},
}
_EACH = pytest.mark.parametrize("name", FORMATS)


def packets_of(rows: Sequence[tuple[int, int]]) -> list[tuple[int, bytes]]:
    """Rows of (number of packets, bytes of a packet); every packet differs from all others."""
    pick = random.Random(1)
    sizes = [size for count, size in rows for _ in range(count)]
    return [(T0_NS + 1_001 * number, pick.randbytes(size)) for number, size in enumerate(sizes)]


def packets_read(name: str, path: Path, buffer_bytes: int) -> list[tuple[int, bytes]]:
    """Receive times and payloads of all packets; the ledger must balance, without notes."""
    opened = open_capture if "pcap" in name else open_bag
    recording = opened(path, buffer_bytes=buffer_bytes)
    seen = read(recording)
    assert recording.notes == []
    assert not recording.counts.skipped
    assert recording.counts.datagrams == len(seen)
    return [(one.host_ns, one.payload) for one in seen]


def _sizes(name: str, size_bytes: int) -> Iterator[int]:
    """Sizes of buffers whose first end is at every byte of the frames around a row's 17th."""
    if "pcap" in name:
        yield from range(_SMALLEST, 400)
        yield from range(max(400, size_bytes - 6 * _LONG), size_bytes + 2)
    else:
        yield from range(_SMALLEST, min(size_bytes, _MOST_OF_BAGS) + 2)


@_EACH
def test_the_first_buffer_may_end_at_every_byte(tmp_path: Path, name: str) -> None:
    rows = [(1, 9), (19, _LONG), (2, 7)] if "pcap" in name else [(2, 9), (6, 4), (1, 7), (5, 4)]
    packets = packets_of(rows)
    path = FORMATS[name](tmp_path, packets)
    for buffer_bytes in _sizes(name, path.stat().st_size):
        assert packets_read(name, path, buffer_bytes) == packets, buffer_bytes
    assert packets_read(name, path, 1 << 22) == packets
