"""The real HESAI recordings: the tables of docs/sources/hesai.md sections 0, 3 (pairs), 4 and 5."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mlbatch.arrays import F64Array, I64Array
from tests.recordings import RECORDINGS
from tests.recordings.references import read_pcd, xyz_of
from tests.reference import hesai as reference

FOLDER = RECORDINGS / "hesai"
DUAL = "dual return, last and strongest"


@dataclass(frozen=True, slots=True)
class Case:
    """A recording, all of it, and the sweep that was published as a cloud.

    first_ns, last_ns: times of packets; block_ns: offsets of the first block of a packet and of its
    last one; differ, equal: pairs of returns; host_ahead_s: recording stamp minus lidar time,
    smallest and largest; limits_m: the ranges that the cloud keeps.
    """

    folder: str
    model: str
    mode: str
    packets: int
    groups: int
    ranges: int
    ranges_first: int
    first_ns: int
    last_ns: int
    block_ns: tuple[int, int]
    differ: int
    equal: int
    host_ahead_s: tuple[float, float]
    points_per_sweep: tuple[int, ...]
    sweep: int
    limits_m: tuple[float, float]

    @property
    def bag(self) -> Path:
        """The folder of the bag."""
        (bag,) = (path.parent for path in (FOLDER / self.folder).glob("*/metadata.yaml"))
        return bag

    @property
    def file(self) -> str:
        """Name of its angle file."""
        (csv,) = (FOLDER / self.folder).glob("*.csv")
        return csv.name

    @property
    def azimuth_micro_deg(self) -> I64Array:
        """(channels,) horizontal angles of the beams."""
        lines = (FOLDER / self.folder / self.file).read_text(encoding="utf-8").split()
        cells = [line.split(",") for line in lines if line[0].isdigit()]
        return np.array([round(float(row[2]) * 1_000_000) for row in cells], np.int64)

    @property
    def offset_ns(self) -> I64Array:
        """(channels,) firing of each beam after its block's time."""
        table: I64Array = reference.firing_ns(self.model)[0]
        return table

    @property
    def published(self) -> F64Array:
        """(n, 3) the cloud of one sweep, by firing group, channel and return."""
        (pcd,) = (FOLDER / self.folder).glob("*.pcd")
        return xyz_of(read_pcd(pcd))


CASES = (
    Case(
        *("pandar40p", "Pandar40P", DUAL, 1439, 7195, 434_934, 217_841),
        *(1504714786881567000, 1504714787281044000),
        block_ns=(-28_580 - 4 * 55_560, -28_580),
        differ=9147,
        equal=207_946,
        host_ahead_s=(168685362.42959, 168685362.43011),
        points_per_sweep=(152, 56530, 56723, 56762, 56604, 217),
        sweep=3,
        limits_m=(0.3, 200.0),
    ),
    Case(
        *("pandar64", "Pandar64", DUAL, 2400, 7200, 716_622, 359_715),
        *(1593086529977341000, 1593086530377208000),
        block_ns=(-42_580 - 2 * 55_560, -42_580),
        differ=14_744,
        equal=342_163,
        host_ahead_s=(80317350.51931, 80317350.52065),
        points_per_sweep=(244, 93079, 93672, 93591, 93463, 410),
        sweep=3,
        limits_m=(0.3, 200.0),
    ),
    Case(
        *("pandarqt64", "PandarQT64", "dual return, first and last"),
        *(1200, 2400, 299_376, 149_688, 1504708282818090000, 1504708283217397000),
        block_ns=(25_710, 25_710 + 500_000 // 3),
        differ=6099,
        equal=143_589,
        host_ahead_s=(168692912.86951, 168692912.86985),
        points_per_sweep=(259, 33940, 34145, 34158, 33898, 268),
        sweep=3,
        limits_m=(0.1, 60.0),
    ),
    Case(
        *("pandarxt16", "PandarXT-16", DUAL, 1626, 6504, 165_138, 82_569),
        *(1564027949274789000, 1564027949599756000),
        block_ns=(5632 - 3 * 50_000, 5632),
        differ=4192,
        equal=78_377,
        host_ahead_s=(168820178.59049, 168820178.59073),
        points_per_sweep=(7905, 26299, 26287, 26252, 18),
        sweep=2,
        limits_m=(0.05, 120.0),
    ),
    Case(
        *("pandarxt32", "PandarXT-32", DUAL, 2000, 8000, 486_606, 243_303),
        *(1564024769619165000, 1564024770019000000),
        block_ns=(5632 - 3 * 50_000, 5632),
        differ=8829,
        equal=234_474,
        host_ahead_s=(109375908.08108, 109375908.08198),
        points_per_sweep=(62826, 63058, 63040, 63021, 187),
        sweep=3,
        limits_m=(0.05, 120.0),
    ),
)
