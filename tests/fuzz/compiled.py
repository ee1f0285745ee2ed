"""Targets: compiled loops called directly, on mutated bytes; numpy must find the same.

Quick enough for a million inputs with the sanitizers (`make fuzz-sanitized`).
"""

from __future__ import annotations

import contextlib
import random
import struct
import tempfile
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from mlbatch.arrays import U8Array
from mlbatch.batching.merge import ColumnMerge
from mlbatch.decode.groups import Source
from mlbatch.decode.packet_ring import PacketRing
from mlbatch.lidar.headers import content_keys, hash_factors
from mlbatch.lidar.interface import Lidar
from mlbatch.motion.se3 import exp_rotation
from mlbatch.native.arena import PacketArena
from mlbatch.native.library import trouble
from mlbatch.pipeline.sensor import new_ring
from mlbatch.readers.capture.dissector import Dissector
from mlbatch.readers.capture.frames import Frames
from mlbatch.ros.point_packets import CloudError, Layout, Points, layout_of, pack
from mlbatch.ros.point_rows import Rows, take_rows
from mlbatch.simulate.ouster.encode import OusterSpec
from mlbatch.simulate.velodyne.encode import VelodyneSpec
from mlbatch.types import (
    EXTRAS,
    CaptureCounts,
    Columns,
    RunInfo,
    SensorInfo,
    StreamTable,
    Window,
    WindowColumns,
)
from tests.builders.captures import udp_frame
from tests.builders.decoded import rotor_words
from tests.builders.engines import BOXES_M, Pair
from tests.builders.spinning import PLAIN, check_headers, ouster_packets, stream_of
from tests.decode.test_engine import (
    END_NS,
    NAMES,
    OTHERS,
    PACKED,
    POSES,
    START_NS,
    Packing,
    lidar_of,
    ouster,
    packets_of,
    words_of,
)
from tests.fuzz.harness import BrokenLaw, Target
from tests.fuzz.mutation import Seeds, mutated
from tests.fuzz.readers import capture_records
from tests.reference.capture import ODD, Frame, dissect
from tests.reference.clouds import packets_of as cloud_packets
from tests.reference.clouds import taken_rows

if not trouble():
    from mlbatch.ros.point_rows import RowPacker

# Mostly Ethernet.
_LINKS = (1, 1, 1, 1, 1, 1, 101, 113, 276, 0)
_PACKETS = 3
_COLUMNS = 40
_HEAD = struct.Struct("<I")
_SIZE = struct.Struct("<H")
_MOST_BYTES = 2000

# -- pixels ---------------------------------------------------------------------------------------


@lru_cache(maxsize=1)
def _lidars() -> Sequence[Lidar]:
    with tempfile.TemporaryDirectory() as name:
        others = [lidar_of(spec, Path(name)) for spec in OTHERS]
    # The loops have a case for 128 beams.
    return (*(ouster(name, beams) for beams in (16, 128) for name in NAMES), *others)


@lru_cache(maxsize=1)
def _pixel_seeds() -> Seeds:
    """Of each lidar three packets behind a number, which chooses the rest of a case."""
    rng = np.random.default_rng(5)
    return tuple(
        _HEAD.pack(number) + packets_of(lidar, rng, _PACKETS).tobytes()
        for number, lidar in enumerate(_lidars())
        for _ in range(3)
    )


@lru_cache(maxsize=128)
def _pair(
    number: int, layout: str, *, is_cut: bool, keeps_repeated: bool, is_packed: bool
) -> tuple[Pair | Packing, PacketRing]:
    """Both decoders for one lidar, of arrays or of packed records."""
    lidar = _lidars()[number]
    pose = POSES[number % len(POSES)]
    ring = new_ring(lidar, PacketArena())
    low_m, high_m = (1.0, 60.0) if is_cut else (0.0, float("inf"))
    sources = [Source(lidar, ring, pose, 0, low_m, high_m, keeps_repeated)]
    info = SensorInfo("one", lidar.model, lidar.channels, lidar.returns, 0, pose)
    run = RunInfo((info,), "base_link", "10", "utc", 1, layout)
    boxes_m = np.array(BOXES_M if is_cut else ()).reshape(-1, 6)
    if is_packed:
        names = [name for name in PACKED if name != "las" or layout == "dense"]
        return Packing(run, sources, boxes_m, names[number % len(names)]), ring
    return Pair(run, sources, boxes_m, EXTRAS), ring


