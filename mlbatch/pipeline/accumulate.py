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
from mlbatch.writers.map_writer import UNITS_PER_M, MapRequest, MapWriter

if TYPE_CHECKING:
    from mlbatch.pipeline.output import OutputRequest

# Edges of voxels, m.
_VOXELS_M = (0.01, 100.0)


def map_of(job: Job, request: OutputRequest, path: Path) -> MapRequest:
    """Return the map that is asked for; UsageError for options that contradict it."""
    if job.deskew in ("", "imu", "constant-velocity"):
        raise UsageError(
            f"--accumulate {path}: expected --deskew FILE.tum, poses that place the scans, found "
            f"{job.deskew or 'none'}; give a trajectory, as odometry or GNSS and INS make it"
        )
    for option, is_given in (
        ("--resume, since a map is made from the start", request.resume),
        ("--shard, since a map needs all scans in order", job.shard is not None),
        ("--batching-times own, since points of a map have one clock", job.batching_times == OWN),
        ("--layout organized, since a map has no empty slots", job.layout == "organized"),
    ):
        if is_given:
            raise UsageError(f"--accumulate {path}: expected no {option}, found both; choose one")
    low_m, high_m = _VOXELS_M
    units = request.voxel * UNITS_PER_M
    is_known = not request.voxel or low_m <= request.voxel <= high_m
    if not is_known or abs(units - round(units)) > 1e-6:
        raise UsageError(
            f"--voxel: expected whole millimetres from {low_m:g} to {high_m:g} m, found "
            f"{request.voxel:g}; write --voxel 0.1"
        )
    return MapRequest(path, request.voxel, request.crs or "", request.overwrite, request.fsync)


def check_map(job: Job, request: MapRequest, output: Path | None) -> None:
    """Refuse a map that could not be written; opens it, and removes what that created."""
    preflight.check_output(job, request.path, None)
    places = [path.absolute() for path in (request.path, *request.path.parents)]
    if output is not None and output.absolute() in places:
        raise ExportError(
            f"{request.path}: expected a map outside the output, found one in {output}; choose "
            "another name"
        )
    MapWriter(request, RunInfo((), "", "10", "unknown")).abandon()
    discard(request.path)
