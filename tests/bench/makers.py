"""Recordings of one lidar of other makers, for measurements: any length, written in pieces.

    python -m tests.bench.makers vlp16-dual /data/bench/vlp16-dual.pcap --seconds 60

Every third of a turn looks alike; about a sixth of the shots find nothing, and where there are two
returns most are equal, as recordings show it (facts/velodyne.md 3, facts/hesai.md 3).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from mlbatch.arrays import I64Array, U8Array
from mlbatch.units import NS_PER_S
from tests.builders import hesai, robosense, velodyne
from tests.builders.captures import udp_frame

US = 1000
PIECE = 2000  # packets
DEG_PER_NS = 360e-8  # 600 rpm
Piece = tuple[I64Array, U8Array]  # arrival in ns, payloads (P, size)
EPOCH_NS = 1_700_000_000_000_000_000


def readings(first: int, shape: tuple[int, int, int], largest: int) -> tuple[I64Array, I64Array]:
    """Raw ranges and levels (columns, channels, returns)."""
    columns, channels, returns = shape
    column = np.arange(first, first + columns)[:, None]
    channel = np.arange(channels)
    wave = np.sin(column * (2 * np.pi / 600) + channel * 0.2)
    distance = np.rint(largest * (0.3 + 0.2 * wave)).astype(np.int64)
    distance[(column * 7 + channel * 13) % 6 == 0] = 0
    out = np.repeat(distance[:, :, None], returns, axis=2)
    if returns > 1:
        differs = (column * 5 + channel * 3) % 20 == 0
        out[:, :, 0] += np.where(differs & (distance > 0), 40, 0)
    return out, (out * 3 + column[:, :, None]) % 256


def vlp16_dual(seconds: float) -> Iterator[Piece]:
    """A VLP-16 with two returns."""
    spec = velodyne.VelodyneSpec("VLP-16", "dual")
    per_packet, packet_us = spec.columns_per_packet, 663.552
    for first in range(0, int(seconds * 1e6 / packet_us), PIECE):
        shape = (PIECE * per_packet, 16, 2)
        begin_us = first * packet_us
        now = replace(
            spec, start_us=1e6 + begin_us, start_azimuth_deg=begin_us * US * DEG_PER_NS % 360
        )
        sent = velodyne.encode(now, *readings(first * per_packet, shape, 10_000))
        yield sent.host_ns, sent.payloads


def pandar64_dual(seconds: float) -> Iterator[Piece]:
    """A HESAI Pandar64 with two returns."""
    spec = hesai.HesaiSpec("Pandar64", mode=0x39)
    step_ns = int(spec.row.step_ns * spec.groups)
    for first in range(0, int(seconds * NS_PER_S / step_ns), PIECE):
        shape = (PIECE * spec.groups, 64, 2)
        began_ns = first * step_ns
        now = replace(
            spec,
            start_ns=EPOCH_NS + began_ns,
            start_deg=began_ns * DEG_PER_NS % 360,
            sequence=first,
        )
        sent = hesai.encode_packets(now, *readings(first * spec.groups, shape, 10_000))
        payloads = np.frombuffer(b"".join(sent), np.uint8).reshape(len(sent), -1)
        yield hesai.host_times_ns(now, len(sent)), payloads


def ruby_plus(seconds: float) -> Iterator[Piece]:
    """A RoboSense Ruby Plus 128 with one return."""
    spec = robosense.RobosenseSpec("Ruby Plus 128", "strongest", start_ns=EPOCH_NS)
    columns = 3
    for first in range(0, int(seconds * NS_PER_S / (columns * 55_560)), PIECE):
        shape = (PIECE * columns, 128, 1)
        began_ns = first * columns * 55_560
        now = replace(spec, start_ns=EPOCH_NS + began_ns, start_deg=began_ns * DEG_PER_NS % 360)
        sent = robosense.msop(now, *readings(first * columns, shape, 8000))
        payloads = np.frombuffer(b"".join(data for _, data in sent), np.uint8)
        yield np.array([at for at, _ in sent]), payloads.reshape(len(sent), -1)


KINDS: Mapping[str, Callable[[float], Iterator[Piece]]] = {
    "vlp16-dual": vlp16_dual,
    "pandar64-dual": pandar64_dual,
    "ruby-plus": ruby_plus,
}
PORTS = {"ruby-plus": 6699}


def write(kind: str, path: Path, seconds: float) -> None:
    """Write a pcap, and beside it what the sensor needs."""
    with path.open("wb") as file:
        file.write(bytes.fromhex("d4c3b2a1020004000000000000000000ffff000001000000"))
        for host_ns, payloads in KINDS[kind](seconds):
            size = payloads.shape[1]
            frame = udp_frame(bytes(size), dport=PORTS.get(kind, 2368))[0]
            head = np.frombuffer(frame[:-size], np.uint8)
            record = np.zeros(
                len(payloads),
                [
                    *(("time", "<u4", 2), ("length", "<u4", 2)),
                    *(("head", "u1", len(head)), ("data", "u1", size)),
                ],
            )
            record["time"] = np.stack([host_ns // 10**9, host_ns % 10**9 // US], axis=1)
            record["length"] = len(head) + size
            record["head"], record["data"] = head, payloads
            file.write(record.tobytes())
    if kind == "pandar64-dual":
        angles = hesai.angles_csv(np.linspace(15, -25, 64).tolist(), [0.0] * 64)
        path.with_suffix(".csv").write_bytes(angles)
    if kind == "ruby-plus":
        spec = robosense.RobosenseSpec("Ruby Plus 128", "strongest")
        text = robosense.angles_csv(robosense.fan(spec))
        path.with_suffix(".csv").write_text(text, encoding="utf-8")


def main(arguments: list[str] | None = None) -> int:
    """Write one recording."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kind", choices=KINDS)
    parser.add_argument("path", type=Path)
    parser.add_argument("--seconds", type=float, default=60.0)
    options = parser.parse_args(arguments)
    write(options.kind, options.path, options.seconds)
    return 0


if __name__ == "__main__":
    sys.exit(main())