def _decode(data: bytes, folder: Path) -> None:
    """Columns of packets of any bytes, in any order and at any position of the rotor."""
    data = data.ljust(_HEAD.size, b"\0")
    (number,) = _HEAD.unpack_from(data)
    lidar = _lidars()[number % len(_lidars())]
    rng = np.random.default_rng(number)
    layout = str(rng.choice(("dense", "organized")))
    is_cut, keeps_repeated, is_packed = (rng.random(3) < 0.5).tolist()
    pair, ring = _pair(
        number % len(_lidars()),
        layout,
        is_cut=is_cut,
        keeps_repeated=keeps_repeated,
        is_packed=is_packed,
    )
    size = lidar.packet_size * _PACKETS
    packets = np.frombuffer(data[_HEAD.size :].ljust(size, b"\0")[:size], np.uint8)
    places = ring.keep(packets, np.arange(_PACKETS) * lidar.packet_size).ring_index
    every = (places[:, None] + ring.column_offsets(lidar.columns_per_packet)).reshape(-1)
    place = rng.choice(every, _COLUMNS)
    word = words_of(lidar, rng, _COLUMNS)
    stamp_ns = np.sort(rng.integers(START_NS, END_NS, _COLUMNS))
    moves = None
    if rng.random() < 0.3:
        # Rigid ones: others may move far points near, with the rounding of far ones.
        turns = exp_rotation(rng.normal(size=(_COLUMNS, 3)))
        shifts_m = rng.normal(size=(_COLUMNS, 3, 1))
        moves = np.concatenate([turns, shifts_m], axis=2).astype(np.float32)
    columns = WindowColumns(stamp_ns, np.zeros(_COLUMNS, np.int64), place, word, moves)
    pair.check(Window(0, 0, START_NS, END_NS, True, 0, columns))


# -- headers --------------------------------------------------------------------------------------


@lru_cache(maxsize=1)
def _headed() -> Sequence[tuple[Lidar, U8Array]]:
    """Lidars whose headers the loops read, and packets of them."""
    specs = [OusterSpec(name, 16, 512) for name in NAMES]
    streams = [stream_of(VelodyneSpec(model, mode)) for model in PLAIN for mode in ("last", "dual")]
    return (
        *(ouster_packets(spec) for spec in specs),
        *((one.lidar(), one.packets[:3]) for one in streams),
    )


def _header_seeds() -> Seeds:
    """Packets of each lidar behind its number."""
    return tuple(
        _HEAD.pack(number) + packets.tobytes() for number, (_, packets) in enumerate(_headed())
    )


def _read_headers(data: bytes, folder: Path) -> None:
    """Headers of packets of any bytes."""
    data = data.ljust(_HEAD.size, b"\0")
    (number,) = _HEAD.unpack_from(data)
    lidar, packets = _headed()[number % len(_headed())]
    whole = np.frombuffer(data[_HEAD.size :].ljust(packets.size, b"\0")[: packets.size], np.uint8)
    host_ns = START_NS + 10**9 * np.arange(len(packets)) * (number % 41)
    check_headers(lidar, whole.reshape(packets.shape), host_ns)


# -- frames ---------------------------------------------------------------------------------------


def _framed(frames: Sequence[bytes]) -> bytes:
    return b"".join(_SIZE.pack(len(one)) + one for one in frames)


def _frames_of(data: bytes) -> list[bytes]:
    found, at = [], 0
    while at + _SIZE.size <= len(data):
        at += _SIZE.size
        found.append(data[at : at + _SIZE.unpack_from(data, at - _SIZE.size)[0]])
        at += len(found[-1])
    return found


def _frame_seeds() -> Seeds:
    """Frames of datagrams, whole, in fragments and of other kinds, each behind its size."""
    rng = random.Random(5)
    every = [frame for _, frame in capture_records()]
    parts = [udp_frame(rng.randbytes(500), ident=ident, mtu=220) for ident in (7, 7, 8)]
    together = [frame for datagram in parts for frame in datagram]
    apart = [frame for three in zip(*parts, strict=True) for frame in three]
    seeds = [_framed(rng.choices(every, k=6)) for _ in range(20)]
    return (*seeds, *[_framed(together)] * 6, _framed([*apart, *together]))


