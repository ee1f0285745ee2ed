"""Draw how windows close: three streams of columns, one of which stalls.

    python docs/streams.py > docs/streams.svg

Rows are streams, ticks are columns. Below: when each window is written, by the newest timestamp
delivered until then. tests/batching/test_page.py computes these times by the reference.
"""

from __future__ import annotations

# First and last column of each uninterrupted part of a stream, ms; a column every 10 ms.
STREAMS = {
    "left": ((20, 840),),
    "right": ((35, 835),),
    "roof": ((50, 240), (620, 840)),
}
STEP_MS = 10
MAX_WAIT_MS = 200
# Scan, its window, the newest timestamp when it is written, whether it is complete; ms.
WRITTEN = (
    (0, 100, 215, True),
    (1, 200, 445, False),
    (2, 300, 445, False),
    (3, 400, 515, False),
    (4, 500, 615, False),
    (5, 600, 715, False),
    (6, 700, 815, True),
)
PERIOD_MS, END_MS = 100, 860
WIDTH, HEIGHT = 840, 330
ORIGIN_X, PX_PER_MS, TOP, LANE_STEP = 60, 0.82, 62, 34

STYLE = """
  .card { fill: #ffffff; stroke: #d0d7de; }
  text { font: 13px -apple-system, "Segoe UI", "Noto Sans", Helvetica, Arial, sans-serif;
    fill: #1f2328; }
  .title { font-weight: 600; font-size: 15px; }
  .faint { fill: #59636e; }
  .small { font-size: 11px; }
  .middle { text-anchor: middle; }
  .grid { stroke: #59636e; stroke-dasharray: 3 3; }
  .tick { stroke: #0b6bcb; stroke-width: 1.6; }
  .dropped { stroke: #8c959f; stroke-width: 1.6; }
  .silent { fill: #d1242f; opacity: 0.16; }
  .whole { fill: #1a7f37; } .part { fill: #c2570c; }
  .wait { stroke: #59636e; fill: none; }
  @media (prefers-color-scheme: dark) {
    .card { fill: #0d1117; stroke: #3d444d; }
    text { fill: #f0f6fc; } .faint { fill: #9198a1; }
    .grid, .wait { stroke: #9198a1; } .tick { stroke: #4493f8; }
  }
"""


def stamps_ms(name: str) -> list[int]:
    """Timestamps of all columns of a stream."""
    return [at for first, last in STREAMS[name] for at in range(first, last + 1, STEP_MS)]


def main() -> None:
    """Print the picture."""
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" role="img">',
        "<title>Three streams of columns, one stalled, and when each window is written</title>",
        f"<style>{STYLE}</style>",
        f'<rect class="card" x="0.5" y="0.5" width="{WIDTH - 1}" height="{HEIGHT - 1}" rx="8"/>',
        text(16, 26, "Columns by their timestamps; windows of 100 ms; --max-wait 0.2", "title"),
        *grid(),
    ]
    for row, name in enumerate(STREAMS):
        parts += lane(name, TOP + row * LANE_STEP)
    parts += written(TOP + len(STREAMS) * LANE_STEP + 24)
    print("\n".join([*parts, "</svg>"]))


def grid() -> list[str]:
    """Bounds of windows."""
    bottom = TOP + len(STREAMS) * LANE_STEP
    return [
        line
        for at in range(0, END_MS, PERIOD_MS)
        for line in (
            f'<line class="grid" x1="{x_of(at):.1f}" x2="{x_of(at):.1f}" '
            f'y1="{TOP - 14}" y2="{bottom}"/>',
            text(x_of(at), TOP - 18, f"{at} ms" if at else "0", "faint small middle"),
        )
    ]


def lane(name: str, top: int) -> list[str]:
    """The columns of a stream, and where it is silent; grey: the head, which is dropped."""
    parts = [text(12, top + 16, name)]
    parts += [
        f'<line class="{"dropped" if at < PERIOD_MS else "tick"}" x1="{x_of(at):.1f}" '
        f'x2="{x_of(at):.1f}" y1="{top + 3}" y2="{top + 19}"/>'
        for at in stamps_ms(name)
    ]
    for (_, last), (first, _) in zip(STREAMS[name], STREAMS[name][1:], strict=False):
        left, right = x_of(last + STEP_MS / 2), x_of(first - STEP_MS / 2)
        parts.append(
            f'<rect class="silent" x="{left:.1f}" y="{top}" '
            f'width="{right - left:.1f}" height="22"/>'
        )
        parts.append(text((left + right) / 2, top + 16, "no packets", "small middle"))
    return parts


def written(top: int) -> list[str]:
    """A line for each window, from its start to the timestamp that closes it."""
    parts = [text(12, top + 4, "scan", "faint small")]
    for row, (scan, start, closed, complete) in enumerate(WRITTEN):
        y = top + 18 * row
        end = start + PERIOD_MS
        kind = "whole" if complete else "part"
        parts += [
            f'<rect class="{kind}" x="{x_of(start) + 1:.1f}" y="{y - 7}" '
            f'width="{PERIOD_MS * PX_PER_MS - 2:.1f}" height="12" rx="2"/>',
            f'<path class="wait" d="M{x_of(end):.1f} {y - 1}H{x_of(closed):.1f}m0 -5v10"/>',
            text(x_of(start) - 14, y + 4, str(scan), "small middle"),
            text(x_of(closed) + 6, y + 4, note(closed, complete), "faint small"),
        ]
    return parts


def note(closed_ms: int, complete: bool) -> str:
    """Text after a window."""
    text = f"written at {closed_ms}"
    return text if complete else f"{text}, incomplete"


def x_of(at_ms: float) -> float:
    """Horizontal place of a time."""
    return ORIGIN_X + at_ms * PX_PER_MS


def text(x: float, y: float, content: str, classes: str = "") -> str:
    """A line of text."""
    names = f' class="{classes}"' if classes else ""
    return f'<text x="{x:.1f}" y="{y:.1f}"{names}>{content}</text>'


if __name__ == "__main__":
    main()
