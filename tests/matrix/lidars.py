"""Packets of small lidars of four vendors, by the encoders: bytes, receive times, true stamps.

Stamps are what packets say, whole us for Velodyne, HESAI and ROBOSENSE (the encoders' sheets);
receive times are whole steps of 10 us, so that drifts by whole ppm of 100 add whole ns.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mlbatch.arrays import I64Array
from mlbatch.simulate.hesai.encode import HesaiSpec, angles_csv
from mlbatch.simulate.ouster.encode import OusterSpec, encode_packets, metadata_json
from mlbatch.simulate.robosense.encode import RobosenseSpec
from mlbatch.simulate.spinning import SpinningSpec
from mlbatch.simulate.velodyne.encode import VelodyneSpec

NS_PER_S = 10**9
NS_PER_MS = 10**6
HOUR_NS = 3600 * NS_PER_S
# One reading in so many has a return.
SPARSE = 16
RECEIVE_STEP_NS = 10_000
# Length of a session; events are at times well inside windows.
LENGTH_NS = 500 * NS_PER_MS
NOON_NS = 1_700_000_000 * NS_PER_S // HOUR_NS * HOUR_NS + 1000 * NS_PER_S

OUSTER = OusterSpec(beams=16, columns_per_frame=512, serial=111)
OUSTER_STEP_NS = 100 * NS_PER_MS // OUSTER.columns_per_frame


@dataclass(frozen=True, slots=True)
class Sent:
    """Packets of one lidar, in their order.

    host_ns: (P,) receive time; stamp_ns: (P, C) of the columns; points: (P, C) their returns.
    """

    vendor: str
    payloads: tuple[bytes, ...]
    host_ns: I64Array
    stamp_ns: I64Array
    points: I64Array

    def where(self, stays: I64Array) -> Sent:
        """The packets at these places."""
        payloads = tuple(self.payloads[at] for at in stays.tolist())
        return replace(
            self,
            payloads=payloads,
            host_ns=self.host_ns[stays],
            stamp_ns=self.stamp_ns[stays],
            points=self.points[stays],
        )

    def then(self, later: Sent) -> Sent:
        """These packets, and then others of the same lidar."""
        return replace(
            self,
            payloads=self.payloads + later.payloads,
            host_ns=np.concatenate([self.host_ns, later.host_ns]),
            stamp_ns=np.concatenate([self.stamp_ns, later.stamp_ns]),
            points=np.concatenate([self.points, later.points]),
        )


@dataclass(frozen=True, slots=True)
class Spell:
    """When a lidar measures, ns by its clock; count: its packet number (Ouster: frame) at first.

    ahead_ns: what the capture host's clock adds to the lidar's.
    """

    begin_ns: int
    length_ns: int
    count: int = 1000
    ahead_ns: int = 0


def _readings(seed: int, *shape: int) -> tuple[I64Array, I64Array]:
    """Counts of range (0: no return) and signal."""
    rng = np.random.default_rng(seed)
    hit = rng.integers(0, SPARSE, shape) == 0
    ranges = np.where(hit, rng.integers(1000, 4000, shape) // 8 * 8, 0)
    return ranges, np.where(hit, rng.integers(1, 256, shape), 0)


def _sent(
    vendor: str, spell: Spell, payloads: list[bytes], stamp_ns: I64Array, ranges: I64Array
) -> Sent:
    """A packet is received 0.3 ms after its last column."""
    shape = len(payloads), -1
    stamps = stamp_ns.reshape(shape)
    receive_ns = stamps[:, -1] + 300_000 + spell.ahead_ns
    host_ns = -(-receive_ns // RECEIVE_STEP_NS) * RECEIVE_STEP_NS
    points = np.count_nonzero(ranges.reshape(len(stamp_ns), -1), axis=1).reshape(shape)
    return Sent(vendor, tuple(payloads), host_ns, stamps, points)


def ouster(spell: Spell) -> Sent:
    """320 packets a second of 16 columns; revolutions begin with the spell."""
    count = spell.length_ns // OUSTER_STEP_NS // 16 * 16
    number = np.arange(count)
    stamps = spell.begin_ns + number * OUSTER_STEP_NS
    ranges, levels = _readings(1, count, 16)
    payloads = encode_packets(
        OUSTER,
        stamps,
        number % 512,
        spell.count + number // 512,
        {"RANGE": ranges, "REFLECTIVITY": levels},
    )
    return _sent("ouster", spell, payloads, stamps, ranges)


def _spun(vendor: str, spell: Spell, seed: int, spec: SpinningSpec) -> Sent:
    """A spinning lidar of 16 channels and one return."""
    packets = int(spell.length_ns / (spec.column_ns * spec.columns_per_packet))
    ranges, levels = _readings(seed, *spec.shape(packets))
    payloads = [sent.payload for sent in spec.encode(ranges, levels)]
    stamps = spec.said_times_ns(len(ranges)).min(axis=1)
    return _sent(vendor, spell, payloads, stamps, ranges)


def velodyne_vlp16(spell: Spell) -> Sent:
    """754 packets a second of 24 columns; no count of packets."""
    hour, past_ns = divmod(spell.begin_ns, HOUR_NS)
    spec = VelodyneSpec("VLP-16", start_azimuth_deg=93.0, start_us=past_ns / 1000, hour=hour)
    return _spun("velodyne", spell, 2, spec)


def hesai_xt16(spell: Spell) -> Sent:
    """2500 packets a second of 8 columns."""
    spec = HesaiSpec("PandarXT-16", start_deg=351.3, start_ns=spell.begin_ns, sequence=spell.count)
    return _spun("hesai", spell, 3, spec)


def robosense_helios16(spell: Spell) -> Sent:
    """750 packets a second of 24 columns."""
    spec = RobosenseSpec(
        "Helios 16", start_deg=301.66, start_ns=spell.begin_ns, first_counter=spell.count
    )
    return _spun("robosense", spell, 4, spec)


@dataclass(frozen=True, slots=True)
class Vendor:
    """A lidar of the matrix.

    begin_ns: begin of its first revolution after that of the others; wrap: its own count of packets
    at the begin of a spell of 0.25 s in which it wraps, 0: it has none.
    """

    send: Callable[[Spell], Sent]
    ip: str
    port: int
    topic: str
    metadata: str
    begin_ns: int
    wrap: int = 0


VENDORS: Mapping[str, Vendor] = {
    "ouster": Vendor(
        send=ouster,
        ip="10.0.0.1",
        port=7502,
        topic="/front/ouster/lidar_packets",
        metadata="front.json",
        begin_ns=0,
        wrap=2**16 - 1,
    ),
    "velodyne": Vendor(
        send=velodyne_vlp16,
        ip="10.0.0.2",
        port=2368,
        topic="/velodyne_packets",
        metadata="",
        begin_ns=3_100_000,
    ),
    "hesai": Vendor(
        send=hesai_xt16,
        ip="10.0.0.3",
        port=2368,
        topic="/pandar_packets",
        metadata="unit.csv",
        begin_ns=5_700_000,
        wrap=2**32 - 100,
    ),
    "robosense": Vendor(
        send=robosense_helios16,
        ip="10.0.0.4",
        port=6699,
        topic="/rslidar_packets",
        metadata="angles.csv",
        begin_ns=7_300_000,
    ),
}


def plain(vendor: str) -> Sent:
    """Half a second around noon."""
    row = VENDORS[vendor]
    return row.send(Spell(NOON_NS + row.begin_ns, LENGTH_NS))


def write_metadata(folder: Path) -> None:
    """What the rig names."""
    (folder / "front.json").write_text(json.dumps(metadata_json(OUSTER)), encoding="utf-8")
    (folder / "unit.csv").write_bytes(angles_csv([15.0 - 2 * n for n in range(16)], [0.0] * 16))
    lines = [f"{n - 8}.0,0.5\n" for n in range(16)]
    (folder / "angles.csv").write_text("".join(lines), encoding="utf-8")
