"""What is wrong with the points of all scans, of a run or of merged shards."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from mlbatch.discovery.types import Note
from mlbatch.errors import NoScanError
from mlbatch.report.ledger import PointCounts
from mlbatch.report.scan_table import ScanStatistics


def refuse_all_removed(where: str, points: Sequence[PointCounts]) -> None:
    """Raise NoScanError if limits and boxes left no point of any sensor."""
    by_range = sum(counts.range for counts in points)
    by_box = sum(counts.box for counts in points)
    if not by_range + by_box or any(counts.written for counts in points):
        return
    removed = [f"{by_range} by --min-range and --max-range (min_range_m, max_range_m of the rig)"]
    removed = removed * bool(by_range)
    if by_box:
        removed.append(f"{by_box} by --exclude-box (exclude_boxes_m of the rig)")
    raise NoScanError(
        f"{where}: no scan with points: expected points within the limits, found that all "
        f"{by_range + by_box} were removed: {', '.join(removed)}; widen the range, or make the "
        "boxes smaller: both are in metres"
    )


def point_notes(points: Sequence[tuple[str, PointCounts]], scans: ScanStatistics) -> Iterator[Note]:
    """Clipped intensities; scans with columns but no points: of a sensor, and of all.

    points: name and counts of each sensor.
    """
    for name, counts in points:
        if counts.clipped:
            text = (
                f"{name}: {counts.clipped} of {counts.written} points "
                f"({counts.clipped / counts.written:.2%}) have an intensity outside 0 to 255, "
                "which the point layout clips; choose one with a float32 intensity"
            )
            yield Note("clipped", name, text)
    for name, count in scans.no_points.items():
        text = (
            f"{name}: {count} of {scans.written} scans have its columns but none of its points: no "
            "returns, or all excluded; check its window, --min-range and --exclude-box"
        )
        yield Note("no_points", name, text)
    if scans.empty_clouds:
        text = f"{scans.empty_clouds} clouds without a point were written"
        yield Note("empty_cloud", "", text)
