"""The real HESAI recordings: the tables of docs/sources/hesai.md sections 0, 3 (pairs), 4 and 5."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mlbatch.arrays import F64Array, I64Array
from tests.recordings import RECORDINGS
from tests.recordings.references import read_pcd, xyz_of

FOLDER = RECORDINGS / "hesai"
DUAL = "dual return, last and strongest"

# Section 12, typed once more: when beams fire after the time of their block, channel by channel.
_P40_NS = """
-42220 -28470 -16040 -3620 -45490 -31740 -47460 -54670 -20620 -33710
-40910 -8190 -20620 -27160 -50730 -8190 -14740 -36980 -45490 -52700
-23890 -31740 -38950 -11470 -18650 -25190 -48760 -6230 -12770 -35010
-21920 -9500 -43520 -29770 -17350 -4920 -42220 -28470 -16040 -3620
"""
_P64_NS = """
-23180 -21876 -20572 -19268 -17964 -16660 -11444 -46796
-7532 -36956 -50732 -54668 -40892 -44828 -31052 -34988
-48764 -52700 -38924 -42860 -29084 -33020 -46796 -25148
-36956 -50732 -27116 -40892 -44828 -31052 -34988 -48764
-25148 -38924 -42860 -29084 -33020 -52700 -6228 -54668
-15356 -27116 -10140 -23180 -4924 -21876 -14052 -17964
-8836 -19268 -3620 -20572 -12748 -16660 -7532 -11444
-6228 -15356 -10140 -4924 -3620 -14052 -8836 -12748
"""
_QT64_NS = """
2310 4370 6430 8490 10540 12600 14660 16710
19160 21220 23280 25340 27390 29450 31500 33560
36610 38670 40730 42780 44840 46900 48950 51010
53450 55520 57580 59630 61690 63740 65800 67860
70900 72970 75020 77080 79140 81190 83250 85300
87750 89820 91870 93930 95980 98040 100100 102150
105200 107260 109320 111380 113430 115490 117540 119600
122050 124110 126170 128220 130280 132340 134390 136450
"""


def _numbers(text: str) -> tuple[int, ...]:
    return tuple(int(word) for word in text.split())


FIRING_NS = {
    "Pandar40P": _numbers(_P40_NS),
    "Pandar64": _numbers(_P64_NS),
    "PandarQT64": _numbers(_QT64_NS),
    "PandarXT-16": tuple(range(368, 368 + 16 * 3024, 3024)),
    "PandarXT-32": tuple(range(368, 368 + 32 * 1512, 1512)),
}


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
        return np.array(FIRING_NS[self.model], np.int64)

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
