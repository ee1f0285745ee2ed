"""What an output says of its run, from each place where it says it; all have to agree."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from fractions import Fraction

from mlbatch.errors import UsageError
from mlbatch.units import parse_rate
from mlbatch.verify.grid import Lines
from mlbatch.verify.verdict import Judge, VerifyError

# More than `--slices` takes; larger claims are damage.
_MOST_SLICES = 1_000_000


@dataclass(frozen=True, slots=True)
class Claims:
    """None where a place does not say it; rate: text, as in all outputs."""

    rate: str | None = None
    slices: int | None = None
    t_init_ns: int | None = None
    sensors: tuple[str, ...] | None = None
    timescale: str | None = None
    frame_id: str | None = None

    def joined(self, judge: Judge, where: str, other: Claims) -> Claims:
        """These claims and those that stand at `where`; contradictions are blamed there."""
        found = self
        for item in fields(self):
            own, new = getattr(found, item.name), getattr(other, item.name)
            if own is None:
                found = replace(found, **{item.name: new})
            elif new is not None:
                judge.equal("metadata", f"{where} {item.name}", own, new)
        return found

    def lines(self, where: str) -> Lines | None:
        """The grid; None if the output does not tell its rate."""
        if self.rate is None:
            return None
        slices = 1 if self.slices is None else self.slices
        try:
            rate: Fraction = parse_rate(self.rate)
        except UsageError as err:
            raise VerifyError(f"{where}: {err}") from err
        if not 1 <= slices <= _MOST_SLICES:
            wanted = f"1 to {_MOST_SLICES} slices a window"
            raise VerifyError(f"{where}: wanted {wanted}, got {slices}")
        return Lines(rate, slices)
