"""Outputs of one file a scan: names, scans.csv and the move at the end (CONTRACT.md, section 3)."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from mlbatch.errors import ExportError, UsageError
from mlbatch.types import ImuSamples, Message, RunInfo, Scan, Summary
from mlbatch.workers import Steps
from mlbatch.writers.atomic import SCANS_CSV, export_errors, prepare
from mlbatch.writers.base import DEFAULT_POINT_LAYOUT, Safe, WriterOptions
from mlbatch.writers.output_file import Trail, forget, taken


class Saver(Protocol):
    """Writes the files of scans, one after the other; owns what it packs them in."""

    def save(self, file: io.FileIO, scan: Scan) -> None:
        """Write the file of one scan."""
        ...


def scan_name(index: int, slice_: int, slices: int) -> str:
    """Name of a scan without suffix: `000042`, of a slice `000042-3`, of the head `head`."""
    stem = "head" if index < 0 else f"{index:06d}"
    return stem if slices == 1 else f"{stem}-{slice_}"


class FolderWriter:
    """Writes each scan by a saver into a file of its own."""

    def __init__(
        self,
        target: Path,
        info: RunInfo,
        options: WriterOptions,
        suffix: str,
        saver: Callable[[], Saver],
    ) -> None:
        """saver: makes one for each of the threads."""
        if options.point_layout != DEFAULT_POINT_LAYOUT:
            raise UsageError(
                f"--point-layout: wanted {DEFAULT_POINT_LAYOUT} for {suffix} files, got "
                f"{options.point_layout}; presets shape PointCloud2, write a .mcap output for them"
            )
        keep = options.kept_bytes is not None
        self._output = prepare(target, options.overwrite, folder=True, keep=keep)
        self._suffix = suffix
        self._saver = saver
        self._idle: list[Saver] = []
        self._written = 0
        self._trail = Trail()
        self._folders: dict[int | None, Path] = {None: self._output.partial}
        if options.split:
            self._folders |= self._sensor_folders(info)

    def write(self, scan: Scan, sensor: int | None = None) -> Steps:
        """Write one scan into a file of its own."""
        path, saver = self._path(scan, sensor), taken(self._idle, self._saver)
        with export_errors(path), path.open("wb", buffering=0) as file:
            saver.save(file, scan)
            size = file.tell()
            forget(file.fileno(), 0, size)
        self._idle.append(saver)
        yield
        self._written += 1
        self._trail.add(path, size)

    def pass_over(self, scan: Scan, sensor: int | None = None) -> Steps:
        """Leave a scan's file as it is."""
        yield
        path = self._path(scan, sensor)
        if not path.is_file():
            raise ExportError(
                f"{path}: wanted a scan of the interrupted run to go on after it, got none; leave "
                "out --resume to begin anew"
            )
        self._written += 1

    def flush(self) -> Steps:
        """Nothing but scans is written."""
        return iter(())

    def safe(self) -> Safe:
        """All: files are closed one by one."""
        return Safe(self._written)

    def write_imu(self, samples: ImuSamples) -> None:
        """Files of scans have no place for IMU samples."""

    def write_message(self, message: Message) -> None:
        """Files of scans have no place for messages."""

    def finish(self, summary: Summary, last: Callable[[Path], None] | None = None) -> None:
        """Add scans.csv and give the folder its final name."""
        path = self._output.partial / SCANS_CSV
        with export_errors(path):
            path.write_text(summary.scans_csv, encoding="utf-8", newline="\n")
        if last is not None:
            last(self._output.partial)
        self._output.publish()

    def abandon(self) -> None:
        """Nothing is open between scans; the folder stays under `.partial`."""

    def _path(self, scan: Scan, sensor: int | None) -> Path:
        name = scan_name(scan.index, scan.slice, scan.slices) + self._suffix
        return self._folders[sensor] / name

    def _sensor_folders(self, info: RunInfo) -> dict[int | None, Path]:
        folders: dict[int | None, Path] = {}
        for number, sensor in enumerate(info.sensors):
            folder = self._output.partial / sensor.name
            with export_errors(folder):
                folder.mkdir(exist_ok=True)
            folders[number] = folder
        return folders
