"""Decoded clouds as drivers publish them, and those that would be silently wrong.

Stamps of points are known by construction: column n of a sweep of 100 ms is measured at n ms.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.builders.bags import Recorded, transforms_message
from tests.builders.points import (
    AUTOWARE,
    CLOUD,
    CUSTOM2,
    HESAI,
    LIVOX,
    OUSTER,
    STAMP_NS,
    VELODYNE,
    XYZ,
    Form,
    cloud_message,
    custom_message,
)
from tests.builders.rosbag2 import write_rosbag2
from tests.builders.run import scan_files
from tests.builders.sessions import Shell

MS = 1_000_000
SWEEP = 100 * MS
COLUMNS = 98
SWEEPS = 6
LAST = (COLUMNS - 1) * MS
Fields = Sequence[tuple[str, str]]


@pytest.fixture
def shell(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> Shell:
    monkeypatch.chdir(tmp_path)
    return Shell(monkeypatch, capsys)


def _point(fields: Fields, x: float, time: float, ring: int) -> tuple[float, ...]:
    """A point by the names of its fields; the first time field gets the time."""
    values = {"x": x, "y": 1.0, "z": 2.0, "intensity": 9, "ring": ring, "channel": ring}
    times = ("t", "time", "timestamp", "time_stamp")
    return tuple(time if name in times else values.get(name, 0) for name, _ in fields)


def _sweep(fields: Fields, times: Sequence[float], x: float = 5.0) -> list[tuple[float, ...]]:
    return [_point(fields, x, time, ring) for time in times for ring in range(4)]


def _bag(
    sweeps: Sequence[bytes], topic: str = "/points", delay: int = SWEEP, kind: str = CLOUD
) -> list[Recorded]:
    """A message for each sweep, logged `delay` after the sweep's start."""
    return [
        Recorded(topic, kind, STAMP_NS + number * SWEEP + delay, data)
        for number, data in enumerate(sweeps)
    ]


def _starts() -> list[int]:
    return [STAMP_NS + number * SWEEP for number in range(SWEEPS)]


def _clouds(
    fields: Fields, times: Sequence[float], header: int = 0, frame: str = "lidar"
) -> list[bytes]:
    """Sweeps of equal times; header: its stamp after the sweep's start, ns."""
    points = _sweep(fields, times)
    return [cloud_message(fields, points, start + header, Form(frame=frame)) for start in _starts()]


# Column n at n ms, in units of a field, from the start.
NS = [n * MS for n in range(COLUMNS)]
US = [n * 1000 for n in range(COLUMNS)]
SECONDS = [n * 1e-3 for n in range(COLUMNS)]


def _stamps(folder: Path) -> list[int]:
    """Stamps of all columns, ns after the first sweep, with repetitions removed."""
    stamps: set[int] = set()
    for path in scan_files(folder):
        with np.load(path) as scan:
            stamps |= set((scan["column_stamp_ns"] - STAMP_NS).tolist())
    return sorted(stamps)


def _expected(shift: int = 0) -> list[int]:
    return [number * SWEEP + n * MS + shift for number in range(SWEEPS) for n in range(COLUMNS)]


def _run(shell: Shell, messages: list[Recorded], options: str = "", rig: str = "") -> Any:
    Path("drive.db3").unlink(missing_ok=True)
    write_rosbag2(Path("drive.db3"), sorted(messages, key=lambda one: one.log_ns))
    if rig:
        Path("rig.yaml").write_text(rig)
        options += " --rig rig.yaml"
    return shell(f"convert drive.db3 -o out --keep-partial --overwrite {options}")


def _rig(points: str = "", topic: str = "/points") -> str:
    lines = ["sensors:", "  - name: top", f"    stream: {{topic: {topic}}}"]
    lines += [f"    points: {points}"] if points else []
    return "\n".join(lines) + "\n"


def _warnings(folder: str = "out") -> list[tuple[str, str]]:
    report = json.loads(Path(folder, "report.json").read_text())
    return [(one["code"], one["message"]) for one in report["warnings"]]


# -- drivers that are read as they are -------------------------------------------------------------


def _hesai() -> list[bytes]:
    return [
        cloud_message(
            HESAI, _sweep(HESAI, [start * 1e-9 + n * 1e-3 for n in range(COLUMNS)]), start
        )
        for start in _starts()
    ]


def _livox_cloud() -> list[bytes]:
    return [
        cloud_message(LIVOX, _sweep(LIVOX, [float(start + n) for n in NS]), start)
        for start in _starts()
    ]


def _custom() -> list[bytes]:
    points = [(n, 1, 2, 3, 7, 0, 0) for n in NS]
    return [custom_message(points, start, start) for start in _starts()]


DRIVERS = {
    "ouster": (_clouds(OUSTER, NS), CLOUD),
    "autoware": (_clouds(AUTOWARE, NS), CLOUD),
    "velodyne, back from the end": (
        _clouds(VELODYNE, [n * 1e-3 - 0.097 for n in range(COLUMNS)], header=LAST),
        CLOUD,
    ),
    "velodyne, from the start": (_clouds(VELODYNE, SECONDS), CLOUD),
    "hesai, robosense": (_hesai(), CLOUD),
    "livox": (_livox_cloud(), CLOUD),
    "livox custom": (_custom(), CUSTOM2),
}


