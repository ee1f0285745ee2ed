"""Decoded clouds as drivers publish them, and those that would be silently wrong.

Stamps of points are known by construction: column n of a sweep of 100 ms is measured at n ms.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

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
from tests.builders.run import Outcome, scan_files
from tests.builders.sessions import Shell, report_of
from tests.builders.transcripts import transcripts

MS = 1_000_000
SWEEP = 100 * MS
COLUMNS = 98
SWEEPS = 6
LAST = (COLUMNS - 1) * MS
Fields = Sequence[tuple[str, str]]


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


def _run(shell: Shell, messages: list[Recorded], options: str = "", rig: str = "") -> Outcome:
    Path("drive.db3").unlink(missing_ok=True)
    write_rosbag2(Path("drive.db3"), sorted(messages, key=lambda one: one.log_ns))
    if rig:
        Path("rig.yaml").write_text(rig)
        options += " --rig rig.yaml"
    return shell(f"convert drive.db3 -o out --keep-partial --overwrite {options}")


def _rig(points: str = "", topic: str = "/points") -> str:
    key = f", points: {points}" if points else ""
    return f"sensors: [{{name: top, stream: {{topic: {topic}}}{key}}}]\n"


def _warnings() -> list[tuple[str, str]]:
    return [(one["code"], one["message"]) for one in report_of("out/report.json")["warnings"]]


# -- recordings -----------------------------------------------------------------------------------


def _since_1970(fields: Fields, times: Callable[[int], list[float]]) -> list[bytes]:
    """Sweeps whose points have absolute times; times: by the start of the sweep, ns."""
    return [cloud_message(fields, _sweep(fields, times(start)), start) for start in _starts()]


def _custom() -> list[bytes]:
    points = [(n, 1, 2, 3, 7, 0, 0) for n in NS]
    return [custom_message(points, start, start) for start in _starts()]


def _quarters() -> list[bytes]:
    """A quarter of a millisecond a column, in a field of another name."""
    fields = (*XYZ, ("t", "uint32"), ("delay", "float64"), ("row", "uint16"))
    points = [(5, 1, 2, 0, n * 0.25, ring) for n in range(COLUMNS) for ring in range(4)]
    return [cloud_message(fields, points, start) for start in _starts()]


def _ordered(layout: str, *, timed: bool) -> list[bytes]:
    """Points in the order of drivers, with a time in a field that no driver has, or with none.

    firings: firing by firing; rows: ring by ring; late: firings that are not in order.
    """
    fields: Fields = (*XYZ, ("intensity", "float32"), ("ring", "uint16"), ("gain", "uint8"))
    shots = [(n, ring) for n in range(COLUMNS) for ring in range(16)]
    if layout == "rows":
        shots.sort(key=lambda shot: (shot[1], shot[0]))
    late = [0, 700, 300, 500] * 4 if layout == "late" else [0] * 16
    points: list[tuple[float, ...]] = [
        (5, 1, 2, (7 * n + 3 * ring) % 50, ring, (5 * n + ring) % 7, n * MS + late[ring] * 1000)
        for n, ring in shots
    ]
    if timed:
        fields = (*fields, ("when", "uint32"))
    return [cloud_message(fields, [one[: len(fields)] for one in points], s) for s in _starts()]


def _without_returns() -> list[bytes]:
    """The last columns of a sweep look into the sky; the header is of its end."""
    points = [
        _point(OUSTER, 0.0 if n > 60 else 5.0, n * MS, ring)
        for n in range(COLUMNS)
        for ring in (0, 1)
    ]
    points = [(x, *((0, 0) if x == 0 else (1, 1)), *rest) for x, _, _, *rest in points]
    return [cloud_message(OUSTER, points, start + LAST) for start in _starts()]


def _shared(apart: int) -> list[Recorded]:
    """Two lidars on one topic that nothing separates."""
    return _bag(_clouds(OUSTER, NS)) + [
        Recorded(
            "/points",
            CLOUD,
            start + apart + SWEEP,
            cloud_message(OUSTER, _sweep(OUSTER, NS), start + apart),
        )
        for start in _starts()
    ]


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


def _pair(header: int, delay: int = SWEEP) -> list[Recorded]:
    """Two lidars; header: how much the clock of the second is ahead, ns; delay: of its log."""
    return [
        *_bag(_clouds(OUSTER, NS), "/one/points"),
        *_bag(_clouds(OUSTER, NS, header=header), "/two/points", delay=delay),
    ]


def _late_frame() -> list[Recorded]:
    """A second frame after the messages by which the topic is judged."""
    starts = [STAMP_NS + number * SWEEP for number in range(30)]
    sweep = _sweep(OUSTER, NS)
    return [
        Recorded(
            "/points", CLOUD, start + SWEEP, cloud_message(OUSTER, sweep, start, Form(frame=frame))
        )
        for start in starts
        for frame in (["front"] if start < starts[20] else ["front", "rear"])
    ]


def _custom_lidars() -> list[Recorded]:
    """The Livox driver publishes all lidars on one topic by default."""
    found = []
    for start, message in zip(_starts(), _custom(), strict=True):
        # Behind the number of points, before three reserved bytes and the points' length.
        at = len(message) - 20 * COLUMNS + 1 - 8
        assert message[at : at + 4] == b"\1\0\0\0"
        for lidar in (0, 1):
            data = message[:at] + bytes([lidar]) + message[at + 1 :]
            found.append(Recorded("/livox/lidar", CUSTOM2, start + SWEEP + lidar, data))
    return found


def _stepping(step: int) -> list[Recorded]:
    """A clock that steps after three sweeps."""
    starts = [start + (step if number >= 3 else 0) for number, start in enumerate(_starts())]
    return _bag([cloud_message(OUSTER, _sweep(OUSTER, NS), start) for start in starts])


def _of_intensities(values: Sequence[float]) -> list[Recorded]:
    """Sweeps with a point of every intensity, in turn."""
    points = [(3, 1, 0.5, v, n * SWEEP // len(values), n % 4) for n, v in enumerate(values)]
    return _bag([cloud_message(OUSTER, points, start) for start in _starts()])


def _placed() -> list[Recorded]:
    """One of two lidars is in a frame of the recording."""
    edge = ("base_link", "one", (7.0, 7.0, 7.0), (0.0, 0.0, 0.0, 1.0))
    return [
        Recorded("/tf_static", "tf2_msgs/TFMessage", STAMP_NS, transforms_message("cdr", [edge])),
        *_bag(_clouds(OUSTER, NS, frame="alpha"), "/one/points"),
        *_bag(_clouds(OUSTER, NS, frame="one"), "/two/points"),
    ]


FLOAT = (*XYZ, ("time", "float32"))
ABSOLUTE = (*XYZ, ("timestamp", "float64"))
AT_END = _clouds(OUSTER, NS, header=LAST)
SEEN = _clouds(OUSTER, NS)
HESAI_SWEEPS = _since_1970(HESAI, lambda start: [start * 1e-9 + n * 1e-3 for n in range(COLUMNS)])
# Exact in float32.
BACK = [n / 1024 - 0.09375 for n in range(97)]
AROUND = [n / 1024 - 0.0625 for n in range(97)]
LATE = LAST + 35 * MS
RECORDINGS: dict[str, list[Recorded]] = {
    # As drivers publish them.
    "ouster": _bag(SEEN),
    "autoware": _bag(_clouds(AUTOWARE, NS)),
    "velodyne_end": _bag(
        _clouds(VELODYNE, [n * 1e-3 - 0.097 for n in range(COLUMNS)], header=LAST)
    ),
    "velodyne": _bag(_clouds(VELODYNE, SECONDS)),
    "hesai": _bag(HESAI_SWEEPS),
    "livox": _bag(_since_1970(LIVOX, lambda start: [float(start + n) for n in NS])),
    "custom": _bag(_custom(), kind=CUSTOM2),
    # Times that are none, or few.
    "zero_t": _bag(_clouds(OUSTER, [0] * 3)),
    "zero_time": _bag(_clouds(VELODYNE, [0.0] * 3)),
    "equal": _bag(_clouds(OUSTER, [7] * 3)),
    "one_zero": _bag(_clouds(OUSTER, [0] * 3)[:1]),
    "few": _bag(_clouds(OUSTER, [n * 50_000 for n in range(COLUMNS)])),
    "sector": _bag(_clouds(OUSTER, [0, 6 * MS])),
    "tenth": _bag(_clouds(OUSTER, [n * MS // 10 for n in range(COLUMNS)])),
    "half": _bag(_clouds(OUSTER, NS[:51])),
    "delay": _bag(_quarters()),
    **{
        f"{layout}_{'timed' if timed else 'timeless'}": _bag(_ordered(layout, timed=timed))
        for layout in ("firings", "rows", "late")
        for timed in (True, False)
    },
    # Units.
    "t_us": _bag(_clouds(OUSTER, US)),
    "t_ms": _bag(_clouds(OUSTER, list(range(COLUMNS)))),
    "time_ms": _bag(_clouds(FLOAT, [float(n) for n in range(COLUMNS)])),
    "time_us": _bag(_clouds(FLOAT, [float(n) for n in US])),
    "quarter_us": _bag(_clouds(OUSTER, US[:25])),
    # As ns, they would be of January 1970.
    "us_since_1970": _bag(_since_1970(ABSOLUTE, lambda start: [start / 1000 + n for n in US])),
    # Headers: at the end, as in NTU VIRAL; so that log times fit two zeros; with times around it.
    "end": _bag(AT_END, delay=LAST + 2 * MS),
    "either": _bag(AT_END, delay=LAST + 120 * MS),
    "sky": _bag(_without_returns()),
    "back": _bag(_clouds(VELODYNE, BACK, header=LAST), delay=LATE),
    "around": _bag(_clouds(VELODYNE, AROUND, header=LAST), delay=LATE),
    # The Velodyne driver stamps the last packet, whose points follow for 1.3 ms.
    "last_packet": _bag(_clouds(VELODYNE, [n / 1024 - 0.09375 for n in range(98)], header=LAST)),
    "first_packet": _bag(_clouds(VELODYNE, [n / 1024 - 1 / 1024 for n in range(97)])),
    # Log times: copies of the header, some in whole microseconds; before the header.
    "copied": _bag(SEEN, delay=0),
    "copied_us": _bag(SEEN, delay=400),
    "ahead_15": _bag(SEEN, delay=-15 * MS),
    "ahead_100": _bag(SEEN, delay=-100 * MS),
    "ahead_37000": _bag(SEEN, delay=-37_000 * MS),
    # The last point is at 97 ms.
    "hesai_ahead": _bag(HESAI_SWEEPS, delay=-3 * MS),
    # Several lidars on a topic, 1 us and 50 ms apart.
    "shared": _shared(1000),
    "shared_50": _shared(50 * MS),
    # Points that were moved to one time, by the name of their topic.
    "undistorted": _bag(SEEN, "/boxi/hesai/points_undistorted"),
    "rectified": _bag(SEEN, "/sensing/lidar/top/rectified/pointcloud"),
    "deskewed": _bag(SEEN, "/lidar/deskewed"),
    # Of ten points two are above 255 and one is below 0; 255 itself is none of them.
    "bright": _of_intensities([0, 1, 255, 256, -1, 17, 18, 19, 4000, 20]),
    # Points to the end of a sweep, as of a driver that publishes it then.
    "last_bright": _of_intensities([0] * 9 + [256]),
    # Several lidars, by their frames, numbers or topics.
    "two_frames": _two_frames(),
    "late_frame": _late_frame(),
    "custom_lidars": _custom_lidars(),
    "car": [*_bag(SEEN, "/car/points_front"), *_bag(SEEN, "/car/points_rear")],
    "placed": _placed(),
    # Of two lidars the second is ahead; the first counts from power-on, the second is logged at
    # the times of its headers.
    **{f"apart_{ms}": _pair(ms * MS) for ms in (100, 500, 37_000)},
    "copies": [
        *_bag(_clouds(OUSTER, NS, header=-1_699_999_500_000 * MS), "/one/points"),
        *_pair(0, delay=0)[SWEEPS:],
    ],
    "forward": _stepping(3600_000 * MS),
    "backward": _stepping(-3600_000 * MS),
    "map": [
        *_bag(SEEN, "/one/points"),
        *_bag([cloud_message(XYZ, [(1, 2, 3)], start) for start in _starts()], "/map/points"),
    ],
}
CASES = transcripts("clouds")


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all of them."""
    folder = tmp_path_factory.mktemp("clouds")
    write_all(folder)
    return folder


