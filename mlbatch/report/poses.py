"""Figures of the check of poses: what each two lidars see of the same surfaces, and how it fits."""

from __future__ import annotations

from typing import NamedTuple

# Outcomes of a pair: its surfaces were compared; they are proven to be apart; they do not fit at
# all; nothing is known.
MEASURED = "measured"
OFF = "off"
MISFIT = "misfit"
NOT_CHECKED = "not checked"
# Reasons why a run compared nothing.
ONE_LIDAR = "one lidar"
NOT_ASKED = "--no-pose-check"


class PairFigures(NamedTuple):
    """Two lidars; all figures are those of the directions that the scene determines.

    lidars: their names; reason: why nothing is known, or ""; places: pairs of windows that were
    compared; surfaces: cells with a surface of both, in all places; overlap_percent: their share of
    the cells with a surface of that lidar which has fewer; fit_percent: share of them with nearly
    parallel and near surfaces; shift_mm: of the second lidar from where it fits the first;
    turn_deg: likewise; both with their standard deviation; undetermined: directions that the scene
    does not determine; swapped: whether the surfaces fit with the two poses exchanged.
    """

    lidars: tuple[str, ...]
    outcome: str
    reason: str = ""
    places: int = 0
    surfaces: int = 0
    overlap_percent: float = 0.0
    fit_percent: float = 0.0
    shift_mm: float | None = None
    shift_deviation_mm: float | None = None
    turn_deg: float | None = None
    turn_deviation_deg: float | None = None
    undetermined: tuple[str, ...] = ()
    swapped: bool = False

    @property
    def is_wrong(self) -> bool:
        """Whether the poses are proven to be wrong."""
        return self.outcome in (OFF, MISFIT)

    @property
    def is_known(self) -> bool:
        """Whether surfaces were compared."""
        return self.outcome != NOT_CHECKED

    def describe(self) -> str:
        """The outcome in words."""
        names = " and ".join(self.lidars)
        if self.outcome == NOT_CHECKED:
            return f"{names}: not checked, since {self.reason}"
        seen = f"{names} have {self.overlap_percent:.0f} % of their surfaces in common"
        if self.outcome == MISFIT:
            return (
                f"{seen}; of {self.surfaces} only {self.fit_percent:.0f} % fit: the poses are "
                "wrong by more than this can measure" + self._swapped()
            )
        if self.outcome == OFF:
            found = f"double walls: {self.lidars[-1]} is {self._found()} off"
        else:
            found = f"they agree within {self._bounds()}"
        text = f"{seen}; {found}"
        if self.undetermined:
            text += f" (not determined by the scene: {', '.join(self.undetermined)})"
        return text + self._swapped()

    def _swapped(self) -> str:
        if not self.swapped:
            return ""
        return f"; with the poses of {' and '.join(self.lidars)} exchanged they fit: names swapped?"

    def _found(self) -> str:
        parts = []
        if self.shift_mm is not None:
            parts.append(f"{self.shift_mm:.0f} mm")
        if self.turn_deg is not None:
            parts.append(f"{self.turn_deg:.2f} degrees")
        return " / ".join(parts)

    def _bounds(self) -> str:
        """Two standard deviations above what was found."""
        parts = []
        if self.shift_mm is not None:
            parts.append(f"{self.shift_mm + 2 * (self.shift_deviation_mm or 0.0):.0f} mm")
        if self.turn_deg is not None:
            parts.append(f"{self.turn_deg + 2 * (self.turn_deviation_deg or 0.0):.2f} degrees")
        return ", ".join(parts)


class PoseFigures(NamedTuple):
    """The check of a run; reason: why nothing was compared, or ""."""

    reason: str = ""
    pairs: tuple[PairFigures, ...] = ()

    @property
    def not_known(self) -> str:
        """Why no pair was compared, or ""."""
        if self.reason or any(pair.is_known for pair in self.pairs):
            return self.reason
        return "; ".join(dict.fromkeys(pair.reason for pair in self.pairs)) or ONE_LIDAR
