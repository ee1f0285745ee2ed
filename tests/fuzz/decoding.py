"""What any packets may give once a lidar was made for them: the laws of `Lidar`, checked."""

from __future__ import annotations

import random
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from mlbatch import sensors
from mlbatch.arrays import I64Array, U8Array
from mlbatch.discovery.match import best_fits, match
from mlbatch.discovery.sampler import Sampler
from mlbatch.errors import MlbatchError
from mlbatch.lidar.geometry import read_rotor_words
from mlbatch.lidar.interface import FAULTS, Calibration, Lidar
from mlbatch.types import ColumnHeaders, PacketBatch, Stream, StreamTable
from tests.builders.decoded import readings
from tests.builders.vendors import wrongly_excluded
from tests.fuzz.framing import Part
from tests.fuzz.harness import BrokenLaw

# What a parser of a fuzzed table could return; none of ours has so many.
_MOST_COLUMNS = 4096
# A ring is a uint16.
_MOST_RINGS = 1 << 16
_DECODE: Sequence[Mapping[str, str]] = (
    {},
    {},
    {"crc": "check"},
    {"firing_azimuth": "off"},
    {"optical_centre": "on", "vertical_offset": "off"},
    {"packet_stamp": "start"},
    {"packet_stamp": "end"},
)


def sampled(parts: Iterable[Part], topic: str = "") -> Sampler:
    """Datagrams of one source as a first look at a recording takes them."""
    table = StreamTable()
    sampler = Sampler(table)
    rows = list(parts)
    if not rows:
        return sampler
    sizes = np.array([len(part.data) for part in rows], np.int64)
    streams = [
        table.number(Stream(topic=topic) if topic else Stream("192.168.1.201", part.kind))
        for part in rows
    ]
    data = np.frombuffer(b"".join(part.data for part in rows) or b"\0", np.uint8)
    host_ns = np.array([part.host_ns for part in rows], np.int64)
    start = np.cumsum(sizes) - sizes
    sampler.add(PacketBatch(data, start, sizes, np.array(streams, np.int64), host_ns))
    return sampler


def decode_samples(
    sampler: Sampler, calibrations: Sequence[Calibration], rng: random.Random
) -> None:
    """Find the sensors of a first look, by a model that a rig names or without; decode them."""
    options = rng.choice(_DECODE)
    every = [*calibrations, *sensors.built_in()]
    model, is_rigged = rng.choice(sensors.models()).name, rng.random() < 0.4
    for kind in sampler.kinds:
        evidence = sampler.evidence(kind)
        text = sensors.describe(evidence.size, evidence.sample)
        if text is not None and (not text.isprintable() or len(text) > 500):
            raise BrokenLaw(f"packets are described as {text!r}")
        if excluded := wrongly_excluded(evidence):
            raise BrokenLaw(f"packets that {excluded} know, though `may_send` is False")
        if is_rigged:
            fits, _ = best_fits(evidence, every, options, model)
            for fit in fits[:2]:
                check_lidar(fit.lidar, evidence.sample, evidence.host_ns)
    if is_rigged:
        return
    for found in match(sampler, calibrations, options).sensors:
        for kind in found.kinds:
            evidence = sampler.evidence(kind)
            check_lidar(found.lidar, evidence.sample, evidence.host_ns)
        sampler.clock_offset_ns(found)


