"""`--accumulate`: checks of a map before the run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from mlbatch.batching.windows import OWN
from mlbatch.errors import ExportError, UsageError
from mlbatch.pipeline import preflight
from mlbatch.pipeline.job import Job
from mlbatch.types import RunInfo
from mlbatch.writers import discard
from mlbatch.writers.map_files import UNITS_PER_M
from mlbatch.writers.map_writer import MapRequest, MapWriter

if TYPE_CHECKING:
    from mlbatch.pipeline.output import OutputRequest

# Edges of voxels, m; finer ones have less bits than a large map needs.
_LEAST_VOXEL_M = 0.01
_MOST_VOXEL_M = 100.0


def map_of(job: Job, request: OutputRequest) -> MapRequest:
    """Return the map that is asked for; UsageError for options that contradict it."""
    path = request.accumulate or Path()
    if job.deskew in ("", "imu", "constant-velocity"):
        raise UsageError(
            f"--accumulate {path}: expected --deskew FILE.tum, poses that place the scans, found "
            f"{job.deskew or 'none'}; give a trajectory, as odometry or GNSS and INS make it"
        )
    given = {
        "--resume": (request.resume, "a map is made from the start"),
        "--shard": (job.shard is not None, "a map needs all scans, in order"),
        "--batching-times own": (job.batching_times == OWN, "points of a map have one clock"),
    }
    for option, (is_given, why) in given.items():
        if is_given:
            raise UsageError(
                f"--accumulate {path}: expected no {option}, since {why}, found both; leave one out"
            )
    units = request.voxel * UNITS_PER_M
    is_fine = not request.voxel or _LEAST_VOXEL_M <= request.voxel <= _MOST_VOXEL_M
    if not is_fine or abs(units - round(units)) > 1e-6:
        raise UsageError(
            f"--voxel: expected whole millimetres from {_LEAST_VOXEL_M:g} to {_MOST_VOXEL_M:g} m, "
            f"found {request.voxel:g}; write --voxel 0.1"
        )
    return MapRequest(path, request.voxel, request.crs or "", request.overwrite, request.fsync)


def check_map(job: Job, request: MapRequest, output: Path | None) -> None:
    """Refuse a map that could not be written; opens it, and removes what that created."""
    preflight.check_output(job, request.path, None)
    if output is not None and output.absolute() in (
        p.absolute() for p in (request.path, *request.path.parents)
    ):
        raise ExportError(
            f"{request.path}: expected a map outside the output, found one in {output}; choose "
            "another name"
        )
    MapWriter(request, RunInfo((), "", "10", "unknown")).abandon()
    discard(request.path)
