"""What to make of which recordings: the options of `mlbatch convert` as values."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from fractions import Fraction
from operator import index
from pathlib import Path
from typing import TYPE_CHECKING, SupportsIndex

from mlbatch.batching.windows import Limit
from mlbatch.discovery.discover import SensorSelection
from mlbatch.errors import UsageError
from mlbatch.pipeline.segments import Part
from mlbatch.types import EXTRAS
from mlbatch.units import NS_PER_S

if TYPE_CHECKING:
    from mlbatch.faults.replay import Fault

DEFAULT_RATE = Fraction(10)
DEFAULT_MAX_WAIT_NS = NS_PER_S
# Nothing lasts longer, and ns of it still fit into int64.
MOST_S = 2**33
MAX_SLICES = 10_000


@dataclass(frozen=True, slots=True)
class Job:
    """What to make of which recordings; times in ns, ranges and boxes in m, body frame.

    rate None: that of the rig, else 10 Hz; drop_incomplete: percent of the columns of every sensor
    that a window must hold; max_wait_ns None: for ever; boxes_m: (k, 6); extras: those of EXTRAS
    that the output has a place for; fault_begin_ns: arrival from which times of faults count, None:
    the first packet; part: of the session, by arrival; passed: patterns of topics to pass through;
    align_clocks_to: host or first, "" where clocks are taken as they are; jobs: scans that are made
    at the same time; engine: one of `kernels.ENGINES`.
    """

    recordings: tuple[Path, ...]
    selection: SensorSelection = field(default_factory=SensorSelection)
    rate: Fraction | None = None
    slices: int = 1
    layout: str = "dense"
    split: bool = False
    keep_partial: bool = False
    keep_repeated: bool = False
    drop_incomplete: float = 0.0
    max_wait_ns: int | None = DEFAULT_MAX_WAIT_NS
    start: Limit | None = None
    end: Limit | None = None
    limits_are_dates: bool = False
    min_range_m: float = 0.0
    max_range_m: float = float("inf")
    boxes_m: tuple[tuple[float, ...], ...] = ()
    strict: bool = False
    faults: tuple[Fault, ...] = ()
    fault_seed: int = 0
    fault_begin_ns: int | None = None
    align_clocks_to: str = ""
    part: Part = field(default_factory=Part)
    passed: tuple[str, ...] = ()
    extras: frozenset[str] = EXTRAS
    jobs: int = 1
    engine: str = "auto"


def wait_ns(option: str, seconds: float, given: object) -> int | None:
    """`max_wait_ns` of a job from seconds; given: what the user wrote."""
    if math.isnan(seconds) or seconds <= 0:
        raise UsageError(f"{option}: wanted seconds above 0, or inf, got {given!r}; write 1.0")
    # Less than a nanosecond is above 0 as well.
    return None if seconds > MOST_S else max(1, round(seconds * NS_PER_S))


def check_slices(option: str, count: object) -> int:
    """`slices` of a job, a whole number."""
    if not (isinstance(count, SupportsIndex) and 1 <= index(count) <= MAX_SLICES):
        raise UsageError(
            f"{option}: wanted a whole number from 1 to {MAX_SLICES}, got {count!r}; leave it out "
            "for 1"
        )
    return index(count)


def check_ranges_m(low_option: str, low: float, high_option: str, high: float) -> None:
    """Refuse limits of ranges between which none lies."""
    if not 0 <= low < math.inf:
        raise UsageError(f"{low_option}: wanted 0 or more metres, got {low}; write 0.5")
    if not high > low:
        raise UsageError(
            f"{high_option}: wanted more than {low_option} ({low} m), got {high} m; write 100"
        )
