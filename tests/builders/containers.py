"""Every kind of container, written of messages or of the packets of the fixture."""

from __future__ import annotations

import gzip
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import zstandard
from mcap.writer import IndexType

from tests.builders import mcaps, rosbag2
from tests.builders.bags import Recorded
from tests.builders.captures import Packet, Section, write_pcapng
from tests.builders.mcaps import FORMS, write_mcap
from tests.builders.rosbag1 import write_rosbag1
from tests.builders.rosbag2 import write_folder, write_rosbag2
from tests.builders.run import TWO_LIDARS
from tests.builders.sessions_of_bags import packets_only, split_at
from tests.builders.traffic import read_pcap

# A message record (opcode 5) that announces more bytes than follow.
CUT_RECORD = b"\x05" + (9000).to_bytes(8, "little") + bytes(40)


@dataclass(frozen=True, slots=True)
class Bag:
    """A kind of bag, and how messages are written to a folder; notes: of a file that is whole."""

    container: str
    encoding: str
    write: Callable[[Path, Sequence[Recorded]], Path]
    notes: int = 0


def mcap(form: mcaps.Form) -> Bag:
    """An MCAP file."""
    return Bag(
        "MCAP",
        form.encoding,
        lambda folder, messages: write_mcap(folder / "a.mcap", messages, form),
        0 if form.summary else 1,
    )


def rosbag1(compression: str, callers: int = 1, chunk_bytes: int = 100_000) -> Bag:
    """A ROS 1 bag."""
    write = partial(
        write_rosbag1, compression=compression, callers=callers, chunk_bytes=chunk_bytes
    )
    return Bag("ROS 1 bag", "ros1", lambda folder, messages: write(folder / "a.bag", messages))


def database(form: rosbag2.Form) -> Bag:
    """A single file of a ROS 2 bag."""
    return Bag(
        "ROS 2 bag (sqlite3)",
        "cdr",
        lambda folder, messages: write_rosbag2(folder / "a.db3", messages, form),
    )


def _packed(bag: Bag, squeeze: Callable[[bytes], bytes]) -> Bag:
    """The same in a compressed file."""

    def write(folder: Path, messages: Sequence[Recorded]) -> Path:
        plain = bag.write(folder, messages)
        packed = plain.with_name(f"{plain.name}.packed")
        packed.write_bytes(squeeze(plain.read_bytes()))
        plain.unlink()
        return packed

    return replace(bag, write=write)


BAGS: Mapping[str, Bag] = {
    **{f"MCAP, {name}": mcap(form) for name, form in FORMS.items()},
    "MCAP, chunks alone": mcap(mcaps.Form(index=IndexType.CHUNK, chunk_bytes=20_000)),
    **{f"ROS 1, {word}": rosbag1(word) for word in ("none", "bz2", "lz4")},
    "ROS 1, three publishers": rosbag1("lz4", callers=3),
    "ROS 1, one chunk": rosbag1("none", chunk_bytes=1 << 30),
    "ROS 2": database(rosbag2.Form()),
    "ROS 2, schema 4": database(rosbag2.Form(schema=4)),
    "ROS 2, no format": database(rosbag2.Form(serialization="")),
    "ROS 2, zstd messages": database(rosbag2.Form(zstd_messages=True)),
    "ROS 2, no index": database(rosbag2.Form(index=False)),
    "MCAP, zstd file": _packed(mcap(FORMS["no index"]), zstandard.compress),
    "ROS 1, gzip file": _packed(rosbag1("none"), gzip.compress),
    "ROS 2, zstd file": _packed(database(rosbag2.Form()), zstandard.compress),
    "ROS 2, gzip file": _packed(database(rosbag2.Form()), gzip.compress),
}


def _packets_in(bag: Bag, folder: Path) -> Path:
    return bag.write(folder, packets_only(bag.encoding))


def _pcapng(folder: Path) -> Path:
    records = read_pcap(TWO_LIDARS / "two_lidars.pcap")
    blocks = [Packet(frame, host_ns) for host_ns, frame in records]
    return write_pcapng(folder / "a.pcapng", [Section(blocks)])


def _mcap_folder(folder: Path) -> Path:
    bag = folder / "bag"
    bag.mkdir()
    for number, part in enumerate(split_at(packets_only("cdr"), 3)):
        write_mcap(bag / f"bag_{number}.mcap", part)
    return bag


_CUT = {
    "MCAP, cut off": mcaps.Form(chunked=False, summary=False, tail=CUT_RECORD),
    "MCAP, chunks cut off": mcaps.Form(summary=False, tail=CUT_RECORD),
}
# Kinds of bags that differ in more than the paths of their reader.
_OF_PACKETS = (
    *(f"MCAP, {name}" for name in ("none", "lz4", "zstd", "unchunked", "ROS 1")),
    *(f"ROS 1, {name}" for name in ("none", "bz2", "three publishers")),
    *(f"ROS 2{name}" for name in ("", ", schema 4", ", no index", ", zstd messages")),
    "ROS 2, zstd file",
)
# The packets of the fixture; the fixture itself is the pcap.
CONTAINERS: Mapping[str, Callable[[Path], Path]] = {
    "pcapng": _pcapng,
    **{name: partial(_packets_in, BAGS[name]) for name in _OF_PACKETS},
    **{name: partial(_packets_in, mcap(form)) for name, form in _CUT.items()},
    "MCAP, folder of three": _mcap_folder,
    "ROS 2, folder of three": lambda folder: write_folder(
        folder / "bag", split_at(packets_only("cdr"), 3)
    ),
}