def _mutated_frames(rng: random.Random, seeds: Seeds) -> bytes:
    """Change some frames, all alike or each in its way."""
    frames = _frames_of(rng.choice(seeds))
    for at in rng.sample(range(len(frames)), rng.choice((1, 1, 2, 6))):
        frames[at] = mutated(rng, (frames[at],))[:_MOST_BYTES]
    return _framed(frames)


def _dissect(data: bytes, folder: Path) -> None:
    """The literal dissector finds the same in frames; nothing beyond the last one is read."""
    pieces = _frames_of(data)
    captured = np.array([len(one) for one in pieces], np.int64)
    link = np.array([_LINKS[size % len(_LINKS)] for size in captured.tolist()], np.int64)
    original = captured + (captured % 7 == 3)
    host_ns = 10**9 + np.arange(len(pieces)) * 1000 - 3000 * (captured % 2)
    front = int(captured.sum())
    bytes_ = np.frombuffer(bytes(front) + b"".join(pieces), np.uint8).copy()
    start = front + captured.cumsum() - captured
    counts, streams = CaptureCounts(), StreamTable()
    dissector = Dissector(counts, streams)
    datagrams, _ = dissector.push(bytes_, Frames(start, captured, original, link, host_ns))
    dissector.finish()
    rows = zip(*(column.tolist() for column in datagrams), strict=True)
    found = [
        (at_ns, str(streams.streams[stream]), bytes_[at : at + size].tobytes())
        for at, size, stream, at_ns in rows
    ]
    columns = (host_ns.tolist(), link.tolist(), pieces, original.tolist())
    expected, skipped = dissect(Frame(*row) for row in zip(*columns, strict=True))
    if ODD in skipped:
        return
    if (found, counts.skipped) != (expected, skipped):
        raise BrokenLaw("compiled loops find other datagrams than the literal dissector")


# -- clouds ---------------------------------------------------------------------------------------

_CLOUD_ROW = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "intensity")]
    + [("time", "<u4"), ("ring", "<u2"), ("tag", "u1")]
)


def _cloud_seeds() -> Seeds:
    """Rows of clouds by column and by ring."""
    rows = np.zeros((40, 16), _CLOUD_ROW)
    rows["x"] = 10 + np.arange(16)
    rows["ring"] = np.arange(16)
    rows["time"] = 55_296 * np.arange(40)[:, None]
    return rows.tobytes(), rows.T.tobytes(), rows[::-1].tobytes()


def _cloud(data: bytes, folder: Path) -> None:
    """Rows of any bytes, taken and packed."""
    count = len(data) // _CLOUD_ROW.itemsize
    rows = np.frombuffer(data[: count * _CLOUD_ROW.itemsize], _CLOUD_ROW)
    one, other = taken_rows(rows), take_rows(rows)
    if (one.placed, one.reals.tobytes()) != (other.placed, other.reals.tobytes()):
        raise BrokenLaw("compiled loops take other points than literally")
    for role, values in one.fields.items():
        if values.tobytes() != other.fields[role].tobytes():
            raise BrokenLaw(f"compiled loops take another {role} than literally")
    if not len(one.reals[0]):
        return
    ring, tag = one.fields["ring"], one.fields["tag"]
    stamp_ns = START_NS + one.fields["time"].astype(np.int64)
    points = Points(stamp_ns, one.reals, ring.astype(np.uint16), np.zeros_like(tag), tag)
    layout = layout_of(points, 0)
    with contextlib.suppress(CloudError):
        if pack(points, layout, 1 << 22).tobytes() != cloud_packets(points, layout).tobytes():
            raise BrokenLaw("compiled loops pack other columns than literally")
    _pack_at_once(rows)


