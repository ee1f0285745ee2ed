"""Accounting of motion correction: every column is moved, not moved, or counted as `no_pose`."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

# Numbers of windows that the report names.
_MOST_NAMED = 100

Json = str | int | list[int] | list[float] | dict[str, int] | dict[str, float]


@dataclass(slots=True)
class VelocityCounts:
    """Of `--deskew constant-velocity`: windows that were registered, and those not moved.

    unmoved: columns; windows: by reason; named: numbers of the first ones; residual_m: median of
    each registered window.
    """

    unmoved: int = 0
    windows: dict[str, int] = field(default_factory=dict)
    named: list[int] = field(default_factory=list)
    residual_m: list[float] = field(default_factory=list)

    def add_window(self, reason: str, index: int) -> None:
        """Count a window that is not moved."""
        self.windows[reason] = self.windows.get(reason, 0) + 1
        if len(self.named) < _MOST_NAMED:
            self.named.append(index)

    def as_json(self) -> dict[str, Json]:
        """Keys of the section of the report."""
        ranks = sorted(self.residual_m)
        last = len(ranks) - 1
        residual = {"p50": ranks[last // 2], "max": ranks[last]} if ranks else {}
        return {
            "unmoved": self.unmoved,
            "windows_registered": len(ranks),
            "windows_unmoved": dict(sorted(self.windows.items())),
            "unmoved_indexes": list(self.named),
            "residual_mm": {name: round(1000 * value, 3) for name, value in residual.items()},
        }

    def describe(self) -> str:
        """Windows that were not moved, by reason."""
        return ", ".join(f"{reason} {count}" for reason, count in sorted(self.windows.items()))


@dataclass(slots=True)
class MotionLedger:
    """What was moved; source: of the poses; to: instant of the window, as `--deskew-to`.

    poses: how many were used; windows_without_poses: left out, with `no_pose` columns; gyro_bias:
    rad/s, of IMU poses; velocity: of velocities instead of poses.
    """

    source: str
    to: str
    poses: int = 0
    columns: int = 0
    moved: int = 0
    no_pose: int = 0
    windows_without_poses: int = 0
    gyro_bias: tuple[float, ...] = field(default=())
    velocity: VelocityCounts | None = None

    def as_json(self) -> dict[str, Json]:
        """The section of the report."""
        found: dict[str, Json] = {
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
        if self.velocity is not None:
            found.update(self.velocity.as_json())
        return found

    def describe(self) -> str:
        """A line of the summary."""
        if self.velocity is not None:
            return self._describe_velocity(self.velocity)
        text = (
            f"points moved to the {self.to} of each window by {self.poses} poses of {self.source}"
        )
        if self.windows_without_poses:
            text += f"; {self.windows_without_poses} windows without poses left out"
        return text

    def _describe_velocity(self, velocity: VelocityCounts) -> str:
        share = math.floor(100 * self.moved / self.columns) if self.columns else 0
        text = (
            f"{share} % of the columns moved to the {self.to} of their window by velocities of "
            f"{self.poses} registered windows"
        )
        windows = sum(velocity.windows.values())
        return text + (f"; {windows} not moved ({velocity.describe()})" if windows else "")
