"""Figures of a map (`--accumulate`): every point of the scans is in it, or in a taken voxel."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True)
class MapFigures:
    """A map; low_m, high_m: its corners; offset_m: of the coordinates in its file; x, y, z."""

    file: str  # without folders
    voxel_m: float  # 0: no voxels
    crs: str  # as EPSG:NNNN, or ""
    scans: int = 0
    points: int = 0
    thinned: int = 0  # not the first point in their voxel
    offset_m: tuple[float, ...] = ()
    low_m: tuple[float, ...] = ()
    high_m: tuple[float, ...] = ()

    def describe(self) -> str:
        """A line of the summary."""
        ends = zip(self.low_m, self.high_m, strict=True)
        size = " x ".join(f"{high - low:.1f}" for low, high in ends)
        thinned = f" ({self.thinned} more in the same {self.voxel_m:g} m)" if self.voxel_m else ""
        text = f"map of {self.scans} scans: {self.points} points{thinned}, {size} m {self.crs}"
        return text.rstrip()
