"""The page of a comparison: windows against frame-level fusion, as clouds and static SVG.

The values of bars are titles of their elements, which browsers show.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.page.instant import SharedInstant
from mlbatch.page.policies import (
    DEFAULT_MPS,
    KMH_PER_MPS,
    SPEEDS_KMH,
    PolicyFigures,
    offset_m,
    quantile,
)
from mlbatch.page.templates import Verdict, render

_WIDTH = 900
_HEIGHT = 300
_LEFT = 56
_RIGHT = 12
_TOP = 14
_BOTTOM = 34
_INNER = _WIDTH - _LEFT - _RIGHT
# Pixel columns of a plot over time; each shows the smallest and the largest of its sets.
_BINS = 400
_ROW = 34
_NAME_WIDTH = 150
_WORDS_WIDTH = 170
_BARS = _WIDTH - _NAME_WIDTH - _WORDS_WIDTH
_HEAD = (
    *("joined by", "sets", "without a sensor", "stale", "span p50, ms", "span max, ms"),
    *("apart p50, ms", "apart max, ms", "latency p50, ms", "latency max, ms", "used twice"),
    "never used",
)

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
    values: dict[str, object] = {"clouds": []}
    if instant is not None:
        oldest_ms, newest_ms = instant.range_ms
        step = nice_step(oldest_ms - newest_ms, 6)
        first, last = math.ceil(newest_ms / step), math.floor(oldest_ms / step)
        ticks = [step * number for number in range(first, last + 1)]
        values |= instant.values(speed_mps, ticks)
    return render(
        "comparison.html",
        title=title,
        verdict=_verdict(summary, policies, speed_mps),
        **values,
        instant=instant,
        speed=f"{speed_mps:g} m/s",
        notes=notes,
        names=[(_kind(number), one.name) for number, one in enumerate(policies)],
        width=_WIDTH,
        left=_LEFT,
        right=_WIDTH - _RIGHT,
        bar=_ROW - 12,
        spans=_spans(policies),
        offsets=_offsets(policies),
        columns=_columns(policies),
        latencies=_latencies(policies),
        head=_HEAD,
        rows=list(map(_row, policies)),
        command=command,
    )


def _verdict(summary: str, policies: Policies, speed_mps: float) -> Verdict:
    *joined, windows = policies
    worst = max(joined, key=lambda one: one.span_ms.max(initial=0.0))
    span_ms = worst.span_ms.max(initial=0.0)
    own_ms = windows.span_ms.max(initial=0.0)
    heading = (
        f"Joined sweeps span up to {span_ms:.0f} ms ({worst.name}), windows up to {own_ms:.0f} ms"
    )
    apart = max(joined, key=lambda one: quantile(one.apart_ms, 0.5))
    apart_ms = quantile(apart.apart_ms, 0.5)
    others = (
        f"At {speed_mps:g} m/s an object moves {offset_m(speed_mps, span_ms):.2f} m within such a "
        f"set, {offset_m(speed_mps, own_ms):.2f} m within a window. The mean times of the lidars "
        f"are {apart_ms:.0f} ms apart ({apart.name}, median): "
        f"{offset_m(speed_mps, apart_ms):.2f} m."
    )
    level = "warning" if span_ms > own_ms * 1.05 else "good"
    return Verdict(level, "Frame-level fusion against windows", heading, others, summary)


# -- plots ------------------------------------------------------------------------------------


def _kind(number: int) -> str:
    """The class of a policy in the style sheet."""
    return f"k{number % 4}"


def nice_step(span: float, count: int) -> float:
    """A step of 1, 2 or 5 times a power of ten, so that about `count` fit into a span."""
    raw = max(span, 1e-9) / count
    power = 10.0 ** math.floor(math.log10(raw))
    return next(factor * power for factor in (1, 2, 5, 10) if factor * power >= raw * (1 - 1e-9))


def _ticks(top: float, count: int) -> list[float]:
    step = nice_step(top, count)
    return [step * number for number in range(math.floor(top / step + 1e-9) + 1)]


def _y_axis(top: float, unit: str) -> tuple[dict[str, object], Callable[[float], float]]:
    """A vertical axis from 0, and the place of a value."""

    def place(value: float) -> float:
        return _HEIGHT - _BOTTOM - value / top * (_HEIGHT - _BOTTOM - _TOP)

    ticks = [(place(tick), f"{tick:g}") for tick in _ticks(top, 5)]
    return {"unit": unit, "ticks": ticks}, place


def _spans(policies: Policies) -> dict[str, object]:
    top = max(one.span_ms.max(initial=1.0) for one in policies) * 1.08
    end_s = max(one.start_s.max(initial=0.0) for one in policies) or 1.0
    axis, place = _y_axis(top, "ms")
    times = [
        (
            _LEFT + tick / end_s * _INNER,
            "end" if tick > 0.97 * end_s else "middle",
            f"{tick:g} s",
        )
        for tick in _ticks(end_s, 8)
    ]
    paths = []
    for number, one in enumerate(policies):
        lines = []
        for at_s, low, high in binned(one.start_s, one.span_ms, end_s, _BINS):
            x = _LEFT + at_s / end_s * _INNER
            # A dot where all sets have one span.
            reach = max(0.0, 1.5 - (place(low) - place(high)) / 2)
            lines.append(f"M{x:.1f} {place(low) + reach:.1f}V{place(high) - reach:.1f}")
        paths.append((_kind(number), one.name, "".join(lines)))
    return {"height": _HEIGHT, "axis": axis, "times": times, "paths": paths}


def binned(
    at: F64Array, values: F64Array, end: float, bins: int
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


def _offsets(policies: Policies) -> dict[str, object]:
    worst_ms = max(one.span_ms.max(initial=1.0) for one in policies)
    axis, place = _y_axis(offset_m(SPEEDS_KMH[-1] / KMH_PER_MPS, worst_ms) * 1.12, "m")
    width = _INNER / len(SPEEDS_KMH)
    step = width / (len(policies) + 1)
    bars = []
    for group, speed in enumerate(SPEEDS_KMH):
        for number, one in enumerate(policies):
            worst = offset_m(speed / KMH_PER_MPS, one.span_ms.max(initial=0.0))
            usual = offset_m(speed / KMH_PER_MPS, quantile(one.apart_ms, 0.5))
            bars.append(
                {
                    "kind": _kind(number),
                    "text": f"{one.name}, {speed} km/h: median {usual:.3f} m, worst case "
                    f"{worst:.3f} m",
                    "x": _LEFT + group * width + (number + 0.5) * step,
                    "width": step * 0.86,
                    "worst": f"{worst:.2f}",
                    "worst_y": place(worst),
                    "usual_y": place(usual),
                }
            )
    speeds = [
        (_LEFT + (group + 0.5) * width, f"{speed} km/h") for group, speed in enumerate(SPEEDS_KMH)
    ]
    return {"height": _HEIGHT, "axis": axis, "bars": bars, "speeds": speeds, "base": place(0)}


def _columns(policies: Policies) -> dict[str, object]:
    rows = []
    for number, one in enumerate(policies):
        _, twice, never = one.shares()
        x = float(_NAME_WIDTH)
        shares = []
        for kind, share in zip(("once", "twice", "never"), one.shares(), strict=True):
            text = f"{one.name}: {100 * share:.1f} % used {kind}"
            shares.append((kind, x, share * _BARS, text))
            x += share * _BARS
        words = f"{100 * twice:.1f} % twice, {100 * never:.1f} % never"
        rows.append({"name": one.name, "y": number * _ROW + 6, "words": words, "shares": shares})
    return {"height": len(policies) * _ROW + 6, "right": _NAME_WIDTH + _BARS + 8, "rows": rows}


def _latencies(policies: Policies) -> dict[str, object]:
    top = max(one.latency_ms.max(initial=1.0) for one in policies) * 1.1
    scale = _BARS / top
    rows = []
    for number, one in enumerate(policies):
        least = one.latency_ms.min(initial=math.inf) if len(one.latency_ms) else 0.0
        middle = quantile(one.latency_ms, 0.5)
        most = one.latency_ms.max(initial=0.0)
        light = (_NAME_WIDTH + least * scale, (most - least) * scale, " light")
        rows.append(
            {
                "kind": _kind(number),
                "name": one.name,
                "y": number * _ROW + 4,
                "bars": [(_NAME_WIDTH, middle * scale, ""), light],
                "text": f"{one.name}: {least:.1f} to {most:.1f} ms, median {middle:.1f} ms",
                "end": _NAME_WIDTH + most * scale + 8,
                "words": f"{middle:.0f} ms (to {most:.0f} ms)",
            }
        )
    ticks = [(_NAME_WIDTH + tick * scale, f"{tick:g} ms") for tick in _ticks(top, 8)]
    return {"height": len(policies) * _ROW + 26, "ticks": ticks, "rows": rows}


def _row(one: PolicyFigures) -> list[str]:
    """A row of the table."""
    _, twice, never = one.shares()
    cells = [one.name, str(one.sets), str(one.without_a_sensor), str(one.stale)]
    for values in (one.span_ms, one.apart_ms, one.latency_ms):
        cells += [f"{quantile(values, 0.5):.1f}", f"{values.max(initial=0.0):.1f}"]
    return [*cells, f"{100 * twice:.1f} %", f"{100 * never:.1f} %"]
