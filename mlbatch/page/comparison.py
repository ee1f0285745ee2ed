"""The page of a comparison: windows against frame-level fusion, as clouds and static SVG.

The values of bars are titles of their elements, which browsers show.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.page.document import COLOURS, kept_words
from mlbatch.page.instant import SharedInstant
from mlbatch.page.policies import DEFAULT_MPS, SPEEDS_KMH, PolicyFigures, offset_m
from mlbatch.page.templates import Verdict, asset, page_json, render

# Of the plots, which are 900 px wide.
_LEFT, _RIGHT = 56, 888
# Pixel columns of a plot over time; each shows the smallest and the largest of its sets.
_BINS = 400

Policies = Sequence[PolicyFigures]


def comparison_page(
    title: str,
    summary: str,
    policies: Policies,
    notes: Sequence[str],
    command: str,
    instant: SharedInstant | None = None,
    speed_mps: float = DEFAULT_MPS,
) -> str:
    """The whole page; policies: windows last; speed_mps: of an object."""
    clouds = [] if instant is None else instant.clouds()
    player = {}
    if instant is not None and clouds:
        player = {
            "kept": kept_words(clouds[0]),
            "instant_rows": [one.row(speed_mps) for one in instant.sets],
            "data": page_json(instant.toggle(clouds)),
            "script": "".join(map(asset, ("viewer.js", "player.js", "page.js"))),
        }
    return render(
        "comparison.html",
        title=title,
        verdict=_verdict(summary, policies, speed_mps),
        **player,
        clouds=clouds,
        colours=COLOURS,
        instant=instant,
        speed=f"{speed_mps:g} m/s",
        speed_mps=speed_mps,
        notes=notes,
        names=[one.name for one in policies],
        policies=policies,
        worst_ms=max(one.worst_ms for one in policies),
        latest_ms=max(one.latency_ms.max(initial=0.0) for one in policies),
        end_s=max(one.start_s.max(initial=0.0) for one in policies) or 1.0,
        rows=list(map(_row, policies)),
        speeds_kmh=SPEEDS_KMH,
        left=_LEFT,
        right=_RIGHT,
        offset_m=offset_m,
        ticks=_ticks,
        binned=binned,
        command=command,
    )


def _verdict(summary: str, policies: Policies, speed_mps: float) -> Verdict:
    *joined, windows = policies
    worst = max(joined, key=lambda one: one.worst_ms)
    span_ms, own_ms = worst.worst_ms, windows.worst_ms
    heading = (
        f"Joined sweeps span up to {span_ms:.0f} ms ({worst.name}), windows up to {own_ms:.0f} ms"
    )
    apart = max(joined, key=lambda one: one.median(one.apart_ms))
    apart_ms = apart.median(apart.apart_ms)
    others = (
        f"At {speed_mps:g} m/s an object moves {offset_m(speed_mps, span_ms):.2f} m within such a "
        f"set, {offset_m(speed_mps, own_ms):.2f} m within a window. The mean times of the lidars "
        f"are {apart_ms:.0f} ms apart ({apart.name}, median): "
        f"{offset_m(speed_mps, apart_ms):.2f} m."
    )
    level = "warning" if span_ms > own_ms * 1.05 else "good"
    return Verdict(level, "Frame-level fusion against windows", heading, others, summary)


def nice_step(span: float, count: int) -> float:
    """A step of 1, 2 or 5 times a power of ten, so that about `count` fit into a span."""
    raw = max(span, 1e-9) / count
    power = 10.0 ** math.floor(math.log10(raw))
    return next(factor * power for factor in (1, 2, 5, 10) if factor * power >= raw * (1 - 1e-9))


def _ticks(low: float, high: float, count: int) -> list[float]:
    step = nice_step(high - low, count)
    numbers = range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)
    return [step * number for number in numbers]


def binned(
    at: F64Array, values: F64Array, end: float, bins: int = _BINS
) -> list[tuple[float, float, float]]:
    """Place, smallest and largest value of each part of [0, end] that has values."""
    if not len(at):
        return []
    part = np.minimum((at / end * bins).astype(np.int64), bins - 1)
    order = np.argsort(part, kind="stable")
    edges = np.flatnonzero(np.diff(part[order], prepend=-1))
    low = np.minimum.reduceat(values[order], edges)
    high = np.maximum.reduceat(values[order], edges)
    centers = (part[order][edges] + 0.5) * end / bins
    return list(zip(centers.tolist(), low.tolist(), high.tolist(), strict=True))


def _row(one: PolicyFigures) -> list[str]:
    """A row of the table."""
    _, twice, never = one.shares()
    cells = [one.name, str(one.sets), str(one.without_a_sensor), str(one.stale)]
    for values in (one.span_ms, one.apart_ms, one.latency_ms):
        cells += [f"{one.median(values):.1f}", f"{values.max(initial=0.0):.1f}"]
    return [*cells, f"{100 * twice:.1f} %", f"{100 * never:.1f} %"]
