"""Streams of spinning lidars by the encoders, what they say, and the lidars that decode them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array, U8Array
from mlbatch.lidar.geometry import read_rotor_words
from mlbatch.lidar.interface import Calibration, Evidence, Lidar, ModelFile, NeighbourStream
from mlbatch.sensors import built_in, parse_calibration
from mlbatch.simulate.hesai import encode as hesai
from mlbatch.simulate.hesai.encode import HesaiSpec
from mlbatch.simulate.ouster.encode import OusterSpec, metadata_json
from mlbatch.simulate.robosense import encode as robosense
from mlbatch.simulate.robosense.encode import RobosenseSpec
from mlbatch.simulate.velodyne import encode as velodyne
from mlbatch.simulate.velodyne.encode import VelodyneSpec
from mlbatch.simulate.velodyne.models import MODELS, calibration_yaml
from mlbatch.types import ColumnHeaders, Stream
from tests.builders.decoded import Readings, readings
from tests.builders.lidar_packets import Spec, encoded, hesai_unit, shape
from tests.builders.others import rows

STREAM = Stream("192.168.1.201", 2368)
DIFOP = Stream("192.168.1.201", 7788)
# Velodynes with a table of their own; an HDL-64E has a file of its unit.
PLAIN = tuple(model for model in MODELS if not model.startswith("HDL-64E"))
MODES = ("strongest", "last", "dual")
_HESAI_COLUMNS = 420
# Packets lie in a wider buffer.
_MORE_BYTES = 94


@dataclass(frozen=True)
class Truth:
    """What a stream says, in the order of its columns, each (n, channels).

    counts, level: one more axis, of returns; counts of unit_m, 0: no return; time_ns: when the
    beams fire; fires: whether they do; direction, origin_m: (n, channels, 3) of the beams then, in
    the sensor frame; reach_m: added to ranges.
    """

    counts: I64Array
    level: I64Array
    unit_m: float
    time_ns: I64Array
    fires: BoolArray
    direction: F64Array
    origin_m: F64Array
    reach_m: F64Array


@dataclass(frozen=True)
class Encoded:
    """Packets (P, size) of random readings, and a calibration for them; sampled: by discovery."""

    truth: Truth
    packets: U8Array
    host_ns: I64Array
    calibration: Calibration
    neighbours: tuple[NeighbourStream, ...] = ()
    sampled: int = 16

    @property
    def evidence(self) -> Evidence:
        """What discovery knows of the stream."""
        sample = slice(self.sampled)
        return evidence_of(self.packets[sample], self.host_ns[sample], self.neighbours)

    def lidar(self, **options: str) -> Lidar:
        """The decoder."""
        return self.calibration.lidar(options, self.evidence)

    def headers(self, lidar: Lidar) -> ColumnHeaders:
        """Headers of all packets."""
        return lidar.column_headers(self.packets, self.host_ns)

    def read(self, lidar: Lidar) -> Readings:
        """All columns."""
        return readings(lidar, self.packets, self.host_ns)

    def damaged(self, *changes: tuple[int, bytes]) -> U8Array:
        """As many packets as changes, each with other bytes at a place, and a sound one."""
        packets: U8Array = self.packets[: len(changes) + 1].copy()
        for packet, (at, value) in zip(packets, changes, strict=False):
            first = at % len(packet)
            packet[first : first + len(value)] = np.frombuffer(value, np.uint8)
        return packets


def evidence_of(
    packets: U8Array | Sequence[bytes],
    host_ns: I64Array | None = None,
    neighbours: tuple[NeighbourStream, ...] = (),
    stream: Stream = STREAM,
) -> Evidence:
    """A stream that begins with these packets."""
    sample = packets if isinstance(packets, np.ndarray) else rows(packets)
    at_ns = np.arange(len(sample)) * 1_000_000 if host_ns is None else host_ns
    return Evidence(stream, sample.shape[1], sample, at_ns, neighbours)


def difops_of(*payloads: bytes) -> tuple[NeighbourStream, ...]:
    """Device packets of a ROBOSENSE, next to its points."""
    if not payloads:
        return ()
    return (NeighbourStream(DIFOP, len(payloads[0]), rows(payloads), np.arange(len(payloads))),)


def best_of(evidence: Evidence) -> Calibration:
    """The built-in calibration that packets name."""
    (best,) = [one for one in built_in() if one.match_score(evidence) == 100]
    return best


def named(model: str, calibration: Calibration | None = None) -> Calibration:
    """A calibration (by default that built in), for the model that a rig names."""
    known = calibration or next(one for one in built_in() if one.model == model)
    assert isinstance(known, ModelFile)
    found = known.for_model(model)
    assert found is not None
    return found


def from_file(content: bytes | str, name: str = "unit.csv") -> Calibration:
    """The calibration in a file."""
    data = content.encode() if isinstance(content, str) else content
    found = parse_calibration(Path(name), data)
    assert found is not None
    return found


def ouster_calibration(spec: OusterSpec, name: str = "a.json") -> Calibration:
    """The metadata of an Ouster."""
    return from_file(json.dumps(metadata_json(spec)), name)


def stream_of(spec: Spec, packets: int = 0) -> Encoded:
    """A stream of so many packets; 0: a usual number."""
    if isinstance(spec, VelodyneSpec):
        return _velodyne(spec, packets or 24)
    if isinstance(spec, HesaiSpec):
        return _hesai(spec, packets or _HESAI_COLUMNS // spec.groups)
    return _robosense(spec, packets or 12)


def fired(lidar: Lidar, headers: ColumnHeaders) -> tuple[I64Array, F64Array, BoolArray]:
    """(columns, channels): when a beam fires, ns, the rotor's angle then, and whether it does."""
    angle, speed, table = read_rotor_words(headers.encoder.reshape(-1))
    own_ns = lidar.firing_ns[table]
    after_ns = np.maximum(own_ns, 0)
    turned: F64Array = angle[:, None] + speed[:, None] * after_ns
    return headers.stamp_ns.reshape(-1)[:, None] + after_ns, turned, own_ns >= 0


