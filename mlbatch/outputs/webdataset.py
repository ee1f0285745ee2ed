"""Folders of tar files with an npz and a JSON for each scan.

Headers are ustar's (POSIX.1-1988), checked by `tarfile`; extensions of later formats, which
may name any size or place, are damage.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tarfile import BLOCKSIZE, HeaderError, TarInfo
from typing import NamedTuple

import numpy as np
from isal.isal_zlib import crc32

from mlbatch.bounded import MOST_TABLE_BYTES, open_file, parse_json
from mlbatch.outputs.damage import CheckLog, DamageError
from mlbatch.outputs.folders import ScanFile, place_of
from mlbatch.outputs.npz import SUFFIX as NPZ
from mlbatch.outputs.npz import NpzReader, Values
from mlbatch.outputs.stored_scan import StoredScan

SUFFIX = ".tar"
JSON = ".json"


class Member(NamedTuple):
    """A file in a tar; begin: position of its bytes."""

    name: str
    begin: int
    size: int


@dataclass(slots=True, kw_only=True)
class Sample(ScanFile):
    """The files of a scan in a tar."""

    npz: Member
    json: Member

    def read(self, other: Path | None = None) -> bytes:
        """The bytes of the npz; `text` gives the JSON."""
        return self._bytes(self.npz)

    def text(self) -> bytes:
        """The bytes of the JSON."""
        return self._bytes(self.json)

    def _bytes(self, member: Member) -> bytes:
        if member.size > MOST_TABLE_BYTES:
            raise DamageError(f"at most {MOST_TABLE_BYTES} bytes", str(member.size))
        try:
            with open_file(self.path) as file:
                file.seek(member.begin)
                data = file.read(member.size)
        except OSError as err:
            raise DamageError("a readable file", str(err.strerror)) from err
        self.checksum = (self.checksum + crc32(data, 0)) % (1 << 32)
        return data


def samples(log: CheckLog, tar: ScanFile) -> Iterator[ScanFile]:
    """The scans of a tar; what is none, or not whole, is a violation."""
    members: list[Member] = []
    try:
        # Has those before a damage, too.
        members.extend(_members(tar.path))
    except DamageError as err:
        log.fail("container", tar.where, err.expected, err.found)
    if len(members) % 2 or len({one.name for one in members}) != len(members):
        log.fail("names", tar.where, "an npz and a JSON of each scan once", f"{len(members)} files")
    for npz, json in zip(members[::2], members[1::2], strict=False):
        where = f"{tar.where}/{npz.name}"
        log.equal("names", where, npz.name.removesuffix(NPZ) + JSON, json.name)
        place = place_of(log, where, npz.name, NPZ)
        if place is None:
            continue
        if max(place[0], 0) < tar.index:
            log.fail("names", where, f"a window from {tar.index} on", place[0])
        yield Sample(tar.path, where, tar.sensor, *place, NPZ, npz=npz, json=json)


def _members(path: Path) -> Iterator[Member]:
    """Yield the files in a tar; DamageError unless it has its end."""
    try:
        with open_file(path) as file:
            size_bytes = path.stat().st_size
            begin = 0
            while (head := file.read(BLOCKSIZE)).strip(b"\0"):
                info = TarInfo.frombuf(head, "ascii", "strict")
                begin += BLOCKSIZE
                if not info.isreg() or not 0 <= info.size <= size_bytes - begin:
                    raise DamageError("whole files", f"{info.name} of {info.size} bytes")
                yield Member(info.name, begin, info.size)
                begin += -(-info.size // BLOCKSIZE) * BLOCKSIZE
                file.seek(begin)
            # A tar that was cut between two files has no other mark.
            if len(head + file.read(BLOCKSIZE)) < 2 * BLOCKSIZE:
                raise DamageError("two blocks of zeros after the last file", "the end of the file")
    except (HeaderError, UnicodeError) as err:
        raise DamageError("headers of ustar", str(err)) from err
    except OSError as err:
        raise DamageError("a readable file", str(err.strerror)) from err


@dataclass(slots=True)
class SampleReader(NpzReader):
    """Reads the scans of tar files: each npz, and whether the JSON says the same."""

    def _stored(self, file: ScanFile, values: dict[str, Values]) -> StoredScan:
        if isinstance(file, Sample):
            self._check_json(file, values)
        return NpzReader._stored(self, file, values)

    def _check_json(self, file: Sample, values: dict[str, Values]) -> None:
        found = None
        with contextlib.suppress(ValueError):
            found = parse_json(file.text())
        if not isinstance(found, dict):
            raise DamageError("a JSON object next to the npz", "other bytes")
        own = self.sensors.index(file.sensor) if file.sensor in self.sensors else 0
        columns = np.bincount(
            values["column_lidar_id"].astype(np.int64), minlength=len(self.sensors)
        )
        xyz, fill = values["xyz"], values["fill"]
        points = np.isfinite(xyz[..., 0]).sum() if self.organized else len(xyz)
        keys = ("index", "slice", "start_ns", "end_ns", "complete")
        expected = {key: values[key].item() for key in keys}
        expected |= {"points": int(points), "columns": len(values["column_lidar_id"])}
        for at, share in enumerate(fill, own):
            expected[f"columns_{self.sensors[at]}"] = int(columns[at])
            expected[f"fill_{self.sensors[at]}"] = None if share != share else float(str(share))
        expected |= {key: str(values[key]) for key in ("frame_id", "rate_hz", "timescale")}
        where = file.where.removesuffix(NPZ) + JSON
        for key in sorted(expected.keys() | found.keys()):
            self.log.equal("metadata", f"{where} {key}", expected.get(key), found.get(key))
