"""Standard recordings for benchmarks: two OS-1-128 for N seconds, replayed from a 3-frame capture.

IPv4 headers by RFC 791, UDP by RFC 768. The capture (see capture.py) is one cycle of the replay. A
cycle of both sensors is laid out once, as pcap records in order of time; every further cycle only
rewrites stamps, frame ids, IP ids and capture times, so that memory does not grow with the length.
Stamps are moved to the epoch of the capture clock.
"""

from __future__ import annotations

import argparse
import ipaddress
import struct
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from mlbatch.arrays import BoolArray, I64Array, U8Array
from mlbatch.units import NS_PER_S, NS_PER_US
from tests.bench.capture import (
    COLUMN_STAMPS_AT,
    FRAME_ID_AT,
    FRAMES_PER_CYCLE,
    IMU_STAMPS_AT,
    LIDAR_BYTES,
    PCAP_HEADER,
    RECORD,
    REPLICAS,
    UDP_HEADER,
    Recorded,
    datagram,
    read_capture,
    u16,
    u64,
    write_rig,
)

IP_HEADER: Final = struct.Struct(">BBHHHBBH4s4s")
ETHERNET: Final = bytes(12) + b"\x08\x00"
IP_AT: Final = RECORD.size + len(ETHERNET)
DATA_AT: Final = IP_AT + IP_HEADER.size
IP_ID_AT: Final = IP_AT + 4 + np.arange(2)
IP_CHECK_AT: Final = IP_AT + 10 + np.arange(2)
RECEIVER: Final = "192.168.7.2"
JUMBO_MTU: Final = 9000
ETHERNET_MTU: Final = 1500
MORE_FRAGMENTS: Final = 0x2000
# A full frame takes this long on 1 Gbit/s Ethernet; fragments of a packet arrive so far apart.
FRAGMENT_STEP_NS: Final = 12 * NS_PER_US


@dataclass(frozen=True, slots=True)
class Piece:
    """One IP packet of a datagram: `data` at byte `offset` of the datagram, sent at `phase_ns`."""

    phase_ns: int
    lag: int
    replica: int
    number: int
    offset: int
    more: bool
    data: bytes


@dataclass(slots=True)
class Place:
    """Where a datagram lies in `Cycle.data`, over all its pieces: `at` is (bytes,) indices."""

    replica: int
    number: int
    at: I64Array
    lag: int


@dataclass(frozen=True, slots=True)
class Shifted:
    """Numbers that rise from cycle to cycle.

    at: (k, width) indices of their bytes in `Cycle.data`; value: (k,) in cycle 0; lag: (k,).
    """

    at: I64Array
    value: I64Array
    lag: I64Array


@dataclass(frozen=True, slots=True)
class Cycle:
    """Both sensors' records of one cycle, and what is rewritten in it.

    data: (bytes,) the pcap records; (n,) of each record: `start`, `size` in bytes, `phase_ns`,
    `lag` (1: belongs to the sensor's previous cycle), `number` of its datagram in the sensor's
    cycle, `ip_sum` of all words of the IP header but the id.
    """

    data: U8Array
    start: I64Array
    size: I64Array
    phase_ns: I64Array
    lag: I64Array
    number: I64Array
    ip_sum: I64Array
    stamps_ns: Shifted
    frame_ids: Shifted
    period_ns: int
    datagrams: int


def lay_out(recorded: Recorded, mtu: int) -> Cycle:
    """Lay out one cycle of both sensors in order of time."""
    pieces = sorted(_pieces(recorded, mtu), key=lambda piece: piece.phase_ns)
    records = [_record(piece) for piece in pieces]
    size = np.array([len(record) for record in records], dtype=np.int64)
    start = np.cumsum(size) - size
    places = _places(recorded, pieces, start)
    return Cycle(
        data=np.frombuffer(b"".join(records), dtype=np.uint8).copy(),
        start=start,
        size=size,
        phase_ns=np.array([piece.phase_ns for piece in pieces]),
        lag=np.array([piece.lag for piece in pieces]),
        number=np.array([piece.number for piece in pieces]),
        ip_sum=np.array([_word_sum(record[IP_AT:DATA_AT]) for record in records]),
        stamps_ns=_stamps(recorded, places),
        frame_ids=_frame_ids(recorded, places),
        period_ns=recorded.period_ns,
        datagrams=len(recorded.payloads),
    )


