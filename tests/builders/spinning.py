"""Streams of spinning lidars by the encoders, what they say, and the lidars that decode them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mlbatch.arrays import BoolArray, F64Array, I64Array, U8Array
from mlbatch.lidar.geometry import read_rotor_words
from mlbatch.lidar.headers import Headers, content_keys
from mlbatch.lidar.interface import Calibration, Evidence, Lidar, NeighbourStream
from mlbatch.sensors import built_in, parse_calibration
from mlbatch.simulate.ouster.encode import OusterSpec, encode_packets, metadata_json
from mlbatch.simulate.robosense.encode import RobosenseSpec
from mlbatch.simulate.spinning import SpinningSpec
from mlbatch.simulate.velodyne.models import MODELS, calibration_yaml
from mlbatch.types import ColumnHeaders, Stream
from tests.builders.decoded import Readings, readings
from tests.builders.lidar_packets import encoded
from tests.builders.others import rows
from tests.reference.headers import read

STREAM = Stream("192.168.1.201", 2368)
DIFOP = Stream("192.168.1.201", 7788)
# Velodynes with a table of their own; an HDL-64E has a file of its unit.
PLAIN = tuple(model for model in MODELS if not model.startswith("HDL-64E"))
MODES = ("strongest", "last", "dual")
# Columns of a stream, if nothing else is said.
_COLUMNS = 420
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
    """Packets (P, size) of random readings, and a calibration for them."""

    truth: Truth
    packets: U8Array
    host_ns: I64Array
    calibration: Calibration
    neighbours: tuple[NeighbourStream, ...] = ()

    @property
    def evidence(self) -> Evidence:
        """What discovery knows of the stream."""
        return evidence_of(self.packets, self.host_ns, self.neighbours)

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


def stream_of(spec: SpinningSpec, packets: int = 0) -> Encoded:
    """A stream of so many packets; 0: a usual number, even, as two may share a column."""
    random = np.random.default_rng(7)
    size = spec.shape(packets or max(24, 2 * round(_COLUMNS / spec.columns_per_packet / 2)))
    # Less is a word, not a range, of an OT128.
    counts = random.integers(4, spec.largest + 1, size)
    counts[random.random(size) < 0.1] = 0
    fires = spec.fires(size[0])
    counts *= fires[:, :, None]
    level = random.integers(0, 256, size)
    sent = encoded(spec, counts, level)
    # They lie in a wider buffer.
    wide = rows([payload + bytes(_MORE_BYTES) for _, payload in sent])[:, :-_MORE_BYTES]
    host_ns = np.array([at for at, _ in sent])
    column = np.arange(size[0])
    if spec.columns_per_packet % 1:
        # A packet cannot contain both returns of all its columns: each is a column of its own.
        column = column.repeat(2)
        counts, level = (
            values.transpose(0, 2, 1).reshape(-1, size[1], 1) for values in (counts, level)
        )
    direction = spec.directions(size[0])
    truth = Truth(
        counts,
        level,
        spec.range_unit_m,
        spec.firing_times_ns(size[0])[column],
        fires[column],
        direction[column],
        np.broadcast_to(spec.origins(size[0]), direction.shape)[column],
        np.broadcast_to(spec.range_offset_m, size[1]),
    )
    # A Velodyne's have the time only.
    neighbours = difops_of(spec.device_packet(0)) if isinstance(spec, RobosenseSpec) else ()
    seen = evidence_of(wide, host_ns, neighbours)
    found = from_file(spec.files.content, f"unit.{spec.files.name}") if spec.files.name else None
    if spec.rig_model:
        found = named(spec.rig_model, found)
    return Encoded(truth, wide, host_ns, found or best_of(seen), neighbours)


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


def velodyne_calibration(model: str) -> Calibration:
    """The table of a model, or a file of the unit."""
    if model in PLAIN:
        return next(one for one in built_in() if one.model == model)
    return named(model, from_file(calibration_yaml(model), "unit.yaml"))


def ouster_packets(spec: OusterSpec, columns: int = 48) -> tuple[Lidar, U8Array]:
    """A lidar and whole packets of it, at the end of a frame and the start of the next."""
    lidar = ouster_calibration(spec).lidar({}, None)
    number = spec.columns_per_frame - columns // 3 + np.arange(columns)
    frame = 65535 + number // spec.columns_per_frame
    stamp_ns = 10**18 + 97_000 * np.arange(columns)
    packets = encode_packets(spec, stamp_ns, number % spec.columns_per_frame, frame % 65536, {})
    return lidar, rows(packets)


def check_headers(lidar: Lidar, packets: U8Array, host_ns: I64Array) -> Headers:
    """The loops read what the packets literally say; those begin at any byte of a buffer."""
    assert lidar.reader is not None
    size = packets.shape[1]
    buffer = np.concatenate([np.zeros(3, np.uint8), packets.reshape(-1)])
    found = lidar.reader.read(buffer, 3 + np.arange(len(packets)) * size, host_ns)
    hashes = content_keys(packets).tolist()
    for row, packet in enumerate(packets):
        seen = read(lidar.reader.table, packet.tobytes(), int(host_ns[row]))
        assert (bool(found.is_mine[row]), int(found.faults[row])) == (seen.is_mine, seen.fault)
        if not seen.is_mine or seen.fault:
            continue
        assert int(found.key[row]) == (hashes[row] if seen.key is None else seen.key)
        columns = found.columns
        arrays = (columns.stamp_ns, columns.encoder, columns.valid)
        assert list(zip(*(one[row].tolist() for one in arrays), strict=True)) == seen.columns
    return found