@pytest.mark.parametrize("driver", DRIVERS)
def test_drivers_are_read_without_a_warning(shell: Shell, tmp_path: Path, driver: str) -> None:
    data, kind = DRIVERS[driver]
    outcome = _run(shell, _bag(data, kind=kind), "--strict")
    assert outcome.code == 0, outcome.err
    found = np.array(_stamps(tmp_path / "out"))
    # A float32 of 0.1 s has a step of 7 ns, a float64 of seconds since 1970 one of 238 ns.
    assert np.abs(found - _expected()).max() <= 512
    assert [code for code, _ in _warnings()] == ["clouds"]


# -- times that are none ---------------------------------------------------------------------------

WAYS_OUT = (
    "name the field of the times or its unit in the rig (points: {time: FIELD, unit: ns}), or "
    "leave the topic out with --ignore /points"
)


@pytest.mark.parametrize(
    ("fields", "times", "found"),
    [
        (OUSTER, [0] * 3, "0 for every point"),
        (VELODYNE, [0.0] * 3, "0 for every point"),
        (OUSTER, [7] * 3, "one time for all points of a cloud"),
    ],
)
def test_times_that_are_all_equal_are_refused(
    shell: Shell, tmp_path: Path, fields: Fields, times: Sequence[float], found: str
) -> None:
    name = "t (uint32)" if fields is OUSTER else "time (float32)"
    for options in ("", "--strict"):
        outcome = _run(shell, _bag(_clouds(fields, times)), options)
        assert outcome.code == 1
        assert outcome.err == (
            f"mlbatch: error: drive.db3: /points: field {name}: expected times of points that span "
            f"about the spacing of the messages (100.000 ms), found {found}; {WAYS_OUT}\n"
        )
        assert not (tmp_path / "out").exists()
    # Also of a single message, and for whoever states the unit of times that are none.
    outcome = _run(shell, _bag(_clouds(fields, times)[:1]))
    assert f"found {found}; " in outcome.err
    outcome = _run(shell, _bag(_clouds(fields, times)), rig=_rig("{unit: ns}"))
    assert outcome.err.startswith(f"mlbatch: error: rig.yaml: sensor top: /points: field {name}")


def test_times_below_5_percent_of_the_spacing_are_refused_unless_stated(
    shell: Shell, tmp_path: Path
) -> None:
    # 4.85 ms of 100 ms.
    clouds = _bag(_clouds(OUSTER, [n * 50_000 for n in range(COLUMNS)]))
    outcome = _run(shell, clouds)
    assert outcome.code == 1
    assert outcome.err == (
        "mlbatch: error: drive.db3: /points: field t (uint32): expected times of points that span "
        "at least 5 % of the spacing of the messages, found 4.850 ms in messages 100.000 ms apart; "
        f"{WAYS_OUT}\n"
    )
    outcome = _run(shell, clouds, "--strict", rig=_rig("{unit: ns}"))
    assert outcome.code == 0, outcome.err
    assert _stamps(tmp_path / "out")[:2] == [0, 50_000]
    # 6 % is a sector of a revolution, or every second sweep.
    assert _run(shell, _bag(_clouds(OUSTER, [0, 6 * MS]))).code == 0


def test_another_field_can_be_named(shell: Shell, tmp_path: Path) -> None:
    fields = (*XYZ, ("t", "uint32"), ("delay", "float64"), ("row", "uint16"))
    points = [(5, 1, 2, 0, n * 0.25, ring) for n in range(COLUMNS) for ring in range(4)]
    data = [cloud_message(fields, points, start) for start in _starts()]
    assert "field t (uint32)" in _run(shell, _bag(data)).err
    # A quarter of a millisecond each.
    rig = _rig("{time: delay, unit: ms, from: start, ring: row}")
    outcome = _run(shell, _bag(data), "--strict", rig=rig)
    assert outcome.code == 0, outcome.err
    assert _stamps(tmp_path / "out") == [
        number * SWEEP + n * MS // 4 for number in range(SWEEPS) for n in range(COLUMNS)
    ]
    assert "up to 16 points a column by ring" in _warnings()[0][1]
    with np.load(scan_files(tmp_path / "out")[0]) as scan:
        assert set(scan["ring"].tolist()) == {0, 1, 2, 3}


@pytest.mark.parametrize(
    ("points", "error"),
    [
        (
            "{time: dely}",
            "rig.yaml:4: sensors[0].points.time: expected a field of the cloud, one of x, y, z, "
            "intensity, t, ring, found 'dely'; t rises within the scan as times do\n",
        ),
        (
            "\n      unit: ns\n      ring: rings",
            "rig.yaml:6: sensors[0].points.ring: expected a field of the cloud, one of x, y, z, "
            "intensity, t, ring, found 'rings'; the nearest one is ring\n",
        ),
        (
            "{ring: intensity}",
            "rig.yaml:4: sensors[0].points.ring: expected a field of whole numbers from 0 to "
            "65535, found others in intensity; name another one, or remove the key\n",
        ),
    ],
)
def test_unknown_fields_are_named_with_their_line(shell: Shell, points: str, error: str) -> None:
    outcome = _run(shell, _bag(_clouds(OUSTER, NS)), rig=_rig(points))
    assert outcome.code == 1
    assert outcome.err.startswith(f"mlbatch: error: {error}")


IN_ORDER = "timestamps, offset_time or ts, found"


