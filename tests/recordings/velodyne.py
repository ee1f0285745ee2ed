"""The real Velodyne recordings (MANIFEST.md, docs/sources/velodyne.md section 11)."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array
from mlbatch.simulate.velodyne.models import MODELS
from tests.recordings import RECORDINGS
from tests.recordings.references import Decoded

FOLDER = RECORDINGS / "velodyne"


@dataclass(frozen=True, slots=True)
class Case:
    """A recording; file: its angles."""

    folder: str
    recording: str
    model: str
    mode: str
    packets: int
    columns: int  # of a packet
    points: int  # without returns that are sent twice
    timescale: str = "unknown"
    file: str = ""

    @property
    def path(self) -> Path:
        """The recording."""
        return FOLDER / self.folder / self.recording

    @property
    def theirs(self) -> Decoded:
        """What velodyne-decoder makes of it."""
        return Decoded.of(FOLDER / self.folder / "reference.npz")

    def alone(self, folder: Path) -> Path:
        """The recording without its angle file."""
        if not self.file:
            return self.path
        return Path(shutil.copytree(self.path, folder / "bag"))

    @property
    def heights_m(self) -> F64Array:
        """(rings,) heights of beam origins (docs/sources/velodyne.md 6); ring 0 is lowest."""
        table = MODELS[self.model]
        heights: F64Array = np.array(table.vertical_m)[np.argsort(table.elevation_deg)]
        return heights

    def known_well(self, theirs: Decoded) -> BoolArray:
        """Their points in packets without a blind sector, which they misplace by 50 ms."""
        packet: I64Array = theirs.column // self.columns
        blind = np.flatnonzero(theirs.behind_jump.any(axis=1))
        return np.isin(packet, blind, invert=True)


SINGLE = "strongest return"
DUAL = Case(
    *("vlp16_ros2_dual", "1673400471837873222", "VLP-16", "dual return"),
    packets=603,
    columns=12,
    points=59_414,
    file="VLP16.yaml",
)
GAPS = Case(
    *("vlp32c_ros2", "1713492677464078412", "VLP-32C", SINGLE),
    packets=379,
    columns=12,
    points=131_305,
    file="VLP32.yaml",
)
GPS = Case(
    *("vlp16_gps", "sample_velodyne_vlp16_gps.pcap", "VLP-16", SINGLE),
    packets=293,
    columns=24,
    points=73_486,
    timescale="utc",
)
BELIED = Case(
    *("vlp16_wrong-product-byte", "velodyne_vlp16.pcap", "VLP-16", SINGLE),
    packets=84,
    columns=24,
    points=19_579,
)
MISNAMED = Case(
    *("hdl32e_named-vlp32", "velodyne_vlp32.pcap", "HDL-32E", SINGLE),
    packets=91,
    columns=12,
    points=30_596,
    timescale="utc",
)
CASES = (DUAL, GAPS, GPS, BELIED, MISNAMED)
