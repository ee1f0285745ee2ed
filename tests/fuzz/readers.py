"""Targets: every container, from the first byte of a file to its last packet and message."""

from __future__ import annotations

import contextlib
import gzip
import importlib
import itertools
import random
import struct
import tempfile
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import zstandard

from mlbatch.readers import open_recording
from mlbatch.readers.capture.recording import CaptureRecording
from mlbatch.types import PacketBatch, Recording, StreamTable
from tests.builders import mcaps, rosbag1
from tests.builders.bags import Recorded, fixture_messages
from tests.builders.captures import (
    ETHERNET,
    Interface,
    Other,
    Packet,
    Section,
    pcap_bytes,
    section_bytes,
    udp_frame,
)
from tests.builders.rosbag2 import Form, write_folder, write_rosbag2
from tests.builders.traffic import frames
from tests.fuzz.harness import BrokenLaw, Target
from tests.fuzz.mutation import Seeds, mutated, mutated_text

# Enough for fragments of both lidars and for packets of every kind.
_RECORDS = 40
_MESSAGES = 24
_BUFFERS = (9_000, 50_000, 4 << 20)
_CHUNK, _LZ4, _ZSTD = 0x06, "lz4", "zstd"
_MAGIC_BYTES = 8
# It comes without types.
_lz4 = importlib.import_module("lz4.frame")


def read_all(recording: Recording, streams: StreamTable) -> None:
    """Read a recording twice, with the messages of all topics; then only its first batch."""
    recording.keep = frozenset(topic.name for topic in recording.topics)
    for most in (None, None, 1):
        with contextlib.closing(recording.packets()) as packets:
            for batch in itertools.islice(packets, most):
                check_batch(batch, streams)
        counts = recording.counts
        if counts.frames != counts.datagrams + sum(counts.skipped.values()):
            raise BrokenLaw(f"frames are forgotten or invented: {counts}")


def check_batch(batch: PacketBatch, streams: StreamTable) -> None:
    """Payloads are within the bytes, and streams are known."""
    if not len(batch):
        return
    end = batch.start + batch.size
    if int(batch.start.min()) < 0 or int(batch.size.min()) < 0 or int(end.max()) > len(batch.data):
        raise BrokenLaw("a payload beyond the bytes of its batch")
    if int(batch.stream.min()) < 0 or int(batch.stream.max()) >= len(streams.streams):
        raise BrokenLaw("a stream without a name")
    if batch.host_ns.dtype != np.int64:
        raise BrokenLaw("receive times that are no int64")


def _read_file(name: str, data: bytes, folder: Path) -> None:
    path = folder / name
    path.write_bytes(data)
    streams = StreamTable()
    recording = open_recording(path, streams)
    if isinstance(recording, CaptureRecording):
        recording.buffer_bytes = _BUFFERS[len(data) % len(_BUFFERS)]
    read_all(recording, streams)


# -- captures -------------------------------------------------------------------------------------


@lru_cache(maxsize=1)
def capture_records() -> tuple[tuple[int, bytes], ...]:
    every = frames(300_000_000)
    foreign = [record for record in every if len(record[1]) < 200][:8]
    payload = bytes(range(200))
    whole = [
        (every[0][0], frame)
        for six in (False, True)
        for frame in udp_frame(
            payload * 10, "fe80::1" if six else "10.0.0.1", "fe80::2" if six else "10.0.0.2"
        )
    ]
    return tuple(sorted([*every[:_RECORDS], *foreign, *whole]))


def _pcaps() -> Seeds:
    small = [record for record in capture_records() if len(record[1]) < 400]
    return (
        pcap_bytes(capture_records()),
        pcap_bytes(small),
        pcap_bytes(small, ns=False),
        pcap_bytes(small, big_endian=True),
        pcap_bytes([]),
    )


