"""Accounting of motion correction: every column is moved, or counted as `no_pose`."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(slots=True)
class MotionLedger:
    """What was moved; source: of the poses; to: instant of the window, as `--deskew-to`.

    poses: how many were used; windows_without_poses: left out, with `no_pose` columns; gyro_bias:
    rad/s, of IMU poses.
    """

    source: str
    to: str
    poses: int = 0
    columns: int = 0
    moved: int = 0
    no_pose: int = 0
    windows_without_poses: int = 0
    gyro_bias: tuple[float, ...] = field(default=())

    def as_json(self) -> dict[str, str | int | list[float]]:
        """The section of the report."""
        found: dict[str, str | int | list[float]] = {
            "source": self.source,
            "to": self.to,
            "poses": self.poses,
            "columns": self.columns,
            "moved": self.moved,
            "no_pose": self.no_pose,
            "windows_without_poses": self.windows_without_poses,
        }
        if self.gyro_bias:
            found["gyro_bias_rad_s"] = list(self.gyro_bias)
        return found

    def describe(self) -> str:
        """A line of the summary."""
        text = (
            f"points moved to the {self.to} of each window by {self.poses} poses of {self.source}"
        )
        if self.windows_without_poses:
            text += f"; {self.windows_without_poses} windows without poses left out"
        return text
