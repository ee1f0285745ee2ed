"""Figures of a map (`--accumulate`): every point of the scans is in it, or in a taken voxel."""

from __future__ import annotations

from typing import NamedTuple


class MapFigures(NamedTuple):
    """A map; low_m, high_m: its corners; offset_m: that its file subtracts, x, y, z."""

    file: str  # without folders
    scans: int
    points: int
    thinned: int  # not the first point in their voxel
    voxel_m: float  # 0: no voxels
    crs: str  # as EPSG:NNNN, or ""
    offset_m: tuple[float, ...]
    low_m: tuple[float, ...]
    high_m: tuple[float, ...]

    def describe(self) -> str:
        """A line of the summary."""
        extent = " x ".join(
            f"{high - low:.1f}" for low, high in zip(self.low_m, self.high_m, strict=True)
        )
        thinned = ""
        if self.voxel_m:
            thinned = f" ({self.thinned} more in voxels of {self.voxel_m:g} m that have one)"
        crs = f", {self.crs}" if self.crs else ""
        return (
            f"map {self.file}: {self.points} points{thinned} of {self.scans} scans, {extent} m{crs}"
        )
