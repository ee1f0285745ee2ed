"""Clouds decoded by a driver, whose points are batched again by their own timestamps.

Source: docs/sources/messages.md, section 8. The packets are those of `mlbatch.clouds`, one column
each: the points of equal timestamp. Points have coordinates, so beams have no angles; a range is
the distance of a point from the origin of the cloud's frame. The channel of a point is its ring if
most points of a timestamp are on different rings, or if every point has its own timestamp; else its
number among the points of its timestamp.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from mlbatch.arrays import F64Array, U8Array
from mlbatch.errors import RigError
from mlbatch.lidar.geometry import BeamTable, PlacedPoints
from mlbatch.lidar.headers import EvenColumns, HeaderReader, check_of, checks
from mlbatch.lidar.interface import Calibration, Evidence, Lidar, Records, SensorModel
from mlbatch.ros.point_packets import (
    HEAD,
    MAGIC,
    MOST_SLOTS,
    REALS,
    VERSION,
    WITH_LABELS,
    Layout,
)
from mlbatch.sensors.options import check_options
from mlbatch.types import CLOUDS

VENDOR = "any"
# In the order of CLOUDS.
MODELS: tuple[SensorModel, ...] = tuple(
    SensorModel(
        name=name,
        vendor=vendor,
        channels=MOST_SLOTS,
        returns=(1,),
        clock="a time for every point",
        calibration="none: points have coordinates",
        verified="two sources",
    )
    for name, vendor in zip(CLOUDS, (VENDOR, "Livox"), strict=True)
)
_FITS = 100
# Magic, version, kind and slots: the same in all packets of a topic.
_SHARED_BYTES = 8
_STAMP_AT = 8
# The table number of a rotor word has room for so many rings.
_RINGS = 128


def _layout(sample: U8Array) -> Layout | None:
    """Layout named by most of the packets (k, size), else None."""
    if sample.shape[1] < HEAD.itemsize or not len(sample):
        return None
    headers = np.ascontiguousarray(sample[:, : HEAD.itemsize]).view(HEAD)[:, 0]
    words = np.ascontiguousarray(sample[:, :_SHARED_BYTES]).view("<u8")[:, 0]
    first = headers[0]
    if 2 * int(np.count_nonzero(words == words[0])) <= len(words):
        return None
    kind = int(first["kind"])
    slots = int(first["slots"])
    version = int(first["version"])
    if int(first["magic"]) != MAGIC or version not in (VERSION, WITH_LABELS):
        return None
    layout = Layout(kind, slots, bool(first["by_ring"]), version == WITH_LABELS)
    known = kind < len(CLOUDS) and 0 < slots <= MOST_SLOTS and layout.size == sample.shape[1]
    return layout if known else None


class CloudCalibration(Calibration):
    """A topic of clouds, which needs no calibration."""

    is_shared = True

    def __init__(self, kind: int) -> None:
        self.model = CLOUDS[kind]
        self._kind = kind

    def match_score(self, evidence: Evidence) -> int:
        """Match cloud packets of this kind; they only come from topics."""
        layout = _layout(evidence.sample) if evidence.stream.topic else None
        return _FITS if layout is not None and layout.kind == self._kind else 0

    def lidar(self, options: Mapping[str, str], evidence: Evidence | None) -> Lidar:
        """The sensor; its first cloud defines the size of its columns."""
        check_options(options)
        layout = None if evidence is None else _layout(evidence.sample)
        if evidence is None or layout is None:
            raise RigError(
                f"{self.model}: expected a cloud of the topic in the first 10 seconds, which "
                "defines how points share timestamps, found none; correct the topic, or leave it "
                "out"
            )
        return CloudLidar(layout, evidence.stream.topic)


BUILT_IN: tuple[Calibration, ...] = tuple(CloudCalibration(kind) for kind in range(len(CLOUDS)))


def read_calibration(path: Path, content: bytes) -> Calibration | None:
    """None: clouds need no calibration file."""
    return None


def describe(size: int, sample: U8Array) -> str | None:
    """Name packets (k, size); None if they are not cloud packets."""
    layout = _layout(np.atleast_2d(sample)[:, :size])
    return None if layout is None else f"lidar points of a {CLOUDS[layout.kind]}, {layout}"


class CloudLidar(Lidar):
    """A topic of clouds. Points with labels are in the body frame."""

    sends_twice = False
    typed_by = ""

    def __init__(self, layout: Layout, topic: str) -> None:
        slots = layout.slots
        self._layout = layout
        self.model = CLOUDS[layout.kind]
        # Names the sensor if its topic does not.
        self.vendor = "Cloud"
        self.mode = str(layout)
        self.channels = slots
        self.returns = 1
        self.return_types = (0,)
        self.packet_size = layout.size
        self.columns_per_packet = 1
        self.records = Records(0, layout.size, layout.size)
        # In columns of one point the rotor word carries the ring.
        has_ring_words = slots == 1 and not layout.has_labels
        rings = _RINGS if has_ring_words else 1
        self.channel = (
            np.arange(slots) + np.arange(rings)[:, None] if has_ring_words else np.arange(slots)
        )
        self.firing_ns = np.zeros((rings, slots), np.int64)
        nowhere = np.zeros((3, slots, 3))
        self.beams = BeamTable(nowhere, nowhere[:, :1], np.zeros(1))
        self.calibration = "none"
        shared = layout.begin.view(np.uint8)[:_SHARED_BYTES].tobytes()
        self.reader = HeaderReader(
            EvenColumns(
                packet_bytes=layout.size,
                columns=1,
                check_count=1,
                checks=checks(check_of(0, shared)),
                stamp_at=_STAMP_AT,
                interval_at=-1,
                interval_ns=0,
                counter_at=-1,
                ring_at=HEAD.itemsize + 4 * REALS if has_ring_words else -1,
                rings=_RINGS,
            ),
            has_number=False,
        )

    def projection(self, body_from_sensor: F64Array) -> PlacedPoints:
        """Transform of the recorded coordinates."""
        if self._layout.has_labels:
            return PlacedPoints(
                HEAD.itemsize,
                np.eye(3, dtype=np.float32),
                np.zeros(3, np.float32),
                self._layout.labels_at,
                body_from_sensor[:3, 3].astype(np.float32),
            )
        return PlacedPoints(
            HEAD.itemsize,
            body_from_sensor[:3, :3].astype(np.float32),
            body_from_sensor[:3, 3].astype(np.float32),
        )
