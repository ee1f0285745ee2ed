"""Folders with a file for each scan, or for several: index, slice and sensor by name and folder."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from isal.isal_zlib import crc32

from mlbatch.bounded import MOST_TABLE_BYTES, read_bytes, read_text
from mlbatch.outputs.damage import CheckLog, DamageError, VerifyError
from mlbatch.outputs.metadata import RunMetadata
from mlbatch.outputs.stored_scan import StoredScan

_NAME = re.compile(r"(?:(\d{6,})|(head))(?:-(\d+))?", re.ASCII)
# File of a shard instead of a report.
_SHARD = "shard.json"
# Files with other suffixes are ignored.
_FIRST, _SECOND = ".pcd.bin", ".time.bin"
_OUTPUTS = (".npz", ".ply", ".pcd", ".las", ".laz", ".bin", ".tar", ".partial", ".mcap", ".bag")


@dataclass(slots=True)
class ScanFile:
    """A file of a scan."""

    path: Path
    where: str
    # The folder, with `--split`.
    sensor: str | None
    index: int
    # None where windows are not sliced.
    slice: int | None
    # Of the format, with its first dot.
    suffix: str
    # Sum of the CRC-32 of what was read, modulo 2^32.
    checksum: int = 0
    # The only scan of an output, which may have any name.
    is_only: bool = False

    def read(self, other: Path | None = None) -> bytes:
        """The bytes of the file, or of another one of the scan."""
        try:
            data = read_bytes(other or self.path, MOST_TABLE_BYTES)
        except OSError as err:
            which = f" {other.name} next to it" if other else ""
            raise DamageError(f"a readable file{which}", str(err.strerror)) from err
        self.checksum = (self.checksum + crc32(data, 0)) % (1 << 32)
        return data

    def check_name(self, log: CheckLog, index: int, part: int, slices: int) -> None:
        """Check the name against index and slice in the file."""
        name = "head" if index < 0 else f"{index:06d}"
        if slices > 1:
            name += f"-{part}"
        if self.is_only:
            return
        log.equal("names", self.where, name + self.suffix, self.where.rpartition("/")[2])

    def sensor_index(self, log: CheckLog, sensors: tuple[str, ...]) -> int | None:
        """Index of the sensor of the folder; None without `--split`."""
        if self.sensor is None:
            return None
        if self.sensor in sensors:
            return sensors.index(self.sensor)
        log.fail("names", self.where, f"the folder of one of {', '.join(sensors)}", self.sensor)
        return None


@dataclass(slots=True)
class ScanReader:
    """Reads the files of one folder, which are of one run."""

    log: CheckLog
    sensors: tuple[str, ...] = ()
    organized: bool = False

    def begin(self, file: ScanFile) -> RunMetadata:
        """Metadata of the run in the first scan; DamageError for another file. By format."""
        raise NotImplementedError

    def know(self, metadata: RunMetadata) -> None:
        """Take over what the report has, in formats whose files have none."""

    def scan(self, file: ScanFile) -> StoredScan | None:
        """One scan, None if it is not in its layout; DamageError for another file. By format."""
        raise NotImplementedError

    def scans(self, files: Iterable[ScanFile]) -> Iterator[StoredScan]:
        """Every readable scan; the others are violations."""
        for file in files:
            file.checksum = 0
            try:
                scan = self.scan(file)
            except DamageError as err:
                self.log.fail("container", file.where, err.expected, err.found)
                continue
            self.log.ok("container")
            if scan is not None:
                scan.checksum = file.checksum
                yield scan


def entries(folder: Path) -> list[Path]:
    """The content of a folder, sorted by name."""
    try:
        return sorted(folder.iterdir())
    except OSError as err:
        raise VerifyError(f"{folder}: expected a readable folder, found {err.strerror!r}") from err


def refuse_shard(folder: Path) -> None:
    """Raise VerifyError for the folder of a shard, which has a part of the scans."""
    if (folder / _SHARD).is_file():
        raise VerifyError(
            f"{folder}: expected a whole output, found one shard of it; join all with mlbatch merge"
        )


def scan_files(
    log: CheckLog,
    folder: Path,
    suffix: str,
    inside: Callable[[CheckLog, ScanFile], Iterator[ScanFile]] | None = None,
) -> list[ScanFile]:
    """All files of scans, sorted by sensor and time; unexpected names are violations.

    folder: or the only scan of an output, whose index and slice are in the table next to it;
    inside: gives the files in a file of several scans.
    """
    if folder.is_file():
        return [_only_file(folder, suffix)]
    files = list(_files_of(log, folder, suffix, None))
    split = [
        file
        for entry in entries(folder)
        if entry.is_dir() and not entry.name.startswith(".")
        for file in _files_of(log, entry, suffix, entry.name)
    ]
    if files and split:
        expected = "scans in the folder or in those of sensors"
        log.fail("names", split[0].where, expected, "both")
    files += split
    if inside is not None:
        files = [scan for file in files for scan in inside(log, file)]
    if len({file.slice is None for file in files}) > 1:
        log.fail("names", folder.name, "names with or without a slice", "both")
    return sorted(files, key=lambda file: (file.sensor or "", file.index, file.slice or 0))


def _only_file(path: Path, suffix: str) -> ScanFile:
    from mlbatch.outputs.table import read_table

    try:
        table = read_text(path.with_name(f"{path.name}.scans.csv"), MOST_TABLE_BYTES)
        row = read_table(table, f"{path}: scans.csv")[0]
        number, part = int(row["index"]), int(row["slice"])
    except (OSError, ValueError, LookupError) as err:
        raise VerifyError(
            f"{path}: expected scans.csv next to the only scan of an output, found none that can "
            "be read; put it back, or convert again"
        ) from err
    return ScanFile(path, path.name, None, number, part, suffix, is_only=True)


def _files_of(log: CheckLog, folder: Path, suffix: str, sensor: str | None) -> Iterator[ScanFile]:
    for path in entries(folder):
        where = path.name if sensor is None else f"{sensor}/{path.name}"
        is_output = path.name.endswith(suffix) or path.suffix in _OUTPUTS
        if not is_output or path.is_dir():
            continue
        log.ok("names")
        # A second file of a scan, which its reader looks for.
        if path.name.endswith(_SECOND) and suffix == _FIRST:
            continue
        place = place_of(log, where, path.name, suffix)
        if place is not None:
            yield ScanFile(path, where, sensor, *place, suffix)


def place_of(log: CheckLog, where: str, name: str, suffix: str) -> tuple[int, int | None] | None:
    """Index and slice by the name of a file; None for another name, which is a violation."""
    stem = name.removesuffix(suffix)
    match = _NAME.fullmatch(stem)
    if match is None or stem == name:
        expected = f"an index of six digits or head, perhaps with a slice, and {suffix}"
        log.fail("names", where, expected, name)
        return None
    number, head, part = match.groups()
    index = -1 if head else int(number)
    if not head and number != f"{index:06d}":
        log.fail("names", where, f"{index:06d}", number)
    return index, None if part is None else int(part)
