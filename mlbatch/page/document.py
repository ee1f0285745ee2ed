"""The page of a run: words and tables for its template, data of the plots as JSON.

A content security policy allows the page's own script and no request.
"""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Sequence
from pathlib import PurePath
from typing import Any

import numpy as np
import numpy.typing as npt

from mlbatch.arrays import F64Array, I64Array
from mlbatch.clocks.timescale import DESCRIPTION, describe_time
from mlbatch.errors import RecordingError
from mlbatch.page.clouds import PageCloud, chosen_clouds
from mlbatch.page.findings import (
    COSTS,
    MEANINGS,
    SERVICES,
    Finding,
    Level,
    findings,
    number,
    percent,
    verdict,
)
from mlbatch.page.source import Source
from mlbatch.page.templates import Verdict, asset, page_json, render
from mlbatch.page.windows import Windows, read_windows, summarise
from mlbatch.reports.report import RunReport, SensorReport, Unassigned
from mlbatch.types import CLOUDS
from mlbatch.units import NS_PER_MS

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
# Outcomes of points, in the order of the page.
_OUTCOMES = ("written", "no_return", "range", "box", "repeated")
# A speed over less is that of the start.
_LEAST_RATED_S = 10.0
# `ClockEstimate.describe`.
_ESTIMATE = re.compile(r"clock: .* to the capture host (\(\+-[\d.]+ ms\))(?:, drift [^,;]*)?")
# Least height of an axis; what varies less is no plot but one line.
_FLOORS_MS = {"gap": 1.0, "span": 1.0, "delay": 5.0}
_FLAT_POINTS = 0.02  # of the largest
# Between two scans that are played.
_PLAY_MS = (100, 500)
# Colours of points: key of the plots, name.
COLOURS = {"lidar": "lidar", "height": "height", "time": "time", "bright": "intensity"}
# Arrays that colours need.
_NEEDED = {"lidar": "lidar_id", "time": "time_ns", "intensity": "intensity"}
_NO_SCANS = "The scans are not available to this page: give the output itself."


def page_text(source: Source) -> str:
    """The whole page. Raises ExportError if scans.csv is damaged."""
    report = source.report
    windows = None if source.table is None else read_windows(source.table, report.slices)
    clouds, why_no_clouds = _clouds(source, windows)
    found = findings(report, windows)
    return render(
        "run.html",
        version=report.version,
        title=_title(source),
        script="".join(map(asset, ("viewer.js", "player.js", "page.js"))),
        data=page_json(_plot_data(report, windows, clouds, shows_worst=_is_bad(found))),
        report=report,
        verdict=_verdict(report, found, windows),
        cards=_cards(report),
        findings=[_finding(one) for one in found],
        timeline=None if windows is None else _timeline(windows),
        clouds=clouds,
        about_clouds=_about_clouds(clouds, windows),
        why_no_clouds=why_no_clouds,
        colours=COLOURS,
        lacking=lacking(frozenset().union(*(cloud.absent for cloud in clouds))),
        accounts=_accounts(report),
        clocks=[_clock(sensor, report.recorded_s) for sensor in report.sensors],
        sensors=list(map(_sensor, report.sensors)),
        inputs=[(one.path, one.container, f"{one.bytes / 1e6:,.1f} MB") for one in report.inputs],
        unassigned=[(one.stream, f"{one.packets:,}", _sender(one)) for one in report.unassigned],
        topics=[(one.topic, f"{one.read:,}", f"{one.written:,}") for one in report.messages],
        costs=_costs(report),
    )


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
        clouds = chosen_clouds(source.output, windows, source.scans, source.report_path)
    except RecordingError as err:
        return [], f"The scans could not be read: {err}"
    return clouds, _NO_SCANS


# -- words ------------------------------------------------------------------------------------


def _verdict(report: RunReport, found: list[Finding], windows: Windows | None) -> Verdict:
    level, heading, others = verdict(found, report)
    sensors = report.sensors
    names = ", ".join(sensor.name for sensor in sensors)
    scans = number(report.scans.written, "scan")
    summary = f"{scans} at {report.rate_hz} Hz of {number(len(sensors), 'lidar')} ({names})"
    if report.recorded_s:
        summary += f", from {_seconds(report.recorded_s)} of recording"
    summary += f". {_loss_words(sensors)}"
    if any(warned.code == "clouds" for warned in report.warnings):
        summary += " Lost clouds are not counted; scans that lack columns are."
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
    """Five figures; by their names."""
    scans = report.scans
    span = scans.span_ms.p50
    packets = [sensor.ledger.packets for sensor in report.sensors]
    rejected = sum(sum(one.rejected.values()) for one in packets)
    return {
        f"scans, {scans.incomplete:,} incomplete": f"{scans.written:,}",
        "points": _short(scans.points),
        f"packets lost, {rejected:,} rejected": f"{sum(one.lost for one in packets):,}",
        "set span, median": "" if span is None else f"{span:.1f} ms",
        "time of the stamps": DESCRIPTION.get(report.timescale, report.timescale),
    }


