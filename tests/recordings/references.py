"""Real recordings converted by the command line, and what other decoders made of them.

recordings/MANIFEST.md says how the references were made: clouds published with the recordings
(PCD), and points of velodyne-decoder (npz).
"""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import BoolArray, F64Array, I64Array
from tests.builders.run import Cloud, command, load, scan_files

HOUR_NS = 3_600_000_000_000
US_NS = 1_000

# Autoware's numbering, docs/sources/outputs.md section 3.
STRONGEST_FIRST, STRONGEST_LAST, WEAK_FIRST, WEAK_LAST, ONLY = 3, 4, 5, 6, 7


@dataclass(frozen=True, slots=True)
class Made:
    """A conversion that ended well: its folder, its report and what it said on stderr."""

    folder: Path
    report: Any
    err: str

    @property
    def sensor(self) -> Any:
        """The only sensor of the report."""
        (sensor,) = self.report["sensors"]
        return sensor

    @property
    def cloud(self) -> Cloud:
        """All points, in the order of the scans."""
        return Cloud.of_all(self.folder)

    @property
    def grid(self) -> dict[str, npt.NDArray[Any]]:
        """All columns of an organized run: (n, slots[, 3]) arrays by their keys, and `at_ns`."""
        scans = [load(path) for path in scan_files(self.folder)]
        keys = [key for key, value in scans[0].items() if value.ndim and key != "sensors"]
        parts = {key: np.concatenate([scan[key] for scan in scans]) for key in keys}
        starts = [scan["time_ns"].astype(np.int64) + int(scan["start_ns"]) for scan in scans]
        return {**parts, "at_ns": np.concatenate(starts)}


def converted(recording: Path, folder: Path, *options: str) -> Made:
    """Convert all of a recording into `folder`; its ledgers must balance."""
    result = command("convert", recording, "-o", folder, "--keep-partial", "--quiet", *options)
    assert result.code == 0, result.err
    made = Made(folder, json.loads((folder / "report.json").read_text("utf-8")), result.err)
    capture, sensor = made.report["capture"], made.sensor
    assert capture["frames"] == capture["datagrams"] + sum(capture["skipped"].values())
    packets, columns, points = (sensor[name] for name in ("packets", "columns", "points"))
    assert packets["read"] == packets["accepted"] + sum(packets["rejected"].values())
    assert columns["decoded"] == columns["written"] + sum(columns["dropped"].values())
    kinds = ("no_return", "range", "box", "repeated", "written")
    assert points["slots"] == sum(points[kind] for kind in kinds)
    assert made.report["scans"]["points"] == points["written"]
    return made


def assert_same_points(one: Cloud, other: Cloud) -> None:
    """Bit for bit: all columns and points, in the same order."""
    for part in fields(Cloud):
        values = getattr(one, part.name), getattr(other, part.name)
        if values[0] is not None:
            assert np.array_equal(*values), part.name


def read_pcd(path: Path) -> npt.NDArray[np.void]:
    """Points of a binary PCD file, one record each."""
    head, _, body = path.read_bytes().partition(b"DATA binary\n")
    words = {line.split()[0]: line.split()[1:] for line in head.decode().splitlines()}
    kinds = zip(words["FIELDS"], words["TYPE"], words["SIZE"], strict=True)
    dtype = np.dtype([(name, f"<{kind.lower()}{size}") for name, kind, size in kinds])
    return np.frombuffer(body, dtype, int(words["POINTS"][0]))


def xyz_of(points: npt.NDArray[np.void]) -> F64Array:
    """(n, 3) coordinates, m."""
    return np.stack([points[axis].astype(np.float64) for axis in "xyz"], axis=1)


def heading_deg(xyz: npt.NDArray[np.floating[Any]], *, ahead: int = 0) -> F64Array:
    """(n,) clockwise from the axis `ahead` (0: x, with y to the left; 1: y, x to the right)."""
    right, forward = (-xyz[:, 1], xyz[:, 0]) if ahead == 0 else (xyz[:, 0], xyz[:, 1])
    angle: F64Array = np.degrees(np.arctan2(right.astype(np.float64), forward.astype(np.float64)))
    return angle


