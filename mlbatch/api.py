"""Python interface: recordings, scans, conversions and outputs (docs/python.md)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from mlbatch.errors import UsageError
from mlbatch.outputs.read import read as read_output
from mlbatch.outputs.scan import Scan
from mlbatch.pipeline.inspect import Inspection
from mlbatch.pipeline.inspect import inspect as inspect_recordings
from mlbatch.python.options import (
    AnyPath,
    ConvertOptions,
    Paths,
    ScanOptions,
    SessionOptions,
    check_names,
    documented,
    path_of,
    paths_of,
    session_job,
    window_job,
)
from mlbatch.python.recording import Recording, scans_of
from mlbatch.python.run import Run, run_job

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


def read(output: AnyPath) -> Iterator[Scan]:
    """Yield the scans of an output of `convert`, in any format.

    Arrays that the format does not store are empty, and named in `Scan.absent`. Raises
    RecordingError where the output is damaged.
    """
    (path,) = paths_of("output", output)
    return read_output(path)


def inspect(recordings: Paths, metadata: Paths = (), *, whole: bool = False) -> Inspection:
    """Inspect the first 10 s of recordings (whole: all of them), as `mlbatch inspect` does."""
    paths = paths_of("recording", recordings)
    if not paths:
        raise UsageError("recording: expected at least one path, found none; name a recording")
    return inspect_recordings(paths, paths_of("metadata", metadata), whole=whole)
