"""Python interface: recordings, scans, conversions and outputs (docs/python.md)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Literal

from mlbatch.discovery.inspect import Inspection
from mlbatch.discovery.inspect import inspect as inspect_recordings
from mlbatch.errors import UsageError
from mlbatch.outputs.read import read as read_output
from mlbatch.outputs.scan import Scan
from mlbatch.python.options import (
    AnyPath,
    Box,
    Moment,
    Names,
    Paths,
    Rate,
    ScanOptions,
    path_of,
    paths_of,
    session_job,
)
from mlbatch.python.recording import Recording, scans_of
from mlbatch.python.run import OutputOptions, Run, run_job


def open(
    *recordings: Paths,
    rig: AnyPath | None = None,
    metadata: Paths = (),
    only: Names = (),
    ignore: Names = (),
    identity_extrinsics: bool = False,
    clock: str = "sensor",
    align_clocks: bool = False,
    decode: Mapping[str, str] | None = None,
    strict: bool = False,
    engine: str = "auto",
) -> Recording:
    """Open the recordings of one session; arguments are the options of `mlbatch convert`.

    The first 10 s are read. Raises MlbatchError where the recording cannot be converted at all;
    unknown extrinsics are an error of `Recording.scans` only.
    """
    return Recording(
        session_job(
            recordings,
            rig=rig,
            metadata=metadata,
            only=only,
            ignore=ignore,
            identity_extrinsics=identity_extrinsics,
            clock=clock,
            align_clocks=align_clocks,
            decode=decode,
            strict=strict,
            engine=engine,
        )
    )


def scans(
    *recordings: Paths,
    rig: AnyPath | None = None,
    rate: Rate | None = None,
    start: Moment | None = None,
    end: Moment | None = None,
    slices: int = 1,
    layout: str = "dense",
    sort: str = "columns",
    keep_partial: bool = False,
    max_wait: float = 1.0,
    clock: str = "sensor",
    min_range: float = 0.0,
    max_range: float = math.inf,
    metadata: Paths = (),
    only: Names = (),
    ignore: Names = (),
    identity_extrinsics: bool = False,
    keep_repeated: bool = False,
    decode: Mapping[str, str] | None = None,
    strict: bool = False,
    engine: str = "auto",
    batching: str = "window",
    batching_times: str = "common",
    deskew: AnyPath | None = None,
    deskew_to: str | None = None,
) -> Iterator[Scan]:
    """Yield the merged scans of one session, each with arrays of its own.

    Arguments are the options of `mlbatch convert` (max_wait in s, ranges in m, rate in Hz); fields
    of a Scan are named as the npz keys. Raises MlbatchError where the command ends with an error.
    """
    job = session_job(
        recordings,
        rig=rig,
        metadata=metadata,
        only=only,
        ignore=ignore,
        identity_extrinsics=identity_extrinsics,
        clock=clock,
        decode=decode,
        strict=strict,
        engine=engine,
    )
    options = ScanOptions(
        rate=rate,
        start=start,
        end=end,
        slices=slices,
        layout=layout,
        sort=sort,
        keep_partial=keep_partial,
        keep_repeated=keep_repeated,
        max_wait=max_wait,
        min_range=min_range,
        max_range=max_range,
        batching=batching,
        batching_times=batching_times,
        deskew=deskew,
        deskew_to=deskew_to,
    )
    yield from scans_of(options.apply(job))


def convert(
    recording: Recording | Paths,
    output: AnyPath | None,
    *,
    rig: AnyPath | None = None,
    metadata: Paths = (),
    rate: Rate | None = None,
    start: Moment | None = None,
    end: Moment | None = None,
    slices: int = 1,
    layout: str = "dense",
    split: bool = False,
    keep_partial: bool = False,
    drop_incomplete: float = 0.0,
    max_wait: float = 1.0,
    min_range: float = 0.0,
    max_range: float = math.inf,
    exclude_boxes: Iterable[Box] = (),
    keep_repeated: bool = False,
    sort: str = "columns",
    copy_topics: Names = (),
    stamp: str = "start",
    batching: str = "window",
    batching_times: str = "common",
    deskew: AnyPath | None = None,
    deskew_to: str | None = None,
    format: str | None = None,
    point_layout: str = "standard",
    compression: str = "none",
    ply_style: str = "standard",
    max_bag_duration: float = 0.0,
    overwrite: bool = False,
    fsync: bool = True,
    report: AnyPath | None = None,
    jobs: int | Literal["auto"] = "auto",
) -> Run:
    """Write the scans of a recording as `mlbatch convert` does; its options are the arguments.

    recording: opened, or paths (then rig and metadata may be given); output: None: a dry run;
    copy_topics: as `--pass`. Raises MlbatchError where the command ends with an error.
    """
    if isinstance(recording, Recording):
        if rig is not None or paths_of("metadata", metadata):
            raise UsageError(
                "convert: expected rig and metadata with paths only, found an opened recording; "
                "give them to mlbatch.open"
            )
        job = recording.job
    else:
        job = session_job(recording, rig=rig, metadata=metadata)
    options = ScanOptions(
        rate=rate,
        start=start,
        end=end,
        slices=slices,
        layout=layout,
        sort=sort,
        split=split,
        keep_partial=keep_partial,
        drop_incomplete=drop_incomplete,
        max_wait=max_wait,
        min_range=min_range,
        max_range=max_range,
        exclude_boxes=exclude_boxes,
        keep_repeated=keep_repeated,
        copy_topics=copy_topics,
        stamp=stamp,
        batching=batching,
        batching_times=batching_times,
        deskew=deskew,
        deskew_to=deskew_to,
    )
    target = OutputOptions(
        format=format,
        point_layout=point_layout,
        compression=compression,
        ply_style=ply_style,
        max_bag_duration=max_bag_duration,
        overwrite=overwrite,
        fsync=fsync,
        report=path_of("report", report),
        jobs=jobs,
    )
    return run_job(options.apply(job), path_of("output", output), target)


def read(output: AnyPath) -> Iterator[Scan]:
    """Yield the scans of an output of `convert`, in any format.

    Arrays that the format does not store are empty, and named in `Scan.absent`. Raises
    RecordingError where the output is damaged.
    """
    (path,) = paths_of("output", output)
    return read_output(path)


def inspect(recordings: Paths, metadata: Paths = (), *, whole: bool = False) -> Inspection:
    """What the first 10 s of recordings contain (whole: all of them), as `mlbatch inspect`."""
    paths = paths_of("recording", recordings)
    return inspect_recordings(paths, paths_of("metadata", metadata), whole=whole)