def turned_deg(one: F64Array, other: F64Array) -> F64Array:
    """`one` minus `other`, from -180 to 180."""
    angle: F64Array = (one - other + 180) % 360 - 180
    return angle


@dataclass(frozen=True, slots=True)
class Decoded:
    """Points of velodyne-decoder, by column, ring and range.

    at_ns: since 1970; which: 1 strongest (odd block), 2 last (even block), 3 both, which are equal;
    packet_ns: (P,) stamps of packets; azimuth_cdeg: (P, 12) of their blocks; host_ns: (P,)
    receive times.
    """

    xyz: F64Array
    intensity: F64Array
    at_ns: I64Array
    column: I64Array
    ring: I64Array
    which: I64Array
    packet_ns: I64Array
    azimuth_cdeg: I64Array
    host_ns: I64Array

    @classmethod
    def of(cls, path: Path) -> Decoded:
        """From a reference.npz."""
        with np.load(path) as npz:
            names, points = npz["point_fields"].tolist(), npz["points"].astype(np.float64)
            field = {name: points[:, at] for at, name in enumerate(names)}
            past_hour_us = npz["packet_device_us_past_hour"].astype(np.int64)
            # The stamp of the last packet in float64 seconds: exact to less than a microsecond.
            hour = round((float(npz["device_time_s"]) - past_hour_us[-1] / 1e6) / 3600)
            host_ns = np.rint(npz["packet_host_time_s"] * 1e9).astype(np.int64)
            azimuth_cdeg = npz["packet_azimuth_cdeg"].astype(np.int64)
        packet_ns = hour * HOUR_NS + past_hour_us * US_NS
        xyz = points[:, [names.index(axis) for axis in "xyz"]]
        order = np.lexsort((np.linalg.norm(xyz, axis=1), field["ring"], field["column"]))
        whole = {key: field[key][order].astype(np.int64) for key in ("column", "ring")}
        return cls(
            xyz[order],
            field["intensity"][order],
            packet_ns[-1] + np.rint(field["time"] * 1e9).astype(np.int64)[order],
            whole["column"],
            whole["ring"],
            field["return_type"][order].astype(np.int64),
            packet_ns,
            azimuth_cdeg,
            host_ns,
        )

    @property
    def behind_jump(self) -> BoolArray:
        """(P, 12) blocks behind a jump of the azimuth by more than 1 degree within their packet."""
        step = np.diff(self.azimuth_cdeg, axis=1, prepend=self.azimuth_cdeg[:, :1]) % 36000
        return np.asarray((step > 100) & (step < 35_900)).cumsum(axis=1) > 0


@dataclass(frozen=True, slots=True)
class Apart:
    """How far our points are from a decoder's, one by one; turn_deg: about z; up_m: in z."""

    turn_deg: F64Array
    up_m: F64Array
    range_m: F64Array
    time_ns: I64Array


def apart(ours: Cloud, theirs: Decoded, above_m: F64Array, added_m: F64Array) -> Apart:
    """Each of our points against its own; rings and levels must be equal.

    above_m: (rings,) height of the beams' origins in their decoder; added_m: what our points, that
    have none, lack of it.
    """
    order = np.lexsort((ours.range_m, ours.ring, ours.column))
    ring = ours.ring[order].astype(np.int64)
    assert len(ring) == len(theirs.ring)
    assert np.array_equal(ring, theirs.ring)
    assert np.array_equal(ours.intensity[order], theirs.intensity)
    xyz = ours.xyz[order].astype(np.float64)
    beam = theirs.xyz - above_m[ring][:, None] * (0.0, 0.0, 1.0)
    return Apart(
        np.abs(turned_deg(heading_deg(xyz), heading_deg(theirs.xyz))),
        np.abs(xyz[:, 2] + added_m[ring] - theirs.xyz[:, 2]),
        np.abs(np.linalg.norm(beam, axis=1) - ours.range_m[order]),
        np.abs(ours.at_ns[order] - theirs.at_ns),
    )
