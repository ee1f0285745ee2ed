"""Checks at the start of what a conversion would fail on at its end."""

from __future__ import annotations

import math
import os
from pathlib import Path

from mlbatch.errors import ExportError
from mlbatch.pipeline.job import Job
from mlbatch.rig.rig import read_rig
from mlbatch.writers import report_paths
from mlbatch.writers.atomic import (
    check_free_space,
    check_name,
    free_bytes,
    is_report,
    is_taken,
    old_path,
    partial_path,
    state_path,
)

# Outputs of whole recordings took 0.51 to 7 times their bytes (sparse LEGACY packets to MCAP; dense
# low-rate ones to npz), so that an output that fits is never refused.
LEAST_OUTPUT = 4
_BYTES_PER_MB = 1_000_000


def _real(path: Path) -> Path:
    """A path without links; one of a loop as it is, which is refused where it is opened."""
    return Path(os.path.realpath(path))


def check_output(job: Job, output: Path, name: str | None) -> None:
    """Raise ExportError if the output overwrites an input; name: of its format; None: a map."""
    check_name(output)
    target = _real(output)
    for path in job.recordings:
        recording = _real(path)
        if recording == target:
            raise ExportError(
                f"{output}: expected an output that is no recording, found one of the inputs; "
                "choose another name"
            )
        if recording.is_dir() and recording in target.parents:
            raise ExportError(
                f"{output}: expected an output outside the recordings, found one inside {path}; "
                "choose another folder"
            )
    files = [output, partial_path(output)] if name is None else _own_files(output, name)
    own = [_real(file) for file in files]
    for path in _read_by(job):
        if _real(path) in own or target in _real(path).parents:
            raise ExportError(
                f"{output}: expected an output that does not overwrite {path}, found one that "
                "does; choose another name"
            )


def _own_files(output: Path, name: str) -> list[Path]:
    """Files that a run creates or removes, apart from those in an output folder."""
    files = [output, partial_path(output), old_path(output), state_path(output)]
    paths = report_paths(output, name)
    if paths.report.parent != output:
        files += [
            paths.scans_csv,
            paths.report,
            *map(partial_path, (paths.scans_csv, paths.report)),
        ]
    return files


def _read_by(job: Job) -> list[Path]:
    """All files that a job names as input."""
    others = [job.selection.rig or Path(), Path(job.deskew)]
    return [*job.recordings, *job.selection.metadata, *filter(Path.is_file, others)]


def check_disk(job: Job, output: Path) -> str:
    """Raise ExportError if the disk is too small; gives a warning if it may be, else ""."""
    selection = job.selection
    in_time = job.start is not None or job.end is not None
    if in_time or job.max_range_m < math.inf or selection.only or selection.ignore:
        # The output may be arbitrarily small.
        return ""
    recorded = sum(path.stat().st_size for path in job.recordings if path.is_file())
    if job.shard is not None:
        recorded //= job.shard.count
    if free_bytes(output) >= recorded:
        return ""
    # As a rule there is space for all, and the rig need not be read here.
    rig = selection.rig
    sensors = () if rig is None else read_rig(rig, job.recordings).sensors
    if any((sensor.max_range_m or math.inf) < math.inf for sensor in sensors):
        return ""
    check_free_space(output, recorded // LEAST_OUTPUT)
    return (
        f"disk: {output}: {free_bytes(output) // _BYTES_PER_MB} MB are free for a recording of "
        f"{recorded // _BYTES_PER_MB} MB, which may not be enough"
    )


def check_report(job: Job, path: Path | None, output: Path | None, name: str) -> None:
    """Raise ExportError if the report cannot be written, or would overwrite another file.

    name: of the output's format.
    """
    if path is None:
        return
    inside = output is not None and _is_inside(path, output, name)
    if output is not None and not inside and _is_of(path, output, name):
        raise ExportError(
            f"{path}: expected a report that is no file of the output, found one; "
            "choose another name for the report"
        )
    if not inside and not path.parent.is_dir():
        raise ExportError(
            f"{path}: expected a report in an existing folder, found none at {path.parent}; "
            "create it (mkdir -p) or choose another"
        )
    if path.is_dir():
        raise ExportError(f"{path}: expected a file for the report, found a folder; add a name")
    if path.exists() and any(one.exists() and path.samefile(one) for one in _read_by(job)):
        raise ExportError(
            f"{path}: expected a new file for the report, found an input; choose another"
        )
    if path.exists() and not _is_replaceable(path):
        raise ExportError(
            f"{path}: expected a new file or an earlier report, found another file; choose another "
            "name for the report"
        )


def _is_inside(path: Path, output: Path, name: str) -> bool:
    """True if the report is in the output folder, under a name of no other file there."""
    usual = report_paths(output, name).report
    if usual.parent != output or path.parent.absolute() != output.absolute():
        return False
    return path.name == usual.name or not is_taken(path.name)


def _is_of(path: Path, output: Path, name: str) -> bool:
    """True if the report is a file of the output, or in a folder that is replaced."""
    place = _real(path)
    own = [_real(file) for file in _own_files(output, name)]
    if place == _real(report_paths(output, name).report):
        return False
    return place in own or any(parent in own for parent in place.parents)


def _is_replaceable(path: Path) -> bool:
    """True if a file is empty or a report; any other file may be the only copy."""
    if not path.is_file():
        return False
    try:
        return not path.stat().st_size or is_report(path)
    except OSError:
        return False
