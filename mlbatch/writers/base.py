"""What every writer plug-in is given, and the face it shows (CONTRACT.md, sections 2 and 3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from mlbatch.types import ImuSamples, Message, RunInfo, Scan, Summary
    from mlbatch.workers import Steps

DEFAULT_POINT_LAYOUT = "standard"


@dataclass(frozen=True, slots=True)
class WriterOptions:
    """Options of an output.

    point_layout: preset of a PointCloud2; overwrite: replace an existing output at the end;
    split: one output stream per sensor instead of merged scans; kept_bytes: what stays of the file
    in an existing `.partial` that is continued (its scans, where they are files), None: start anew;
    compression: none, lz4 or zstd[:level].
    """

    point_layout: str = DEFAULT_POINT_LAYOUT
    overwrite: bool = False
    split: bool = False
    kept_bytes: int | None = None
    compression: str = "none"


@dataclass(frozen=True, slots=True)
class Safe:
    """What a killed process would leave: the first `scans`, in the first `kept_bytes` of a file."""

    scans: int
    kept_bytes: int = 0


class ScanWriter(Protocol):
    """Writes one run; nothing stands under the final name before `finish`.

    The steps of scans may be done by several threads; all else is called in turn (see `workers`).
    """

    def write(self, scan: Scan, sensor: int | None = None) -> Steps:
        """Write one scan; its arrays must be valid until the last of the steps.

        sensor: index of the only sensor in the scan with `--split`, None for a merged scan.
        """
        ...

    def pass_over(self, scan: Scan, sensor: int | None = None) -> Steps:
        """Go past a scan that the continued `.partial` holds; its point arrays mean nothing."""
        ...

    def flush(self) -> Steps:
        """Write what messages and IMU samples have completed, where no scan follows them."""
        ...

    def safe(self) -> Safe:
        """Hand what was written to the system, and say what of it needs no second writing."""
        ...

    def write_imu(self, samples: ImuSamples) -> None:
        """Write IMU samples; formats without a place for them ignore the call."""
        ...

    def write_message(self, message: Message) -> None:
        """Write a message of the recording as it is; formats without a place ignore the call."""
        ...

    def finish(self, summary: Summary, last: Callable[[Path], None] | None = None) -> None:
        """Complete the output and move it to its final name.

        last: called with the path of the complete output, just before that.
        """
        ...

    def abandon(self) -> None:
        """Close files after an error; what was written stays under `.partial`."""
        ...


class WriterModule(Protocol):
    """A plug-in: a module of this package whose name has no leading underscore.

    FORMAT equals the module's name; SUFFIX is that of an output file, None for a folder; COMPRESSES
    tells whether there is a place for `--compression`.
    """

    FORMAT: str
    SUFFIX: str | None
    COMPRESSES: bool

    def extras(self, options: WriterOptions) -> frozenset[str]:
        """Those of `types.EXTRAS` that the output holds, `types.IMU`, `types.MESSAGE_ENCODINGS`."""
        ...

    def open_writer(self, target: Path, info: RunInfo, options: WriterOptions) -> ScanWriter:
        """Start an output; nothing stands at `target` before the writer's `finish`."""
        ...