def _pcapngs() -> Seeds:
    blocks = [Packet(frame, host_ns) for host_ns, frame in capture_records()[:_RECORDS]]
    small = [block for block in blocks if len(block.frame) < 400][:12]
    mixed: list[Packet | Other | Interface] = [*small[:3], Other(4, bytes(32)), *small[3:]]
    return (
        section_bytes(Section(blocks)),
        section_bytes(Section(mixed)),
        section_bytes(Section(mixed, big_endian=True)) + section_bytes(Section(small)),
        section_bytes(Section(small, interfaces=[Interface(ETHERNET), Interface(101)])),
        section_bytes(Section([])),
    )


def _compressed(rng: random.Random, seeds: Seeds) -> bytes:
    """A mutated file that is whole as compressed data, or the other way round."""
    data = mutated(rng, seeds) if rng.random() < 0.7 else rng.choice(seeds)
    packed = rng.choice(_PACKERS)(data)
    return mutated(rng, (packed,)) if rng.random() < 0.5 else packed


_PACKERS: tuple[Callable[[bytes], bytes], ...] = (
    partial(gzip.compress, compresslevel=1, mtime=0),
    lambda data: gzip.compress(data[:500], 1, mtime=0) + gzip.compress(data[500:], 1, mtime=0),
    lambda data: zstandard.ZstdCompressor(level=1).compress(data),
    lambda data: zstandard.ZstdCompressor(level=1, write_checksum=True).compress(data),
)


def _containers() -> Seeds:
    """One of each kind, to be compressed."""
    return (*_pcaps()[1:3], _pcapngs()[1], _mcaps()[0], _bags()[0], _databases()[0])


# -- bags -----------------------------------------------------------------------------------------


@lru_cache(maxsize=4)
def _messages(encoding: str) -> list[Recorded]:
    """The first messages of each topic."""
    found: list[Recorded] = []
    seen: dict[str, int] = {}
    for message in fixture_messages(encoding):
        seen[message.topic] = seen.get(message.topic, 0) + 1
        if seen[message.topic] <= 3:
            found.append(message)
    return found[:_MESSAGES]


def _file(write: Callable[[Path], object], suffix: str) -> bytes:
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / f"seed{suffix}"
        write(path)
        return path.read_bytes()


@lru_cache(maxsize=1)
def _mcaps() -> Seeds:
    forms = [*mcaps.FORMS.values(), mcaps.Form(chunk_bytes=500)]
    seeds = []
    for number, form in enumerate(forms):
        messages = _messages(form.encoding)
        small = [message for message in messages if len(message.data) < 3000]
        sent = messages if number < 2 else small
        write = partial(mcaps.write_mcap, messages=sent, form=form)
        seeds.append(_file(write, ".mcap"))
    return tuple(seeds)


def mutated_mcap(rng: random.Random, seeds: Seeds) -> bytes:
    """Bytes anywhere, or the records within a chunk, which is then packed and measured anew."""
    data = rng.choice(seeds)
    parts = _mcap_records(data)
    chunks = [at for at, (op, body) in enumerate(parts) if op == _CHUNK]
    if not chunks or rng.random() < 0.4:
        return mutated(rng, seeds)
    for at in chunks:
        op, body = parts[at]
        parts[at] = op, _packed_chunk(rng, _chunk_content(body), body[:16])
    joined = b"".join(struct.pack("<BQ", op, len(body)) + body for op, body in parts)
    whole = data[:_MAGIC_BYTES] + joined + data[:_MAGIC_BYTES]
    return mutated(rng, (whole,)) if rng.random() < 0.1 else whole


def _mcap_records(data: bytes) -> list[tuple[int, bytes]]:
    """Records of a sound file: opcode and content (MCAP specification, Records)."""
    at, found = _MAGIC_BYTES, []
    while at + 9 <= len(data) - _MAGIC_BYTES:
        op, size = struct.unpack_from("<BQ", data, at)
        found.append((op, data[at + 9 : at + 9 + size]))
        at += 9 + size
    return found


def _chunk_content(body: bytes) -> bytes:
    """Records of a chunk: times u64 x 2, size u64, crc u32, compression, size u64, bytes."""
    (size,) = struct.unpack_from("<I", body, 28)
    packed = body[32 + size + 8 :]
    if body[32 : 32 + size] == _LZ4.encode():
        content: bytes = _lz4.decompress(packed)
        return content
    if body[32 : 32 + size] == _ZSTD.encode():
        return zstandard.ZstdDecompressor().decompress(packed)
    return packed


def _packed_chunk(rng: random.Random, content: bytes, times: bytes) -> bytes:
    content = mutated(rng, (content,))
    word = rng.choice((b"", b"lz4", b"zstd", b"zstd", b"lz4", b"bz2"))
    packed = content
    if word == b"lz4":
        packed = _lz4.compress(content)
    elif word == b"zstd":
        packed = zstandard.ZstdCompressor(level=1).compress(content)
    if rng.random() < 0.2:
        packed = mutated(rng, (packed,))
    size = rng.choice((len(content),) * 8 + (0, len(content) + 1, 1 << 32, (1 << 64) - 1))
    head = times + struct.pack("<QII", size, 0, len(word)) + word
    return head + struct.pack("<Q", len(packed)) + packed


@lru_cache(maxsize=1)
def _bags() -> Seeds:
    messages = _messages("ros1")
    small = [message for message in messages if len(message.data) < 3000]
    seeds = []
    for compression in ("none", "bz2", "lz4"):
        write = partial(
            rosbag1.write_rosbag1, messages=small, compression=compression, chunk_bytes=2000
        )
        seeds.append(_file(write, ".bag"))
    whole = _file(partial(rosbag1.write_rosbag1, messages=messages), ".bag")
    return (*seeds, whole, rosbag1.without_index(seeds[0]), rosbag1.open_chunk(seeds[0]))


@lru_cache(maxsize=1)
def _databases() -> Seeds:
    messages = _messages("cdr")
    small = [message for message in messages if len(message.data) < 3000]
    forms = (Form(), Form(schema=4), Form(index=False), Form(zstd_messages=True))
    seeds = [_file(partial(write_rosbag2, messages=small, form=form), ".db3") for form in forms]
    return (*seeds, _file(partial(write_rosbag2, messages=messages), ".db3"))


@lru_cache(maxsize=1)
def _folder_parts() -> tuple[bytes, bytes]:
    """metadata.yaml and the file of a folder of one file."""
    with tempfile.TemporaryDirectory() as name:
        small = [message for message in _messages("cdr") if len(message.data) < 3000]
        folder = write_folder(Path(name) / "bag", [small])
        return (folder / "metadata.yaml").read_bytes(), (folder / "bag_0.db3").read_bytes()


def _metadata() -> Seeds:
    text = _folder_parts()[0]
    more = text.replace(b"  - bag_0.db3", b"  - bag_0.db3\n  - ../bag/bag_0.db3\n  - bag_1.db3")
    packed = text + b"  compression_format: zstd\n  compression_mode: FILE\n"
    return (text, more, packed, b"", b"rosbag2_bagfile_information: {}\n")


def _read_folder(data: bytes, folder: Path) -> None:
    bag = folder / "bag"
    bag.mkdir(exist_ok=True)
    if not (bag / "bag_0.db3").exists():
        (bag / "bag_0.db3").write_bytes(_folder_parts()[1])
    (bag / "metadata.yaml").write_bytes(data)
    streams = StreamTable()
    read_all(open_recording(bag, streams), streams)


def _file_target(
    name: str,
    seeds: Callable[[], Seeds],
    mutate: Callable[[random.Random, Seeds], bytes] = mutated,
    share: int = 10,
) -> Target:
    return Target(f"read {name}", seeds, partial(_read_file, f"a.{name}"), mutate, share)


TARGETS: Sequence[Target] = (
    _file_target("pcap", _pcaps, share=14),
    _file_target("pcapng", _pcapngs, share=14),
    _file_target("compressed", _containers, _compressed),
    _file_target("mcap", _mcaps, mutated_mcap, share=14),
    _file_target("bag", _bags, share=12),
    _file_target("db3", _databases, share=12),
    Target("read folder", _metadata, _read_folder, mutated_text, 3),
)
