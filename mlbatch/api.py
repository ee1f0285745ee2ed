"""Python interface: recordings, scans, conversions and outputs (docs/python.md)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING

from mlbatch.comparison.compare import Comparison, Settings
from mlbatch.comparison.compare import compare as compare_policies
from mlbatch.comparison.figures import check_figures, write_figures
from mlbatch.errors import UsageError
from mlbatch.outputs.read import read as read_output
from mlbatch.outputs.scan import Scan
from mlbatch.page import check_page, find_source, shown_scans, write_page, write_text_page
from mlbatch.page.calibration import calibration_page
from mlbatch.page.comparison import comparison_page
from mlbatch.page.policies import DEFAULT_MPS
from mlbatch.pipeline.conversion import Progress
from mlbatch.pipeline.extract import Extracted
from mlbatch.pipeline.extract import extract as extract_packets
from mlbatch.pipeline.inspect import Inspection
from mlbatch.pipeline.inspect import inspect as inspect_recordings
from mlbatch.pipeline.job import Job
from mlbatch.poses.calibration import Calibration
from mlbatch.python.calibrate import CalibrateOptions, calibrate_job, check_output, rig_text
from mlbatch.python.calibrate import calibrate as calibrate_rig
from mlbatch.python.dataset import Dataset, dataset_of
from mlbatch.python.extract import ExtractOptions, extraction
from mlbatch.python.options import (
    AnyPath,
    ConvertOptions,
    Document,
    Documents,
    Paths,
    Rate,
    ScanOptions,
    SessionOptions,
    check_names,
    documented,
    metadata_paths,
    path_of,
    paths_of,
    rig_path,
    session_job,
    window_job,
)
from mlbatch.python.recording import Recording, scans_of
from mlbatch.python.run import Run, run_job
from mlbatch.units import NS_PER_S
from mlbatch.writers.atomic import write_text

if TYPE_CHECKING:
    # In `typing` from Python 3.11 on.
    from typing_extensions import Unpack


@documented(SessionOptions)
def open(*recordings: Paths, **options: Unpack[SessionOptions]) -> Recording:
    """Open the recordings of one session; options are as for `mlbatch convert`.

    The first 10 s are read. Raises MlbatchError where the recording cannot be converted at all;
    unknown extrinsics are an error of `Recording.scans` only.
    """
    check_names("mlbatch.open", options, SessionOptions)
    return Recording(session_job(recordings, options))


@documented(ScanOptions)
def scans(*recordings: Paths, **options: Unpack[ScanOptions]) -> Iterator[Scan]:
    """Yield the merged scans of one session, each with arrays of its own.

    Options are as for `mlbatch convert` (max_wait in s, ranges in m, rate in Hz); fields
    of a Scan are named as the npz keys. Raises MlbatchError where the command ends with an error;
    what the first 10 s show is raised at the call.
    """
    check_names("mlbatch.scans", options, ScanOptions)
    return scans_of(window_job(session_job(recordings, options), options))


@documented(ConvertOptions)
def convert(
    recording: Recording | Paths, output: AnyPath | None, **options: Unpack[ConvertOptions]
) -> Run:
    """Write the scans of a recording as `mlbatch convert` does, with its options.

    recording: opened, or paths (then it takes the options of mlbatch.open, too); output: None: a
    dry run; copy_topics: as `--pass`. Raises MlbatchError where the command ends with an error.
    """
    check_names("mlbatch.convert", options, ConvertOptions)
    if isinstance(recording, Recording):
        for name in SessionOptions.__annotations__:
            if name in options:
                raise UsageError(
                    f"convert: expected {name} with paths only, found an opened recording; give it "
                    "to mlbatch.open"
                )
        job = recording.job
    else:
        job = session_job(recording, options)
    return run_job(window_job(job, options), path_of("output", output), options)


@documented(ExtractOptions)
def extract(recordings: Paths, output: AnyPath, **options: Unpack[ExtractOptions]) -> Extracted:
    """Write raw packets into another recording, as `mlbatch extract` does, with its options.

    start, end: int ns or texts, by receive time; duration: s; copy_topics: as `--pass`. Raises
    MlbatchError where the command ends with an error.
    """
    check_names("mlbatch.extract", options, ExtractOptions)
    return extract_packets(extraction(recordings, output, options))


def read(output: AnyPath) -> Iterator[Scan]:
    """Yield the scans of an output of `convert`, in any format.

    Arrays that the format does not store are empty, and named in `Scan.absent`. Raises
    RecordingError where the output is damaged.
    """
    (path,) = paths_of("output", output)
    return read_output(path)


def report(
    source: AnyPath,
    output: AnyPath | None = None,
    *,
    report: AnyPath | None = None,
    html_scans: int | str | None = None,
    overwrite: bool = False,
) -> Path:
    """Write a page (HTML) of a run, as `mlbatch report` does, and return its path.

    source: an output, or a report; html_scans: number of scans, or "all".
    """
    (path,) = paths_of("source", source)
    found = find_source(path, path_of("report", report))
    shown = shown_scans(None if html_scans is None else str(html_scans), "html_scans")
    page = path_of("output", output) or found.page
    check_page(page, overwrite=overwrite)
    write_page(page, replace(found, scans=shown))
    return page


def compare(
    recordings: Paths,
    rig: Document | None = None,
    *,
    rate: Rate | None = None,
    metadata: Documents = (),
    clock: str = "sensor",
    tolerance: float = 0.05,
    timeout: float = 0.1,
    html: AnyPath | None = None,
    figures: AnyPath | None = None,
    speed: float = DEFAULT_MPS,
    overwrite: bool = False,
) -> Comparison:
    """Compare frame-level fusion with windows, as `mlbatch compare` does; write page and figures.

    tolerance, timeout: s; speed: of an object on the page, m/s.
    """
    session = session_job(recordings, {"rig": rig, "metadata": metadata, "clock": clock})
    found, _ = run_comparison(
        window_job(session, {"rate": rate}),
        tolerance=tolerance,
        timeout=timeout,
        html=path_of("html", html),
        figures=path_of("figures", figures),
        speed=speed,
        overwrite=overwrite,
    )
    return found


def run_comparison(
    job: Job,
    *,
    tolerance: float | str,
    timeout: float | str,
    html: Path | None,
    figures: Path | None,
    speed: float | str,
    overwrite: bool,
    shown: Callable[[str], str] = str,
    show: Callable[[str], object] | None = None,
    command: str = "mlbatch.compare",
    progress: Progress | None = None,
) -> tuple[Comparison, list[Path]]:
    """Compare policies on the recordings of a job; write the page and the figures asked for.

    shown: the name of an option in errors; show: takes the page instead of a file. Returns the
    paths of what was written, too.
    """
    settings = Settings(
        round(_above_0(shown("tolerance"), tolerance, "seconds", "0.05") * NS_PER_S),
        round(_above_0(shown("timeout"), timeout, "seconds", "0.05") * NS_PER_S),
    )
    speed_mps = _above_0(shown("speed"), speed, "m/s", "10")
    if html is not None:
        check_page(html, overwrite=overwrite)
    if figures is not None:
        check_figures(figures, overwrite=overwrite)
    has_page = html is not None or show is not None
    found = compare_policies(job, settings, progress, finds_instant=has_page)
    policies = found.figures()
    written = [] if figures is None else write_figures(figures, policies)
    if has_page:
        names = ", ".join(path.name for path in job.recordings)
        notes = [f"{note.code}: {note.message}" for note in found.notes]
        words = (names, found.title(), policies, notes, command)
        page = comparison_page(*words, found.instant, speed_mps)
        if html is not None:
            write_text_page(html, page)
            written.append(html)
        if show is not None:
            show(page)
    return found, written


def _above_0(option: str, value: float | str, unit: str, example: str) -> float:
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not 0 < number < math.inf:
        raise UsageError(f"{option}: expected {unit} above 0, found {value!r}; write {example}")
    return number


def dataset(*outputs: Paths) -> Dataset:
    """Open finished outputs of `convert` for random access, as for training.

    outputs: paths, or patterns ("out/*"), which leave out what is no finished output. Only indexes
    are read. Raises MlbatchError where an output is damaged.
    """
    return dataset_of(path for one in outputs for path in paths_of("output", one))


def inspect(recordings: Paths, metadata: Documents = (), *, whole: bool = False) -> Inspection:
    """Inspect the first 10 s of recordings (whole: all of them), as `mlbatch inspect` does."""
    paths = paths_of("recording", recordings)
    if not paths:
        raise UsageError("recording: expected at least one path, found none; name a recording")
    return inspect_recordings(paths, metadata_paths(metadata), whole=whole)


@documented(CalibrateOptions)
def calibrate(
    recordings: Paths,
    rig: Document,
    output: AnyPath | None = None,
    *,
    time_offset: bool = False,
    from_motion: bool = False,
    html: AnyPath | None = None,
    overwrite: bool = False,
    **options: Unpack[CalibrateOptions],
) -> Calibration:
    """Refine the poses of a rig's lidars, as `mlbatch calibrate` does; write rig and page if asked.

    rig: with a guess of each pose, within 20 degrees and 1 m. Raises MlbatchError where the
    recording does not determine the poses.
    """
    guess = rig_path(rig)
    if guess is None:
        raise UsageError("rig: expected a path or a mapping, found None; give the guess")
    check_names("mlbatch.calibrate", options, CalibrateOptions)
    job = calibrate_job(recordings, guess, options, from_motion=from_motion)
    return run_calibration(
        job,
        path_of("output", output),
        path_of("html", html),
        time_offset=time_offset,
        from_motion=from_motion,
        overwrite=overwrite,
    )


def run_calibration(
    job: Job,
    output: Path | None,
    html: Path | None,
    *,
    time_offset: bool,
    from_motion: bool,
    overwrite: bool,
    command: str = "mlbatch.calibrate",
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate the rig of a job; write the rig file and the page that are asked for."""
    if output is not None:
        check_output(output, overwrite=overwrite)
    if html is not None:
        check_page(html, overwrite=overwrite)
    found = calibrate_rig(job, time_offset=time_offset, from_motion=from_motion, progress=progress)
    if output is not None:
        text = rig_text(job, found, output.parent, date.today())
        write_text(output, text)
    if html is not None:
        names = ", ".join(path.name for path in job.recordings)
        write_text_page(html, calibration_page(names, found, command))
    return found
