"""Clouds that a driver decoded: their points are batched anew by their own times.

Source: facts/messages.md, section 8. The packets are those of `mlbatch.clouds`, one column each:
points that share a stamp. Points have a place already, so that no beam has angles; ranges are the
distances of the points from the origin of the cloud's frame. A point's channel is its ring where
many points of a stamp are on rings of their own, and where every point has a time of its own; else
its turn among those that share its stamp.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mlbatch.arrays import F32Array, F64Array, I64Array, U8Array
from mlbatch.clouds import HEAD, KINDS, MAGIC, MOST_SLOTS, REALS, VERSION, Layout
from mlbatch.errors import RigError
from mlbatch.lidar.geometry import BeamTable, Projection, rotor_words
from mlbatch.lidar.interface import FAULTS, Calibration, Evidence, Lidar, Records, SensorModel
from mlbatch.sensors._options import check_options
from mlbatch.sensors._turning_lidar import TurningLidar
from mlbatch.types import Heads, Pixels

MAKER = "any"
# In the order of KINDS.
MODELS: tuple[SensorModel, ...] = tuple(
    SensorModel(
        name=name,
        maker=maker,
        channels=MOST_SLOTS,
        returns=(1,),
        clock="a time for every point",
        calibration="none: points have a place already",
        verified="two sources",
    )
    for name, maker in zip(KINDS, (MAKER, "Livox"), strict=True)
)
_FITS = 100
_BAD_HEADER = FAULTS.index("bad_header")
# Magic, version, kind and slots: the same in all packets of a topic.
_SHARED_BYTES = 8
# As many rings of single points as a rotor word can tell.
_RINGS = 128


def _layout(sample: U8Array) -> Layout | None:
    """The layout that packets (k, size) name, if most of them name the same."""
    if sample.shape[1] < HEAD.itemsize or not len(sample):
        return None
    heads = np.ascontiguousarray(sample[:, : HEAD.itemsize]).view(HEAD)[:, 0]
    words = np.ascontiguousarray(sample[:, :_SHARED_BYTES]).view("<u8")[:, 0]
    usual = heads[words == words[0]][0]
    if 2 * int(np.count_nonzero(words == words[0])) <= len(words):
        return None
    kind, slots = int(usual["kind"]), int(usual["slots"])
    if (int(usual["magic"]), int(usual["version"])) != (MAGIC, VERSION):
        return None
    layout = Layout(kind, slots, bool(usual["by_ring"]))
    known = kind < len(KINDS) and 0 < slots <= MOST_SLOTS and layout.size == sample.shape[1]
    return layout if known else None


class PointsCalibration:
    """That nothing needs to be known of a topic of clouds; `Calibration` of lidar.py."""

    path: Path | None = None
    serial = ""
    is_shared = True

    def __init__(self, kind: int) -> None:
        self.model = KINDS[kind]
        self._kind = kind

    def fit(self, evidence: Evidence) -> int:
        """Packets of our own making come from topics alone."""
        layout = _layout(evidence.sample) if evidence.stream.topic else None
        return _FITS if layout is not None and layout.kind == self._kind else 0

    def lidar(self, options: Mapping[str, str], evidence: Evidence | None) -> Lidar:
        """The sensor; the size of its columns is known from its first cloud."""
        check_options(options)
        layout = None if evidence is None else _layout(evidence.sample)
        if evidence is None or layout is None:
            raise RigError(
                f"{self.model}: wanted a cloud of the topic in the first 10 seconds, which tells "
                "how its points share times, got none; correct the topic, or leave it out"
            )
        return PointsLidar(layout, evidence.stream.topic)


BUILT_IN: tuple[Calibration, ...] = tuple(PointsCalibration(kind) for kind in range(len(KINDS)))


def read_calibration(path: Path, content: bytes) -> Calibration | None:
    """No file is needed."""
    return None


def describe(size: int, sample: U8Array) -> str | None:
    """What packets (k, size) are, None where they are none of ours."""
    layout = _layout(np.atleast_2d(sample)[:, :size])
    return None if layout is None else f"lidar points of a {KINDS[layout.kind]}, {layout}"


class PointsLidar(TurningLidar):
    """A topic of clouds; `Lidar` of lidar.py."""

    sends_twice = False
    typed_by = ""

    def __init__(self, layout: Layout, topic: str) -> None:
        slots = layout.slots
        self.model = KINDS[layout.kind]
        # What a sensor is named after where nothing else tells its place.
        self.maker = "Cloud"
        self.mode = str(layout)
        self.channels, self.returns, self.return_types = slots, 1, (0,)
        self.packet_size = layout.size
        self.columns_per_packet = 1
        self.records = Records(0, layout.size, layout.size)
        # `read` leaves places for the projection of the same topic.
        self.pixel_layout = ("points", slots, topic)
        # Of columns of one point the rotor word tells the ring.
        rings = _RINGS if slots == 1 else 1
        self.channel = (
            np.arange(slots) + np.arange(rings)[:, None] if slots == 1 else np.arange(slots)
        )
        self.firing_ns = np.zeros((rings, slots), np.int64)
        nowhere = np.zeros((3, slots, 3))
        self.beams = BeamTable(nowhere, nowhere[:, :1], np.zeros(1))
        self.calibration = "none"
        self._shared = layout.begin.view(np.uint8)[:_SHARED_BYTES].view("<u8")[0]
        self._reals = slice(HEAD.itemsize, HEAD.itemsize + 4 * REALS * slots)
        self._scratch = _Places(np.empty((0, REALS, slots), np.float32))

    def faults(self, packets: U8Array) -> U8Array:
        """Packets of another layout."""
        head = np.ascontiguousarray(packets[:, :_SHARED_BYTES]).view("<u8")[:, 0]
        faults = np.zeros(len(packets), np.uint8)
        faults[head != self._shared] = _BAD_HEADER
        return faults

    def heads(self, packets: U8Array, host_ns: I64Array) -> Heads:
        """The stamp that the points of a column share."""
        head = np.ascontiguousarray(packets[:, : HEAD.itemsize]).view(HEAD)
        stamp_ns: I64Array = head["stamp_ns"].astype(np.int64)
        still = np.zeros(stamp_ns.shape)
        ring: I64Array | int = 0
        if self.channels == 1:
            at = HEAD.itemsize + 4 * REALS
            ring = (
                np.ascontiguousarray(packets[:, at : at + 2]).view("<u2").astype(np.int64) % _RINGS
            )
        return Heads(stamp_ns, rotor_words(still, still, ring), np.ones(stamp_ns.shape, np.bool_))

    def read(self, records: U8Array, which: int, out: Pixels) -> None:
        """Distances and levels of columns (n, records.size); their places wait for `points`."""
        reals: F32Array = records[:, self._reals].view("<f4")
        reals = reals.reshape(len(records), REALS, self.channels)
        self._scratch.reals = reals
        x, y, z, level = reals.transpose(1, 0, 2)
        range_m = np.multiply(x, x, out=out.range_m)
        range_m += y * y
        range_m += z * z
        np.sqrt(range_m, out=range_m)
        np.copyto(out.intensity, level)

    def projection(self, body_from_sensor: F64Array, columns: int) -> Projection | None:
        """Points are moved, not made."""
        return _Moved(self._scratch, body_from_sensor)


@dataclass(slots=True)
class _Places:
    """The columns that were read last, (n, REALS, slots), where they lie in their records."""

    reals: F32Array


class _Moved:
    """The places of the columns read last, in the body frame; `Projection` of geometry.py."""

    def __init__(self, places: _Places, body_from_sensor: F64Array) -> None:
        self._places = places
        self._rotation = body_from_sensor[:3, :3].astype(np.float32)
        self._translation_m = body_from_sensor[:3, 3].astype(np.float32)

    def prepare(self, member: I64Array, encoder: I64Array) -> None:
        """Nothing turns."""

    def project(self, range_m: F32Array, out: F32Array) -> None:
        """Rotation and translation, axis by axis in a fixed order; empty slots mean nothing."""
        reals = self._places.reals
        x, y, z = (reals[:, axis] for axis in range(3))
        for axis, (row, shift_m) in enumerate(
            zip(self._rotation, self._translation_m, strict=True)
        ):
            moved = x * row[0]
            moved += y * row[1]
            moved += z * row[2]
            np.add(moved, shift_m, out=out[:, :, axis])