def check_lidar(lidar: Lidar, sample: U8Array, host_ns: I64Array) -> None:
    """Packets through all that a lidar does with them; sample: (P, size), also of other sizes."""
    _check_description(lidar)
    if lidar.is_imu(sample.shape[1]):
        lidar.imu(sample, 0)
    if sample.shape[1] < lidar.packet_size:
        return
    packets = np.ascontiguousarray(sample[:, : lidar.packet_size])
    faults, owns, keys = lidar.faults(packets), lidar.sent_by_me(packets), lidar.sequence(packets)
    if not faults.shape == owns.shape == keys.shape == (len(packets),):
        raise BrokenLaw("verdicts of another shape than (packets,)")
    if int(faults.max(initial=0)) >= len(FAULTS):
        raise BrokenLaw("a fault without a name")
    good = packets[faults == 0]
    # A batch of damaged packets alone leaves none.
    nothing = packets[:0]
    for verdict in (lidar.sent_by_me, lidar.faults, lidar.sequence):
        verdict(nothing)
    none = lidar.column_headers(nothing, host_ns[:0])
    if none.stamp_ns.shape != (0, lidar.columns_per_packet):
        raise BrokenLaw("headers of no packets of another shape than (0, columns)")
    if lidar.sequence_modulus and int(keys.max(initial=0)) >= lidar.sequence_modulus:
        raise BrokenLaw(f"number {int(keys.max())} of a count below {lidar.sequence_modulus}")
    headers = lidar.column_headers(packets, host_ns)
    _check_heads(lidar, headers, faults == 0)
    if len(packets):
        alone = lidar.column_headers(packets[-1:], host_ns[-1:])
        if not np.array_equal(alone.stamp_ns[0], headers.stamp_ns[-1]):
            raise BrokenLaw("stamps of a packet depend on the packets before it")
    if len(good):
        _check_pixels(lidar, good[:4])


def _check_description(lidar: Lidar) -> None:
    """Sizes fit each other, and every number of the geometry is finite."""
    last = lidar.columns_per_packet - 1
    at = lidar.records
    end = at.start + last // at.per_row * at.stride + last % at.per_row * at.step + at.size
    if not (0 <= last < _MOST_COLUMNS and at.start >= 0 and end <= lidar.packet_size):
        raise BrokenLaw(f"columns reach to byte {end} of packets of {lidar.packet_size}")
    beams = lidar.beams
    for name, values in (("U", beams.direction), ("O", beams.origin), ("reach", beams.reach_m)):
        if not np.isfinite(values).all():
            raise BrokenLaw(f"geometry that is not finite: {name}")
    if lidar.firing_ns.shape[1] != lidar.channels or int(lidar.firing_ns.max()) > 10**9:
        raise BrokenLaw("firing times of other channels, or later than 1 s")
    for row in np.atleast_2d(lidar.channel):
        if len(np.unique(row)) != lidar.channels or row.min() < 0 or row.max() >= _MOST_RINGS:
            raise BrokenLaw("channels of the output that are not distinct numbers of a ring")


def _check_heads(
    lidar: Lidar, headers: ColumnHeaders, good: np.ndarray[tuple[int], np.dtype[np.bool_]]
) -> None:
    shape = (len(good), lidar.columns_per_packet)
    if not headers.stamp_ns.shape == headers.encoder.shape == headers.valid.shape == shape:
        raise BrokenLaw(f"headers of another shape than {shape}")
    if headers.stamp_ns.dtype != np.int64 or headers.valid.dtype != np.bool_:
        raise BrokenLaw("headers of other types than int64 and bool")
    encoder = headers.encoder[good[:, None] & headers.valid]
    if lidar.beams.angle_rad is None:
        _, _, table = read_rotor_words(encoder)
        low, high, count = table.min(initial=0), table.max(initial=0), len(lidar.firing_ns)
    else:
        low, high, count = (
            encoder.min(initial=0),
            encoder.max(initial=0),
            len(lidar.beams.angle_rad),
        )
    if not 0 <= low <= high < count:
        raise BrokenLaw(f"rotor positions or tables {low} to {high}, though there are {count}")


def _check_pixels(lidar: Lidar, packets: U8Array) -> None:
    found = readings(lidar, packets)
    if not (np.isfinite(found.range_m).all() and (found.range_m >= 0).all()):
        raise BrokenLaw("ranges that are negative or not finite")
    if not np.isfinite(found.intensity).all():
        raise BrokenLaw("intensities that are not finite")
    if not np.isfinite(found.xyz[found.range_m > 0]).all():
        raise BrokenLaw("points that are not finite")


def try_all(calibration: Calibration, rng: random.Random) -> list[Lidar]:
    """What a calibration gives without packets; errors of mlbatch are answers, too."""
    found = []
    for options in rng.sample(list(_DECODE), 2):
        try:
            lidar = calibration.lidar(options, None)
        except MlbatchError:
            continue
        _check_description(lidar)
        found.append(lidar)
    return found
