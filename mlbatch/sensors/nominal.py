"""Compare elevations in a calibration file with the model of the packets.

Files of other models with as many lines can be read as well, and give wrong points.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mlbatch.arrays import F64Array
from mlbatch.errors import RigError

# Units of a model differ by less.
MOST_APART_DEG = 5.0
# Lowest and highest beam, deg.
Span = tuple[float, float]


def apart_deg(elevation_deg: F64Array, span: Span) -> float:
    """Largest difference of the outer beams from a model."""
    lowest, highest = span
    return max(abs(float(elevation_deg.min()) - lowest), abs(float(elevation_deg.max()) - highest))


def refuse_other_beams(
    path: Path | None, model: str, elevation_deg: F64Array, spans: Sequence[Span]
) -> None:
    """Raise RigError for a file of another model; spans: of all variants, empty: not known."""
    if not spans or min(apart_deg(elevation_deg, span) for span in spans) <= MOST_APART_DEG:
        return
    expected = " or ".join(f"{lowest:g} to {highest:g}" for lowest, highest in spans)
    raise RigError(
        f"{path}: expected elevations of a {model}, {expected} deg, found "
        f"{elevation_deg.min():.1f} to {elevation_deg.max():.1f}, the file of another model; give "
        "the one of this lidar"
    )
