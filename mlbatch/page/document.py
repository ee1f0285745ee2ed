"""The page of a run: words and tables for its template, data of the plots as JSON.

A content security policy allows the page's own script and no request.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
from collections.abc import Sequence
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
from mlbatch.page.templates import Verdict, asset, render
from mlbatch.page.windows import Windows, read_windows, summarise
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
# Colours of points: key of the plots, name.
_COLOURS = {"lidar": "lidar", "height": "height", "time": "time", "bright": "intensity"}
_NO_SCANS = "The scans are not available to this page: give the output itself."


def page_text(source: Source) -> str:
    """The whole page. Raises ExportError if scans.csv is damaged."""
    report = source.report
    windows = None if source.table is None else read_windows(source.table, report.slices)
    clouds, why_no_clouds = _clouds(source, windows)
    found = findings(report, windows)
    script = asset("page.js")
    clocks = [sensor.clock for sensor in report.sensors]
    timing = report.timing
    lacking = {
        "lidar": not all(cloud.has_lidar for cloud in clouds),
        "time": not all(cloud.has_time for cloud in clouds),
        "intensity": not all(cloud.has_intensity for cloud in clouds),
    }
    return render(
        "run.html",
        version=report.version,
        title=_title(source),
        digest=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        script=script,
        data=_json(_plot_data(report, windows, clouds)),
        report=report,
        verdict=_verdict(report, found, windows),
        cards=_cards(report),
        findings=[_finding(one) for one in found],
        timeline=None if windows is None else _timeline(windows),
        clouds=[{"title": one.place.title.capitalize(), "text": _caption(one)} for one in clouds],
        why_no_clouds=why_no_clouds,
        colours=_COLOURS,
        lacking=[name for name, is_absent in lacking.items() if is_absent],
        accounts=_accounts(report),
        clocks=list(map(_clock, report.sensors)),
        has_drift=report.recorded_s and any(one.drift_ppm is not None for one in clocks),
        sensors=list(map(_sensor, report.sensors)),
        inputs=[(one.path, one.container, f"{one.bytes / 1e6:,.1f} MB") for one in report.inputs],
        unassigned=[(one.stream, f"{one.packets:,}", one.what) for one in report.unassigned],
        topics=[(one.topic, f"{one.read:,}", f"{one.written:,}") for one in report.messages],
        costs={} if timing is None else {key: f"{getattr(timing, key):.2f}" for key in _COSTS},
    )


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
    """Scans to show, or the reason why there are none; "": no table names them."""
    if windows is None:
        return [], ""
    if source.output is None:
        return [], _NO_SCANS
    try:
        clouds = read_clouds(source.output, choose_places(windows), windows.sensors)
    except VerifyError as err:
        return [], f"The scans could not be read: {err}"
    return clouds, _NO_SCANS


# -- words ------------------------------------------------------------------------------------


def _verdict(report: RunReport, found: list[Finding], windows: Windows | None) -> Verdict:
    level, heading, others = verdict(found)
    sensors = report.sensors
    names = ", ".join(sensor.name for sensor in sensors)
    scans = number(report.scans.written, "scan")
    summary = f"{scans} at {report.rate_hz} Hz of {number(len(sensors), 'lidar')} ({names})"
    if report.recorded_s:
        summary += f", from {_seconds(report.recorded_s)} of recording"
    summary += f". {_loss_words(sensors)}"
    if windows is not None:
        start = describe_time(int(windows.start_ns[0]), report.timescale)
        summary += f" First scan at {start}."
    return Verdict(*_WORDS[level], heading, others, summary)


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


def _cards(report: RunReport) -> dict[str, str]:
    scans = report.scans
    span = scans.span_ms.p50
    timing = report.timing
    packets = [sensor.ledger.packets for sensor in report.sensors]
    return {
        "scans": f"{scans.written:,}",
        "incomplete": f"{scans.incomplete:,}",
        "points": _short(scans.points),
        "lost packets": f"{sum(one.lost for one in packets):,}",
        "rejected packets": f"{sum(sum(one.rejected.values()) for one in packets):,}",
        "set span, median": "" if span is None else f"{span:.1f} ms",
        "clock": report.timescale,
        "times real time": "" if timing is None else f"{timing.realtime_factor:.1f}",
    }


def _short(count: int) -> str:
    for limit, unit in ((10**9, "G"), (10**6, "M"), (10**4, "k")):
        if count >= limit:
            return f"{count / (1000 if unit == 'k' else limit):.1f} {unit}"
    return f"{count:,}"


def _finding(one: Finding) -> dict[str, str]:
    level, label = _WORDS[one.level]
    return {
        "level": level,
        "label": label,
        "text": one.text,
        "code": one.code,
        "remedy": one.remedy,
    }


def _timeline(windows: Windows) -> dict[str, object]:
    sensors = zip(windows.sensors, windows.estimated, strict=True)
    far_ms = windows.far_ms
    return {
        "group": summarise(windows).group,
        "estimated": [name for name, is_estimated in sensors if is_estimated],
        "far_s": f"{far_ms / 1000:,.0f}" if far_ms else "",
    }


def _caption(cloud: PageCloud) -> str:
    place = cloud.place
    shown = len(cloud.xyz)
    part = "" if shown == cloud.total else f", {shown:,} of them drawn"
    sliced = f" slice {place.slice}" if place.slice else ""
    return f"scan {place.index}{sliced}, {number(cloud.total, 'point')}{part}"


def _accounts(report: RunReport) -> dict[str, dict[str, list[dict[str, object]]]]:
    """Shares of each sensor by outcome, for packets, columns and points."""
    found: dict[str, dict[str, list[dict[str, object]]]] = {}
    for sensor in report.sensors:
        packets, columns, points = (
            sensor.ledger.packets,
            sensor.ledger.columns,
            sensor.ledger.points,
        )
        accounts = {
            "Packets": {"accepted": packets.accepted, **packets.rejected, "lost": packets.lost},
            "Columns": {"written": columns.written, **columns.dropped},
            "Points": {name: getattr(points, name) for name in _OUTCOMES},
        }
        for title, counts in accounts.items():
            found.setdefault(title, {})[sensor.name] = _shares(counts)
    return found


def _shares(counts: dict[str, int]) -> list[dict[str, object]]:
    total = sum(counts.values())
    shares: list[dict[str, object]] = []
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
        shares.append({"mark": mark, "share": count / total, "text": text})
    return shares


def _clock(sensor: SensorReport) -> tuple[str, ...]:
    clock = sensor.clock
    offset = clock.offset_to_host_ms
    drift = clock.drift_ppm
    return (
        sensor.name,
        clock.source,
        clock.epoch,
        "" if offset is None else _offset(offset),
        "not determined" if drift is None else f"{drift:+.2f} ppm",
        "" if drift is None else f"{drift * 3.6:+.1f} ms/h",
        "; ".join(clock.notes),
    )


def _offset(offset_ms: float) -> str:
    if abs(offset_ms) >= 10_000:
        return f"{offset_ms / 1000:,.3f} s"
    return f"{offset_ms:.3f} ms"


def _sensor(sensor: SensorReport) -> tuple[str, ...]:
    position, angles = _pose_words(sensor)
    ledger = sensor.ledger
    return (
        *(sensor.name, sensor.model, sensor.stream, sensor.mode),
        f"{ledger.packets.read:,}",
        f"{ledger.packets.lost:,}",
        f"{sum(ledger.packets.rejected.values()):,}",
        f"{ledger.columns.written:,}",
        f"{ledger.points.written:,}",
        *(position, angles, sensor.extrinsics_source),
        "; ".join(filter(None, (sensor.calibration, sensor.calibration_note))),
    )


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
