"""Draw the problem that mlbatch solves: time spans of scans from two lidars 37 ms out of phase.

    python docs/time_span.py > docs/time_span.svg

Top: frame-level fusion of the latest sweep of each lidar; bottom: columns batched on one time
grid, so that every scan spans one period.
"""

from __future__ import annotations

from dataclasses import dataclass

PERIOD_MS = 100
# Rotors pass zero this long after a bound of the grid; 37 ms apart.
PHASE_MS = {"left": 20, "right": 57}
END_MS = 520
ORIGIN_X, PX_PER_MS, LANE_HEIGHT, LANE_STEP = 70, 1.42, 20, 26
WIDTH, HEIGHT = 840, 376

STYLE = """
  .card { fill: #ffffff; stroke: #d0d7de; }
  text { font: 13px -apple-system, "Segoe UI", "Noto Sans", Helvetica, Arial, sans-serif;
    fill: #1f2328; }
  .title { font-weight: 600; font-size: 15px; }
  .faint { fill: #59636e; }
  .small { font-size: 11px; }
  .inside { fill: #ffffff; text-anchor: middle; font-size: 12px; }
  .middle { text-anchor: middle; }
  .grid { stroke: #59636e; stroke-dasharray: 3 3; }
  .notch { stroke: #ffffff; stroke-width: 2; }
  .span { fill: none; stroke-width: 2; }
  .a { fill: #c2570c; } .span.a { fill: none; stroke: #c2570c; }
  .b { fill: #0b6bcb; } .span.b { fill: none; stroke: #0b6bcb; }
  .cut { fill: #8c959f; opacity: 0.45; }
  @media (prefers-color-scheme: dark) {
    .card { fill: #0d1117; stroke: #3d444d; }
    text { fill: #f0f6fc; } .faint { fill: #9198a1; }
    .inside { fill: #ffffff; }
    .grid { stroke: #9198a1; } .notch { stroke: #0d1117; }
  }
"""


@dataclass(frozen=True, slots=True)
class Bar:
    """Columns of one lidar that go into one scan; `number` picks the colour."""

    start_ms: int
    end_ms: int
    number: int | None


def main() -> None:
    """Print the picture."""
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" role="img">',
        "<title>Time spans: fusion of latest sweeps, and scans on one time grid</title>",
        f"<style>{STYLE}</style>",
        f'<rect class="card" x="0.5" y="0.5" width="{WIDTH - 1}" height="{HEIGHT - 1}" rx="8"/>',
        *fused_sweeps(18),
        *windows(206),
        "</svg>",
    ]
    print("\n".join(parts))


def fused_sweeps(top: int) -> list[str]:
    """Each set: a sweep of `left`, and the latest sweep of `right` complete by then."""
    parts = [text(16, top + 16, "Frame-level fusion: latest sweep of each lidar", "title")]
    lanes = {
        name: [Bar(start, start + PERIOD_MS, number) for number, start in enumerate(starts(name))]
        for name in PHASE_MS
    }
    # The first sweep of `left` has no complete partner in the picture.
    lanes["left"] = [
        Bar(bar.start_ms, bar.end_ms, None if bar.number == 0 else (bar.number or 0) - 1)
        for bar in lanes["left"]
    ]
    parts += draw_lanes(lanes, top + 32)
    sets = [
        (right.start_ms, left.end_ms, right.number or 0)
        for right, left in zip(lanes["right"], lanes["left"][1:], strict=False)
        if left.end_ms <= END_MS
    ]
    for start, end, number in sets:
        parts += bracket(start, end, top + 94 + 22 * (number % 2), "ab"[number % 2])
    note = "a set spans up to two sweeps, and columns of one instant are in different sets"
    parts.append(text(ORIGIN_X, top + 148, note, "faint"))
    return parts