def rewrite(template: Cycle, index: int) -> None:
    """Make the template's bytes those of cycle `index`."""
    data, start = template.data, template.start[:, None]
    host_us = (template.phase_ns + index * template.period_ns) // NS_PER_US
    times = np.stack(np.divmod(host_us, NS_PER_S // NS_PER_US), axis=1)
    data[start + np.arange(8)] = times.astype("<u4").view(np.uint8)
    ip_id = ((index - template.lag) * template.datagrams + template.number) & 0xFFFF
    total = template.ip_sum + ip_id
    folded = (total & 0xFFFF) + (total >> 16)
    check = ~((folded & 0xFFFF) + (folded >> 16)) & 0xFFFF
    data[start + IP_ID_AT] = ip_id.astype(">u2").view(np.uint8).reshape(-1, 2)
    data[start + IP_CHECK_AT] = check.astype(">u2").view(np.uint8).reshape(-1, 2)
    _shift(data, template.stamps_ns, index, template.period_ns)
    _shift(data, template.frame_ids, index, FRAMES_PER_CYCLE)


def _shift(data: U8Array, numbers: Shifted, index: int, step: int) -> None:
    """Write the numbers of cycle `index`, little endian, wrapped to their width."""
    width = numbers.at.shape[1]
    value = numbers.value + (index - numbers.lag) * step
    data[numbers.at] = value.astype("<i8").view(np.uint8).reshape(-1, 8)[:, :width]


def cycles_for(seconds: float, period_ns: int) -> int:
    """Whole cycles nearest to a length, at least one."""
    return max(1, round(seconds * NS_PER_S / period_ns))


def make_recording(folder: Path, seconds: float, fragments: bool) -> Path:
    """Write the recording, its metadata files and its rig into `folder`; returns the pcap."""
    recorded = read_capture()
    folder.mkdir(parents=True, exist_ok=True)
    write_rig(folder)
    path = folder / f"two_os1-128_{seconds:g}s{'_fragments' if fragments else ''}.pcap"
    template = lay_out(recorded, ETHERNET_MTU if fragments else JUMBO_MTU)
    late = np.repeat(template.lag == 1, template.size)
    count = cycles_for(seconds, recorded.period_ns)
    partial = path.with_name(path.name + ".partial")
    with partial.open("wb") as file:
        file.write(PCAP_HEADER.pack(0xA1B2C3D4, 2, 4, 0, 0, 65535, 1))
        for index in range(count + 1):
            rewrite(template, index)
            file.write(_part(template, late, index, count))
    partial.replace(path)
    return path


def _part(template: Cycle, late: BoolArray, index: int, count: int) -> memoryview:
    """Bytes to write: the first cycle has no previous one, after the last only its rest follows."""
    if index == 0:
        return template.data[~late].data
    return template.data[late].data if index == count else template.data.data


def _pieces(recorded: Recorded, mtu: int) -> Iterator[Piece]:
    step = (mtu - IP_HEADER.size) // 8 * 8
    begin_ns = recorded.host_ns[0]
    for index, replica in enumerate(REPLICAS):
        for number, payload in enumerate(recorded.payloads):
            data = datagram(replica, payload)
            lag, phase_ns = divmod(
                recorded.host_ns[number] - begin_ns + replica.phase_ns, recorded.period_ns
            )
            for offset in range(0, len(data), step):
                left = (len(data) - 1 - offset) // step
                yield Piece(
                    # Packets are as late as their last fragment.
                    begin_ns + phase_ns - left * FRAGMENT_STEP_NS,
                    lag,
                    index,
                    number,
                    offset,
                    left > 0,
                    data[offset : offset + step],
                )


def _record(piece: Piece) -> bytes:
    """A pcap record; time, IP id and IP checksum are zero until `rewrite`."""
    source = ipaddress.IPv4Address(REPLICAS[piece.replica].source_ip).packed
    flags = piece.offset // 8 | (MORE_FRAGMENTS if piece.more else 0)
    size = IP_HEADER.size + len(piece.data)
    receiver = ipaddress.IPv4Address(RECEIVER).packed
    ip = IP_HEADER.pack(0x45, 0, size, 0, flags, 64, 17, 0, source, receiver)
    length = len(ETHERNET) + size
    return RECORD.pack(0, 0, length, length) + ETHERNET + ip + piece.data


def _places(recorded: Recorded, pieces: list[Piece], start: I64Array) -> list[Place]:
    """Where all datagrams of a cycle lie, sensor by sensor."""
    places = [
        Place(replica, number, np.zeros(UDP_HEADER.size + len(payload), dtype=np.int64), 0)
        for replica in range(len(REPLICAS))
        for number, payload in enumerate(recorded.payloads)
    ]
    for piece, record_at in zip(pieces, start, strict=True):
        place = places[piece.replica * len(recorded.payloads) + piece.number]
        end = piece.offset + len(piece.data)
        place.at[piece.offset : end] = record_at + DATA_AT + np.arange(len(piece.data))
        place.lag = piece.lag
    return places


def _stamps(recorded: Recorded, places: list[Place]) -> Shifted:
    """All stamps of columns and IMU samples, as epoch time (ns)."""
    at, value, lag = [], [], []
    for place in places:
        payload = recorded.payloads[place.number]
        offset_ns = recorded.epoch_offset_ns + REPLICAS[place.replica].phase_ns
        for byte in COLUMN_STAMPS_AT if len(payload) == LIDAR_BYTES else IMU_STAMPS_AT:
            at.append(place.at[UDP_HEADER.size + byte :][:8])
            value.append(u64(payload, byte) + offset_ns)
            lag.append(place.lag)
    return Shifted(np.stack(at), np.array(value), np.array(lag))


def _frame_ids(recorded: Recorded, places: list[Place]) -> Shifted:
    """The frame ids of all lidar packets."""
    lidar = [place for place in places if len(recorded.payloads[place.number]) == LIDAR_BYTES]
    return Shifted(
        np.stack([place.at[UDP_HEADER.size + FRAME_ID_AT :][:2] for place in lidar]),
        np.array([u16(recorded.payloads[place.number], FRAME_ID_AT) for place in lidar]),
        np.array([place.lag for place in lidar]),
    )


def _word_sum(header: bytes) -> int:
    return sum(struct.unpack(f">{len(header) // 2}H", header))


def main() -> int:
    """Write one recording; prints its path."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.recordings", description=__doc__)
    parser.add_argument("out", type=Path, help="folder for the pcap, the metadata and rig.yaml")
    parser.add_argument("--seconds", type=float, default=60.0, help="length; default 60")
    parser.add_argument("--fragments", action="store_true", help="1500-byte IPv4 fragments")
    options = parser.parse_args()
    try:
        print(make_recording(options.out, options.seconds, options.fragments))
    except OSError as err:
        print(f"cannot make the recording: {err}; put the shared recordings there", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