def _pack_at_once(rows: Rows) -> None:
    """Rows whose rings fit, straight to packets, unless they are unusual."""
    layout = Layout(0, 16, by_ring=True)
    rows = rows.copy()
    rows["ring"] %= layout.slots
    factors = hash_factors(layout.size // 8)
    found = RowPacker().pack(
        rows,
        lambda time: (START_NS + time.astype(np.int64), ""),
        layout,
        1 << 22,
        lambda count, size: np.full((count, size), 0xA5, np.uint8),
        factors,
    )
    if found is None:
        return
    one = taken_rows(rows)
    stamp_ns = START_NS + one.fields["time"].astype(np.int64)
    tag = one.fields["tag"]
    points = Points(stamp_ns, one.reals, one.fields["ring"], np.zeros_like(tag), tag)
    expected = cloud_packets(points, layout)
    if found.packets.tobytes() != expected.tobytes():
        raise BrokenLaw("compiled loops pack rows at once to other columns than literally")
    if (found.placed, found.points) != (one.placed, len(points)):
        raise BrokenLaw("compiled loops count other points than numpy")
    keys = found.content_key
    if keys is None or keys.tolist() != content_keys(expected).tolist():
        raise BrokenLaw("compiled loops give packets other keys than numpy")


# -- columns --------------------------------------------------------------------------------------

_SENSORS = 3
_ROW = struct.Struct("<BbH")
_POSITIONS = (512, None, 8)


def _stamp_seeds() -> Seeds:
    """Rows of a sensor, a step in time and a position."""
    rng = random.Random(5)
    return tuple(
        b"".join(
            _ROW.pack(rng.randrange(_SENSORS), rng.choice((0, 1, 1, 3)), rng.randrange(512))
            for _ in range(120)
        )
        for _ in range(10)
    )


def _merge(data: bytes, folder: Path) -> None:
    """Columns of sensors in parts, with steps back in time, taken in three portions."""
    rows = [_ROW.unpack_from(data, at) for at in range(0, len(data) - 3, _ROW.size)]
    sensor = np.array([row[0] % _SENSORS for row in rows], np.int64)
    step = np.array([row[1] for row in rows], np.int64)
    ticks = np.array([row[2] for row in rows], np.int64)
    words = rotor_words(np.float64(1 / 512) * ticks, np.float64(1) * (ticks % 41) - 20.0)
    word = np.choose(sensor, (ticks % 512, words, ticks % 8))
    stamp_ns = START_NS + step.cumsum()
    portions = [int(stamp_ns[len(rows) * third // 3]) if rows else 0 for third in (1, 2)]
    places = [int(np.count_nonzero(sensor[:at] == sensor[at])) for at in range(len(sensor))]
    left = list(zip(stamp_ns.tolist(), sensor.tolist(), places, word.tolist(), strict=True))
    waiting: list[list[Columns]] = [[] for _ in range(_SENSORS)]
    for number, own in enumerate(waiting):
        is_own = sensor == number
        stamps, words = stamp_ns[is_own], word[is_own]
        half = len(stamps) // 2
        for part in (slice(None, half), slice(half, None)):
            if len(stamps[part]):
                own.append(Columns(stamps[part], np.arange(len(stamps))[part], words[part]))
    merge = ColumnMerge(_POSITIONS)
    for until in (*portions, END_NS):
        merged = merge.take_until(waiting, until)
        arrays = (merged.stamp_ns, merged.sensor, merged.ring_index, merged.encoder)
        due = sorted(one for one in left if one[0] < until)
        left = [one for one in left if one[0] >= until]
        if list(zip(*(one.tolist() for one in arrays), strict=True)) != due:
            raise BrokenLaw("columns are merged in another order than by stamp, sensor, delivery")
        ends = [len(due) // 3, len(due)]
        found = merge.figures(merged, ends)
        if sum(one.columns for window in found for one in window) != len(due):
            raise BrokenLaw("the figures of windows have other columns than the windows")


TARGETS: Sequence[Target] = (
    ()
    if trouble()
    else (
        Target("pixels, compiled", _pixel_seeds, _decode, mutated, 20),
        Target("headers, compiled", _header_seeds, _read_headers, mutated, 20),
        Target("frames, compiled", _frame_seeds, _dissect, _mutated_frames, 10),
        Target("clouds, compiled", _cloud_seeds, _cloud, mutated, 10),
        Target("columns, compiled", _stamp_seeds, _merge, mutated, 10),
    )
)