def _costs(report: RunReport) -> dict[str, str]:
    timing = report.timing
    if timing is None:
        return {}
    costs = {name: f"{getattr(timing, key):.2f}" for key, name in COSTS.items()}
    if report.recorded_s and report.recorded_s >= _LEAST_RATED_S:
        costs["times real time"] = f"{timing.realtime_factor:.1f}"
    return costs


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
    less = f" (less {far_ms / 1000:,.0f} s: the clocks differ)" if far_ms else ""
    delay = f"Delay: receive time of the packet that closed a window, after its end, ms{less}"
    span = "Set span: first to last column of a scan, ms"
    is_whole = bool((windows.fill == 1).all() and windows.complete.all())
    is_whole &= bool((np.diff(windows.step) == 1).all())
    lowest = f"lowest fill {percent(float(windows.fill.min(initial=1)), 1)}"
    columns = "every column received" if is_whole else lowest
    most = float(windows.points.max(initial=1))
    series = (
        ("timeline", "", columns, is_whole, len(windows.sensors)),
        ("gap", "Longest time without a column, ms", *_range("gap", windows.gap_ms)),
        ("points", "Points of a scan", *_range("points", windows.points, _FLAT_POINTS * most)),
        ("span", span, *_range("span", windows.span_ms)),
        ("delay", delay, *_range("delay", windows.delay_ms - far_ms)),
    )
    flat = [(words, count) for _, _, words, is_flat, count in series if is_flat]
    count = sum(count for _, count in flat)
    return {
        "group": summarise(windows).group,
        "estimated": [name for name, is_estimated in sensors if is_estimated],
        "plots": [(key, title, words) for key, title, words, is_flat, _ in series if not is_flat],
        "flat": f"{number(count, 'series', 'series')}, {'all ' if count > 1 else ''}constant: "
        f"{'; '.join(words for words, _ in flat)}."
        if flat
        else "",
    }


def _range(
    key: str, values: F64Array | I64Array, floor: float | None = None
) -> tuple[str, bool, int]:
    """Smallest to largest value in words, whether no series varies by more, number of series."""
    name, unit, digits = {
        "gap": ("longest gap", " ms", 2),
        "points": ("points per scan", "", 0),
        "span": ("set span", " ms", 1),
        "delay": ("delay", " ms", 1),
    }[key]
    series = values.reshape(len(values), -1)
    known = series[np.isfinite(series).all(axis=1)]
    if not len(known):
        return f"{name} not recorded", True, series.shape[1]
    low, high = (f"{one:,.{digits}f}" for one in (float(known.min()), float(known.max())))
    least = _FLOORS_MS[key] if floor is None else floor
    is_flat = len(known) == len(series) and bool((np.ptp(known, axis=0) <= least).all())
    return f"{name} {low if low == high else f'{low} to {high}'}{unit}", is_flat, series.shape[1]


def _about_clouds(clouds: list[PageCloud], windows: Windows | None) -> str:
    if not clouds or windows is None:
        return ""
    kilobytes = sum(one.chars for one in clouds) / len(clouds) / 1000
    step_mm = max(one.step_m for one in clouds) * 1000
    return (
        f"{len(clouds):,} of {number(len(windows), 'scan')}, with {kept_words(clouds[0])}; "
        f"{kilobytes:,.0f} kB per scan; coordinates rounded to {step_mm:.0f} mm."
    )


def lacking(absent: frozenset[str]) -> list[str]:
    """Colours that scans do not have; absent: as of `Scan`."""
    return [name for name, array in _NEEDED.items() if array in absent]


def kept_words(cloud: PageCloud) -> str:
    """Words for the share of points that a page has of its scans."""
    return "all their points" if cloud.stride == 1 else f"every {_ordinal(cloud.stride)} column"


def _ordinal(count: int) -> str:
    ends = {1: "st", 2: "nd", 3: "rd"}
    return f"{count}{'th' if count % 100 in (11, 12, 13) else ends.get(count % 10, 'th')}"


def _caption(cloud: PageCloud) -> str:
    part = "" if cloud.shown == cloud.total else f", {cloud.shown:,} of them shown"
    title = f"{cloud.place.title}, " if cloud.place.title else ""
    away_m = math.hypot(*cloud.centre_m)
    away = f"; the view is centred {away_m:,.0f} m from the body" if away_m else ""
    return f"{title}{number(cloud.total, 'point')}{part}{away}"


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
            "Columns": {
                "written": columns.written,
                **columns.dropped,
                # Of the lost packets, as many in each as in the others.
                "lost": round(packets.lost * columns.decoded / max(1, packets.accepted)),
            },
            "Points": {name: getattr(points, name) for name in _OUTCOMES},
        }
        if sensor.model in CLOUDS:
            # Slots that no point of the cloud fills say nothing of its lidar.
            del accounts["Points"]["no_return"]
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
        mark = f"{kind} r-{key}" if key in MEANINGS else kind
        text = f"{MEANINGS.get(key, key)} {count:,} ({percent(count, total)})"
        shares.append({"mark": mark, "share": count / total, "text": text})
    return shares


