"""The tables and the figure of the case study, after the paper's figure 8."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from drift import FAILED_SHARE

if TYPE_CHECKING:
    from casestudy import Outcome, Run

_COLOURS = {"left": "#dd8452", "right": "#c44e52", "both": "#1b6ca8"}


def in_words(outcome: Outcome) -> str:
    """Return an outcome in a line."""
    own = outcome.drift
    text = "no drift" if own is None else f"drift {own.six_m:.2f} m of {own.way_m:.1f} m"
    return f"{text}, {outcome.nodes} nodes" + (
        f", ended at {outcome.ended}" if outcome.ended else ""
    )


def is_failure(outcome: Outcome) -> bool:
    """Return whether a run "explodes": it ended early, or drifted by 10 % of its way."""
    own = outcome.drift
    return bool(outcome.ended) or own is None or own.six_m > FAILED_SHARE * own.way_m


def tables(
    found: Mapping[tuple[str, int], Mapping[Run, Outcome]],
    scenes: Sequence[str],
    lidars: Sequence[str],
    every: Sequence[int],
) -> list[str]:
    """Return the tables in Markdown."""
    lines = [
        "Largest drift: median over seeds and phases (smallest to largest). Heading aligned: the "
        "alignment leaves roll and pitch as they are. Failures: runs that ended early or drifted "
        f"by more than {100 * FAILED_SHARE:g} % of the way.",
        "",
        "| scene | lidars | N | runs | drift, m | heading aligned, m | failures |",
        "|---|---|---|---|---|---|---|",
    ]
    for scene in scenes:
        for name in lidars:
            for number in every:
                outcomes = _outcomes(found, scene, name, number, "window")
                if outcomes:
                    lines.append(f"| {scene} | {name} | {number} | {_cells(outcomes)} |")
    lines += [
        "",
        "Both lidars, windows against fused sweeps (nearest stamp), from the first scan on:",
        "",
        "| scene | N | runs | windows: drift, m | heading aligned, m | fused: drift, m "
        "| heading aligned, m |",
        "|---|---|---|---|---|---|---|",
    ]
    for scene in scenes:
        for number in every:
            windows, joined = (
                _outcomes(found, scene, "both", number, batching, phase=0)
                for batching in ("window", "approximate")
            )
            if joined:
                cells = [
                    cell
                    for outcomes in (windows, joined)
                    for cell in (_interval(outcomes, "six_m"), _interval(outcomes, "four_m"))
                ]
                lines.append(f"| {scene} | {number} | {len(joined)} | {' | '.join(cells)} |")
    return lines


def _outcomes(
    found: Mapping[tuple[str, int], Mapping[Run, Outcome]],
    scene: str,
    lidars: str,
    every: int,
    batching: str,
    phase: int | None = None,
) -> list[Outcome]:
    return [
        outcome
        for (own, _), runs in found.items()
        for run, outcome in runs.items()
        if (own, run.lidars, run.every, run.batching) == (scene, lidars, every, batching)
        and phase in (None, run.phase)
    ]


def _cells(outcomes: Sequence[Outcome]) -> str:
    drifts = (_interval(outcomes, key) for key in ("six_m", "four_m"))
    return " | ".join([str(len(outcomes)), *drifts, _failures(outcomes)])


def _failures(outcomes: Sequence[Outcome]) -> str:
    return f"{sum(map(is_failure, outcomes))} of {len(outcomes)}"


def _drifts(outcomes: Sequence[Outcome], key: str) -> list[float]:
    """Return drifts; infinite for runs that ended early."""
    return [
        np.inf if one.ended or one.drift is None else getattr(one.drift, key) for one in outcomes
    ]


def _interval(outcomes: Sequence[Outcome], key: str) -> str:
    values = _drifts(outcomes, key)
    if not values:
        return "not run"
    middle, low, high = np.median(values), min(values), max(values)
    texts = [f"{value:.2f}" if np.isfinite(value) else "ended" for value in (middle, low, high)]
    return texts[0] if len(values) == 1 else f"{texts[0]} ({texts[1]} to {texts[2]})"


def draw(
    path: Path,
    found: Mapping[tuple[str, int], Mapping[Run, Outcome]],
    scenes: Sequence[str],
    lidars: Sequence[str],
    every: Sequence[int],
) -> None:
    """Draw the drift against N, one plot a scene, every run a mark; ended runs at the top."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, len(scenes), figsize=(11, 4.5), sharey=True, squeeze=False)
    top_m = 100.0
    for axis, scene in zip(axes[0], scenes, strict=True):
        for shift, name in enumerate(lidars):
            medians = []
            for place, number in enumerate(every):
                values = _drifts(_outcomes(found, scene, name, number, "window"), "six_m")
                shown = np.minimum(values, top_m)
                at = place + 0.2 * (shift - 1)
                axis.plot([at] * len(shown), shown, "o", color=_COLOURS[name], alpha=0.4)
                medians.append((at, min(float(np.median(values)), top_m) if values else np.nan))
            label = "both lidars" if name == "both" else f"{name} lidar"
            axis.plot(*zip(*medians, strict=True), "-_", color=_COLOURS[name], ms=14, label=label)
        axis.set_title(scene)
        axis.set_xticks(range(len(every)), [f"N = {number}" for number in every])
        axis.set_yscale("log")
        axis.grid(axis="y", alpha=0.3)
    axes[0][0].set_ylabel("largest drift, m (at 100: ended early)")
    axes[0][0].legend()
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
