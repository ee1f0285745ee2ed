"""Two engines side by side: the same columns decoded by both, all bytes compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np
import pytest

from mlbatch.decode.decoder import Decoder, ScanHeader, WindowColumns
from mlbatch.native.library import trouble
from mlbatch.pipeline.conversion import Conversion, SkippedWindow
from mlbatch.pipeline.job import Job
from mlbatch.pipeline.session import excluded_boxes_m, limits
from mlbatch.types import EXTRAS, Scan
from mlbatch.units import rate_text

needs_native = pytest.mark.skipif(
    bool(trouble()), reason="the engine native is not installed: no C compiler was found"
)
ENGINES = ("numpy", "native")

# Layers of space, in which every sensor has some points.
BOXES_M = ((-90.0, -90.0, -90.0, 90.0, 90.0, 0.0), (-90.0, -90.0, 0.3, 90.0, 90.0, 1.5))
_CUT = Job((), min_range_m=2.0, max_range_m=5.0, boxes_m=BOXES_M)
# Jobs on the same columns: all layouts, extras, and reasons to leave points out.
WANTED = (
    Job((), extras=EXTRAS),
    Job((), extras=frozenset(), keep_repeated=True),
    replace(_CUT, extras=frozenset({"range_m"})),
    replace(_CUT, extras=frozenset({"column", "reflectivity"}), min_range_m=0.0, boxes_m=()),
    Job((), extras=EXTRAS, layout="organized", keep_repeated=True),
    replace(_CUT, extras=frozenset({"reflectivity"}), layout="organized"),
    Job((), extras=frozenset(), layout="organized"),
)


class Pair:
    """The decoders of both engines, made for the same sensors and wishes."""

    def __init__(self, one: Decoder, other: Decoder) -> None:
        self.one = one
        self.other = other

    def check(self, due: WindowColumns, label: ScanHeader) -> Scan:
        """Decode a window by both; all that they say is the same, byte by byte."""
        one = self.one.scan(due, label)
        other = self.other.scan(due, label)
        assert_same(one, other)
        assert self.one.counts == self.other.counts
        return one


def assert_same(one: Scan, other: Scan) -> None:
    """All fields of two scans have the same bytes."""
    for part in fields(Scan):
        first = getattr(one, part.name)
        second = getattr(other, part.name)
        if isinstance(first, np.ndarray):
            assert (first.dtype, first.shape) == (second.dtype, second.shape), part.name
            assert first.tobytes() == second.tobytes(), part.name
        else:
            assert first == second, part.name


def check_conversion(job: Job, wanted: Sequence[Job] = WANTED) -> list[Pair]:
    """Decode all windows of a job by both engines, with the settings of each of `wanted`."""
    run = Conversion(job)
    pairs: list[Pair] = []
    for task in run.tasks():
        if isinstance(task, SkippedWindow):
            continue
        pairs = pairs or [Pair(*(_decoder(run, one, name) for name in ENGINES)) for one in wanted]
        for pair in pairs:
            pair.check(task.columns, task.label)
        task.is_decoded = True
    return pairs


def _decoder(run: Conversion, wanted: Job, engine: str) -> Decoder:
    assert run.info is not None
    session = run.session
    info = session.run_info(rate_text(run.grid.rate), run.info.timescale)
    sensors = [replace(one, limits=limits(wanted, one.rig)) for one in run.sensors]
    return Decoder(
        info._replace(layout=wanted.layout),
        [sensor.source() for sensor in sensors],
        excluded_boxes_m(wanted, session.setup.rig),
        wanted.extras,
        engine=engine,
    )
