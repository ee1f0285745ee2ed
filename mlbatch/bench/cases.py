"""The standard cases: which recordings are converted to what, and what runs beside them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from mlbatch.bench.ratios import COPY, DRY_RUN, LIBRARY, START, WRITE
from mlbatch.bench.recordings import RECORDINGS, Recording

AUTO, NUMPY, NUMBA = "auto", "numpy", "numba"


@dataclass(frozen=True, slots=True)
class Conversion:
    """A conversion as it is measured.

    output: suffix of a file, or a format of a folder; empty: a dry run. base: another program of
    the case, which this one extends.
    """

    name: str
    recording: str
    engine: str = AUTO
    output: str = ""
    options: tuple[str, ...] = ()
    base: str = ""


@dataclass(frozen=True, slots=True)
class Case:
    """Programs that run in turn: conversions, floors, and peers of the first recording.

    variants: conversions of their own kind, instead of those that follow from the output.
    """

    name: str
    recordings: tuple[str, ...]
    output: str = ""
    floors: tuple[str, ...] = (START, COPY)
    variants: tuple[Conversion, ...] = ()

    @property
    def first(self) -> Recording:
        """The recording that its peers get."""
        return RECORDINGS[self.recordings[0]]

    def conversions(self, engines: Sequence[str]) -> list[Conversion]:
        """What is converted: each recording by each engine, or to the output."""
        if self.variants:
            return list(self.variants)
        if self.output:
            (recording,) = self.recordings
            dry = Conversion(DRY_RUN, recording)
            return [dry, Conversion(self.output, recording, output=self.output, base=DRY_RUN)]
        return [
            Conversion(
                engine if number == 0 else f"{engine}, fragments",
                recording,
                engine,
                base="" if number == 0 else engine,
            )
            for number, recording in enumerate(self.recordings)
            for engine in engines
        ]


_DUAL: Final = "dual-4"


def _by_jobs(*options: str) -> tuple[Conversion, ...]:
    """The same output by one and by two jobs."""
    one = Conversion("jobs 1", _DUAL, output="mcap", options=(*options, "--jobs", "1"))
    two = (*options, "--jobs", "2")
    return one, replace(one, name="jobs 2", options=two, base=one.name)


CASES: Final = (
    Case("dual-4", (_DUAL, "dual-4-fragments")),
    Case("dual-12", ("dual-12", "dual-12-fragments")),
    Case("three-vlp16", ("three-vlp16",)),
    Case("pandar64", ("pandar64",)),
    Case("mixed", ("mixed",)),
    Case("dual-4-mcap", (_DUAL,), "mcap", (COPY, WRITE, LIBRARY)),
    Case("dual-4-npz", (_DUAL,), "npz", (COPY, WRITE)),
    Case("dual-4-ply", (_DUAL,), "ply", (COPY, WRITE)),
    Case("mixed-mcap", ("mixed",), "mcap", (COPY, WRITE)),
    Case("dual-4-jobs", (_DUAL,), "mcap", (), _by_jobs()),
    Case("dual-4-zstd", (_DUAL,), "mcap", (), _by_jobs("--compression", "zstd")),
)
# What a point takes in the largest output, in bytes, and what floors and peers write beside it.
MOST_POINT_BYTES: Final = 48


def disk_bytes(cases: Sequence[Case], seconds: float) -> int:
    """Most that the recordings and one output at a time take."""
    names = {name for case in cases for name in case.recordings}
    recorded = sum(RECORDINGS[name].bytes_a_second for name in names)
    written = [case.first.slots_a_second * MOST_POINT_BYTES for case in cases if case.output]
    return round(seconds * (recorded + max(written, default=0)))
