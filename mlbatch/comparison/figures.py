"""Figures of a comparison for papers, by matplotlib (extra `plot`): PDF and PNG."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mlbatch.errors import ExportError, install_extra
from mlbatch.page.policies import KMH_PER_MPS, SPEEDS_KMH, PolicyFigures, offset_m

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SUFFIXES = (".pdf", ".png")
_WIDTH_IN = 6.4
_HEIGHT_IN = 3.2
_DPI = 200
# Distinct in print and for people who do not see all colours (Okabe and Ito, 2008).
_COLORS = ("#0072B2", "#D55E00", "#CC79A7", "#009E73")


def check_figures(folder: Path, *, overwrite: bool) -> None:
    """Raise ExportError if figures cannot be written; before anything is read."""
    try:
        import matplotlib  # noqa: F401
    except ImportError as err:
        raise ExportError(
            f"--figures: expected the package matplotlib, found none ({err}); "
            f"{install_extra('plot')}"
        ) from err
    if folder.exists() and not folder.is_dir():
        raise ExportError(f"{folder}: expected a folder for figures, found a file; choose another")
    if not folder.exists() and not folder.absolute().parent.is_dir():
        raise ExportError(
            f"{folder}: expected an existing folder around it, found none; create it (mkdir -p)"
        )
    there = [path.name for path in _paths(folder) if path.exists()]
    if there and not overwrite:
        raise ExportError(
            f"{folder}: expected no figures, found {there[0]}; replace them with --overwrite"
        )


def write_figures(folder: Path, policies: Sequence[PolicyFigures]) -> list[Path]:
    """Write all figures; policies: windows last."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    written = []
    try:
        folder.mkdir(exist_ok=True)
        for name, draw in _FIGURES.items():
            figure = Figure(figsize=(_WIDTH_IN, _HEIGHT_IN), dpi=_DPI, layout="constrained")
            FigureCanvasAgg(figure)
            draw(figure.add_subplot(), policies)
            for suffix in SUFFIXES:
                path = folder / f"{name}{suffix}"
                # No date: the same recording gives the same file.
                metadata = {"CreationDate": None} if suffix == ".pdf" else {"Software": None}
                figure.savefig(path, metadata=metadata)
                written.append(path)
    except OSError as err:
        raise ExportError(
            f"{folder}: expected to write figures, found {err.strerror!r}; choose another folder"
        ) from err
    return written


def _paths(folder: Path) -> list[Path]:
    return [folder / f"{name}{suffix}" for name in _FIGURES for suffix in SUFFIXES]


def _spans(axes: Axes, policies: Sequence[PolicyFigures]) -> None:
    """Time span of each set over time."""
    for one, color in zip(policies, _COLORS, strict=False):
        axes.plot(one.start_s, one.span_ms, ".", markersize=3, color=color, label=one.name)
    axes.set_xlabel("time (s)")
    axes.set_ylabel("time span of a set (ms)")
    axes.set_ylim(bottom=0)
    _finish(axes)


def _offsets(axes: Axes, policies: Sequence[PolicyFigures]) -> None:
    """Offset of an object at several speeds: median by mean times, worst case by spans."""
    width = 1 / (len(policies) + 1)
    for number, (one, color) in enumerate(zip(policies, _COLORS, strict=False)):
        at = [group + (number + 1) * width - 0.5 for group in range(len(SPEEDS_KMH))]
        worst = [offset_m(speed / KMH_PER_MPS, one.worst_ms) for speed in SPEEDS_KMH]
        usual = [offset_m(speed / KMH_PER_MPS, one.median(one.apart_ms)) for speed in SPEEDS_KMH]
        axes.bar(at, worst, width * 0.9, color=color, alpha=0.38)
        axes.bar(at, usual, width * 0.9, color=color, label=one.name)
    axes.set_xticks(range(len(SPEEDS_KMH)), [f"{speed} km/h" for speed in SPEEDS_KMH])
    axes.set_ylabel("offset (m): median, worst case")
    _finish(axes)


def _columns(axes: Axes, policies: Sequence[PolicyFigures]) -> None:
    """Shares of columns used once, twice and never."""
    names = [one.name for one in policies]
    left = [0.0] * len(policies)
    kinds = (("used once", "#999999"), ("used twice", "#E69F00"), ("never used", "#D55E00"))
    for number, (label, color) in enumerate(kinds):
        shares = [100 * one.shares()[number] for one in policies]
        axes.barh(names, shares, left=left, color=color, label=label)
        left = [before + share for before, share in zip(left, shares, strict=True)]
    axes.invert_yaxis()
    axes.set_xlabel("columns (%)")
    axes.set_xlim(0, 100)
    _finish(axes)


def _latencies(axes: Axes, policies: Sequence[PolicyFigures]) -> None:
    """Distribution of the latencies of sets."""
    values = [one.latency_ms if len(one.latency_ms) else [0.0] for one in policies]
    axes.boxplot(values, orientation="horizontal", whis=(0, 100))
    axes.set_yticks(range(1, len(policies) + 1), [one.name for one in policies])
    axes.invert_yaxis()
    axes.set_xlim(left=0)
    axes.set_xlabel("age of the first column when the set is complete (ms)")
    axes.grid(axis="x", alpha=0.3)


def _finish(axes: Axes) -> None:
    axes.grid(alpha=0.3)
    axes.set_axisbelow(True)
    axes.legend(fontsize="small", loc="upper center", bbox_to_anchor=(0.5, 1.18), ncols=4)


_FIGURES: dict[str, Callable[[Axes, Sequence[PolicyFigures]], None]] = {
    "spans": _spans,
    "offsets": _offsets,
    "columns": _columns,
    "latency": _latencies,
}
