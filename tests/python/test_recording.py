"""Opened recordings: sensors, scans, single scans, packets and IMU samples."""

from __future__ import annotations

import gzip
import math
import multiprocessing
import pickle
from collections.abc import Iterator
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import dpkt
import numpy as np
import pytest

import mlbatch
from mlbatch.errors import RecordingError, RigError, UsageError
from mlbatch.pipeline.job import Job
from mlbatch.python.options import output_job, session_job, window_job
from mlbatch.python.recording import Recording
from mlbatch.types import PacketBatch
from tests.builders.run import command
from tests.builders.sessions import CAPTURE, FIXTURE, RIG, Unit, twin, write_session
from tests.contract.tree import ROOT
from tests.python.test_dataset import assert_equal

FOUR_RIG = ROOT / "fixtures/four_makers/rig.yaml"
FIRST_NS = 1_777_881_600_100_000_000  # 2026-05-04T08:00:00.1Z, by SOURCE.md of the fixture
PERIOD_NS = 100_000_000


@pytest.fixture(scope="module")
def rec() -> Recording:
    return mlbatch.open(CAPTURE, rig=RIG)


def test_the_description_of_a_recording(rec: Recording) -> None:
    head, names, left, right = str(rec).splitlines()
    assert head == f"{CAPTURE}: pcap, 2.5 MB, 0.850 s"
    assert names.split() == ["sensor", "model", "mode", "streams", "calibration", "extrinsics"]
    assert left.split()[:2] == ["left", "OS-0-32-U1"]
    assert right.endswith("10.5.5.88 > port 7502  right.json   rig")
    assert repr(rec) == "<Recording two_lidars.pcap: left, right>"


def test_the_duration_is_that_of_the_packets(rec: Recording) -> None:
    with CAPTURE.open("rb") as file:
        times = [seconds for seconds, _ in dpkt.pcap.Reader(file)]
    assert rec.duration_s == pytest.approx(max(times) - min(times), abs=1e-6)


