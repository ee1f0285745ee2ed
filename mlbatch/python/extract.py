"""Python values of the options of `mlbatch extract`."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypedDict

from mlbatch.discovery.discover import SensorSelection
from mlbatch.errors import UsageError
from mlbatch.pipeline.extract import Extraction
from mlbatch.pipeline.job import MOST_S
from mlbatch.pipeline.time_limits import limits_of
from mlbatch.python.options import (
    AnyPath,
    Document,
    Documents,
    Moment,
    Names,
    Paths,
    metadata_paths,
    names_of,
    paths_of,
    recordings_of,
    rig_path,
)
from mlbatch.units import NS_PER_S


class ExtractOptions(TypedDict, total=False):
    """Options with the names of `mlbatch extract`; duration: s; copy_topics: as `--pass`."""

    rig: Document | None
    metadata: Documents | None
    only: Names | None
    ignore: Names | None
    start: Moment | None
    end: Moment | None
    duration: float | None
    copy_topics: Names | None
    overwrite: bool


def extraction(
    recordings: Paths | tuple[Paths, ...],
    output: AnyPath,
    options: ExtractOptions,
    shown: Callable[[str], str] = str,
) -> Extraction:
    """Return the request of `extract`; shown: the name of an option in errors."""
    start, end, _ = limits_of(
        shown("start"), options.get("start"), shown("end"), options.get("end")
    )
    (target,) = paths_of("output", output)
    duration_ns = _duration_ns(shown("duration"), options.get("duration"))
    if duration_ns is not None and end is not None:
        raise UsageError(
            f"{shown('duration')}: expected one end, found {shown('end')} too; leave one out"
        )
    return Extraction(
        recordings_of(recordings),
        target,
        SensorSelection(
            rig=rig_path(options.get("rig")),
            metadata=metadata_paths(options.get("metadata")),
            only=names_of(options.get("only")),
            ignore=names_of(options.get("ignore")),
        ),
        start,
        end,
        duration_ns,
        names_of(options.get("copy_topics")),
        options.get("overwrite", False),
    )


def _duration_ns(option: str, seconds: float | None) -> int | None:
    if seconds is None:
        return None
    if not 0 < seconds <= MOST_S:
        raise UsageError(f"{option}: expected seconds above 0, found {seconds}; write 2")
    return round(seconds * NS_PER_S)
