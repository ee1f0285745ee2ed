"""Options of a conversion as values: recordings, sensors, windows, output."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from mlbatch.batching.windows import COMMON, WINDOW, Limit
from mlbatch.discovery.discover import SensorSelection
from mlbatch.errors import UsageError
from mlbatch.options import INSTANTS
from mlbatch.types import EXTRAS, RecordLayout
from mlbatch.units import NS_PER_S

if TYPE_CHECKING:
    from mlbatch.faults import Fault

DEFAULT_RATE = Fraction(10)
DEFAULT_MAX_WAIT_NS = NS_PER_S
# Upper bound of any time, s: its nanoseconds fit into int64.
MOST_S = 2**33


class TimeSegment(NamedTuple):
    """Receive times in [begin_ns, end_ns); None: no limit."""

    begin_ns: int | None = None
    end_ns: int | None = None


@dataclass(frozen=True, slots=True)
class Shard:
    """One of the shards of a conversion."""

    number: int  # from 1
    count: int

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    def has(self, file: int) -> bool:
        """Whether a file is of this shard, by its number."""
        return file % self.count == self.number - 1


def parse_shard(option: str, text: str) -> Shard:
    """A part of a whole, K/N with K from 1 to N; option: for errors."""
    match = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text, re.ASCII)
    shard = Shard(int(match[1]), int(match[2])) if match else Shard(0, 0)
    if not 1 <= shard.number <= shard.count:
        raise UsageError(
            f"{option}: expected K/N with K from 1 to N, found {text!r}; write {option} 1/8"
        )
    return shard


@dataclass(frozen=True, slots=True)
class Job:
    """Options of a conversion; names and defaults as in `mlbatch convert`."""

    recordings: tuple[Path, ...]
    selection: SensorSelection = field(default_factory=SensorSelection)
    rate: Fraction | None = None  # Hz; None: the rig's, else 10
    slices: int = 1  # sub-scans per window
    layout: str = "dense"  # or organized
    sort: str = "columns"  # or points: order of the points of a scan
    split: bool = False  # one scan per sensor instead of merged ones
    keep_partial: bool = False  # also the first and the last, partial window
    keep_repeated: bool = False  # the second of two equal returns of a shot
    drop_incomplete: float = 0.0  # percent of the columns of every sensor that a window must have
    max_wait_ns: int | None = DEFAULT_MAX_WAIT_NS  # idle-source timeout; None: infinite
    start: Limit | None = None
    end: Limit | None = None
    limits_are_dates: bool = False  # start or end was given as a date
    min_range_m: float = 0.0
    max_range_m: float = math.inf
    boxes_m: tuple[tuple[float, ...], ...] = ()  # excluded: (x0, y0, z0, x1, y1, z1), body frame
    strict: bool = False  # warnings and rejected packets are errors
    faults: tuple[Fault, ...] = ()  # to inject
    fault_seed: int = 0
    fault_begin_ns: int | None = None  # receive time that fault times count from; None: the first
    align_clocks_to: str = ""  # host or first; "": clocks are not aligned
    segment: TimeSegment = field(default_factory=TimeSegment)  # of the session, by receive time
    passed: tuple[str, ...] = ()  # patterns of topics to forward
    extras: frozenset[str] = EXTRAS  # optional contents that the output can store
    record: RecordLayout | None = None  # records of points that the output takes packed
    stamp: str = "start"  # or middle, end: instant of a window that its message is stamped with
    batching: str = WINDOW  # or a policy of frame-level fusion
    batching_times: str = COMMON  # or own
    deskew: str = ""  # where poses come from: imu, or the path of a trajectory; "": no motion
    deskew_to: str = INSTANTS[0]  # instant of a window that its points are moved to
    checks_poses: bool = True  # compares what lidars see of the same surfaces
    max_bag_s: float = 0.0  # recorded time in a file of a ROS 2 bag, s; 0: all in one file
    shard: Shard | None = None  # the only scans to make; None: all
    jobs: int = 1  # scans made at the same time

    @property
    def is_fused(self) -> bool:
        """Whether scans are sets of sweeps instead of windows."""
        return self.batching != WINDOW

    @property
    def variants(self) -> tuple[tuple[str, str], ...]:
        """See `RunInfo`."""
        values = (
            ("batching", self.batching, WINDOW),
            # Also the default: with it nothing is left to guess.
            ("batching_times", self.batching_times if self.is_fused else "", ""),
            ("stamp", self.stamp, "start"),
            # Without folders: outputs do not depend on where files are.
            ("deskew", Path(self.deskew).name, ""),
            ("deskew_to", self.deskew_to if self.deskew else "", ""),
        )
        return tuple((name, value) for name, value, default in values if value != default)


def wait_ns(option: str, given: object) -> int | None:
    """`max_wait_ns` of a job: from seconds, as a number or a text, or inf; None: infinite."""
    try:
        seconds = float(given)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        seconds = math.nan
    if math.isnan(seconds) or seconds <= 0:
        raise UsageError(f"{option}: expected seconds above 0, or inf, found {given!r}; write 1.0")
    # Rounds less than a nanosecond up, since it is above 0.
    return None if seconds > MOST_S else max(1, round(seconds * NS_PER_S))


def check_sort(option: str, sort: str, layout: str) -> str:
    """`sort` of a job; an organized scan has no order of points."""
    if sort == "points" and layout == "organized":
        raise UsageError(
            f"{option} points: expected a dense layout, found organized, whose points have the "
            "places of their columns; leave one of them out"
        )
    return sort


def check_deskew(job: Job, is_given: bool) -> Job:
    """Return the job; UsageError for poses that cannot be had; is_given: of `--deskew-to`."""
    if is_given and not job.deskew:
        raise UsageError(
            "--deskew-to: expected --deskew, which moves points, found none; give --deskew imu or "
            "--deskew FILE.tum, or leave it out"
        )
    # What would give other velocities than the whole recording, or none.
    is_by_points = job.deskew == "constant-velocity"
    if is_by_points and job.is_fused:
        raise UsageError(
            "--deskew constant-velocity: expected windows, which follow each other, found "
            f"--batching {job.batching}; leave one of them out"
        )
    if is_by_points and job.start is not None:
        raise UsageError(
            "--deskew constant-velocity: expected the recording from its beginning, since each "
            "window needs those before it, found --start; leave it out, or give poses "
            "(--deskew FILE.tum)"
        )
    if job.deskew == "imu" and job.selection.host_clock:
        raise UsageError(
            "--deskew imu: expected the clocks of the sensors, which IMU samples have, found "
            "--clock host; leave one of them out"
        )
    is_file = job.deskew not in ("", "imu") and not is_by_points
    if is_file and not Path(job.deskew).is_file():
        raise UsageError(
            "--deskew: expected imu, constant-velocity or the file of a trajectory (TUM), found "
            f"{job.deskew!r}; check the path"
        )
    return job


def check_batching(job: Job) -> Job:
    """Return the job; UsageError for options that have no meaning for sets of sweeps."""
    if not job.is_fused:
        if job.batching_times != COMMON:
            raise UsageError(
                f"--batching-times: expected {COMMON} for windows, found {job.batching_times}; "
                "give --batching latest, or leave it out"
            )
        return job
    given = {
        "--slices": job.slices > 1,
        "--split": job.split,
        "--keep-partial": job.keep_partial,
        "--drop-incomplete": job.drop_incomplete > 0,
    }
    for option, is_given in given.items():
        if is_given:
            raise UsageError(
                f"{option}: expected windows, found --batching {job.batching}, whose scans are "
                "sets of sweeps; leave one of them out"
            )
    return job


def check_ranges_m(low_option: str, low: float, high_option: str, high: float) -> None:
    """Raise UsageError for ranges that leave no point."""
    if not high > low:
        raise UsageError(
            f"{high_option}: expected more than {low_option} ({low} m), found {high} m; write 100"
        )