def windows(top: int) -> list[str]:
    """Each scan: all columns between two bounds of the grid."""
    cuts = range(0, END_MS + 1, PERIOD_MS)
    parts = [
        f'<line class="grid" x1="{x_of(cut):.1f}" x2="{x_of(cut):.1f}" '
        f'y1="{top + 26}" y2="{top + 112}"/>'
        for cut in cuts
    ]
    parts.append(text(16, top + 16, "mlbatch: columns on one time grid", "title"))
    lanes = {
        name: [
            Bar(max(cut, phase), min(cut + PERIOD_MS, END_MS), whole(cut, phase)) for cut in cuts
        ]
        for name, phase in PHASE_MS.items()
    }
    parts += draw_lanes(lanes, top + 32)
    for name, y in zip(PHASE_MS, (top + 32, top + 32 + LANE_STEP), strict=True):
        parts += [
            f'<line class="notch" x1="{x_of(at):.1f}" x2="{x_of(at):.1f}" y1="{y}" y2="{y + 6}"/>'
            for at in starts(name)[1:]
        ]
    for cut in cuts[1:-1]:
        number = cut // PERIOD_MS - 1
        parts += bracket(cut, cut + PERIOD_MS, top + 94, "ab"[number % 2], inset=2)
    parts += [text(x_of(cut), top + 128, f"{cut} ms", "faint middle") for cut in cuts]
    note = "every scan spans one period; notches: the rotor passes zero"
    parts.append(text(ORIGIN_X, top + 154, note, "faint"))
    return parts


def starts(name: str) -> list[int]:
    """Start times of the sweeps of a lidar, ms."""
    return list(range(PHASE_MS[name], END_MS, PERIOD_MS))


def whole(cut_ms: int, phase_ms: int) -> int | None:
    """Number of the scan that begins at a cut; None for the first and last, which are partial."""
    partial = cut_ms < max(PHASE_MS.values()) or cut_ms + PERIOD_MS > END_MS
    return None if partial else cut_ms // PERIOD_MS - 1


def draw_lanes(lanes: dict[str, list[Bar]], top: int) -> list[str]:
    """A row of bars for each lidar; grey: in no scan."""
    parts = []
    for row, (name, bars) in enumerate(lanes.items()):
        y = top + row * LANE_STEP
        parts.append(text(16, y + 15, name))
        for bar in bars:
            parts += draw_bar(bar, y)
    return parts


def draw_bar(bar: Bar, y: int) -> list[str]:
    """A bar, with the number of its scan inside where it is whole."""
    left, right = x_of(bar.start_ms), x_of(min(bar.end_ms, END_MS))
    whole_bar = bar.number is not None and bar.end_ms <= END_MS
    colour = "ab"[(bar.number or 0) % 2] if whole_bar else "cut"
    parts = [
        f'<rect class="{colour}" x="{left + 1:.1f}" y="{y}" '
        f'width="{right - left - 2:.1f}" height="{LANE_HEIGHT}" rx="3"/>'
    ]
    if whole_bar:
        parts.append(text((left + right) / 2, y + 15, str((bar.number or 0) + 1), "inside"))
    return parts


def bracket(start_ms: int, end_ms: int, y: int, colour: str, inset: int = 0) -> list[str]:
    """A span with both ends marked, and its length."""
    left, right = x_of(start_ms) + inset, x_of(end_ms) - inset
    return [
        f'<path class="span {colour}" d="M{left:.1f} {y}v8H{right:.1f}v-8"/>',
        text((left + right) / 2, y + 4, f"{end_ms - start_ms} ms", "small middle"),
    ]


def text(x: float, y: float, words: str, style: str = "") -> str:
    """A line of text; `y` is its baseline."""
    style = f' class="{style}"' if style else ""
    return f'<text{style} x="{x:.1f}" y="{y:.1f}">{words}</text>'


def x_of(time_ms: float) -> float:
    """Where a time is drawn."""
    return ORIGIN_X + PX_PER_MS * time_ms


if __name__ == "__main__":
    main()
