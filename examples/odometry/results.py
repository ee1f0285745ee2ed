"""Medians over seeds with intervals, the table, and the picture."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from evaluation import Array, Errors, Track

_LEAST_COVERAGE = 0.95
_COLOURS = ("#1b6ca8", "#c44e52", "#8c2d04", "#dd8452", "#937860", "#55a868", "#7f7f7f", "#b5b500")


def median_interval(values: Sequence[float]) -> tuple[float, float, float, float]:
    """Return median, and the narrowest interval of ranks that contains it with 95 % confidence.

    Free of assumptions about the distribution: its coverage, the last number, is binomial. With
    fewer than 6 values it is that of all of them, less than 0.95.
    """
    ordered = sorted(values)
    count = len(ordered)
    best = (ordered[0], ordered[-1], _coverage(count, 0))
    for rank in range(1, (count + 1) // 2):
        if _coverage(count, rank) < _LEAST_COVERAGE:
            break
        best = (ordered[rank], ordered[-1 - rank], _coverage(count, rank))
    return float(np.median(ordered)), *best


def _coverage(count: int, rank: int) -> float:
    outside = sum(math.comb(count, below) for below in range(rank + 1))
    return 1.0 - 2.0 * outside / 2.0**count


def write_csv(path: Path, found: Mapping[str, Mapping[int, Errors]]) -> None:
    """Write one row a variant and seed."""
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        for number, (variant, seeds) in enumerate(found.items()):
            for seed, errors in sorted(seeds.items()):
                values = asdict(errors)
                if number == 0 and seed == min(seeds):
                    rows.writerow(["variant", "seed", *values])
                rows.writerow([variant, seed, *(f"{value:.6g}" for value in values.values())])


def table_lines(found: Mapping[str, Mapping[int, Errors]], base: str) -> list[str]:
    """Return a Markdown table: medians with intervals, and ratios to `base` by seed."""
    lines = [
        "| input of KISS-ICP | RPE, mm | RPE, degrees | APE, mm | ratio RPE | ratio rotation "
        "| worse in | offset, ms | at own stamps: ratio RPE | ratio rotation |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for variant, seeds in found.items():
        errors = list(seeds.values())
        pairs = [(one, found[base][seed]) for seed, one in seeds.items() if seed in found[base]]
        cells = [
            variant,
            _cell([1000.0 * one.rpe_m for one in errors], 1),
            _cell([one.rpe_deg for one in errors], 3),
            _cell([1000.0 * one.ape_m for one in errors], 1),
        ]
        if variant == base:
            cells += ["1", "1", ""]
        else:
            ratios = [one.rpe_m / other.rpe_m for one, other in pairs]
            turns = [one.rpe_deg / other.rpe_deg for one, other in pairs]
            worse = sum(ratio > 1.0 for ratio in ratios)
            cells += [_cell(ratios, 2), _cell(turns, 2), f"{worse} of {len(ratios)}"]
        cells.append(_cell([1000.0 * one.offset_s for one in errors], 0))
        if variant == base:
            cells += ["1", "1"]
        else:
            ratios = [one.at_stamp_rpe_m / other.at_stamp_rpe_m for one, other in pairs]
            turns = [one.at_stamp_rpe_deg / other.at_stamp_rpe_deg for one, other in pairs]
            cells += [_cell(ratios, 2), _cell(turns, 2)]
        lines.append(f"| {' | '.join(cells)} |")
    return [*lines, "", statement([len(seeds) for seeds in found.values()])]


def statement(counts: Sequence[int]) -> str:
    """Return what the cells of a table are, given the numbers of runs behind them."""
    if max(counts) == 1:
        return "One run: no intervals, and no evidence of a difference."
    coverage = median_interval([0.0] * min(counts))[-1]
    numbers = " or ".join(map(str, sorted(set(counts))))
    return (
        f"Median over {numbers} seeds; in brackets its interval "
        f"({100 * coverage:.1f} % confidence or more)."
    )


def _cell(values: Sequence[float], digits: int) -> str:
    median, low, high, _ = median_interval(values)
    if len(values) == 1:
        return f"{median:.{digits}f}"
    return f"{median:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


def draw(
    path: Path,
    found: Mapping[str, Mapping[int, Errors]],
    base: str,
    tracks: Mapping[str, Track],
    truth: Track | None,
) -> None:
    """Draw ratios to `base` of all seeds, and the tracks of one recording seen from above."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (left, right) = pyplot.subplots(1, 2, figsize=(12, 5), width_ratios=[3, 2])
    others = [name for name in found if name != base]
    for row, name in enumerate(others):
        for shift, key, mark in ((0.15, "rpe_m", "o"), (-0.15, "rpe_deg", "^")):
            ratios = [
                getattr(one, key) / getattr(found[base][seed], key)
                for seed, one in found[name].items()
                if seed in found[base]
            ]
            colour = _COLOURS[(row + 1) % len(_COLOURS)]
            left.plot(ratios, [row + shift] * len(ratios), mark, color=colour, alpha=0.6)
            left.plot([np.median(ratios)] * 2, [row + shift - 0.12, row + shift + 0.12], "k-")
    left.axvline(1.0, color="black", linewidth=0.8)
    left.set_xscale("log")
    left.set_yticks(range(len(others)), others)
    left.set_ylim(len(others) - 0.5, -0.5)
    left.set_xlabel(
        f"relative error over 1 s / that of {base}, one mark a seed\n"
        "circles: translation, triangles: rotation, lines: medians"
    )
    if truth is not None:
        right.plot(*truth.poses[:, :2, 3].T, "k--", linewidth=1.0, label="truth")
    for number, (name, track) in enumerate(tracks.items()):
        right.plot(*_placed(track, truth).T, color=_COLOURS[number % len(_COLOURS)], label=name)
    right.set_aspect("equal")
    right.set_xlabel("x, m")
    right.set_ylabel("y, m")
    right.legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def _placed(track: Track, truth: Track | None) -> Array:
    """Positions from above, with the first pose on that of the truth."""
    if truth is None:
        return track.poses[:, :2, 3]
    row = int(np.argmin(np.abs(truth.stamp_s - track.stamp_s[0])))
    moved = truth.poses[row] @ np.linalg.inv(track.poses[0])
    placed: Array = (track.poses[:, :3, 3] @ moved[:3, :3].T + moved[:3, 3])[:, :2]
    return placed