def pointing(lidar: Lidar, angle: F64Array) -> tuple[F64Array, F64Array]:
    """Directions and origins (columns, channels, 3) of beams at these angles, in float64."""
    cosine, sine = np.cos(angle)[..., None], np.sin(angle)[..., None]
    direction, origin = (
        cosine * vectors[0] + sine * vectors[1] + vectors[2]
        for vectors in (lidar.beams.direction, lidar.beams.origin)
    )
    return direction, origin


def _sent(spec: Spec, counts: I64Array, level: I64Array) -> tuple[U8Array, I64Array]:
    """Packets, as rows of a wider buffer, and their receive times."""
    sent = encoded(spec, counts, level)
    wide = np.pad(rows([payload for _, payload in sent]), ((0, 0), (0, _MORE_BYTES)))
    return wide[:, :-_MORE_BYTES], np.array([at for at, _ in sent])


def _velodyne(spec: VelodyneSpec, packets: int) -> Encoded:
    rng = np.random.default_rng(7)
    table = spec.table
    size = shape(spec, packets)
    counts = np.where(rng.random(size) < 0.2, 0, rng.integers(1, 65536, size))
    level = rng.integers(0, 256, size)
    columns = np.arange(size[0])
    truth = Truth(
        counts,
        level,
        table.unit_m,
        velodyne.firing_times_ns(spec, columns),
        np.ones(size[:2], np.bool_),
        velodyne.directions(spec, columns),
        velodyne.origins(spec, columns),
        np.array(table.dist_m),
    )
    return Encoded(truth, *_sent(spec, counts, level), velodyne_calibration(spec.model))


def velodyne_calibration(model: str) -> Calibration:
    """The table of a model, or a file of the unit."""
    if model in PLAIN:
        return next(one for one in built_in() if one.model == model)
    return named(model, from_file(calibration_yaml(model), "unit.yaml"))


def _hesai(spec: HesaiSpec, packets: int) -> Encoded:
    random = np.random.default_rng(7)
    size = shape(spec, packets)
    counts = random.integers(100, 30000, size)
    counts[random.random(size) < 0.1] = 0
    fires = hesai.fires(spec, size[0])
    counts *= fires[:, :, None]
    level = random.integers(0, 256, size)
    beams, name, content = hesai_unit(spec.model, size[1])
    # When the beams of a JT16 fire is not known.
    direction = hesai.directions(spec, beams, size[0], turning=spec.model != "JT16")
    truth = Truth(
        counts,
        level,
        spec.row.unit_mm / 1000,
        hesai.firing_times_ns(spec, size[0]),
        fires,
        direction,
        np.zeros_like(direction),
        np.zeros(size[1]),
    )
    return Encoded(truth, *_sent(spec, counts, level), from_file(content, name))


def _robosense(spec: RobosenseSpec, packets: int) -> Encoded:
    random = np.random.default_rng(3)
    size = shape(spec, packets)
    bits = 14 if spec.model.startswith("Airy") else 16
    counts, level = random.integers(0, 1 << bits, size), random.integers(0, 256, size)
    sent, host_ns = _sent(spec, counts, level)
    angles, columns = robosense.fan(spec), np.arange(size[0])
    # A unit that turns the other way takes its corrections backwards, too.
    sense = -1 if spec.is_reversed else 1
    own = robosense.Angles(angles.elevation_deg, sense * angles.azimuth_deg)
    if spec.columns_per_packet % 1:
        # A packet cannot contain both returns of all its columns: each is a column of its own.
        columns = columns.repeat(2)
        counts, level = (
            values.transpose(0, 2, 1).reshape(-1, size[1], 1) for values in (counts, level)
        )
    truth = Truth(
        counts,
        level,
        spec.range_unit_m,
        robosense.firing_times_ns(spec, columns),
        np.ones(counts.shape[:2], np.bool_),
        robosense.directions(spec, own, columns),
        robosense.origins(spec, columns),
        np.zeros(size[1]),
    )
    neighbours = difops_of(robosense.difop(spec, angles))
    best = best_of(evidence_of(sent, host_ns, neighbours))
    return Encoded(truth, sent, host_ns, best, neighbours, len(sent))