@pytest.mark.parametrize("layout", ["firings", "rows of rings", "firing times"])
def test_only_fields_that_rise_within_a_scan_are_proposed(shell: Shell, layout: str) -> None:
    """The order of drivers: firing by firing, ring by ring, and firings that are not in order."""
    fields = (*XYZ, ("intensity", "float32"), ("ring", "uint16"), ("gain", "uint8"))
    stamped = (*fields, ("when", "uint32"))
    shots = [(n, ring) for n in range(COLUMNS) for ring in range(16)]
    if layout == "rows of rings":
        shots.sort(key=lambda shot: (shot[1], shot[0]))
    late = [0, 700, 300, 500] * 4 if layout == "firing times" else [0] * 16
    points = [
        (5, 1, 2, (7 * n + 3 * ring) % 50, ring, (5 * n + ring) % 7, n * MS + late[ring] * 1000)
        for n, ring in shots
    ]
    timed = _bag([cloud_message(stamped, points, start) for start in _starts()])
    timeless = _bag(
        [cloud_message(fields, [one[:-1] for one in points], start) for start in _starts()]
    )
    for rig, what in (("", f"{IN_ORDER} x, y, z, intensity, ring, gain"), ("{time: stamp}", "")):
        outcome = _run(shell, timed, rig=_rig(rig) if rig else "")
        assert outcome.code == 1
        assert what in outcome.err
        assert "when rises within the scan as times do" in outcome.err
        outcome = _run(shell, timeless, rig=_rig(rig) if rig else "")
        assert outcome.code == 1
        assert what in outcome.err
        assert "none of them rises within the scan as times do" in outcome.err
        for name in ("is intensity", "is gain", "points: {time", "intensity rises"):
            assert name not in outcome.err
    outcome = _run(shell, timed, "--strict", rig=_rig("{time: when}"))
    assert outcome.code == 0, outcome.err


def test_points_of_a_topic_without_clouds(shell: Shell) -> None:
    outcome = _run(shell, _bag(_clouds(OUSTER, NS)), rig=_rig("{unit: ns}", "/point"))
    assert outcome.err == (
        "mlbatch: error: rig.yaml:4: sensors[0].points.unit: expected decoded clouds on /point, "
        "found none; the nearest topic of clouds is /points\n"
    )


# -- units -----------------------------------------------------------------------------------------

FLOAT = (*XYZ, ("time", "float32"))


@pytest.mark.parametrize(
    ("fields", "times", "unit", "instead"),
    [
        (OUSTER, US, "us", ", not ns as usual"),
        (FLOAT, [float(n) for n in range(COLUMNS)], "ms", ", not s as usual"),
        (FLOAT, [float(n) for n in US], "us", ""),
        (OUSTER, list(range(COLUMNS)), "ms", ", not ns as usual"),
    ],
)
def test_units_follow_from_the_span_of_sweeps(
    shell: Shell, tmp_path: Path, fields: Fields, times: Sequence[float], unit: str, instead: str
) -> None:
    clouds = _bag(_clouds(fields, times))
    outcome = _run(shell, clouds)
    assert outcome.code == 0, outcome.err
    assert _stamps(tmp_path / "out") == _expected()
    name = "t (uint32)" if fields is OUSTER else "time (float32)"
    why = f"inferred by sweeps of 97.000 ms in messages 100.000 ms apart{instead}"
    assert _warnings()[0] == (
        "cloud_time",
        f"/points: field {name}: its unit is {unit}, {why}; confirm it in the rig (points: "
        f"{{unit: {unit}}}), or leave the topic out with --ignore /points",
    )
    code, text = _warnings()[1]
    assert code == "clouds"
    assert f"{name}, {unit} after the header's stamp ({why}); " in text
    outcome = _run(shell, clouds, "--strict")
    assert outcome.code == 1
    assert "(cloud_time, an error because of --strict)" in outcome.err
    outcome = _run(shell, clouds, "--strict", rig=_rig(f"{{unit: {unit}}}"))
    assert outcome.code == 0, outcome.err
    assert _stamps(tmp_path / "out") == _expected()


def test_microseconds_since_1970(shell: Shell, tmp_path: Path) -> None:
    """As ns, they would be of January 1970."""
    fields = (*XYZ, ("timestamp", "float64"))
    data = [
        cloud_message(fields, _sweep(fields, [start / 1000 + n for n in US]), start)
        for start in _starts()
    ]
    outcome = _run(shell, _bag(data))
    assert outcome.code == 0, outcome.err
    assert _stamps(tmp_path / "out") == _expected()
    assert _warnings()[0][0] == "cloud_time"


# -- the header ------------------------------------------------------------------------------------


def test_headers_at_the_end_of_a_sweep(shell: Shell, tmp_path: Path) -> None:
    """As in NTU VIRAL: ns from the start of the sweep, a header of its end."""
    clouds = _bag(_clouds(OUSTER, NS, header=LAST), delay=LAST + 2 * MS)
    outcome = _run(shell, clouds)
    assert outcome.code == 0, outcome.err
    (code, text), _ = _warnings()
    assert code == "cloud_time"
    assert text == (
        "/points: field t (uint32): points are up to 95.0 ms later than the log time of their "
        "message, as where a driver stamps the header at the end of the sweep: then write points: "
        "{from: end} in the rig; if the header is that of the first point, write points: "
        "{from: start}"
    )
    outcome = _run(shell, clouds, "--strict")
    assert outcome.code == 1
    assert "points: {from: end}" in outcome.err
    outcome = _run(shell, clouds, "--strict", rig=_rig("{from: end}"))
    assert outcome.code == 0, outcome.err
    assert _stamps(tmp_path / "out") == _expected()
    outcome = _run(shell, clouds, "--strict", rig=_rig("{from: start}"))
    assert outcome.code == 0, outcome.err
    assert _stamps(tmp_path / "out") == _expected(LAST)


