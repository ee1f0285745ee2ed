"""What tests of the ROBOSENSE decoder share: evidence from payloads, and points in float64."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mlbatch.arrays import F32Array, F64Array, I64Array, U8Array
from mlbatch.lidar.geometry import read_rotor_words
from mlbatch.lidar.interface import Evidence, Lidar, NeighbourStream
from mlbatch.sensors.robosense import sensor as robosense
from mlbatch.types import Stream
from tests.builders.decoded import readings
from tests.builders.others import rows

SOURCE = "192.168.1.200"
MSOP = Stream(SOURCE, 6699)
DIFOP = Stream(SOURCE, 7788)


def evidence_of(
    points: Sequence[bytes], difops: Sequence[bytes] = (), host_ns: I64Array | None = None
) -> Evidence:
    """Point packets on port 6699, device packets on port 7788 of one source."""
    sample = rows(points)
    receive_ns = np.arange(len(points)) * 1_000_000 if host_ns is None else host_ns
    neighbours = tuple(
        NeighbourStream(DIFOP, len(difop), rows([difop]), receive_ns[:1]) for difop in difops[:1]
    )
    if len(difops) > 1:
        neighbours = (NeighbourStream(DIFOP, len(difops[0]), rows(difops), np.arange(len(difops))),)
    return Evidence(MSOP, sample.shape[1], sample, receive_ns, neighbours)


def built_in(evidence: Evidence) -> robosense.DifopCalibration:
    """The calibration that the packets name."""
    (best,) = [one for one in robosense.BUILT_IN if one.match_score(evidence) == 100]
    assert isinstance(best, robosense.DifopCalibration)
    return best


@dataclass(frozen=True, slots=True)
class Decoded:
    """Columns of packets: (n, channels) or (n, channels, returns); xyz_m: one more axis of 3."""

    range_m: F32Array
    intensity: F32Array
    time_ns: I64Array
    angle_rad: F64Array
    xyz_m: F64Array


def decoded(lidar: Lidar, packets: U8Array) -> Decoded:
    """All columns of packets (P, size), projected in the sensor frame."""
    found = readings(lidar, packets)
    rotor_rad, rad_per_ns, _ = read_rotor_words(found.encoder)
    angle_rad = rotor_rad[:, None] + rad_per_ns[:, None] * lidar.firing_ns[0]
    cosine = np.cos(angle_rad)[..., None]
    sine = np.sin(angle_rad)[..., None]
    towards, origin = (
        cosine * one[0] + sine * one[1] + one[2]
        for one in (lidar.beams.direction, lidar.beams.origin)
    )
    xyz_m = found.range_m[..., None] * towards[:, :, None] + origin[:, :, None]
    time_ns = found.stamp_ns[:, None] + lidar.firing_ns[0]
    return Decoded(found.range_m, found.intensity, time_ns, angle_rad, xyz_m)
