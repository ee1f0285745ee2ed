"""Accounting of motion correction: every column is moved, or counted as `no_pose`."""

from __future__ import annotations

from dataclasses import dataclass

from mlbatch.motion.track import ColumnMotion


@dataclass(slots=True)
class MotionLedger:
    """Columns of one sensor; source: of the poses; to: instant of the window, as `--deskew-to`."""

    source: str
    to: str
    columns: int = 0
    moved: int = 0
    no_pose: int = 0

    def add(self, motion: ColumnMotion) -> None:
        """Count the columns of a window."""
        missing = int(motion.no_pose.sum())
        self.columns += len(motion.no_pose)
        self.no_pose += missing
        self.moved += len(motion.no_pose) - missing

    def as_json(self) -> dict[str, str | int]:
        """The section of the report."""
        return {
            "source": self.source,
            "to": self.to,
            "columns": self.columns,
            "moved": self.moved,
            "no_pose": self.no_pose,
        }
