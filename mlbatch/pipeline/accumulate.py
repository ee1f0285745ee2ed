"""`--accumulate`: checks of a map before the run."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mlbatch.batching.windows import OWN
from mlbatch.errors import UsageError
from mlbatch.pipeline import preflight
from mlbatch.pipeline.job import Job
from mlbatch.writers.map_writer import UNITS_PER_M

if TYPE_CHECKING:
    from pathlib import Path

    from mlbatch.pipeline.output import OutputRequest


def check_map(job: Job, request: OutputRequest, output: Path | None) -> None:
    """Raise UsageError for options that contradict a map, ExportError for one over an input.

    output: that of the scans, as given.
    """
    path = request.accumulate
    if path is None:
        option = "--crs" if request.voxel is None else "--voxel"
        raise UsageError(f"{option}: expected --accumulate MAP, found none; give both, or none")
    if job.deskew in ("", "imu", "constant-velocity"):
        raise UsageError(
            f"--accumulate {path}: expected --deskew FILE.tum, poses that place the scans, found "
            f"{job.deskew or 'none'}; give a trajectory, as odometry or GNSS and INS make it"
        )
    for option, is_given in (
        ("--resume, since a map is made from the start", request.resume),
        ("--shard, since a map needs all scans in order", job.shard is not None),
        ("--batching-times own, since points of a map have one clock", job.batching_times == OWN),
        ("--split, since a map is of all lidars", job.split),
        ("--report of the same name", _are_one(request.report, path)),
        ("-o of the same name", _are_one(output, path)),
        ("--layout organized, since a map has no empty slots", job.layout == "organized"),
    ):
        if is_given:
            raise UsageError(f"--accumulate {path}: expected no {option}, found both; choose one")
    units = (request.voxel or 0.0) * UNITS_PER_M
    if request.voxel is not None and not (10 <= units <= 1e5 and abs(units - round(units)) < 1e-6):
        text = f"--voxel: expected whole millimetres from 0.01 to 100 m, found {request.voxel:g}"
        raise UsageError(f"{text}; write --voxel 0.1")
    if not request.dry_run:
        preflight.check_output(job, path, None)


def _are_one(one: Path | None, other: Path) -> bool:
    return one is not None and one.absolute() == other.absolute()
