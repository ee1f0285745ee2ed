"""Golden files for tests: `digest(output)` describes an output in a small JSON document.

Grid, accounting and warnings are in it as they are; each array of a scan by a checksum, which finds
every difference, and by a few statistics and four points, which explain it without the scans.
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path

from mlbatch.digests.comparison import Comparison, Difference, Json, compare
from mlbatch.digests.golden import SCHEMA, golden_of, golden_text, read_golden

__all__ = [
    "SCHEMA",
    "Comparison",
    "Difference",
    "compare",
    "digest",
    "golden_text",
    "read_golden",
]


def digest(output: str | PathLike[str]) -> dict[str, Json]:
    """Describe an output of `convert`, as JSON values; see docs/digest.md.

    Raises RecordingError where the output is damaged, or not one of mlbatch.
    """
    return golden_of(Path(output))
