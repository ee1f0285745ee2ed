"""Figures of the check of poses: what each two lidars see of the same surfaces, and how it fits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

# Outcomes of a pair: its surfaces were compared; they are proven to be apart; they do not fit at
# all; nothing is known.
MEASURED = "measured"
OFF = "off"
MISFIT = "misfit"
NOT_CHECKED = "not checked"
# A wrong pose: a residual above these is a warning.
LIMIT_MM = 30.0
LIMIT_DEG = 0.3
# Standard deviations that words add to a figure.
_SHOWN = 2.0
# Mistakes that explain a wrong pose.
EXCHANGED = "exchanged"
RADIANS = "radians"
# Reasons why a run compared nothing.
ONE_LIDAR = "one lidar"
NOT_ASKED = "--no-pose-check"


class PairFigures(NamedTuple):
    """Two lidars; figures of the directions that the scene determines.

    lidars: their names; reason: why nothing is known, or ""; places: pairs of windows that were
    compared; surfaces: cells with a surface of both, in all places; overlap_percent: their share of
    the cells with a surface of that lidar which has fewer; fit_percent: share of them with nearly
    parallel and near surfaces; shift_mm: of the second lidar from where it fits the first;
    turn_deg: likewise; both with their standard deviation; undetermined: directions that the scene
    does not determine; fits_with: mistake without which the surfaces fit, or "".
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
    fits_with: str = ""

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
        if self.fits_with and self.outcome == MISFIT:
            return f"{seen}{self._cause()}"
        if self.outcome == MISFIT:
            return (
                f"{seen}; of {self.surfaces} only {self.fit_percent:.0f} % fit: the poses are "
                "wrong by more than this can measure"
            )
        if self.outcome == OFF:
            found = f"double walls: {self.lidars[-1]} is {self._found()} off"
        elif not self.is_within(_SHOWN):
            found = f"they are not significantly apart: {self._found(with_sigma=True)}"
        else:
            found = f"they agree within {_bounds([self])}"
        text = f"{seen}; {found}"
        if self.undetermined:
            text += f" (this check does not determine: {', '.join(self.undetermined)})"
        return text + self._cause()

    def _cause(self) -> str:
        if self.fits_with == EXCHANGED:
            return "; with the two poses exchanged they fit: names swapped?"
        if self.fits_with == RADIANS:
            return "; with rotation_rpy_deg as radians they fit: write degrees"
        return ""

    def bounds(self, deviations: float) -> tuple[float | None, float | None]:
        """Shift, mm, and turn, degrees, plus so many standard deviations; None: not known."""
        shift_mm = self.shift_mm and self.shift_mm + deviations * (self.shift_deviation_mm or 0.0)
        turn_deg = self.turn_deg and self.turn_deg + deviations * (self.turn_deviation_deg or 0.0)
        return shift_mm, turn_deg

    def is_within(self, deviations: float) -> bool:
        """Whether the figures and so many standard deviations are within the limits."""
        shift_mm, turn_deg = self.bounds(deviations)
        return (shift_mm or 0.0) <= LIMIT_MM and (turn_deg or 0.0) <= LIMIT_DEG

    def _found(self, *, with_sigma: bool = False) -> str:
        parts = []
        if self.shift_mm is not None:
            sigma = f" (standard deviation {self.shift_deviation_mm:.0f} mm)" if with_sigma else ""
            parts.append(f"{self.shift_mm:.0f} mm{sigma}")
        if self.turn_deg is not None:
            sigma = f" (standard deviation {self.turn_deviation_deg:.2f})" if with_sigma else ""
            parts.append(f"{self.turn_deg:.2f} degrees{sigma}")
        return " / ".join(parts)


def _bounds(pairs: Sequence[PairFigures]) -> str:
    """Two standard deviations above the largest figures of pairs."""
    shifts_mm, turns_deg = zip(*(pair.bounds(_SHOWN) for pair in pairs), strict=True)
    shift_mm = max((one for one in shifts_mm if one is not None), default=None)
    turn_deg = max((one for one in turns_deg if one is not None), default=None)
    parts = [] if shift_mm is None else [f"{shift_mm:.0f} mm"]
    parts += [] if turn_deg is None else [f"{turn_deg:.2f} degrees"]
    return ", ".join(parts)


class PoseFigures(NamedTuple):
    """The check of a run; reason: why nothing was compared, or ""."""

    reason: str = ""
    pairs: tuple[PairFigures, ...] = ()

    def gaps(self) -> list[str]:
        """Parts that the check does not cover, one line each."""
        if self.reason:
            return [f"not checked ({self.reason})"]
        return [
            pair.describe()
            if not pair.is_known
            else f"{' and '.join(pair.lidars)}: the scene does not determine "
            f"{', '.join(pair.undetermined)}"
            for pair in self.pairs
            if pair.undetermined or not pair.is_known
        ]

    def describe(self) -> str:
        """Words for the outcome in a verdict."""
        if self.reason:
            return f"poses: not checked ({self.reason})"
        known = [pair for pair in self.pairs if pair.is_known]
        if not known:
            reasons = dict.fromkeys(pair.reason for pair in self.pairs)
            return f"poses: not checked, since {'; '.join(reasons)}"
        if any(pair.is_wrong for pair in known):
            return "poses are wrong"
        text = f"surfaces agree within {_bounds(known)}"
        if not all(pair.is_within(_SHOWN) for pair in known):
            text = "poses: neither confirmed nor refuted"
        elif any(pair.undetermined for pair in known):
            text += " in the directions that the scene determines"
        if len(known) < len(self.pairs):
            text += f", of {len(known)} of {len(self.pairs)} pairs of lidars"
        return text