def write_all(folder: Path) -> None:
    """Write the recordings as ROS 2 bags."""
    for name, messages in RECORDINGS.items():
        write_rosbag2(folder / f"{name}.db3", sorted(messages, key=lambda one: one.log_ns))


@pytest.mark.parametrize("name", CASES)
def test_transcript(shell: Shell, recordings: Path, tmp_path: Path, name: str) -> None:
    CASES[name].check_with(recordings, shell, tmp_path)


def _at(number: int) -> list[int]:
    return [number * SWEEP + n * MS // 4 for n in range(COLUMNS)]


# A float32 of 0.1 s has a step of 7 ns, a float64 of seconds since 1970 one of 238 ns.
ROUNDED_NS = dict.fromkeys(("velodyne_end", "velodyne", "hesai", "livox"), 512)
# A recording, `points` of the rig, and the stamps of all columns, or the first of them.
STAMPS: list[tuple[str, str, list[int]]] = [
    *((driver, "", _expected()) for driver in list(RECORDINGS)[:7]),
    ("few", "{unit: ns}", [0, 50_000]),
    (
        "delay",
        "{time: delay, unit: ms, from: start, ring: row}",
        [ns for number in range(SWEEPS) for ns in _at(number)],
    ),
    *((f"{layout}_timed", "{time: when}", [0]) for layout in ("firings", "rows", "late")),
    ("t_us", "{unit: us}", _expected()),
    ("t_ms", "{unit: ms}", _expected()),
    ("time_ms", "{unit: ms}", _expected()),
    ("time_us", "{unit: us}", _expected()),
    ("end", "{from: end}", _expected()),
    ("end", "{from: start}", _expected(LAST)),
    # Else sweeps would shift by the sector that looks into the sky.
    ("sky", "{from: end}", NS[:61]),
    # As they are: the first point is that long before the header's stamp.
    ("back", "{unit: s}", [LAST - 93_750_000]),
    ("around", "{unit: s}", [LAST - 62_500_000]),
    ("last_packet", "{from: end}", [LAST - 93_750_000]),
    ("either", "{from: start}", [LAST]),
    ("either", "{from: end}", [0]),
    ("copied", "", _expected()),
    ("copied_us", "", _expected()),
    ("tenth", "{unit: ns}", [0, MS // 10]),
    ("half", "{from: start}", NS[:51]),
    ("hesai", "{unit: s, from: absolute}", _expected()),
]


@pytest.mark.parametrize(("recording", "points", "expected"), STAMPS)
def test_columns_are_where_they_were_measured(
    shell: Shell, tmp_path: Path, recording: str, points: str, expected: list[int]
) -> None:
    """Without a warning but the one that says how they are read."""
    rig = _rig(points) if points else ""
    outcome = _run(shell, RECORDINGS[recording], "--strict", rig)
    assert outcome.code == 0, outcome.err
    found = np.array(_stamps(tmp_path / "out"))
    if len(expected) == len(_expected()):
        assert len(found) == len(expected)
    assert np.abs(found[: len(expected)] - expected).max() <= ROUNDED_NS.get(recording, 0)
    assert [code for code, _ in _warnings()] == ["clouds"]


@pytest.mark.parametrize("recording", ["t_us", "t_ms", "time_ms", "time_us", "us_since_1970"])
def test_units_follow_from_the_span_of_sweeps(shell: Shell, tmp_path: Path, recording: str) -> None:
    outcome = _run(shell, RECORDINGS[recording])
    assert outcome.code == 0, outcome.err
    assert _stamps(tmp_path / "out") == _expected()


@pytest.mark.parametrize("recording", ["undistorted", "rectified", "deskewed"])
def test_points_moved_to_one_time_are_read_as_stated(
    shell: Shell, tmp_path: Path, recording: str
) -> None:
    messages = RECORDINGS[recording]
    outcome = _run(shell, messages, rig=_rig("{from: start}", messages[0].topic))
    assert outcome.code == 0, outcome.err
    assert _stamps(tmp_path / "out") == _expected()


def test_points_of_the_first_packet_are_before_the_header(shell: Shell, tmp_path: Path) -> None:
    outcome = _run(shell, RECORDINGS["first_packet"], "--strict", rig=_rig("{from: start}"))
    assert outcome.code == 0, outcome.err
    # The first column of all is before the first window.
    assert _stamps(tmp_path / "out")[0] in (-976_562, -976_563, 0)


def test_another_field_of_rings(shell: Shell, tmp_path: Path) -> None:
    rig = _rig("{time: delay, unit: ms, from: start, ring: row}")
    assert _run(shell, RECORDINGS["delay"], rig=rig).code == 0
    assert "up to 16 points per column by ring" in _warnings()[0][1]
    with np.load(scan_files(tmp_path / "out")[0]) as scan:
        assert set(scan["ring"].tolist()) == {0, 1, 2, 3}


# -- several lidars on a topic ---------------------------------------------------------------------


@pytest.mark.parametrize("apart", [0, 30 * MS])
def test_frames_separate_lidars_on_one_topic(shell: Shell, tmp_path: Path, apart: int) -> None:
    outcome = _run(shell, _two_frames(apart=apart), "--identity-extrinsics --strict")
    assert outcome.code == 0, outcome.err
    report = report_of("out/report.json")
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
    report = report_of("out/report.json")
    assert [(one["stream"], one["points"]["written"]) for one in report["sensors"]] == [
        (f"/points (lidar_id {lidar})", SWEEPS * COLUMNS * 4) for lidar in (0, 1, 3)
    ]
    for path in scan_files(tmp_path / "out"):
        with np.load(path) as scan:
            # Places of the sensors: 5, 15 and 35 m.
            expected = np.array([5.0, 15.0, 35.0])[scan["lidar_id"]]
            assert (scan["xyz"][:, 0] == expected).all()


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
    report = report_of("out/report.json")
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