def test_long_recordings_are_not_read_by_print(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mlbatch.python.recording._MEASURED_BYTES", 1000)
    rec = mlbatch.open(CAPTURE, rig=RIG)
    assert "duration_s not measured yet" in str(rec)
    assert rec.duration_s > 0
    assert "0.850 s" in str(rec)


def test_sensors_have_the_extrinsics_of_the_rig(rec: Recording) -> None:
    """left of the rig: translation 0.3, 0.95, 2.45; its z axis stays a unit vector."""
    assert list(rec.sensors) == ["left", "right"]
    pose = rec.sensors["left"].extrinsics
    assert pose is not None
    np.testing.assert_array_equal(pose[:3, 3], [0.3, 0.95, 2.45])
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    assert rec.sensors["left"].extrinsics_source == "rig"
    assert (rec.sensors["right"].channels, rec.sensors["right"].returns) == (32, 1)


def test_unknown_extrinsics_are_an_error_of_scans_only(tmp_path: Path) -> None:
    unit = Unit()
    rec = mlbatch.open(write_session(tmp_path, unit, twin(unit, 7)))
    assert [one.extrinsics for one in rec.sensors.values()] == [None, None]
    assert "unknown" in str(rec)
    name = next(iter(rec.sensors))
    assert next(rec.packets(name)).data
    with pytest.raises(RigError, match="extrinsics"):
        next(rec.scans())


@pytest.mark.parametrize(
    ("recordings", "options", "sensors"),
    [
        # The right sensor is left out where its metadata are not given.
        (("two_lidars.pcap",), {"metadata": "left.json", "ignore": "122648000456"}, 1),
        (("two_lidars.pcap",), {"metadata": Path("left.json"), "ignore": ["122648000456"]}, 1),
        (("two_lidars.pcap",), {"metadata": ["left.json", "right.json"]}, 2),
        ((CAPTURE,), {"rig": str(RIG), "only": "right"}, 1),
        (([CAPTURE],), {"rig": RIG, "ignore": ["right"]}, 1),
        ((iter([str(CAPTURE)]),), {"rig": RIG}, 2),
    ],
)
def test_a_text_is_one_path(
    recordings: Any, options: dict[str, Any], sensors: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(FIXTURE)
    rec = mlbatch.open(*recordings, identity_extrinsics="rig" not in options, **options)
    assert len(rec.sensors) == len(next(rec.scans()).sensors) == sensors


# -- scans ----------------------------------------------------------------------------------------


# 08:00 UTC of the recording, a drive at 10 m/s along x.
TUM = "".join(
    f"{1_777_881_600 + hundredth // 100}.{hundredth % 100:02} {hundredth / 10} 0 0 0 0 0 1\n"
    for hundredth in range(-100, 300)
)
AS_BY_COMMAND: list[dict[str, Any]] = [
    {"rate": 20},
    {"deskew": "drive.tum", "deskew_to": "end"},
    {"batching": "latest", "batching_times": "own"},
]


def _command(output: str, options: dict[str, Any]) -> None:
    """Convert by the command."""
    words = [
        word
        for name, value in options.items()
        for word in (f"--{name.replace('_', '-')}", str(value))
    ]
    done = command("convert", CAPTURE, "--rig", RIG, "--quiet", "-o", output, *words)
    assert done.code == 0, done.err


@pytest.mark.parametrize("options", [*AS_BY_COMMAND, {"stamp": "middle"}])
def test_scans_and_outputs_are_those_of_the_command(
    rec: Recording, options: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("drive.tum").write_text(TUM, encoding="utf-8")
    _command("command.mcap", options)
    run = mlbatch.convert(rec, "python.mcap", **options)
    assert run.path == Path("python.mcap")
    assert Path("python.mcap").read_bytes() == Path("command.mcap").read_bytes()
    names = [path.name for path in sorted(tmp_path.glob("python*"))]
    assert names == ["python.mcap", "python.mcap.report.json", "python.mcap.scans.csv"]
    if "stamp" in options:
        # Of messages.
        return
    _command("scans", options)
    files = sorted(Path("scans").glob("*.npz"))
    for file, scan in zip(files, rec.scans(**options), strict=True):
        with np.load(file) as stored:
            for key in set(stored.files) - {"schema", *options}:
                np.testing.assert_array_equal(getattr(scan, key), stored[key], err_msg=key)


def test_each_pass_is_of_its_own(rec: Recording) -> None:
    one, other = rec.scans(), iter(rec)
    for _ in range(2):
        np.testing.assert_array_equal(next(one).xyz, next(other).xyz)
    assert [scan.index for scan in one] == [2, 3, 4, 5, 6]


def test_a_part_of_the_recording(rec: Recording) -> None:
    """Windows that start in [0.2 s, 0.4 s) after the first: 2 and 3."""
    for start, end in (
        ("+0.2s", "+0.4s"),
        ("+0.2", "+0.4"),
        (FIRST_NS + 2 * PERIOD_NS, FIRST_NS + 4 * PERIOD_NS),
        ("2026-05-04T08:00:00.3Z", "2026-05-04T10:00:00.5+02:00"),
    ):
        found = list(rec.scans(start=start, end=end))
        assert [scan.index for scan in found] == [2, 3], start
        assert found[0].start_ns == FIRST_NS + 2 * PERIOD_NS


def _without_middle(capture: Path) -> Path:
    """The capture without the packets of 0.35 s, so that windows have no column."""
    path = capture.with_name("gap.pcap")
    with CAPTURE.open("rb") as source, path.open("wb") as target:
        writer = dpkt.pcap.Writer(target, nano=True)
        begin_s = None
        for at_s, frame in dpkt.pcap.Reader(source):
            begin_s = begin_s or at_s
            if not 0.25 < at_s - begin_s < 0.6:
                writer.writepkt(frame, at_s)
    return path


def _opened(case: str, folder: Path) -> Recording:
    """A recording of a kind."""
    if case == "four_makers.pcap":
        return mlbatch.open(ROOT / "fixtures/four_makers" / case, rig=FOUR_RIG)
    if case == "moving.mcap":
        moving = ROOT / "fixtures/moving"
        return mlbatch.open(moving / case, rig=moving / "moving.rig.yaml")
    path = folder / case
    if case == "gap.pcap":
        _without_middle(path)
    elif case == "two_lidars.pcap.gz":
        path.write_bytes(gzip.compress(CAPTURE.read_bytes(), 1))
    else:
        mlbatch.extract(CAPTURE, path, rig=RIG)
        return mlbatch.open(path, rig=path.with_suffix(".rig.yaml"))
    return mlbatch.open(path, rig=RIG)


@pytest.mark.parametrize(
    "case",
    ["two_lidars.pcap.gz", "moving.mcap", "x.db3", "x.bag", "four_makers.pcap", "gap.pcap"],
)
def test_scans_by_number_are_those_in_order(case: str, tmp_path: Path) -> None:
    rec = _opened(case, tmp_path)
    whole = list(rec.scans())
    order = [0, 2, 3, len(whole) - 1, 1, 1, -1, -len(whole)]
    for number in order:
        assert_equal(rec[np.int64(number)], whole[number])
    assert len(rec) == len(whole) >= 4
    for part in (slice(1, 4, 2), slice(None, None, -2), slice(9, 3)):
        found = rec[part]
        assert [scan.index for scan in found] == [scan.index for scan in whole[part]]
        for one, other in zip(found, whole[part], strict=True):
            assert_equal(one, other)
    gaps = [later.index - earlier.index for earlier, later in pairwise(whole)]
    assert (max(gaps) > 1) == (case == "gap.pcap")


def test_other_processes_read_a_recording_on_their_own(rec: Recording) -> None:
    """File positions would be shared with a forked process."""
    assert rec[1].index == 1
    with multiprocessing.get_context("fork").Pool(2) as pool:
        found = pool.map(rec.__getitem__, [2, 3, 5], chunksize=1)
    assert rec[4].index == 4
    assert_equal(pickle.loads(pickle.dumps(rec))[5], found[-1])
    for scan, expected in zip(found, (2, 3, 5), strict=True):
        assert_equal(scan, rec[expected])


@pytest.mark.parametrize("rate", ["15", "10/3", "29.97"])
def test_a_scan_by_its_index_where_bounds_are_rounded(rate: str, tmp_path: Path) -> None:
    rig = tmp_path / "rig.yaml"
    text = RIG.read_text(encoding="utf-8").replace("metadata: ", f"metadata: {FIXTURE}/")
    assert "rate_hz: 10\n" in text
    rig.write_text(text.replace("rate_hz: 10\n", f"rate_hz: {rate}\n"), encoding="utf-8")
    rec = mlbatch.open(CAPTURE, rig=rig)
    for scan in rec.scans():
        assert rec[scan.index].start_ns == scan.start_ns
        assert rec.at(scan.start_ns).index == scan.index
        assert rec.at(scan.end_ns - 1).index == scan.index


@pytest.mark.parametrize("index", [-8, 7, 1000])
def test_an_index_without_a_scan(index: int, rec: Recording) -> None:
    with pytest.raises(IndexError, match=f"scan {index}: "):
        rec[index]


def test_the_scan_at_a_time(rec: Recording) -> None:
    start_ns = FIRST_NS + 3 * PERIOD_NS
    assert rec.at("2026-05-04T08:00:00.45Z").index == 3
    assert rec.at("+0.35").index == 3
    assert [rec.at(start_ns + ns).index for ns in (-1, 0, PERIOD_NS - 1, PERIOD_NS)] == [2, 3, 3, 4]
    # At 20 Hz the first scan is half a period earlier.
    assert [rec.at(start_ns, rate=20).index, rec.at("+0.35", rate=20).index] == [6 + 1, 7]


@pytest.mark.parametrize("moment", ["+5", "2026-05-04T08:00:01Z", FIRST_NS - PERIOD_NS])
def test_a_time_without_a_scan(moment: str | int, rec: Recording) -> None:
    with pytest.raises(RecordingError, match=r"expected a scan at .*, found none"):
        rec.at(moment)


def test_the_table_has_typed_columns(rec: Recording) -> None:
    table = rec.table()
    scans = list(rec.scans())
    assert table["index"].tolist() == list(range(7))
    assert table["points"].tolist() == [scan.point_count for scan in scans]
    assert table["complete"].all()
    assert {table.dtype[name].str for name in ("start_ns", "columns_left", "points")} == {"<i8"}
    assert table.dtype["coverage_left"].str == "<f8"


def test_scans_wait_for_nobody_to_ask(monkeypatch: pytest.MonkeyPatch, rec: Recording) -> None:
    """The file is read as far as the scans that are taken need it."""
    read: list[int] = []
    from mlbatch.pipeline.session import Session

    packets = Session.packets

    def counted(self: Session) -> Iterator[PacketBatch]:
        for batch in packets(self):
            read.append(1)
            yield batch

    monkeypatch.setattr(Session, "packets", counted)
    scans = rec.scans()
    assert read == []
    assert len(list(islice(scans, 1))) == 1


# -- packets --------------------------------------------------------------------------------------


def _payloads(source: str, port: int) -> list[tuple[int, bytes]]:
    """Payloads as another library reads the frames, with receive times in ns.

    Fragments are joined by their IP identification; the last one gives the time.
    """
    found = []
    parts: dict[int, bytes] = {}
    with CAPTURE.open("rb") as file:
        for seconds, frame in dpkt.pcap.Reader(file):
            ip = dpkt.ethernet.Ethernet(frame).data
            if not isinstance(ip, dpkt.ip.IP) or ".".join(map(str, ip.src)) != source:
                continue
            parts[ip.id] = parts.get(ip.id, b"") + bytes(ip.data)
            if not ip.mf:
                datagram = parts.pop(ip.id)
                if int.from_bytes(datagram[2:4], "big") == port:
                    found.append((round(float(seconds) * 1e9), datagram[8:]))
    return found


@pytest.mark.parametrize(("sensor", "source"), [("left", "10.5.5.87"), ("right", "10.5.5.88")])
def test_packets_are_the_payloads(sensor: str, source: str, rec: Recording) -> None:
    expected = _payloads(source, 7502)
    found = list(rec.packets(sensor))
    assert [packet.data for packet in found] == [data for _, data in expected]
    for packet, (host_ns, _) in zip(found, expected, strict=True):
        assert abs(packet.host_ns - host_ns) < 2000
    assert {packet.stream for packet in found} == {f"{source} > port 7502"}


def test_imu_samples(rec: Recording) -> None:
    """One sample a packet, at 100 Hz, as they lie in the output."""
    samples = list(rec.imu("left"))
    stamps = np.concatenate([one.stamp_ns for one in samples])
    assert len(stamps) == len(_payloads("10.5.5.87", 7503))
    np.testing.assert_allclose(np.diff(stamps), 10_000_000, atol=1_000_000)
    gravity = np.concatenate([one.acceleration for one in samples])
    assert np.linalg.norm(gravity, axis=1).mean() == pytest.approx(9.81, abs=0.5)


def test_packets_of_no_sensor(rec: Recording) -> None:
    for read in (rec.packets, rec.imu):
        with pytest.raises(UsageError, match="expected one of left, right, found 'top'"):
            next(iter(read("top")))


# -- values of options ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        *(({"start": start}, "start: expected ") for start in (1.5, True, "tomorrow")),
        ({"layout": "flat"}, "layout: expected dense or organized, found 'flat'"),
        ({"drop_incomplete": 101}, "drop_incomplete: expected a number from 0 to 100, found 101; "),
        ({"exclude_boxes": [(0, 0, 0, 1, 1)]}, "exclude_boxes: expected"),
        ({"min_range": math.nan}, "min_range: expected a number of 0 or more, found nan; "),
        ({"min_range": "0.5"}, "min_range: expected a number of 0 or more, found '0.5'"),
        ({"max_range": None}, "max_range: expected a number of 0 or more, found None"),
        ({"drop_incomplete": True}, "drop_incomplete: expected a number from 0 to 100, found True"),
        ({"max_wait": "never"}, "max_wait: expected seconds above 0, or inf, found 'never'"),
        ({"max_wait": None}, "max_wait: expected seconds above 0, or inf, found None"),
        ({"exclude_boxes": [("a", "b")]}, "exclude_boxes: expected"),
        ({"start": "+2", "end": "+1"}, "end: expected a time after start"),
        ({"deskew": "constant-velocity", "start": "+1"}, "expected the recording from its begin"),
        ({"deskew": "missing.tum"}, "--deskew: expected imu, constant-velocity or the file"),
        ({"deskew_to": "end"}, "--deskew-to: expected --deskew, which moves points"),
        ({"deskew": "imu", "deskew_to": "later"}, "deskew_to: expected start or middle or end"),
        ({"batching": "newest"}, "batching: expected window or latest or approximate or collate"),
        ({"batching_times": "own"}, "batching-times: expected common for windows, found own"),
        *(
            ({"max_wait": seconds}, "max_wait: expected seconds above 0, or inf, found ")
            for seconds in (math.nan, 0.0, -1.0, -math.inf)
        ),
        *(
            ({"min_range": low_m, "max_range": high_m}, r"m(in|ax)_range: expected ")
            for low_m, high_m in ((-1.0, 2.0), (math.nan, 2.0), (3.0, 2.0), (3.0, math.nan))
        ),
        *(
            ({"slices": slices}, "slices: expected a whole number from 1 to 10000, found ")
            for slices in (0, 2.5, 2.0, 10_001, "2", None)
        ),
    ],
)
def test_impossible_values(options: dict[str, object], expected: str, rec: Recording) -> None:
    with pytest.raises(UsageError, match=expected):
        rec.scans(**options)  # type: ignore[arg-type]
    with pytest.raises(UsageError, match=expected):
        mlbatch.scans(CAPTURE, rig=RIG, **options)  # type: ignore[arg-type]


def test_defaults_of_the_table_are_those_of_a_job() -> None:
    assert output_job(window_job(session_job(CAPTURE, {}), {}), {}) == Job((CAPTURE,))


def test_a_path_of_another_type() -> None:
    with pytest.raises(UsageError, match=r"recording: expected a path .*, found int"):
        mlbatch.open(3)  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="recording: expected at least one path, found none"):
        mlbatch.open()
