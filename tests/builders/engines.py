"""The compiled decoder beside the literal one: the same columns decoded by both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.decode.decoder import Decoder
from mlbatch.decode.groups import Source
from mlbatch.native.arena import PacketArena
from mlbatch.pipeline.conversion import Conversion, SkippedWindow
from mlbatch.pipeline.job import Job
from mlbatch.pipeline.sensor import sensors_of
from mlbatch.types import EXTRAS, RunInfo, Scan, Window
from tests.reference.decoder import LiteralDecoder, check_scan

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
# Columns of a window that are compared: the literal decoder takes 2 ms for one of 128 beams.
MOST_COLUMNS = 4


class Pair:
    """Both decoders, made for the same sensors and wishes."""

    def __init__(
        self,
        info: RunInfo,
        sources: Sequence[Source],
        boxes_m: F64Array,
        extras: frozenset[str] = EXTRAS,
    ) -> None:
        self.sources = sources
        self.decoder = Decoder(info, sources, boxes_m, extras)
        self.literal = LiteralDecoder(sources, np.asarray(boxes_m).reshape(-1, 6))

    def check(self, window: Window) -> Scan:
        """Decode a window; the scan, and the counts so far, are what the columns say."""
        scan = self.decoder.scan(window)
        check_scan(self.literal, window.columns, scan, window.start_ns)
        for counts, expected in zip(self.decoder.counts, self.literal.counts, strict=True):
            for name in ("slots", "no_return", "repeated", "range", "box", "written"):
                assert getattr(counts, name) == expected[name], name
        return scan


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
    """Decode columns of all windows of a job by both, with the settings of each of `wanted`."""
    run = Conversion(job)
    rng = np.random.default_rng(1)
    pairs: list[Pair] = []
    for task in run.tasks():
        if isinstance(task, SkippedWindow):
            continue
        pairs = pairs or [_pair(run, one) for one in wanted]
        columns = task.window.columns
        for pair in pairs:
            few = rng.permutation(len(columns))[:MOST_COLUMNS]
            pair.check(replace(task.window, columns=columns.take(np.sort(few))))
        task.is_decoded = True
    return pairs


def _pair(run: Conversion, wanted: Job) -> Pair:
    assert run.info is not None
    session = run.session
    sensors = zip(sensors_of(session.setup, wanted, PacketArena()), run.sensors, strict=True)
    return Pair(
        run.info._replace(layout=wanted.layout),
        [replace(new.source, ring=one.source.ring) for new, one in sensors],
        np.concatenate([session.boxes_m, np.array(wanted.boxes_m).reshape(-1, 6)]),
        wanted.extras,
    )