def test_the_end_of_a_sweep_counts_shots_without_a_return(shell: Shell, tmp_path: Path) -> None:
    """Else sweeps would shift by the sector that looks into the sky."""
    points = [
        _point(OUSTER, 0.0 if n > 60 else 5.0, n * MS, ring)
        for n in range(COLUMNS)
        for ring in (0, 1)
    ]
    points = [(x, *((0, 0) if x == 0 else (1, 1)), *rest) for x, _, _, *rest in points]
    data = [cloud_message(OUSTER, points, start + LAST) for start in _starts()]
    outcome = _run(shell, _bag(data), "--strict", rig=_rig("{from: end}"))
    assert outcome.code == 0, outcome.err
    assert _stamps(tmp_path / "out")[:61] == [n * MS for n in range(61)]


BACK = [n / 1024 - 0.09375 for n in range(97)]  # exact in float32
AROUND = [n / 1024 - 0.0625 for n in range(97)]
AS_THEY_ARE = "remove from if they count from the header's stamp as they are"


@pytest.mark.parametrize(
    ("times", "origin", "found"),
    [
        (BACK, "start", "-93.750 to 0.000 ms; write from: end if the header's stamp is that of "
         f"the last point, or {AS_THEY_ARE}"),
        (AROUND, "start", f"-62.500 to 31.250 ms; {AS_THEY_ARE}"),
        (AROUND, "end", f"-62.500 to 31.250 ms; {AS_THEY_ARE}"),
    ],
)  # fmt: skip
def test_times_that_the_stated_direction_excludes_are_refused(
    shell: Shell, tmp_path: Path, times: Sequence[float], origin: str, found: str
) -> None:
    """They were shifted: points were 62 or 94 ms late."""
    data = _bag(_clouds(VELODYNE, times, header=LAST), delay=LAST + 35 * MS)
    outcome = _run(shell, data, rig=_rig(f"{{from: {origin}}}"))
    assert outcome.code == 1
    assert outcome.err.startswith("mlbatch: error: rig.yaml: sensor top: /points: field time")
    assert outcome.err.endswith(f"(from: {origin}), found {found}\n")
    # As they are: the first point is that long before the header's stamp.
    outcome = _run(shell, data, "--strict", rig=_rig("{unit: s}"))
    assert outcome.code == 0, outcome.err
    assert _stamps(tmp_path / "out")[0] == LAST + round(times[0] * 1e9)


def test_points_of_the_stamped_packet_are_on_the_other_side_of_the_header(
    shell: Shell, tmp_path: Path
) -> None:
    """The Velodyne driver stamps the last packet, whose points follow for 1.3 ms."""
    times = [n / 1024 - 0.09375 for n in range(98)]
    data = _bag(_clouds(VELODYNE, times, header=LAST))
    outcome = _run(shell, data, "--strict", rig=_rig("{from: end}"))
    assert outcome.code == 0, outcome.err
    assert _stamps(tmp_path / "out")[0] == LAST - 93_750_000
    data = _bag(_clouds(VELODYNE, [n / 1024 - 1 / 1024 for n in range(97)]))
    outcome = _run(shell, data, "--strict", rig=_rig("{from: start}"))
    assert outcome.code == 0, outcome.err
    # The first column of all is before the first window.
    assert _stamps(tmp_path / "out")[0] in (-976_562, -976_563, 0)


# -- log times -------------------------------------------------------------------------------------


def test_log_times_that_fit_two_zeros_are_warned_about(shell: Shell) -> None:
    """Header at the end, logged 120 ms later: as a header at the start, logged 23 ms later."""
    clouds = _bag(_clouds(OUSTER, NS, header=LAST), delay=LAST + 120 * MS)
    outcome = _run(shell, clouds)
    assert outcome.code == 0, outcome.err
    (code, text), _ = _warnings()
    assert code == "cloud_time"
    assert "logged 23.0 ms after their last point if the header is that of the first point" in text
    assert "120.0 ms after it if a driver stamps the header at the end of the sweep" in text
    assert "points: {from: end}" in text
    assert "points: {from: start}" in text
    for origin in ("start", "end"):
        outcome = _run(shell, clouds, "--strict", rig=_rig(f"{{from: {origin}}}"))
        assert outcome.code == 0, outcome.err


@pytest.mark.parametrize("delay", [0, 400])
def test_log_times_that_are_the_header_show_no_zero(shell: Shell, delay: int) -> None:
    """Files whose log times are copies, some in whole microseconds."""
    outcome = _run(shell, _bag(_clouds(OUSTER, NS), delay=delay), "--strict")
    assert outcome.code == 0, outcome.err


