"""Accounting of motion correction: every column is moved, not moved, or counted as `no_pose`."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

# Numbers of windows that the report names.
_MOST_NAMED = 100

Json = (
    str
    | int
    | list[int]
    | list[float]
    | dict[str, int]
    | dict[str, float]
    | dict[str, str | int | float]
)


@dataclass(slots=True)
class RotationFigures:
    """Of poses: how their rotation fits that of the points; windows: that were compared.

    not_checked: why nothing is known, or ""; scale: rotation of the poses by that of the points;
    turned_deg: between their axes; delay_ms: how late the poses are; known_ms: its standard
    deviation.
    """

    windows: int = 0
    not_checked: str = ""
    scale: float = 1.0
    turned_deg: float = 0.0
    delay_ms: float = 0.0
    known_ms: float = 0.0

    def as_json(self) -> dict[str, str | int | float]:
        """The section of the report."""
        if self.not_checked:
            return {"outcome": "not checked", "reason": self.not_checked, "windows": self.windows}
        return {
            "outcome": "agrees",
            "windows": self.windows,
            "scale": round(self.scale, 4),
            "turned_deg": round(self.turned_deg, 2),
            "delay_ms": self.delay_ms,
            "delay_deviation_ms": round(self.known_ms, 2),
        }

    def describe(self) -> str:
        """A part of a line of the summary."""
        if self.not_checked:
            return f"rotation not checked ({self.not_checked})"
        return f"rotation as that of the points in {self.windows} windows"


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
    """Figures of moved columns; source: of the poses; to: instant of the window, as `--deskew-to`.

    poses: how many were used; windows_without_poses: left out, with `no_pose` columns; gyro_bias:
    rad/s, of IMU poses; ended: why there are no later poses; rotation: against that of the points;
    velocity: of velocities instead of poses.
    """

    source: str
    to: str
    poses: int = 0
    columns: int = 0
    moved: int = 0
    no_pose: int = 0
    windows_without_poses: int = 0
    gyro_bias: tuple[float, ...] = field(default=())
    ended: str = ""
    rotation: RotationFigures | None = None
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
        if self.rotation is not None:
            found["rotation_check"] = self.rotation.as_json()
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
        if self.rotation is not None:
            text += f"; {self.rotation.describe()}"
        return text

    def _describe_velocity(self, velocity: VelocityCounts) -> str:
        share = math.floor(100 * self.moved / self.columns) if self.columns else 0
        text = (
            f"{share} % of the columns moved to the {self.to} of their window by velocities of "
            f"{self.poses} registered windows"
        )
        windows = sum(velocity.windows.values())
        return text + (f"; {windows} not moved ({velocity.describe()})" if windows else "")
