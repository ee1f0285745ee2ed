"""Python values of options to a `Job`, whose fields are those of the command line."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from os import PathLike, fspath
from pathlib import Path
from typing import TypeAlias

from mlbatch.discovery.discover import SensorSelection
from mlbatch.errors import UsageError
from mlbatch.native import ALIASES, ENGINES
from mlbatch.pipeline.job import (
    Job,
    check_batching,
    check_deskew,
    check_ranges_m,
    check_slices,
    check_sort,
    wait_ns,
)
from mlbatch.pipeline.time_limits import limits_of
from mlbatch.readers.inputs import expand
from mlbatch.types import INSTANTS
from mlbatch.units import parse_rate

AnyPath: TypeAlias = "str | PathLike[str]"
# One path or several: a text is one, never an iterable of its letters.
Paths: TypeAlias = "AnyPath | Iterable[AnyPath]"
Names: TypeAlias = "str | Iterable[str]"
Rate: TypeAlias = int | float | str | Fraction
# Nanoseconds of the common clock; or a text as on the command line: ISO time, epoch seconds, +S.
Moment: TypeAlias = int | str
Box: TypeAlias = "tuple[float, float, float, float, float, float]"

_BOX_VALUES = 6


def paths_of(what: str, values: Paths) -> tuple[Path, ...]:
    """One or several paths as a tuple."""
    if isinstance(values, str | PathLike):
        return (_path(what, values),)
    if not isinstance(values, Iterable):
        raise _no_path(what, values)
    return tuple(_path(what, value) for value in values)


def path_of(what: str, value: AnyPath | None) -> Path | None:
    """A path, or None."""
    return None if value is None else _path(what, value)


def names_of(values: Names) -> tuple[str, ...]:
    """One or several names as a tuple."""
    return (values,) if isinstance(values, str) else tuple(values)


def _path(what: str, value: object) -> Path:
    if not isinstance(value, str | PathLike):
        raise _no_path(what, value)
    return Path(fspath(value))


def _no_path(what: str, value: object) -> UsageError:
    return UsageError(
        f"{what}: expected a path (str or Path) or several, found {type(value).__name__}; "
        "give the name of a file"
    )


def choice(option: str, value: str, known: Iterable[str]) -> str:
    """An option with a closed list of words."""
    words = tuple(known)
    if value not in words:
        raise UsageError(f"{option}: expected {' or '.join(words)}, found {value!r}; choose one")
    return value


def session_job(
    recordings: Paths | tuple[Paths, ...],
    *,
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
) -> Job:
    """The options that select recordings and sensors; those of windows have their defaults."""
    choice("clock", clock, ("sensor", "host"))
    choice("engine", engine, (*ENGINES, *ALIASES))
    several = recordings if isinstance(recordings, tuple) else (recordings,)
    found = expand(path for one in several for path in paths_of("recording", one))
    if not found:
        raise UsageError("recording: expected at least one path, found none; name a recording")
    return Job(
        recordings=found,
        selection=SensorSelection(
            rig=path_of("rig", rig),
            metadata=paths_of("metadata", metadata),
            only=names_of(only),
            ignore=names_of(ignore),
            identity_extrinsics=identity_extrinsics,
            host_clock=clock == "host",
            aligned=align_clocks,
            decode=dict(decode or {}),
        ),
        align_clocks_to="host" if align_clocks else "",
        strict=strict,
        engine=ALIASES.get(engine, engine),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanOptions:
    """Options of windows and points, with the names and defaults of `mlbatch convert`.

    rate: Hz; start, end: see `Moment`; max_wait: s; ranges and boxes: m; drop_incomplete: percent.
    """

    rate: Rate | None = None
    start: Moment | None = None
    end: Moment | None = None
    slices: int = 1
    layout: str = "dense"
    sort: str = "columns"
    split: bool = False
    keep_partial: bool = False
    drop_incomplete: float = 0.0
    max_wait: float = 1.0
    min_range: float = 0.0
    max_range: float = math.inf
    exclude_boxes: Iterable[Box] = ()
    keep_repeated: bool = False
    copy_topics: Names = ()
    stamp: str = "start"
    batching: str = "window"
    batching_times: str = "common"
    # "imu", "constant-velocity", or the path of a trajectory.
    deskew: AnyPath | None = None
    deskew_to: str | None = None

    def apply(self, job: Job) -> Job:
        """A job with these options."""
        choice("layout", self.layout, ("dense", "organized"))
        choice("stamp", self.stamp, INSTANTS)
        choice("deskew_to", self.deskew_to or INSTANTS[0], INSTANTS)
        check_ranges_m("min_range", self.min_range, "max_range", self.max_range)
        if not 0 <= self.drop_incomplete <= 100:
            raise UsageError(
                f"drop_incomplete: expected a share from 0 to 100 %, found "
                f"{self.drop_incomplete:g}; correct it"
            )
        start, end, are_dates = limits_of("start", self.start, "end", self.end)
        job = replace(
            job,
            # By the text of a float: 29.97 means 2997/100, not the nearest binary number.
            rate=None if self.rate is None else parse_rate(str(self.rate)),
            slices=check_slices("slices", self.slices),
            layout=self.layout,
            sort=check_sort("sort", self.sort, self.layout),
            split=self.split,
            keep_partial=self.keep_partial,
            keep_repeated=self.keep_repeated,
            drop_incomplete=self.drop_incomplete,
            max_wait_ns=wait_ns("max_wait", self.max_wait, self.max_wait),
            start=start,
            end=end,
            limits_are_dates=are_dates,
            min_range_m=self.min_range,
            max_range_m=self.max_range,
            boxes_m=tuple(_box(box) for box in self.exclude_boxes),
            passed=names_of(self.copy_topics),
            stamp=self.stamp,
            batching=self.batching,
            batching_times=self.batching_times,
            deskew=str(path_of("deskew", self.deskew) or ""),
            deskew_to=self.deskew_to or INSTANTS[0],
        )
        return check_deskew(check_batching(job), self.deskew_to is not None)


def _box(values: Box) -> tuple[float, ...]:
    box = tuple(map(float, values))
    if len(box) != _BOX_VALUES or not all(a < b for a, b in zip(box[:3], box[3:], strict=True)):
        raise UsageError(
            "exclude_boxes: expected (x0, y0, z0, x1, y1, z1) in metres with x0 < x1, y0 < y1, "
            f"z0 < z1, found {values!r}; correct it"
        )
    return box
