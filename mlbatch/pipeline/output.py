"""The output of a job as the command line and Python ask for it: checked, made, reported."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from mlbatch.batching.windows import OWN
from mlbatch.errors import ExportError, UsageError
from mlbatch.pipeline import preflight
from mlbatch.pipeline.conversion import Conversion, Progress
from mlbatch.pipeline.job import Job
from mlbatch.pipeline.run import convert
from mlbatch.reports.report import RunReport, report_text
from mlbatch.types import RunInfo
from mlbatch.writers import (
    check_options,
    check_target,
    check_variants,
    choose_format,
    extras,
    one_file_format,
    open_writer,
    record_layout,
    report_paths,
)
from mlbatch.writers.atomic import (
    FILES_JSONL,
    REPORT_JSON,
    SCANS_CSV,
    SHARD_JSON,
    discard,
    export_errors,
    partial_path,
    side_path,
    state_path,
    tidy,
    write_text,
)
from mlbatch.writers.base import FilesWriter, ScanWriter, WriterOptions
from mlbatch.writers.durable import sync_entries
from mlbatch.writers.threads import jobs_for

# Loaded where it is needed: a dry run has no files.
if TYPE_CHECKING:
    from mlbatch.pipeline.files import Files
    from mlbatch.writers.map_writer import MapWriter

Listener = Callable[[str], None]


class OutputRequest(NamedTuple):
    """Where a result goes and how it is stored; names and defaults as in `mlbatch convert`."""

    output: Path | None
    format: str | None = None  # None: by the output
    point_layout: str = "standard"
    compression: str = "none"
    ply_style: str = "standard"
    accumulate: Path | None = None  # a map
    voxel: float | None = None  # m, of the map; None: all points
    crs: str | None = None  # of the map
    dry_run: bool = False
    jobs: int | None = None  # None: auto
    report: Path | None = None  # None: next to the output
    overwrite: bool = False
    resume: bool = False
    fsync: bool = True
    command: str = ""  # for the report

    @property
    def written(self) -> Path | None:
        """The output, None in a dry run."""
        return None if self.dry_run else self.output


class Output:
    """An output that can be made: all was checked that does not need the recording.

    format: its name; report_path: None without a report; files: None in a dry run; is_complete: an
    earlier run of the job has made all of it. `say` takes a line for the user, `warn` a warning.
    """

    def __init__(self, job: Job, request: OutputRequest, say: Listener, warn: Listener) -> None:
        request, only = _one_file(job, request)
        self.format = choose_format(request.output, request.format)
        self.files: Files | None = None
        self.report_path = request.report
        if only is not None and request.report is None and not request.dry_run:
            self.report_path = side_path(only, REPORT_JSON)
        self.is_complete = False
        self._map: MapWriter | None = None
        self._request = request
        self._say = say
        options = WriterOptions(
            request.point_layout,
            request.overwrite,
            job.split,
            compression=request.compression,
            ply_style=request.ply_style,
            fsync=request.fsync,
            max_bag_s=job.max_bag_s,
            only=only,
        )
        check_options(self.format, options)
        check_variants(self.format, job.variants)
        if job.shard is not None:
            from mlbatch.pipeline.shards import check_format

            check_format(self.format, options)
        if (request.accumulate, request.voxel, request.crs) != (None, None, None):
            _check_map(job, request, only or request.written)
        path = request.written
        jobs = request.jobs or 1 if path is None else jobs_for(request.jobs, self.format, options)
        self.job = replace(job, extras=extras(self.format, options), jobs=jobs)
        self._options = options
        if path is not None:
            self.job = replace(self.job, record=record_layout(self.format, options))
            preflight.check_output(self.job, path, self.format)
            if request.resume and self._was_completed(path):
                self.is_complete = True
                return
            self._prepare(path, warn)
        accumulated = request.accumulate
        if path is None and accumulated is not None and not request.dry_run:
            self.report_path = self.report_path or side_path(accumulated, REPORT_JSON)
        preflight.check_report(self.job, self.report_path, path, self.format)
        if accumulated is not None and not request.dry_run:
            from mlbatch.writers.map_writer import MapWriter

            self._map = MapWriter(
                accumulated, request.voxel or 0.0, request.crs, request.overwrite, request.fsync
            )
            # A map takes arrays, and nothing else but what LAS stores.
            others = frozenset[str]() if path is None else self.job.extras
            self.job = replace(self.job, extras=others | {"reflectivity"}, record=None)

    def _prepare(self, path: Path, warn: Listener) -> None:
        """Take the files of an interrupted run, or check that all can be made from the start."""
        from mlbatch.pipeline.files import Files, find

        _remove_state(path, self._say)
        resumes = self._request.resume
        earlier = find(path)
        if earlier is not None and not resumes:
            warn(
                f"interrupted: {partial_path(path)} with {earlier.scans} finished scans is "
                "discarded; --resume would continue after them"
            )
        files = Files(path, self.job, self.format, self._options, earlier if resumes else None)
        self.files = files
        self._options = self._options._replace(files=files)
        if not files.is_continued:
            if resumes:
                self._say(f"{path}: nothing to resume; started over")
            check_target(self.format, path, self._options, self.job.layout)
            if shortage := preflight.check_disk(self.job, path):
                warn(shortage)
        if self.job.shard is None and self.report_path is None:
            self.report_path = report_paths(path, self.format).report

    def make(self, progress: Progress | None = None) -> tuple[Conversion, RunReport]:
        """Convert, write the output and its report; returns the run and what the report has."""
        path = self._request.written
        if path is None and self._map is None:
            run, report = convert(self.job, None, progress)
            report = self._completed(report)
            if self.report_path is not None:
                write_text(self.report_path, report_text(report))
            return run, report
        open_scans = None if path is None else partial(self._open, path)
        only = self._options.only
        try:
            run, report = convert(
                self.job, open_scans, progress, self.files, self._finish, self._map
            )
        except BaseException:
            if path is not None and only is not None:
                discard(path)
            raise
        if path is not None and only is not None:
            _take_out(path, only)
        return run, self._completed(report)

    def _completed(self, report: RunReport) -> RunReport:
        """The report with the command line and, of an output, what made it."""
        figures = None if self._map is None else self._map.figures
        report = report._replace(command=self._request.command, map=figures)
        if self.files is None or self.files.is_shard:
            return report
        from mlbatch.pipeline.job_identity import identity_of_parts

        return report._replace(identity=identity_of_parts(self.files.identity))

    def _open(self, path: Path, info: RunInfo) -> ScanWriter:
        files = self.files
        if files is not None and files.is_continued:
            # Only now it is known that this is the job of the interrupted run.
            self._say(f"{path}: resumed after {files.scans} scans")
        writer = open_writer(self.format, path, info, self._options)
        if files is not None and files.is_shard and not isinstance(writer, FilesWriter):
            from mlbatch.pipeline.shards import not_in_files

            writer.abandon()
            raise not_in_files(self.format)
        return writer

    def _finish(self, report: RunReport, unfinished: Path) -> None:
        """Write the report, or the account of a shard.

        Before the output has its name, so that no output is without one.
        """
        files, path = self.files, self.report_path
        output = self._request.written or self._request.accumulate
        report = self._completed(report)
        if files is not None and files.is_shard:
            from mlbatch.pipeline.shards import write_account

            write_account(unfinished, self.format, self._options, files, report)
            return
        if path is None or output is None:
            return
        if path.parent.absolute() == output.absolute():
            path = unfinished / path.name
        write_text(path, report_text(report), self._options.fsync)
        if self._options.fsync and path.parent.absolute() != output.parent.absolute():
            sync_entries(path.parent)

    # -- earlier runs -------------------------------------------------------------------------

    def _was_completed(self, path: Path) -> bool:
        """True if an earlier run of this job completed the output: there is nothing to resume.

        UsageError if another job made the output, ExportError if files of it are missing.
        """
        from mlbatch.pipeline.files import missing

        if self._request.overwrite or not path.exists() or partial_path(path).exists():
            return False
        changed = self._difference(path)
        if changed:
            raise UsageError(
                f"{path}: expected the complete output of this job for --resume, found {changed}; "
                "choose another output, or replace this one with --overwrite"
            )
        lost = missing(path, self.job, self.format, self._options)
        if lost:
            raise ExportError(
                f"{path}: expected all files of the complete output for --resume, found "
                f"{len(lost)} missing, first {lost[0]}; restore it, or make all again with "
                "--overwrite"
            )
        tidy(path)
        self._say(f"{path}: is complete; there is nothing to resume")
        return True

    def _difference(self, path: Path) -> str:
        """First difference between the job and the one that made an output, "" if there is none.

        Outputs that do not say which job made them have none.
        """
        from mlbatch.pipeline.job_identity import difference_of_outputs, identity_of, read_identity

        job = self.job
        is_shard = (path / SHARD_JSON).is_file()
        if is_shard != (job.shard is not None):
            return (
                f"a shard ({SHARD_JSON})" if is_shard else "all of its scans, not those of a shard"
            )
        report = self._request.report or report_paths(path, self.format).report
        identity = read_identity(report if job.shard is None else path / SHARD_JSON)
        if not identity:
            return ""
        shard = {} if job.shard is None else {"shard": str(job.shard)}
        return difference_of_outputs(identity, identity_of(job, self.format, self._options) | shard)


def _one_file(job: Job, request: OutputRequest) -> tuple[OutputRequest, Path | None]:
    """The request for a folder with one scan, and the file that becomes of it; None for others."""
    only = request.output
    name = "" if only is None else one_file_format(only, request.format)
    if only is None or not name or job.split or job.shard is not None or request.resume:
        return request, None
    if only.exists() and not (request.overwrite and only.is_file()):
        raise ExportError(
            f"{only}: expected a new output, found an existing one; choose another or --overwrite"
        )
    folder = only.with_name(f"{only.name}.d")
    return request._replace(output=folder, format=name), only


def _take_out(folder: Path, only: Path) -> None:
    """Move the only scan and the table out of their folder, and remove that."""
    with export_errors(only):
        (folder / SCANS_CSV).replace(side_path(only, SCANS_CSV))
        (scan,) = folder.glob(f"*{only.suffix.lower()}")
        scan.replace(only)
        folder.rmdir()


def _remove_state(path: Path, say: Listener) -> None:
    """Remove the state file of an earlier version next to an output."""
    old = state_path(path)
    if not old.is_file():
        return
    say(
        f"{old}: expected {FILES_JSONL} in {partial_path(path)}, found the state file of an "
        "earlier version of mlbatch; it is removed, and all files are made again"
    )
    with export_errors(old):
        old.unlink()


def _check_map(job: Job, request: OutputRequest, output: Path | None) -> None:
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
    # Not loaded without a map.
    from mlbatch.writers.map_writer import UNITS_PER_M

    units = (request.voxel or 0.0) * UNITS_PER_M
    if request.voxel is not None and not (10 <= units <= 1e5 and abs(units - round(units)) < 1e-6):
        text = f"--voxel: expected whole millimetres from 0.01 to 100 m, found {request.voxel:g}"
        raise UsageError(f"{text}; write --voxel 0.1")
    if not request.dry_run:
        preflight.check_output(job, path, None)


def _are_one(one: Path | None, other: Path) -> bool:
    return one is not None and one.absolute() == other.absolute()