def _clock(sensor: SensorReport, recorded_s: float) -> tuple[str, ...]:
    clock = sensor.clock
    offset = clock.offset_to_host_ms
    ppm = clock.drift_ppm
    # The estimate in words repeats offset and drift; its range and what follows are new.
    notes = [_ESTIMATE.sub("", note).lstrip(",; ") for note in clock.notes]
    estimate = next(filter(None, map(_ESTIMATE.match, clock.notes)), None)
    drift = "not determined"
    if ppm is not None:
        drift = f"{ppm:+.2f} ppm"
        if recorded_s:
            drift += (
                f", {round(ppm * recorded_s / 1000, 2) + 0.0:+.2f} ms in {_seconds(recorded_s)}"
            )
    return (
        sensor.name,
        clock.source,
        DESCRIPTION.get(clock.epoch, clock.epoch),
        "" if offset is None else f"{_offset(offset)} {'' if estimate is None else estimate[1]}",
        drift,
        "; ".join(filter(None, notes)),
    )


def _sender(stream: Unassigned) -> str:
    """Words for a stream of no sensor; for unknown packets the service of their port."""
    port = re.search(r"port (\d+)", stream.stream)
    service = SERVICES.get(int(port[1])) if port else None
    return stream.what.replace("unknown", service, 1) if service else stream.what


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


def _is_bad(found: list[Finding]) -> bool:
    return any(one.level >= Level.WARNING for one in found)


def _plot_data(
    report: RunReport, windows: Windows | None, clouds: list[PageCloud], *, shows_worst: bool
) -> dict[str, Any]:
    """shows_worst: first, instead of the first scan of the run."""
    sensors = report.sensors
    data: dict[str, Any] = {
        "sensors": [sensor.name for sensor in sensors],
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
        cloud_data(one, windows.seconds(one.place.row))
        | {"data": base64.b64encode(one.packed).decode()}
        | {"middle": int(windows.step[one.place.row] - windows.step[0]) + 0.5}
        for one in clouds
    ]
    between_ms = np.diff([one.place.start_ns for one in clouds]) / NS_PER_MS
    apart_ms = float(np.median(between_ms)) if len(between_ms) else 0.0
    data["ahead"] = 1
    numbers = {word: i for i, one in enumerate(clouds) for word in one.place.title.split(" and ")}
    # The head of a run, before its first whole window, is chosen by hand.
    begin = numbers.get("first", 0)
    data["begin"] = numbers.get("worst", begin) if shows_worst else begin
    data["play_ms"] = min(max(_PLAY_MS[0], apart_ms), _PLAY_MS[1])
    return data


def cloud_data(cloud: PageCloud, after_s: float) -> dict[str, Any]:
    """A scan for viewer.js without its points; after_s: its start after the first scan."""
    place = cloud.place
    sliced = f" slice {place.slice}" if place.slice else ""
    return {
        "title": f"Scan {place.index}{sliced}, +{after_s:.1f} s",
        "text": _caption(cloud),
        "shown": cloud.shown,
        "low": cloud.low_m,
        "step": cloud.step_m,
        "height": cloud.height_m,
        "centre": cloud.centre_m,
        "view": cloud.view_m,
        "times": cloud.times_ms,
        "has": {
            **{name: _NEEDED[name] not in cloud.absent for name in ("lidar", "time")},
            "ring": "ring" not in cloud.absent,
        },
    }


def _window_data(windows: Windows) -> dict[str, Any]:
    found = summarise(windows)
    rows = len(windows)
    last = rows - 1
    steps = int(windows.step[last] - windows.step[0])
    length_ms = int(windows.end_ns[0] - windows.start_ns[0]) / 1e6
    period_ms = (
        int(windows.start_ns[last] - windows.start_ns[0]) / 1e6 / steps if steps else length_ms
    )
    values = found.values
    return {
        "sensors": windows.sensors,
        "group": found.group,
        "period_ms": period_ms,
        "first_index": int(windows.index[0]),
        "slices": windows.slices,
        "floors": _FLOORS_MS,
        "step": _packed(values["step"] - values["step"][0]),
        "count": _packed(found.count),
        "incomplete": _packed(found.incomplete),
        "points": _scaled(values["points"]),
        "span": _scaled(values["span_ms"]),
        "delay": _scaled(values["delay_ms"] - windows.far_ms),
        "gap": [_scaled(column) for column in values["gap_ms"].T],
        **{key: [_packed(one) for one in values[key].T] for key in ("columns", "expected")},
        **{key: [_scaled(one, 1.0) for one in values[key].T] for key in ("fill", "coverage")},
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
    data = base64.b64encode(words.astype("<u2").tobytes()).decode()
    return {"low": low, "step": step, "type": "u2", "data": data}
