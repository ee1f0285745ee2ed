"""The metadata of a run, which each output has in a place of its own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from mlbatch.bounded import parse_json
from mlbatch.outputs.damage import CheckLog
from mlbatch.types import VARIANTS

# Python refuses very long numbers.
_MOST_DIGITS = 19
_TEXTS = ("rate_hz", "timescale", "frame_id", "sort")
_VARIANT_WORDS = {
    "batching": ("latest", "approximate", "collate"),
    "batching_times": ("common", "own"),
    "stamp": ("middle", "end"),
    "deskew_to": ("start", "middle", "end"),
}


@dataclass(frozen=True, slots=True)
class RunMetadata:
    """Metadata of a run as one place has it; None for what it does not have."""

    # Text, as in all outputs.
    rate: str | None = None
    slices: int | None = None
    t_init_ns: int | None = None
    sensors: tuple[str, ...] | None = None
    timescale: str | None = None
    frame_id: str | None = None
    # Order of points: columns or points.
    sort: str | None = None
    # Options that change what a scan is; None: the default.
    batching: str | None = None
    batching_times: str | None = None
    stamp: str | None = None
    deskew: str | None = None
    deskew_to: str | None = None

    @classmethod
    def of(
        cls,
        log: CheckLog,
        where: str,
        said: Mapping[str, str],
        sensors: tuple[str, ...] | None = None,
        slices: int | None = None,
        t_init_ns: int | None = None,
    ) -> RunMetadata:
        """Metadata of texts by name, where there are some; unknown words are violations."""
        texts: dict[str, Any] = {name: said[name] for name in (*_TEXTS, *VARIANTS) if name in said}
        for name, words in _VARIANT_WORDS.items():
            if name in texts and texts[name] not in words:
                log.fail("metadata", f"{where} {name}", f"one of {', '.join(words)}", texts[name])
                del texts[name]
        return cls(texts.pop("rate_hz", None), slices, t_init_ns, sensors, **texts)

    @property
    def variants(self) -> tuple[tuple[str, str], ...]:
        """The options that change what a scan is, as `RunInfo.variants`."""
        found = ((name, getattr(self, name)) for name in VARIANTS)
        return tuple((name, value) for name, value in found if value is not None)

    @property
    def limits(self) -> dict[str, str]:
        """Checks that such options make impossible, and why."""
        limits: dict[str, str] = {}
        if self.batching is not None:
            reason = f"sets of sweeps (--batching {self.batching}) are on no grid"
            limits |= dict.fromkeys(("grid", "t_init"), reason)
        if self.batching_times == "own":
            limits["order"] = "columns only: times of points count from the start of each sweep"
        if self.deskew is not None:
            limits["geometry"] = "points were moved (--deskew): ranges are as measured"
        return limits

    def joined(self, log: CheckLog, where: str, other: RunMetadata) -> RunMetadata:
        """Both together; contradictions are violations at `where`."""
        found = self
        for item in fields(self):
            own = getattr(found, item.name)
            new = getattr(other, item.name)
            if own is None:
                found = replace(found, **{item.name: new})
            elif new is not None:
                log.equal("metadata", f"{where} {item.name}", own, new)
        return found


def metadata_of_grid(log: CheckLog, where: str, grid: dict[str, str]) -> RunMetadata:
    """Metadata in the metadata record mlbatch.grid of an MCAP file."""
    where = f"{where} mlbatch.grid"
    numbers: list[int | None] = []
    for key in ("slices", "t_init_ns"):
        text = grid.get(key, "")
        is_number = text.isdecimal() and len(text) <= _MOST_DIGITS
        numbers.append(int(text) if is_number else None)
        log.ok("metadata")
        if not is_number:
            log.fail("metadata", f"{where} {key}", "a number", text or "nothing")
    for key in _TEXTS:
        if key not in grid:
            log.fail("metadata", f"{where} {key}", "a text", "nothing")
    try:
        names = parse_json(grid.get("sensors", ""))
    except ValueError:
        names = None
    if not isinstance(names, list):
        log.fail("metadata", f"{where} sensors", "a list", grid.get("sensors"))
        return RunMetadata.of(log, where, grid, None, *numbers)
    return RunMetadata.of(log, where, grid, tuple(map(str, names)), *numbers)