@pytest.mark.parametrize(("ahead", "offset_s"), [(100, "-0.100"), (37_000, "-37.000"), (15, "")])
def test_headers_after_the_log_time_are_warned_about(
    shell: Shell, ahead: int, offset_s: str
) -> None:
    clouds = _bag(_clouds(OUSTER, NS), delay=-ahead * MS)
    outcome = _run(shell, clouds, rig=_rig("{from: start}"))
    assert outcome.code == 0, outcome.err
    found = [text for code, text in _warnings() if code == "cloud_time"]
    assert len(found) == bool(offset_s)
    if offset_s:
        assert f"the header is {ahead}.0 ms later than the log time of every message" in found[0]
        assert f"clock: {{offset_s: {offset_s}}}" in found[0]
        rig = _rig("{from: start}") + f"    clock: {{offset_s: {offset_s}}}\n"
        outcome = _run(shell, clouds, "--strict", rig=rig)
        assert outcome.code == 0, outcome.err


def test_absolute_times_after_the_log_time_are_warned_about(shell: Shell) -> None:
    # The last point is at 97 ms.
    outcome = _run(shell, _bag(_hesai(), delay=-3 * MS))
    assert outcome.code == 0, outcome.err
    assert "the last points are 100.0 ms later than the log time of every message" in outcome.err


