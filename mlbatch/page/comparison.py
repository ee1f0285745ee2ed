"""The page of a comparison: windows against frame-level fusion, as static HTML and SVG.

No script: the values of bars are titles of their elements, which browsers show.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from html import escape

import numpy as np

from mlbatch.arrays import F64Array
from mlbatch.page.document import asset
from mlbatch.page.policies import SPEEDS_KMH, PolicyFigures, offset_m, quantile

_WIDTH = 900
_HEIGHT = 300
_LEFT = 56
_RIGHT = 12
_TOP = 14
_BOTTOM = 34
# Pixel columns of a plot over time; each shows the smallest and the largest of its sets.
_BINS = 400
_ROW = 34
_NAME_WIDTH = 150
_WORDS_WIDTH = 170
_STYLE = """
svg { display: block; width: 100%; min-width: 620px; height: auto; }
svg text { fill: var(--soft); font-size: 12px; font-family: inherit; }
svg .value { fill: var(--text); font-size: 11px; }
.axis { stroke: var(--grid); }
.k0 { fill: #2f7ed8; stroke: #2f7ed8; } .k1 { fill: #e8743b; stroke: #e8743b; }
.k2 { fill: #945ecf; stroke: #945ecf; } .k3 { fill: #19a979; stroke: #19a979; }
.light { opacity: .38; }
.legend span { white-space: nowrap; margin-right: 14px; }
th { white-space: normal; }
td:last-child { min-width: 0; }
td:first-child { white-space: nowrap; }
.legend i { display: inline-block; width: 12px; height: 12px; border-radius: 3px;
  margin-right: 5px; vertical-align: -2px; }
i.k0 { background: #2f7ed8; } i.k1 { background: #e8743b; } i.k2 { background: #945ecf; }
i.k3 { background: #19a979; }
.once { fill: #8d99a8; } .twice { fill: #d97706; } .never { fill: #e23b4b; }
i.once { background: #8d99a8; } i.twice { background: #d97706; } i.never { background: #e23b4b; }
"""
_HEAD = (
    *("joined by", "sets", "without a sensor", "stale", "span p50, ms", "span max, ms"),
    *("apart p50, ms", "apart max, ms", "latency p50, ms", "latency max, ms", "used twice"),
    "never used",
)


def comparison_page(
    title: str, summary: str, policies: Sequence[PolicyFigures], notes: Sequence[str], command: str
) -> str:
    """The whole page; policies: windows last."""
    body = "\n".join(
        [
            _header(title, summary, policies),
            _notes(notes),
            _section(
                "Time span of a set",
                _legend(policies) + _scroll(_spans(policies)),
                "From the first column of a set to its last. Without motion compensation an object "
                "is smeared over this time. A line shows the smallest and the largest span of "
                "the sets in its pixel.",
            ),
            _section(
                "Offset of an object that two lidars see",
                _legend(policies) + _scroll(_offsets(policies)),
                "How far apart the lidars of one set show an object that moves at this speed "
                "(speed x time). Full bar: distance of the mean times of the lidars, median of the "
                "sets; light bar: worst case, the largest span.",
            ),
            _section(
                "Columns used twice or never",
                _column_legend() + _scroll(_columns(policies)),
                "Share of the columns that the sets could use.",
            ),
            _section(
                "Latency",
                _scroll(_latencies(policies)),
                "Age of the first column of a set when the set is complete, if packets and sweeps "
                "arrive without delay. Light: smallest to largest; full: to the median. Windows "
                "wait 10 ms for late packets.",
            ),
            _section("Figures", _table(policies)),
            _section("Command", f"<pre>{escape(command)}</pre>"),
        ]
    )
    return f"""<!DOCTYPE html>
<!-- mlbatch page -->
<html lang="en" data-drawn="0">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; \
style-src 'unsafe-inline'">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<link rel="icon" href="data:,">
<title>{escape(title)} - mlbatch compare</title>
<style>
{asset("page.css")}{_STYLE}</style>
</head>
<body>
<main>
{body}
</main>
</body>
</html>
"""


def _section(title: str, content: str, about: str = "") -> str:
    note = f"<p class='about'>{about}</p>" if about else ""
    return f"<section>\n<h2>{title}</h2>\n{note}{content}\n</section>"


def _scroll(svg: str) -> str:
    return f"<div class='scroll'>{svg}</div>"


def _header(title: str, summary: str, policies: Sequence[PolicyFigures]) -> str:
    *joined, windows = policies
    worst = max(joined, key=lambda one: one.span_ms.max(initial=0.0))
    span_ms = worst.span_ms.max(initial=0.0)
    own_ms = windows.span_ms.max(initial=0.0)
    heading = (
        f"Joined sweeps span up to {span_ms:.0f} ms ({worst.name}), windows up to {own_ms:.0f} ms"
    )
    speed = SPEEDS_KMH[2]
    apart = max(joined, key=lambda one: quantile(one.apart_ms, 0.5))
    apart_ms = quantile(apart.apart_ms, 0.5)
    others = (
        f"At {speed} km/h an object moves {offset_m(speed, span_ms):.2f} m within such a set, "
        f"{offset_m(speed, own_ms):.2f} m within a window. The mean times of the lidars are "
        f"{apart_ms:.0f} ms apart ({apart.name}, median): {offset_m(speed, apart_ms):.2f} m."
    )
    word = "warning" if span_ms > own_ms * 1.05 else "good"
    return (
        f"<header>\n<h1>{escape(title)}</h1>\n<div class='verdict {word}' id='verdict'>"
        f"<em>Frame-level fusion against windows</em><strong>{escape(heading)}</strong>"
        f"<p>{escape(others)}</p><span>{escape(summary)}</span></div>\n</header>"
    )


def _notes(notes: Sequence[str]) -> str:
    if not notes:
        return ""
    items = "".join(f"<p>{escape(note)}</p>" for note in notes)
    return _section("Warnings", items)


def _legend(policies: Sequence[PolicyFigures]) -> str:
    marks = "".join(
        f"<span><i class='k{number % 4}'></i>{escape(one.name)}</span>"
        for number, one in enumerate(policies)
    )
    return f"<p class='legend'>{marks}</p>"


def _column_legend() -> str:
    return (
        "<p class='legend'><span><i class='once'></i>used once</span><span><i class='twice'></i>"
        "used twice or more</span><span><i class='never'></i>never used</span></p>"
    )


# -- plots ------------------------------------------------------------------------------------


def _svg(height: float, parts: Sequence[str], label: str) -> str:
    return (
        f"<svg viewBox='0 0 {_WIDTH} {height:g}' role='img' aria-label='{escape(label)}'>"
        + "".join(parts)
        + "</svg>"
    )


def nice_step(span: float, count: int) -> float:
    """A step of 1, 2 or 5 times a power of ten, so that about `count` fit into a span."""
    raw = max(span, 1e-9) / count
    power = 10.0 ** math.floor(math.log10(raw))
    return next(factor * power for factor in (1, 2, 5, 10) if factor * power >= raw * (1 - 1e-9))


def _ticks(top: float, count: int) -> list[float]:
    step = nice_step(top, count)
    return [step * number for number in range(math.floor(top / step + 1e-9) + 1)]


def _y_axis(top: float, unit: str, height: float) -> tuple[list[str], Callable[[float], float]]:
    """Lines and texts of a vertical axis from 0, and the place of a value."""
    bottom = height - _BOTTOM

    def place(value: float) -> float:
        return bottom - value / top * (bottom - _TOP)

    parts = []
    for tick in _ticks(top, 5):
        y = place(tick)
        parts.append(
            f"<line class='axis' x1='{_LEFT}' x2='{_WIDTH - _RIGHT}' y1='{y:.1f}' y2='{y:.1f}'/>"
            f"<text x='{_LEFT - 6}' y='{y + 4:.1f}' text-anchor='end'>{tick:g}</text>"
        )
    parts.append(f"<text x='4' y='{_TOP - 2}'>{unit}</text>")
    return parts, place


def _spans(policies: Sequence[PolicyFigures]) -> str:
    top = max(one.span_ms.max(initial=1.0) for one in policies) * 1.08
    end_s = max(one.start_s.max(initial=0.0) for one in policies) or 1.0
    parts, place = _y_axis(top, "ms", _HEIGHT)
    width = _WIDTH - _LEFT - _RIGHT
    for tick in _ticks(end_s, 8):
        x = _LEFT + tick / end_s * width
        anchor = "end" if tick > 0.97 * end_s else "middle"
        parts.append(
            f"<text x='{x:.1f}' y='{_HEIGHT - 12}' text-anchor='{anchor}'>{tick:g} s</text>"
        )
    for number, one in enumerate(policies):
        lines = []
        for at_s, low, high in binned(one.start_s, one.span_ms, end_s, _BINS):
            x = _LEFT + at_s / end_s * width
            # A dot where all sets have one span.
            reach = max(0.0, 1.5 - (place(low) - place(high)) / 2)
            lines.append(f"M{x:.1f} {place(low) + reach:.1f}V{place(high) - reach:.1f}")
        parts.append(
            f"<path class='k{number % 4}' stroke-width='2.5' fill='none' d='{''.join(lines)}'>"
            f"<title>{escape(one.name)}</title></path>"
        )
    return _svg(_HEIGHT, parts, "time span of sets over time")


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


def _offsets(policies: Sequence[PolicyFigures]) -> str:
    fastest = SPEEDS_KMH[-1]
    worst_ms = max(one.span_ms.max(initial=1.0) for one in policies)
    parts, place = _y_axis(offset_m(fastest, worst_ms) * 1.12, "m", _HEIGHT)
    width = (_WIDTH - _LEFT - _RIGHT) / len(SPEEDS_KMH)
    bar = width / (len(policies) + 1)
    base = place(0)
    for group, speed in enumerate(SPEEDS_KMH):
        left = _LEFT + group * width
        for number, one in enumerate(policies):
            x = left + (number + 0.5) * bar
            worst = offset_m(speed, one.span_ms.max(initial=0.0))
            usual = offset_m(speed, quantile(one.apart_ms, 0.5))
            text = f"{one.name}, {speed} km/h: median {usual:.3f} m, worst case {worst:.3f} m"
            parts.append(f"<g class='k{number % 4}' stroke='none'><title>{escape(text)}</title>")
            for value, light in ((worst, " class='light'"), (usual, "")):
                y = place(value)
                parts.append(
                    f"<rect{light} stroke='none' x='{x:.1f}' y='{y:.1f}' width='{bar * 0.86:.1f}' "
                    f"height='{base - y:.1f}'/>"
                )
            parts.append("</g>")
            parts.append(
                f"<text class='value' text-anchor='middle' x='{x + bar * 0.43:.1f}' "
                f"y='{place(worst) - 4:.1f}'>{worst:.2f}</text>"
            )
        parts.append(
            f"<text text-anchor='middle' x='{left + width / 2:.1f}' y='{_HEIGHT - 12}'>"
            f"{speed} km/h</text>"
        )
    return _svg(_HEIGHT, parts, "offset of an object by speed")


def _columns(policies: Sequence[PolicyFigures]) -> str:
    width = _WIDTH - _NAME_WIDTH - _WORDS_WIDTH
    parts = []
    for number, one in enumerate(policies):
        y = number * _ROW + 6
        _, twice, never = one.shares()
        words = f"{100 * twice:.1f} % twice, {100 * never:.1f} % never"
        parts.append(
            f"<text class='value' x='{_NAME_WIDTH + width + 8}' y='{y + 16}'>{words}</text>"
        )
        parts.append(f"<text x='0' y='{y + 16}'>{escape(one.name)}</text>")
        x = float(_NAME_WIDTH)
        for kind, share in zip(("once", "twice", "never"), one.shares(), strict=True):
            text = f"{one.name}: {100 * share:.1f} % used {kind}"
            parts.append(
                f"<rect class='{kind}' x='{x:.1f}' y='{y}' width='{share * width:.1f}' "
                f"height='{_ROW - 12}'><title>{escape(text)}</title></rect>"
            )
            x += share * width
    return _svg(len(policies) * _ROW + 6, parts, "columns used once, twice or never")


def _latencies(policies: Sequence[PolicyFigures]) -> str:
    top = max(one.latency_ms.max(initial=1.0) for one in policies) * 1.1
    width = _WIDTH - _NAME_WIDTH - _WORDS_WIDTH
    height = len(policies) * _ROW + 26
    parts = []
    for tick in _ticks(top, 8):
        x = _NAME_WIDTH + tick / top * width
        parts.append(
            f"<line class='axis' x1='{x:.1f}' x2='{x:.1f}' y1='0' y2='{height - 18}'/>"
            f"<text x='{x:.1f}' y='{height - 4}' text-anchor='middle'>{tick:g} ms</text>"
        )
    for number, one in enumerate(policies):
        y = number * _ROW + 4
        least = one.latency_ms.min(initial=math.inf) if len(one.latency_ms) else 0.0
        middle = quantile(one.latency_ms, 0.5)
        most = one.latency_ms.max(initial=0.0)
        words = f"{middle:.0f} ms (to {most:.0f} ms)"
        parts.append(f"<text x='0' y='{y + 16}'>{escape(one.name)}</text>")
        for low, high, light in ((0.0, middle, ""), (least, most, " light")):
            parts.append(
                f"<rect class='k{number % 4}{light}' stroke='none' style='stroke:none' "
                f"x='{_NAME_WIDTH + low / top * width:.1f}' y='{y}' "
                f"width='{(high - low) / top * width:.1f}' height='{_ROW - 12}'>"
                f"<title>{escape(one.name)}: {least:.1f} to {most:.1f} ms, median {middle:.1f} ms"
                "</title></rect>"
            )
        x = _NAME_WIDTH + most / top * width
        parts.append(f"<text class='value' x='{x + 8:.1f}' y='{y + 16}'>{words}</text>")
    return _svg(height, parts, "latency of sets")


def _table(policies: Sequence[PolicyFigures]) -> str:
    head = "".join(f"<th>{escape(cell)}</th>" for cell in _HEAD)
    rows = []
    for one in policies:
        _, twice, never = one.shares()
        times = (one.span_ms, one.apart_ms, one.latency_ms)
        cells = [one.name, str(one.sets), str(one.without_a_sensor), str(one.stale)]
        for values in times:
            cells += [f"{quantile(values, 0.5):.1f}", f"{values.max(initial=0.0):.1f}"]
        cells += [f"{100 * twice:.1f} %", f"{100 * never:.1f} %"]
        rows.append("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in cells) + "</tr>")
    return (
        f"<div class='scroll'><table><thead><tr>{head}</tr></thead>"
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )
