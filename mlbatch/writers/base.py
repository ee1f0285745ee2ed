"""The interface of writers: what a format module offers, and what it is given."""

from __future__ import annotations

from fractions import Fraction
from typing import TYPE_CHECKING, NamedTuple, Protocol, TypeVar, runtime_checkable

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from mlbatch.types import ImuSamples, Message, RunInfo, Scan, Summary

Value = TypeVar("Value")
DEFAULT_POINT_LAYOUT = "standard"
NO_COMPRESSION = "none"
# Number of checksums of scans: sums of CRC-32 are modulo this.
CHECKSUMS = 1 << 32


class WriterOptions(NamedTuple):
    """Options of an output."""

    point_layout: str = DEFAULT_POINT_LAYOUT  # preset of PointCloud2 fields
    overwrite: bool = False  # replace an existing output at the end
    split: bool = False  # one output stream per sensor instead of merged scans
    compression: str = NO_COMPRESSION  # none, lz4 or zstd[:level]
    ply_style: str = "standard"  # names and types of PLY properties
    fsync: bool = True  # force the output to the disk before it gets its name
    max_bag_s: float = 0.0  # recorded time in a file of a ROS 2 bag, s; 0: all in one file
    files: FileSet | None = None  # the files that this run is to make; None: all
    only: Path | None = None  # the file that the only scan of a folder becomes; None: any number


def fixed(value: Value) -> Callable[[WriterOptions], Value]:
    """Return `extras` or `record_layout` of a format in which no option changes it."""
    return lambda options: value


class FileSet(Protocol):
    """The files of an output of several, as its writer sees them; see `pipeline/files.py`.

    A file is named by its scan: index, slice and, with `--split`, sensor; one of a bag by the index
    of any of its windows.
    """

    @property
    def is_continued(self) -> bool:
        """Whether the folder under construction has finished files to continue after."""
        ...

    def is_due(self, index: int, slice_: int = 0, sensor: int | None = None) -> bool:
        """Whether this run is to make a file."""
        ...

    def made(
        self, crcs: Mapping[str, int], index: int, slice_: int = 0, sensor: int | None = None
    ) -> None:
        """Note a file that is whole; crcs: CRC-32 by name, as a scan may have two. In order."""
        ...


class ScanJob:
    """The work of a writer for one scan, in four stages; a stage without work does nothing.

    The caller runs all four in this order, each once. `pack` and `compress` run in any thread, at
    the same time as stages of other jobs. `append` and `commit` run in the order of the scans,
    each after the same stage of all earlier jobs.

    checksum: from `pack` on, the sum of the CRC-32 of the files of the scan, or that of the data of
    its message, as `scans.csv` has it; None: not known.
    """

    checksum: int | None = None

    def start(self, index: int) -> None:
        """Prepare for the window of the scan: the messages before it follow, then `append`.

        Runs in order, as `append` does; also for messages of the window that are written apart.
        """

    def pack(self) -> None:
        """Convert the points to the bytes of a message or file. Any thread."""

    def append(self) -> None:
        """Assign the position in the output: sequence number, chunk. In order."""

    def compress(self) -> None:
        """Compress what is complete, compute its checksums. Any thread."""

    def commit(self) -> None:
        """Write what is complete. In order."""


class ScanWriter(Protocol):
    """Writer of one run; there is no file at the final path before `finish`.

    Stages of jobs may run in several threads, see `ScanJob`. IMU samples and messages are written
    right before an `append`; other jobs may be in other stages then. `finish` is called when all
    jobs are done.
    """

    def write(self, scan: Scan, sensor: int | None = None) -> ScanJob:
        """Return the job that writes a scan; its arrays must stay valid until the last stage.

        sensor: index of the only sensor in the scan with `--split`, None for a merged scan.
        """
        ...

    def flush(self) -> ScanJob:
        """Return the job that writes complete chunks of messages where no scan follows them."""
        return ScanJob()

    def write_imu(self, samples: ImuSamples) -> None:
        """Write IMU samples; formats without IMU ignore the call."""
        return

    def write_message(self, message: Message) -> None:
        """Forward a recorded message unchanged; formats without messages ignore the call."""
        return

    def finish(self, summary: Summary, last: Callable[[Path], None] | None = None) -> None:
        """Complete the output and move it to its final path.

        last: called with the path of the complete output, just before the move.
        """
        ...

    def abandon(self) -> None:
        """Close all files after an error; the `.partial` stays."""
        ...


@runtime_checkable
class FilesWriter(ScanWriter, Protocol):
    """A writer of several files, each independent of the others; reports them to a `FileSet`."""

    def skip(self, scan: Scan, sensor: int | None = None) -> ScanJob:
        """Return the job of a scan in a file that is not due here; call it in the order of scans.

        The points of the scan are not used.
        """
        ...


def windows_per_file(max_bag_s: float, rate: Fraction) -> int:
    """Return the number of windows in a file of a bag, 1 at least; rate: Hz."""
    # As it was written: 0.3 s at 10 Hz are three windows.
    return max(1, int(Fraction(str(max_bag_s)) * rate))


class WriterModule(Protocol):
    """A format: a module in `writers/formats/`, called by the name of the format."""

    FORMAT: str  # name of the module
    SUFFIX: str | None  # of the output file; None: the output is a folder
    COMPRESSES: bool  # whether `--compression` applies
    # Optional: IS_SLOW, True if a scan takes longer to write than to decode, even without
    # `--compression`, and several threads can write at the same time.
    # Optional, only for folders: FILE_SUFFIXES, a tuple with the suffixes of the files of a scan,
    # without the first dot. Without it the suffix is FORMAT.
    # Optional, only for folders: WINDOWS_PER_FILE, if a file has the scans of several windows: of
    # so many by their number, whichever of them there are.
    # Optional: record_layout(options: WriterOptions) -> RecordLayout | None, records of points
    # that the writer takes packed (`Scan.packed`). With `--sort points` scans have arrays instead.

    def extras(self, options: WriterOptions) -> frozenset[str]:
        """Return the optional contents that the output includes.

        A subset of `types.EXTRAS`, `types.IMU` and `types.MESSAGE_ENCODINGS`.
        """
        ...

    def open_writer(self, target: Path, info: RunInfo, options: WriterOptions) -> ScanWriter:
        """Start the output `target`; nothing is created at that path before `finish`."""
        ...
