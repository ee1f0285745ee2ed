"""Encoded Velodyne streams and their decoders, for the tests."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mlbatch.arrays import F32Array, F64Array, I64Array, U8Array
from mlbatch.lidar.geometry import read_rotor_words
from mlbatch.lidar.interface import Evidence
from mlbatch.sensors.velodyne import sensor as velodyne
from mlbatch.sensors.velodyne.packets import VelodyneLidar
from mlbatch.simulate.velodyne.encode import Sent, VelodyneSpec, encode
from mlbatch.simulate.velodyne.models import calibration_yaml
from mlbatch.types import Stream
from tests.builders.decoded import readings

PLAIN = ("VLP-16", "Puck Hi-Res", "HDL-32E", "VLP-32C", "VLS-128")
MODES = ("strongest", "last", "dual")
STREAM = Stream("192.168.1.201", 2368)
# Stamps are whole us; azimuths whole hundredths of a degree.
TIME_NS = 800
ANGLE_DEG = 0.012


@dataclass(frozen=True)
class Seen:
    """A stream, what was encoded into it, and its decoder."""

    spec: VelodyneSpec
    sent: Sent
    counts: I64Array
    level: I64Array
    lidar: VelodyneLidar

    @property
    def columns(self) -> I64Array:
        return np.arange(len(self.counts))


def made_of(spec: VelodyneSpec, packets: int = 24, options: dict[str, str] | None = None) -> Seen:
    """A stream of random readings."""
    rng = np.random.default_rng(7)
    lasers = len(spec.table.elevation_deg)
    shape = (packets * spec.columns_per_packet, lasers, spec.returns)
    counts = np.where(rng.random(shape) < 0.2, 0, rng.integers(1, 65536, shape))
    level = rng.integers(0, 256, shape)
    sent = encode(spec, counts, level)
    lidar = calibration(spec.model).lidar(options or {}, evidence(sent))
    return Seen(spec, sent, counts, level, lidar)


def evidence(sent: Sent) -> Evidence:
    return Evidence(STREAM, 1206, sent.payloads[:16], sent.host_ns[:16])


def calibration(model: str) -> velodyne.VelodyneCalibration:
    if model in PLAIN:
        built_in = [one for one in velodyne.BUILT_IN if one.model == model]
        assert isinstance(built_in[0], velodyne.VelodyneCalibration)
        return built_in[0]
    read = velodyne.read_calibration(Path("unit.yaml"), calibration_yaml(model).encode())
    assert read is not None
    named = read.for_model(model)
    assert named is not None
    return named


def pixels(lidar: VelodyneLidar, packets: U8Array) -> tuple[F32Array, F32Array]:
    """Ranges and levels, (columns, lasers, returns)."""
    found = readings(lidar, packets)
    return found.range_m, found.intensity


def fired(lidar: VelodyneLidar, sent: Sent) -> tuple[I64Array, F64Array]:
    """(columns, lasers): when each beam fires, ns, and the angle of the rotor then, rad."""
    headers = lidar.column_headers(sent.payloads, sent.host_ns)
    assert headers.valid.all()
    angle, speed, table = read_rotor_words(headers.encoder.reshape(-1))
    assert not table.any()
    time_ns = headers.stamp_ns.reshape(-1)[:, None] + lidar.firing_ns
    return time_ns, angle[:, None] + speed[:, None] * lidar.firing_ns


def pointing(lidar: VelodyneLidar, angle: F64Array) -> tuple[F64Array, F64Array]:
    """Directions and origins of beams at these angles, (columns, lasers, 3), in float64."""
    cosine = np.cos(angle)[..., None]
    sine = np.sin(angle)[..., None]
    direction, origin = (
        cosine * vectors[0] + sine * vectors[1] + vectors[2]
        for vectors in (lidar.beams.direction, lidar.beams.origin)
    )
    return direction, origin


def apart_deg(one: F64Array, other: F64Array) -> float:
    """Largest angle between unit vectors."""
    return float(np.degrees(2 * np.arcsin(np.linalg.norm(one - other, axis=-1) / 2)).max())