def test_times_below_half_of_the_spacing_are_warned_about(shell: Shell) -> None:
    """9.7 ms of 100 ms; 50 % and more are usual, as of a lidar with a blind half."""
    clouds = _bag(_clouds(OUSTER, [n * MS // 10 for n in range(COLUMNS)]))
    outcome = _run(shell, clouds, "--strict")
    assert outcome.code == 1
    assert (
        "field t (uint32): points span 9.700 ms in messages 100.000 ms apart, 10 %, as those of a "
        "sector, of another field or of another unit: write points: {unit: ns} in the rig if that "
        "is right" in outcome.err
    )
    outcome = _run(shell, clouds, "--strict", rig=_rig("{unit: ns}"))
    assert outcome.code == 0, outcome.err
    clouds = _bag(_clouds(OUSTER, [n * MS for n in range(51)]))
    outcome = _run(shell, clouds, "--strict", rig=_rig("{from: start}"))
    assert outcome.code == 0, outcome.err


@pytest.mark.parametrize(
    ("fields", "times", "stated", "span_ms", "right"),
    [
        (OUSTER, US, "ns", "0.097", "us"),
        (OUSTER, NS, "us", "97000", "ns"),
        (OUSTER, NS, "ms", "9.7e+07", "ns"),
        (VELODYNE, SECONDS, "ms", "0.097", "s"),
        (VELODYNE, SECONDS, "us", "9.7e-05", "s"),
        # A quarter of a revolution.
        (OUSTER, US[:25], "ns", "0.024", "us"),
    ],
)
def test_a_stated_unit_that_is_wrong_is_refused(
    shell: Shell, fields: Fields, times: Sequence[float], stated: str, span_ms: str, right: str
) -> None:
    outcome = _run(shell, _bag(_clouds(fields, times)), rig=_rig(f"{{unit: {stated}}}"))
    assert (outcome.code, outcome.out) == (1, "")
    assert re.fullmatch(
        r"mlbatch: error: .*rig\.yaml:4: sensors\[0\]\.points\.unit: field \w+ \(\w+\): expected "
        r"times of points that span about the spacing of the messages \(100\.000 ms\), found "
        rf"{re.escape(span_ms)} ms by unit: {stated}; write unit: {right}, by which they span "
        rf"{len(times) - 1} ms.*\n",
        outcome.err,
    )
    assert _run(shell, _bag(_clouds(fields, times)), rig=_rig(f"{{unit: {right}}}")).code == 0


def test_absolute_times_can_be_stated(shell: Shell, tmp_path: Path) -> None:
    outcome = _run(shell, _bag(_hesai()), "--strict", rig=_rig("{unit: s, from: absolute}"))
    assert outcome.code == 0, outcome.err
    outcome = _run(shell, _bag(_hesai()), rig=_rig("{from: start}"))
    assert outcome.code == 1
    assert "expected times within 1000 s of the header's stamp" in outcome.err
    outcome = _run(shell, _bag(_clouds(OUSTER, NS)), rig=_rig("{from: absolute}"))
    assert outcome.code == 1
    assert "expected times since 1970" in outcome.err


# -- several lidars on a topic ---------------------------------------------------------------------


def _two_frames(*, apart: int = 30 * MS) -> list[Recorded]:
    one = _bag(_clouds(OUSTER, NS, frame="front"))
    two = [
        Recorded(
            "/points",
            CLOUD,
            start + SWEEP + apart,
            cloud_message(OUSTER, _sweep(OUSTER, NS, x=-3.0), start + apart, Form(frame="rear")),
        )
        for start in _starts()
    ]
    return [*one, *two]


@pytest.mark.parametrize("apart", [0, 30 * MS])
def test_frames_separate_lidars_on_one_topic(shell: Shell, tmp_path: Path, apart: int) -> None:
    outcome = _run(shell, _two_frames(apart=apart), "--identity-extrinsics --strict")
    assert outcome.code == 0, outcome.err
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    sensors = [(one["name"], one["stream"], one["points"]["written"]) for one in report["sensors"]]
    count = SWEEPS * COLUMNS * 4
    assert sensors == [
        ("cloud_1_front", "/points (frame_id front)", count),
        ("cloud_2_rear", "/points (frame_id rear)", count),
    ]
    for path in scan_files(tmp_path / "out"):
        with np.load(path) as scan:
            # Points of the first lidar are at x = 5, of the second at x = -3.
            assert ((scan["xyz"][:, 0] > 0) == (scan["lidar_id"] == 0)).all()


def test_one_of_two_frames_can_be_named_and_ignored(shell: Shell, tmp_path: Path) -> None:
    outcome = _run(shell, _two_frames(), "--ignore 'cloud_2_rear'")
    assert outcome.code == 0, outcome.err
    rig = "sensors:\n  - {name: back, stream: {topic: /points, frame_id: rear}}\n"
    outcome = _run(shell, _two_frames(), "--strict", rig=rig)
    assert outcome.code == 1
    assert "leave it out with --ignore '/points (frame_id front)' (not_in_rig" in outcome.err
    ignore = "--ignore '/points (frame_id front)'"
    outcome = _run(shell, _two_frames(), f"--strict {ignore}", rig=rig)
    assert outcome.code == 0, outcome.err
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert [one["name"] for one in report["sensors"]] == ["back"]
    (other,) = report["unassigned"]
    assert other["stream"] == "/points (frame_id front)"
    # Without frame_id the sensor could be either.
    outcome = _run(shell, _two_frames(), rig=_rig())
    assert outcome.code == 1
    assert "expected packets of one lidar, found those of several" in outcome.err


def test_a_frame_that_comes_late_is_not_merged(shell: Shell, tmp_path: Path) -> None:
    """After the messages by which the topic is judged."""
    starts = [STAMP_NS + number * SWEEP for number in range(30)]
    sweep = _sweep(OUSTER, NS)
    messages = [
        Recorded(
            "/points", CLOUD, start + SWEEP, cloud_message(OUSTER, sweep, start, Form(frame=f))
        )
        for start in starts
        for f in (["front"] if start < starts[20] else ["front", "rear"])
    ]
    outcome = _run(shell, messages, "--identity-extrinsics")
    assert outcome.code == 0, outcome.err
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    streams = {one["stream"]: one["packets"]["read"] for one in report["sensors"]}
    assert streams == {"/points": 30 * COLUMNS, "/points (frame_id rear)": 10 * COLUMNS}


def test_lidar_ids_of_points_separate_lidars(shell: Shell, tmp_path: Path) -> None:
    fields = (*OUSTER, ("lidar_id", "uint8"))
    points = [
        (5.0 + 10 * lidar, 1, 2, 9, n * MS, ring, lidar)
        for n in range(COLUMNS)
        for ring in range(4)
        for lidar in (0, 1, 3)
    ]
    data = [cloud_message(fields, points, start) for start in _starts()]
    outcome = _run(shell, _bag(data), "--identity-extrinsics --strict")
    assert outcome.code == 0, outcome.err
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert [(one["stream"], one["points"]["written"]) for one in report["sensors"]] == [
        (f"/points (lidar_id {lidar})", SWEEPS * COLUMNS * 4) for lidar in (0, 1, 3)
    ]
    for path in scan_files(tmp_path / "out"):
        with np.load(path) as scan:
            # Places of the sensors: 5, 15 and 35 m.
            expected = np.array([5.0, 15.0, 35.0])[scan["lidar_id"]]
            assert (scan["xyz"][:, 0] == expected).all()


def test_a_custom_message_names_its_lidar(shell: Shell, tmp_path: Path) -> None:
    """The Livox driver publishes all lidars on one topic unless it is told otherwise."""
    data = []
    for start in _starts():
        for lidar in (0, 1):
            message = bytearray(custom_message([(n, 1, 2, 3, 7, 0, 0) for n in NS], start, start))
            # Behind the number of points, before three reserved bytes and the points' length.
            at = len(message) - 20 * COLUMNS + 1 - 8
            assert message[at : at + 4] == b"\1\0\0\0"
            message[at] = lidar
            data.append(Recorded("/livox/lidar", CUSTOM2, start + SWEEP + lidar, bytes(message)))
    outcome = _run(shell, data, "--identity-extrinsics --strict")
    assert outcome.code == 0, outcome.err
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert [(one["stream"], one["packets"]["read"]) for one in report["sensors"]] == [
        (f"/livox/lidar (lidar_id {lidar})", SWEEPS * COLUMNS) for lidar in (0, 1)
    ]


@pytest.mark.parametrize("apart", [1000, 50 * MS])
def test_two_lidars_that_nothing_separates_are_refused(shell: Shell, apart: int) -> None:
    data = _bag(_clouds(OUSTER, NS))
    for start in _starts():
        message = cloud_message(OUSTER, _sweep(OUSTER, NS), start + apart)
        data.append(Recorded("/points", CLOUD, start + apart + SWEEP, message))
    outcome = _run(shell, data)
    assert outcome.code == 1
    assert "which overlap: several lidars share the topic" in outcome.err
    assert "give each lidar a topic or a frame_id of its own" in outcome.err
    # Whoever states the unit is warned.
    outcome = _run(shell, data, rig=_rig("{unit: ns}"))
    assert outcome.code == 0, outcome.err
    assert _warnings()[0][0] == "cloud_time"


def test_sensors_in_one_namespace_have_names_of_their_own(shell: Shell, tmp_path: Path) -> None:
    messages = [
        *_bag(_clouds(OUSTER, NS), "/car/points_front"),
        *_bag(_clouds(OUSTER, NS), "/car/points_rear"),
    ]
    outcome = _run(shell, messages, "--identity-extrinsics --strict")
    assert outcome.code == 0, outcome.err
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert [one["name"] for one in report["sensors"]] == ["car", "car_2"]


# -- frames, clocks, topics left out ---------------------------------------------------------------


def test_frames_of_headers_give_extrinsics(shell: Shell, tmp_path: Path) -> None:
    # Frames that no driver would use: 1 m ahead, and 2 m back and a quarter turn to the left.
    half = math.sqrt(0.5)
    transforms = transforms_message(
        "cdr",
        [
            ("base_link", "alpha", (1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)),
            ("base_link", "beta", (-2.0, 0.0, 0.0), (0.0, 0.0, half, half)),
            # The name that a driver of this topic might use is another place.
            ("base_link", "one", (7.0, 7.0, 7.0), (0.0, 0.0, 0.0, 1.0)),
        ],
    )
    messages = [
        Recorded("/tf_static", "tf2_msgs/TFMessage", STAMP_NS, transforms),
        *_bag(_clouds(OUSTER, NS, frame="/alpha"), "/one/points"),
        *_bag(_clouds(OUSTER, NS, frame="beta"), "/two/points"),
    ]
    outcome = _run(shell, messages, "--strict")
    assert outcome.code == 0, outcome.err
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert [one["extrinsics"]["source"] for one in report["sensors"]] == [
        "tf_static: base_link -> alpha",
        "tf_static: base_link -> beta",
    ]
    with np.load(scan_files(tmp_path / "out")[0]) as scan:
        # (5, 1, 2) in each frame.
        first = scan["xyz"][scan["lidar_id"] == 0]
        second = scan["xyz"][scan["lidar_id"] == 1]
    assert np.abs(first - (6, 1, 2)).max() < 1e-5
    assert np.abs(second - (-3, 5, 2)).max() < 1e-5


def test_a_frame_that_no_transform_has_is_named(shell: Shell) -> None:
    transforms = transforms_message(
        "cdr", [("base_link", "one", (7.0, 7.0, 7.0), (0.0, 0.0, 0.0, 1.0))]
    )
    messages = [
        Recorded("/tf_static", "tf2_msgs/TFMessage", STAMP_NS, transforms),
        *_bag(_clouds(OUSTER, NS, frame="alpha"), "/one/points"),
        *_bag(_clouds(OUSTER, NS, frame="one"), "/two/points"),
    ]
    outcome = _run(shell, messages)
    assert outcome.code == 1
    assert "its points are in frame alpha, which is none of the recording's (base_link, one)" in (
        outcome.err
    )


@pytest.mark.parametrize(
    ("topic", "word"),
    [
        ("/boxi/hesai/points_undistorted", "undistorted"),
        ("/sensing/lidar/top/rectified/pointcloud", "rectified"),
        ("/lidar/deskewed", "deskewed"),
    ],
)
def test_points_moved_to_one_time_are_refused_unless_stated(
    shell: Shell, topic: str, word: str
) -> None:
    messages = _bag(_clouds(OUSTER, NS), topic)
    outcome = _run(shell, messages)
    assert outcome.code == 1
    assert f"found a topic that by its name ({word}) has points moved to one time" in outcome.err
    assert not Path("out").exists()
    outcome = _run(shell, messages, rig=_rig("{from: start}", topic))
    assert outcome.code == 0, outcome.err
    assert _stamps(Path("out")) == _expected()


def test_offsets_of_mixed_clocks_are_written_out(shell: Shell) -> None:
    """One lidar counts from power-on, one is right; the delays of their drivers differ by 20 ms.

    The first is 1,699,999,500 s behind, and logged 20 ms later than the second, which is nearest to
    the log times: its offset appears 20 ms too large.
    """
    behind = -1_699_999_500 * 1000 * MS
    us = 1000
    velodyne = _clouds(VELODYNE, [n - 0.097 for n in SECONDS], header=LAST + 10 * us)
    messages = [
        *_bag(_clouds(OUSTER, NS, header=behind), "/os/points", delay=SWEEP + 20 * MS),
        *_bag(velodyne, "/velodyne_points"),
    ]
    rig = "sensors:\n" + "".join(
        f"  - {{name: {name}, stream: {{topic: {topic}}}{clock}}}\n"
        for name, topic, clock in (
            ("os", "/os/points", "%s"),
            ("velo", "/velodyne_points", ""),
        )
    )
    outcome = _run(shell, messages, "--identity-extrinsics", rig=rig % "")
    assert outcome.code == 1
    line = "os clock: {offset_s: 1699999500.020}"
    assert f"in the rig: {line} (by log times of messages: coarse" in outcome.err
    assert outcome.err.count("offset_s:") == 1
    paste = ", clock: {offset_s: 1699999500.020}"
    outcome = _run(shell, messages, "--identity-extrinsics", rig=rig % paste)
    assert outcome.code == 0, outcome.err
    # Columns of the first lidar are 20 ms late, those of the second where they were measured.
    # float32 seconds are within 10 ns.
    found = {round(stamp / us) * us for stamp in _stamps(Path("out"))}
    assert found == {*_expected(20 * MS), *_expected(10 * us)}


@pytest.mark.parametrize(("ahead", "is_warned"), [(100 * MS, False), (500 * MS, True)])
def test_clouds_apart_by_their_log_times_are_warned_about(
    shell: Shell, ahead: int, is_warned: bool
) -> None:
    """Both lidars are logged 3 ms after their last points; the clock of the second is ahead."""
    messages = [
        *_bag(_clouds(OUSTER, NS), "/one/points"),
        *_bag(_clouds(OUSTER, NS, header=ahead), "/two/points"),
    ]
    rig = (
        "sensors:\n  - {name: one, stream: {topic: /one/points}, points: {from: start}}\n"
        "  - {name: two, stream: {topic: /two/points}, points: {from: start}%s}\n"
    )
    outcome = _run(shell, messages, "--identity-extrinsics", rig=rig % "")
    assert outcome.code == 0, outcome.err
    text = "the points of two are 500 ms later than those of one: their clocks"
    assert (text in outcome.err) == is_warned
    clock = f", clock: {{offset_s: {-ahead / 1e9}}}"
    outcome = _run(shell, messages, "--identity-extrinsics", rig=rig % clock)
    assert outcome.code == 0, outcome.err
    assert "later than those" not in outcome.err


def test_log_times_that_are_copies_show_no_offset(shell: Shell) -> None:
    behind = -1_699_999_500 * 1000 * MS
    messages = [
        *_bag(_clouds(OUSTER, NS, header=behind), "/one/points"),
        *_bag(_clouds(OUSTER, NS), "/two/points", delay=0),
    ]
    outcome = _run(shell, messages, "--identity-extrinsics")
    assert outcome.code == 1
    assert "; the log times of two do not show the offset" in outcome.err
    assert "offset_s:" not in outcome.err


def test_clock_errors_name_what_works(shell: Shell, tmp_path: Path) -> None:
    late = 37 * 1000 * MS
    messages = [
        *_bag(_clouds(OUSTER, NS), "/one/points"),
        *_bag(_clouds(OUSTER, NS, header=late), "/two/points"),
    ]
    outcome = _run(shell, messages, "--identity-extrinsics")
    assert outcome.code == 1
    assert "clocks of the sensors cannot be compared" in outcome.err
    assert "--clock host" not in outcome.err
    assert "--align-clocks" not in outcome.err
    assert "give clock.offset_s or clock.epoch in the rig" in outcome.err
    # Both messages are logged 3 ms after their last points, which are measured at 97 ms.
    assert "in the rig: two clock: {offset_s: -37.000} (by log times" in outcome.err
    rig = (
        "sensors:\n  - {name: one, stream: {topic: /one/points}}\n"
        "  - {name: two, stream: {topic: /two/points}, clock: {offset_s: -37}}\n"
    )
    outcome = _run(shell, messages, "--identity-extrinsics", rig=rig)
    assert outcome.code == 0, outcome.err


@pytest.mark.parametrize("step", [3600_000 * MS, -3600_000 * MS])
def test_clock_jumps_of_clouds_name_what_works(shell: Shell, step: int) -> None:
    starts = [start + (step if number >= 3 else 0) for number, start in enumerate(_starts())]
    data = [cloud_message(OUSTER, _sweep(OUSTER, NS), start) for start in starts]
    outcome = _run(shell, _bag(data))
    assert outcome.code == 1
    assert outcome.err.endswith("; use --on-jump split\n")
    assert _run(shell, _bag(data), "--on-jump split").code == 0


def test_a_topic_without_times_is_an_error_unless_ignored(shell: Shell, tmp_path: Path) -> None:
    timeless = [cloud_message(XYZ, [(1, 2, 3)], start) for start in _starts()]
    messages = [*_bag(_clouds(OUSTER, NS), "/one/points"), *_bag(timeless, "/map/points")]
    outcome = _run(shell, messages)
    assert outcome.code == 1
    assert outcome.err == (
        "mlbatch: error: drive.db3: /map/points: expected the time of each point in a field t, "
        "time, timestamp, time_stamp, timestamps, offset_time or ts, found x, y, z; none of them "
        "rises within the scan as times do: record the raw packets, or clouds with times, or leave "
        "the topic out with --ignore /map/points\n"
    )
    for option in ("--ignore /map/points", "--only one"):
        outcome = _run(shell, messages, f"--strict {option}")
        assert outcome.code == 0, outcome.err
        report = json.loads((tmp_path / "out" / "report.json").read_text())
        assert [one["name"] for one in report["sensors"]] == ["one"]
    outcome = _run(shell, messages, "--strict", rig=_rig(topic="/one/points"))
    assert outcome.code == 0, outcome.err
    # Inspection goes on, and says so.
    text = shell("inspect drive.db3").out
    assert "/map/points: expected the time of each point" in text


def test_jobs_agree(shell: Shell, tmp_path: Path) -> None:
    options = "--identity-extrinsics --jobs 3"
    assert _run(shell, _two_frames(), options).code == 0
    found = [dict(np.load(path)) for path in scan_files(tmp_path / "out")]
    assert _run(shell, _two_frames(), "--identity-extrinsics --jobs 1").code == 0
    for one, path in zip(found, scan_files(tmp_path / "out"), strict=True):
        with np.load(path) as other:
            # A cloud has no known fill.
            assert {key: one[key].tobytes() for key in one} == {
                key: other[key].tobytes() for key in other.files
            }
