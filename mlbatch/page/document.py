"""The page as text: static HTML for words and tables, canvases for plots, their data as JSON.

Every value of a report or file is escaped; a content security policy allows the page's own script
and no request.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
from collections.abc import Callable, Iterable, Sequence
from html import escape
from importlib import resources
from pathlib import PurePath
from typing import Any

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import F64Array
from mlbatch.clocks.timescale import describe_time
from mlbatch.outputs.damage import VerifyError
from mlbatch.page.clouds import PageCloud, choose_places, read_clouds, window_ms
from mlbatch.page.findings import Finding, Level, findings, number, percent, verdict
from mlbatch.page.source import Source
from mlbatch.page.windows import Windows, read_windows, summarise
from mlbatch.report.ledger import SensorLedger
from mlbatch.report.report import RunReport, SensorReport

_WORDS = {
    Level.GOOD: ("good", "OK"),
    Level.NOTE: ("note", "Note"),
    Level.WARNING: ("warning", "Warning"),
    Level.PROBLEM: ("problem", "Problem"),
}
# Colours of parts by reason: class of the style sheet.
_GOOD_PARTS = frozenset({"accepted", "written"})
_NEUTRAL_PARTS = frozenset(
    {"no_return", "range", "box", "repeated", "head", "tail", "outside_time", "duplicate"}
)
_MEANINGS = {
    "accepted": "accepted",
    "written": "in the output",
    "lost": "never received",
    "no_return": "no return",
    "range": "outside the range limits",
    "box": "in an excluded box",
    "repeated": "repeated return",
    "head": "before the first whole window",
    "tail": "after the last whole window",
    "before_start": "before all sensors had started",
    "outside_time": "outside --start and --end",
    "late": "late",
    "invalid": "marked invalid by the sensor",
    "incomplete": "in a window left out as incomplete",
    "bad_size": "bad size",
    "bad_header": "bad header",
    "bad_crc": "bad checksum",
    "bad_stamp": "bad timestamp",
    "duplicate": "duplicate",
}
# Outcomes of points, and costs of a run, in the order of the page.
_OUTCOMES = ("written", "no_return", "range", "box", "repeated")
_COSTS = ("wall_s", "cpu_s", "read_s", "decode_s", "merge_s", "write_s", "peak_rss_mb")
_NO_TABLE = (
    "No scans.csv was found, so nothing is known of single windows: give the output "
    "(<code>mlbatch report OUTPUT</code>), or keep scans.csv next to it."
)
_NO_SCANS = "The scans are not available to this page: give the output itself."


def page_text(source: Source) -> str:
    """The whole page. Raises ExportError if scans.csv is damaged."""
    report = source.report
    slices = report.slices
    windows = None if source.table is None else read_windows(source.table, slices)
    clouds, why_no_clouds = _clouds(source, windows)
    found = findings(report, windows)
    script = asset("page.js")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    title = _title(source)
    body = "\n".join(
        [
            _header(source, title, found, windows),
            _cards(report),
            _findings(found),
            _timeline(windows),
            _scans(clouds, why_no_clouds),
            _accounts(report),
            _clock(report),
            _sensors(report),
            _about(report),
        ]
    )
    data = _json(_plot_data(report, windows, clouds))
    return f"""<!DOCTYPE html>
