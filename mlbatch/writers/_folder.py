"""Outputs of one file a scan: names, scans.csv and the move at the end (CONTRACT.md, section 3)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO, TypeAlias

from mlbatch.errors import UsageError
from mlbatch.types import ImuSamples, Message, RunInfo, Scan, Summary
from mlbatch.writers._atomic import SCANS_CSV, export_errors, prepare
from mlbatch.writers._options import DEFAULT_POINT_LAYOUT, WriterOptions

Save: TypeAlias = Callable[[BinaryIO, Scan], None]


def scan_name(index: int, slice_: int, slices: int) -> str:
    """Name of a scan without suffix: `000042`, of a slice `000042-3`, of the head `head`."""
    stem = "head" if index < 0 else f"{index:06d}"
    return stem if slices == 1 else f"{stem}-{slice_}"


class FolderWriter:
    """Writes each scan by `save` into a file of its own."""

    def __init__(
        self, target: Path, info: RunInfo, options: WriterOptions, suffix: str, save: Save
    ) -> None:
        if options.point_layout != DEFAULT_POINT_LAYOUT:
            raise UsageError(
                f"--point-layout: wanted {DEFAULT_POINT_LAYOUT} for {suffix} files, got "
                f"{options.point_layout}; presets shape PointCloud2, write a .mcap output for them"
            )
        self._output = prepare(target, options.overwrite, folder=True)
        self._suffix = suffix
        self._save = save
        self._folders: dict[int | None, Path] = {None: self._output.partial}
        if options.split:
            self._folders |= self._sensor_folders(info)

    def write(self, scan: Scan, sensor: int | None = None) -> None:
        """Write one scan into a file of its own."""
        name = scan_name(scan.index, scan.slice, scan.slices) + self._suffix
        path = self._folders[sensor] / name
        with export_errors(path), path.open("wb") as file:
            self._save(file, scan)

    def write_imu(self, samples: ImuSamples) -> None:
        """Files of scans have no place for IMU samples."""

    def write_message(self, message: Message) -> None:
        """Files of scans have no place for messages."""

    def finish(self, summary: Summary) -> None:
        """Add scans.csv and give the folder its final name."""
        path = self._output.partial / SCANS_CSV
        with export_errors(path):
            path.write_text(summary.scans_csv, encoding="utf-8", newline="\n")
        self._output.publish()

    def abandon(self) -> None:
        """Nothing is open between scans; the folder stays under `.partial`."""

    def _sensor_folders(self, info: RunInfo) -> dict[int | None, Path]:
        folders: dict[int | None, Path] = {}
        for number, sensor in enumerate(info.sensors):
            folder = self._output.partial / sensor.name
            with export_errors(folder):
                folder.mkdir()
            folders[number] = folder
        return folders
