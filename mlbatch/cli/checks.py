"""What a conversion would fail on at its end, told at its start."""

from __future__ import annotations

import math
import shutil
from pathlib import Path

import typer

from mlbatch.errors import ExportError
from mlbatch.job import Job
from mlbatch.report import SCHEMA
from mlbatch.rig import read_rig
from mlbatch.writers import check_free_space

# Outputs of whole recordings took 0.51 to 7 times their bytes (sparse LEGACY packets to MCAP; dense
# low-rate ones to npz): nothing that would fit is refused.
LEAST_OUTPUT = 4
_BYTES_PER_MB = 1_000_000
# A report names its schema first.
_HEAD_BYTES = 64


def place(job: Job, output: Path) -> None:
    """Refuse an output in the place of a recording, or in the folder of a bag."""
    target = output.resolve()
    for path in job.recordings:
        recording = path.resolve()
        if recording == target:
            raise ExportError(
                f"{output}: wanted an output besides the recordings, got one of them; "
                "choose another name"
            )
        if recording.is_dir() and recording in target.parents:
            raise ExportError(
                f"{output}: wanted an output outside the recordings, got one inside {path}; "
                "choose another folder"
            )


def disk(job: Job, output: Path) -> None:
    """Refuse a disk on which the output surely has no room; warn where it may have none."""
    if _is_limited(job):
        return
    recorded = sum(path.stat().st_size for path in job.recordings if path.is_file())
    check_free_space(output, recorded // LEAST_OUTPUT)
    free = shutil.disk_usage(output.parent).free
    if free < recorded:
        typer.echo(
            f"mlbatch: warning: disk: {output}: {free // _BYTES_PER_MB} MB are free for a "
            f"recording of {recorded // _BYTES_PER_MB} MB, which may not be enough",
            err=True,
        )


def _is_limited(job: Job) -> bool:
    """Whether only a part is wanted, so that the output may be as small as one likes."""
    wishes = job.wishes
    ranges_m = [job.max_range_m]
    if wishes.rig is not None:
        ranges_m += [sensor.max_range_m or math.inf for sensor in read_rig(wishes.rig).sensors]
    in_time = job.start is not None or job.end is not None
    return in_time or min(ranges_m) < math.inf or bool(wishes.only or wishes.ignore)


def report(job: Job, path: Path | None, output: Path | None) -> None:
    """Refuse a report that could not be written, or that would replace what is read."""
    if path is None:
        return
    if path.parent.absolute() != (output or path).absolute() and not path.parent.is_dir():
        raise ExportError(
            f"{path}: wanted a report in an existing folder, got {path.parent}, which is none; "
            "create it (mkdir -p) or choose another"
        )
    if path.is_dir():
        raise ExportError(f"{path}: wanted a file for the report, got a folder; add a name")
    read = (*job.recordings, *job.wishes.metadata, *filter(None, [job.wishes.rig]))
    if path.exists() and any(other.exists() and path.samefile(other) for other in read):
        raise ExportError(
            f"{path}: wanted a new file for the report, got one that is read; choose another"
        )
    if path.exists() and not _is_replaceable(path):
        raise ExportError(
            f"{path}: wanted a new file or an earlier report, got something else; choose another "
            "name for the report"
        )


def _is_replaceable(path: Path) -> bool:
    """Whether a file is empty or a report: anything else may be somebody's only copy."""
    if not path.is_file():
        return False
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except OSError:
        return False
    return not head or SCHEMA.encode() in head