<!-- mlbatch page -->
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; \
style-src 'unsafe-inline'; script-src 'sha256-{digest}'">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta name="generator" content="mlbatch {escape(report.version)}">
<link rel="icon" href="data:,">
<title>{escape(title)} - mlbatch</title>
<style>
{asset("page.css")}</style>
</head>
<body>
<main>
{body}
</main>
<div id="tip" hidden></div>
<script type="application/json" id="data">{data}</script>
<script>{script}</script>
</body>
</html>
"""


def asset(name: str) -> str:
    """Text of a file of this package."""
    return resources.files("mlbatch.page").joinpath(name).read_text(encoding="utf-8")


def _json(value: object) -> str:
    """JSON that cannot end its script element."""
    text = json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def _title(source: Source) -> str:
    if source.output is not None:
        return source.output.name or str(source.output)
    inputs = [PurePath(one.path).name for one in source.report.inputs]
    return ", ".join(filter(None, inputs)) or "run"


def _clouds(source: Source, windows: Windows | None) -> tuple[list[PageCloud], str]:
    """Scans to show, or the reason why there are none, as HTML."""
    if windows is None:
        return [], _NO_TABLE
    if source.output is None:
        return [], _NO_SCANS
    try:
        clouds = read_clouds(source.output, choose_places(windows), windows.sensors)
    except VerifyError as err:
        return [], escape(f"The scans could not be read: {err}")
    return clouds, "" if clouds else _NO_SCANS


# -- sections ---------------------------------------------------------------------------------


def _section(title: str, content: str, about: str = "") -> str:
    note = f"<p class='about'>{about}</p>" if about else ""
    return f"<section>\n<h2>{title}</h2>\n{note}{content}\n</section>"


def _header(source: Source, title: str, found: list[Finding], windows: Windows | None) -> str:
    level, heading, others = verdict(found)
    word, label = _WORDS[level]
    report = source.report
    sensors = report.sensors
    written = report.scans.written
    names = ", ".join(sensor.name for sensor in sensors)
    rate = report.rate_hz
    summary = f"{number(written, 'scan')} at {rate} Hz of {number(len(sensors), 'lidar')} ({names})"
    if report.recorded_s:
        summary += f", from {_seconds(report.recorded_s)} of recording"
    summary += f". {_loss_words(sensors)}"
    if windows is not None:
        start = describe_time(int(windows.start_ns[0]), report.timescale)
        summary += f" First scan at {start}."
    return (
        f"<header>\n<h1>{escape(title)}</h1>\n"
        f"<div class='verdict {word}' id='verdict'><em>{label}</em>"
        f"<strong>{escape(heading)}</strong><p>{escape(others)}</p>"
        f"<span>{escape(summary)}</span></div>\n</header>"
    )


def _loss_words(sensors: Sequence[SensorReport]) -> str:
    lost = sum(sensor.ledger.packets.lost for sensor in sensors)
    read = sum(sensor.ledger.packets.read for sensor in sensors)
    if not lost:
        return f"None of {number(read, 'packet')} was lost."
    return f"{number(lost, 'packet')} lost ({percent(lost, read + lost)})."


def _seconds(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest} s"
    return f"{minutes // 60} h {minutes % 60} min"


def _cards(report: RunReport) -> str:
    scans = report.scans
    sensors = report.sensors
    span = scans.span_ms.p50
    timing = report.timing
    packets = [sensor.ledger.packets for sensor in sensors]
    cards = [
        ("scans", f"{scans.written:,}"),
        ("incomplete", f"{scans.incomplete:,}"),
        ("points", _short(scans.points)),
        ("lost packets", f"{sum(one.lost for one in packets):,}"),
        ("rejected packets", f"{sum(sum(one.rejected.values()) for one in packets):,}"),
        ("set span, median", "" if span is None else f"{span:.1f} ms"),
        ("clock", report.timescale),
        ("times real time", "" if timing is None else f"{timing.realtime_factor:.1f}"),
    ]
    items = "".join(
        f"<div class='card'><b>{escape(value)}</b><span>{escape(name)}</span></div>"
        for name, value in cards
        if value
    )
    return f"<div class='cards'>{items}</div>"


def _short(count: int) -> str:
    for limit, unit in ((10**9, "G"), (10**6, "M"), (10**4, "k")):
        if count >= limit:
            return f"{count / (1000 if unit == 'k' else limit):.1f} {unit}"
    return f"{count:,}"


def _findings(found: list[Finding]) -> str:
    if not found:
        return _section("Findings and warnings", "<p>None.</p>")
    rows = []
    for one in found:
        word, label = _WORDS[one.level]
        code = f" <code>{escape(one.code)}</code>" if one.code else ""
        remedy = f"<p class='remedy'>Remedy: {escape(one.remedy)}</p>" if one.remedy else ""
        rows.append(
            f"<li class='{word}'><span class='badge'>{label}</span>"
            f"<div><p>{escape(one.text)}{code}</p>{remedy}</div></li>"
        )
    return _section("Findings and warnings", f"<ul class='findings'>{''.join(rows)}</ul>")


_CONTROLS = (
    "<div class='controls'><span id='range'></span>"
    "<button id='in'>Zoom in</button><button id='out'>Zoom out</button>"
    "<button id='back'>Earlier</button><button id='on'>Later</button>"
    "<button id='all'>Whole run</button></div>"
)


def _timeline(windows: Windows | None) -> str:
    if windows is None:
        return _section("Timeline", f"<p class='lacks'>{_NO_TABLE}</p>")
    group = summarise(windows).group
    joined = f" Each value summarises {group} windows, by the worst of them." if group > 1 else ""
    estimated = [
        name for name, flag in zip(windows.sensors, windows.estimated, strict=True) if flag
    ]
    guess = (
        f" Expected columns of {escape(', '.join(estimated))} are the median of the run: "
        "scans.csv has none."
        if estimated
        else ""
    )
    far_ms = windows.far_ms
    far = f" (less {far_ms / 1000:,.0f} s: the clocks differ)" if far_ms else ""
    plots = (
        "<h3>Columns of each sensor: received, <span class='swatch missing'></span> missing, "
        "<span class='swatch none'></span> no scan, <span class='swatch incomplete'></span> "
        "incomplete</h3><canvas id='timeline'></canvas>"
        "<h3>Fill of each window: columns received / expected "
        "<span class='ramp'></span> 0 to 100 %</h3><canvas id='fill'></canvas>"
        "<h3>Longest time without a column, ms</h3><canvas id='gap'></canvas>"
        "<h3>Points of a scan</h3><canvas id='points'></canvas>"
        "<h3>Set span: first to last column of a scan, ms</h3><canvas id='span'></canvas>"
        f"<h3>Delay: receive time of the packet that closed a window, after its end, ms{far}</h3>"
        "<canvas id='delay'></canvas>"
    )
    return _section(
        "Timeline",
        _CONTROLS + plots,
        "From scans.csv. Drag in a plot to enlarge a part, double-click for the whole run; a pixel "
        f"shows the worst of its windows.{joined}{guess}",
    )


def _scans(clouds: list[PageCloud], why_not: str) -> str:
    if not clouds:
        return _section("Scans", f"<p class='lacks'>{why_not}</p>")
    colours = [("lidar", "lidar"), ("height", "height"), ("time", "time"), ("bright", "intensity")]
    absent = {
        "lidar": not all(cloud.has_lidar for cloud in clouds),
        "time": not all(cloud.has_time for cloud in clouds),
        "bright": not all(cloud.has_intensity for cloud in clouds),
    }
    buttons = "".join(
        f"<button data-colour='{key}'{' disabled' if absent.get(key) else ''}>{name}</button>"
        for key, name in colours
    )
    views = "".join(
        f"<figure><canvas class='top' data-scan='{i}' tabindex='0'></canvas>"
        f"<figcaption>{_caption(cloud)}</figcaption></figure>"
        for i, cloud in enumerate(clouds)
    )
    lacks = [name for key, name in colours if absent.get(key)]
    note = (
        f" The output has no {' and no '.join(lacks)} of points that this page can read."
        if lacks
        else ""
    )
    return _section(
        "Scans",
        f"<div class='controls'>Colour: {buttons}</div><div class='tops'>{views}</div>"
        "<figure><canvas id='cloud' tabindex='0'></canvas><figcaption id='cloudinfo'>"
        "</figcaption></figure><div id='legend'></div>",
        "From above (x up, y left) and in space: drag to rotate, wheel to "
        "enlarge; select a scan above. Axes at the body frame and at each lidar: x red, y green, "
        f"z blue.{note}",
    )


def _caption(cloud: PageCloud) -> str:
    place = cloud.place
    shown = len(cloud.xyz)
    part = "" if shown == cloud.total else f", {shown:,} of them drawn"
    sliced = f" slice {place.slice}" if place.slice else ""
    return (
        f"<b>{place.title.capitalize()}</b>: scan {place.index}{sliced}, "
        f"{number(cloud.total, 'point')}{part}"
    )


def _accounts(report: RunReport) -> str:
    accounts: dict[str, Callable[[SensorLedger], dict[str, int]]] = {
        "Packets": lambda one: {
            "accepted": one.packets.accepted,
            **one.packets.rejected,
            "lost": one.packets.lost,
        },
        "Columns": lambda one: {"written": one.columns.written, **one.columns.dropped},
        "Points": lambda one: {name: getattr(one.points, name) for name in _OUTCOMES},
    }
    lines = []
    for title, counts in accounts.items() if report.sensors else ():
        lines.append(f"<h3>{title}</h3>")
        lines += [_bar(sensor.name, counts(sensor.ledger)) for sensor in report.sensors]
    about = "Every packet, column and point by outcome; the accounts of the report balance."
    return _section("Accounts", "".join(lines), about)


def _bar(name: str, counts: dict[str, int]) -> str:
    total = sum(counts.values())
    parts = []
    words = []
    for key, count in counts.items():
        if not count:
            continue
        kind = "p-bad"
        if key in _GOOD_PARTS:
            kind = "p-good"
        elif key in _NEUTRAL_PARTS:
            kind = "p-neutral"
        mark = f"{kind} r-{key}" if key in _MEANINGS else kind
        text = f"{_MEANINGS.get(key, key)} {count:,} ({percent(count, total)})"
        parts.append(
            f"<i class='{escape(mark)}' style='flex-grow:{count / total:.6f}' "
            f"title='{escape(text)}'></i>"
        )
        words.append(f"<span><i class='{escape(mark)}'></i>{escape(text)}</span>")
    bar = "".join(parts) or "<i class='p-neutral' style='flex-grow:1'></i>"
    return (
        f"<div class='account'><b>{escape(name)}</b><div class='bar'>{bar}</div>"
        f"<div class='words'>{''.join(words) or 'none'}</div></div>"
    )


def _clock(report: RunReport) -> str:
    rows = []
    has_drift = False
    for sensor in report.sensors:
        clock = sensor.clock
        offset = clock.offset_to_host_ms
        drift = clock.drift_ppm
        has_drift |= drift is not None
        cells = (
            sensor.name,
            clock.source,
            clock.epoch,
            "" if offset is None else _offset(offset),
            "not determined" if drift is None else f"{drift:+.2f} ppm",
            "" if drift is None else f"{drift * 3.6:+.1f} ms/h",
            "; ".join(clock.notes),
        )
        rows.append(cells)
    head = ("sensor", "stamps from", "epoch", "offset to host", "drift", "", "notes")
    plot = (
        "<h3>Offset since the start, by the fitted drift, ms</h3><canvas id='drift'></canvas>"
        if has_drift and report.recorded_s
        else "<p class='lacks'>No drift was determined: the recording is too short, or stamps are "
        "receive times.</p>"
    )
    about = (
        "Clock of each sensor minus that of the capture host. The lines are the fit over the whole "
        "run; the report has no single measurements."
    )
    return _section("Clocks", plot + _table(head, rows), about)


def _offset(offset_ms: float) -> str:
    if abs(offset_ms) >= 10_000:
        return f"{offset_ms / 1000:,.3f} s"
    return f"{offset_ms:.3f} ms"


def _sensors(report: RunReport) -> str:
    head = (
        *("sensor", "model", "stream", "mode", "packets", "lost", "rejected", "columns", "points"),
        *("position, m", "roll, pitch, yaw", "extrinsics from", "calibration"),
    )
    rows = []
    for sensor in report.sensors:
        position, angles = _pose_words(sensor)
        rows.append(
            (
                *(sensor.name, sensor.model, sensor.stream, sensor.mode),
                f"{sensor.ledger.packets.read:,}",
                f"{sensor.ledger.packets.lost:,}",
                f"{sum(sensor.ledger.packets.rejected.values()):,}",
                f"{sensor.ledger.columns.written:,}",
                f"{sensor.ledger.points.written:,}",
                position,
                angles,
                sensor.extrinsics_source,
                "; ".join(filter(None, (sensor.calibration, sensor.calibration_note))),
            )
        )
    return _section("Sensors", _table(head, rows))


def _pose(sensor: SensorReport) -> F64Array | None:
    """`body_from_sensor` (4, 4); None if absent or damaged."""
    pose = sensor.body_from_sensor
    return pose if pose.shape == (4, 4) and np.isfinite(pose).all() else None


def _pose_words(sensor: SensorReport) -> tuple[str, str]:
    pose = _pose(sensor)
    if pose is None:
        return "", ""
    position = ", ".join(f"{value:.3f}" for value in pose[:3, 3])
    # Fixed axes x, y, z: R = Rz Ry Rx.
    pitch = math.atan2(-pose[2, 0], math.hypot(pose[0, 0], pose[1, 0]))
    roll = math.atan2(pose[2, 1], pose[2, 2])
    yaw = math.atan2(pose[1, 0], pose[0, 0])
    angles = ", ".join(f"{math.degrees(angle) + 0.0:.2f}" for angle in (roll, pitch, yaw))
    return position, f"{angles} deg"


def _about(report: RunReport) -> str:
    command = report.command
    shown = (
        f"<pre id='command'>{escape(command)}</pre>"
        if command
        else "<p class='lacks'>The report has no command line.</p>"
    )
    inputs = [(one.path, one.container, f"{one.bytes / 1e6:,.1f} MB") for one in report.inputs]
    costs = (
        [] if report.timing is None else [f"{getattr(report.timing, key):.2f}" for key in _COSTS]
    )
    topics = [(one.topic, f"{one.read:,}", f"{one.written:,}") for one in report.messages]
    unassigned = [(one.stream, f"{one.packets:,}", one.what) for one in report.unassigned]
    parts = [shown, "<h3>Inputs</h3>", _table(("path", "container", "size"), inputs)]
    if unassigned:
        parts += ["<h3>Packets of no sensor</h3>"]
        parts += [_table(("stream", "packets", "what"), unassigned)]
    if topics:
        parts += ["<h3>Forwarded topics</h3>", _table(("topic", "read", "written"), topics)]
    if costs:
        parts += ["<h3>Costs</h3>", _table(_COSTS, [costs])]
    parts.append(
        "<p class='lacks'>Against frame-level fusion: not part of a conversion; "
        "<code>mlbatch compare RECORDING</code> computes it.</p>"
        f"<p class='lacks'>mlbatch {escape(report.version)}</p>"
    )
    return _section("Command and inputs", "".join(parts))


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    top = "".join(f"<th>{escape(name)}</th>" for name in head)
    lines = "".join(
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows
    )
    table = f"<table><thead><tr>{top}</tr></thead><tbody>{lines}</tbody></table>"
    return f"<div class='scroll'>{table}</div>"


# -- data of the plots ------------------------------------------------------------------------


def _plot_data(
    report: RunReport, windows: Windows | None, clouds: list[PageCloud]
) -> dict[str, Any]:
    sensors = report.sensors
    data: dict[str, Any] = {
        "sensors": [sensor.name for sensor in sensors],
        "recorded_s": report.recorded_s or None,
        "drift_ppm": [sensor.clock.drift_ppm for sensor in sensors],
        "poses": [
            None if (pose := _pose(sensor)) is None else pose[:3].ravel().tolist()
            for sensor in sensors
        ],
        "windows": None,
        "clouds": [],
    }
    if windows is None:
        return data
    data["windows"] = _window_data(windows)
    data["clouds"] = [
        {
            "title": f"{cloud.place.title} scan ({cloud.place.index})",
            "low": cloud.low_m,
            "size": cloud.size_m,
            "xyz": _packed(cloud.xyz),
            "lidar": _packed(cloud.lidar),
            "time": _packed(cloud.time),
            "bright": _packed(cloud.intensity),
            "height": cloud.height_m,
            "centre": cloud.centre_m,
            "view": cloud.view_m,
            "window_ms": window_ms(windows, cloud.place),
        }
        for cloud in clouds
    ]
    return data


def _window_data(windows: Windows) -> dict[str, Any]:
    found = summarise(windows)
    rows = len(windows)
    last = rows - 1
    steps = int(windows.step[last] - windows.step[0])
    length_ms = int(windows.end_ns[0] - windows.start_ns[0]) / 1e6
    period_ms = (
        int(windows.start_ns[last] - windows.start_ns[0]) / 1e6 / steps if steps else length_ms
    )
    return {
        "sensors": windows.sensors,
        "group": found.group,
        "period_ms": period_ms,
        "first_index": int(windows.index[0]),
        "slices": windows.slices,
        "step": _packed(found.step - found.step[0]),
        "count": _packed(found.count),
        "incomplete": _packed(found.incomplete),
        "points": _scaled(found.points),
        "span": _scaled(found.span_ms),
        "delay": _scaled(found.delay_ms - windows.far_ms),
        "columns": [_packed(column) for column in found.columns.T],
        "expected": [_packed(column) for column in found.expected.T],
        "fill": [_scaled(column, 1.0) for column in found.fill.T],
        "gap": [_scaled(column) for column in found.gap_ms.T],
        "coverage": [_scaled(column, 1.0) for column in found.coverage.T],
    }


def _packed(values: npt.NDArray[np.generic]) -> dict[str, str]:
    """Whole numbers from 0 in the smallest type, base64."""
    most = int(np.max(values, initial=np.zeros((), values.dtype)))  # type: ignore[call-overload]
    kind = "u1" if most < 2**8 else "u2" if most < 2**16 else "u4"
    data = np.ascontiguousarray(values).astype(f"<{kind}").tobytes()
    return {"type": kind, "data": base64.b64encode(data).decode()}


# Largest word: no value.
_NONE = 65535


def _scaled(values: F64Array, top: float | None = None) -> dict[str, Any]:
    """Numbers in 16 bits between the smallest and the largest one; top: largest, from 0."""
    known = np.isfinite(values)
    if not known.any():
        return {"type": "none", "data": ""}
    low = 0.0 if top is not None else float(values[known].min())
    high = top if top is not None else float(values[known].max())
    step = (high - low) / (_NONE - 1) or 1.0
    words = np.where(known, np.rint((np.where(known, values, low) - low) / step), _NONE)
    return {"low": low, "step": step, **_words(words)}


def _words(words: F64Array) -> dict[str, str]:
    data = words.astype("<u2").tobytes()
    return {"type": "u2", "data": base64.b64encode(data).decode()}
