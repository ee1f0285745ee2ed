"""Ledgers, scans.csv, report.json and the summary."""

from __future__ import annotations

import csv
import io
import json
import os
from dataclasses import replace

import numpy as np
import pytest

from mlbatch.reports.ledger import SensorLedger, check_capture
from mlbatch.reports.report import (
    ClockReport,
    ForwardedMessages,
    InputReport,
    RunReport,
    SensorReport,
    Timing,
    Unassigned,
    Warned,
    imbalances,
    report_of,
    report_text,
)
from mlbatch.reports.scan_table import ScanTable
from mlbatch.types import CaptureCounts
from tests.builders.scans import PERIOD_NS, START_NS, dense_scan, run_info


def ledger() -> SensorLedger:
    """A ledger that balances, every counter different."""
    counts = SensorLedger()
    counts.packets.read = 110
    counts.packets.accepted = 100
    counts.packets.reject("duplicate", 7)
    counts.packets.reject("bad_size", 2)
    counts.packets.reject("bad_size")
    counts.packets.lost = 4
    counts.packets.reordered = 5
    counts.columns.decoded = 1600
    counts.columns.written = 1500
    counts.columns.drop("late", 100)
    counts.columns.drop("tail", 0)
    points = counts.points
    points.slots = 6000
    points.no_return = 1000
    points.range = 300
    points.box = 200
    points.repeated = 0
    points.written = 4500
    counts.imu_packets = 9
    return counts


def run() -> RunReport:
    """A whole run, with timings."""
    table = ScanTable(run_info())
    table.add(dense_scan(0))
    table.add(dense_scan(1))
    capture = CaptureCounts(131, 121)
    capture.skip("fragment_lost", 3)
    capture.skip("not_ip", 7)
    clock = ClockReport("sensor", "ptp", 12.5, None, ("notes",))
    sensor = SensorReport(
        *("left", "OS1-4", 0, "10.0.0.1 > port 7502", "1024x10"),
        ledger(),
        0.75,
        *(clock, "rig", np.eye(4), "left.json"),
    )
    return RunReport(
        inputs=(InputReport("/data/a.pcap", 1000, "pcap"),),
        timescale="utc",
        rate_hz="10",
        t_init_ns=START_NS,
        slices=1,
        sort="columns",
        capture=capture,
        sensors=(sensor,),
        scans=table.statistics(empty=3),
        unassigned=(Unassigned("10.0.0.9 > port 53", 2, "unknown"),),
        timing=Timing(2.0, 1.9, 0.1, 0.2, 0.3, 0.4, 10.0, 1e6, 123.0, "numpy"),
        warnings=(Warned("loss", "left", "4 packets lost"),),
    )


def test_balanced_ledgers_have_nothing_to_say() -> None:
    assert imbalances(run()) == []


@pytest.mark.parametrize(
    ("part", "name"),
    [
        ("packets", "read"),
        ("packets", "accepted"),
        ("columns", "decoded"),
        ("columns", "written"),
        *(("points", name) for name in ("slots", "no_return", "range", "box", "repeated")),
        ("points", "written"),
        ("imu_samples", "decoded"),
        ("imu_samples", "written"),
    ],
)
def test_every_counter_tips_its_ledger(part: str, name: str) -> None:
    counts = ledger()
    counter = getattr(counts, part)
    setattr(counter, name, getattr(counter, name) + 1)
    [line] = counts.check()
    assert line.startswith(part.replace("imu_", "IMU "))


def test_messages_that_nobody_accounts_for_are_found() -> None:
    passed = ForwardedMessages("/imu", 10, 6, {"no_place": 4})
    assert imbalances(run()._replace(messages=(passed,))) == []
    assert imbalances(run()._replace(messages=(passed, passed._replace(written=5)))) == [
        "messages of /imu: expected 10 accounted for, found 5 + 4"
    ]


@pytest.mark.parametrize("repeated", [0, 4, -3])
def test_datagrams_that_reach_no_sensor_are_found(repeated: int) -> None:
    """110 lidar packets, 9 of an IMU and 2 of no sensor."""
    counted = run()._replace(capture=CaptureCounts(121 - repeated, 121 - repeated))
    assert imbalances(counted._replace(repeated=repeated)) == []
    assert imbalances(counted._replace(repeated=repeated + 1)) == [
        "datagrams: expected 122 accounted for, found 110 + 9 + 2"
    ]


def test_unknown_reasons_are_found() -> None:
    counts = ledger()
    counts.packets.reject("mood", 1)
    counts.packets.read += 1
    assert counts.check() == ["packets: unknown reason 'mood'"]
    capture = CaptureCounts(10, 8, {"not_udp": 1})
    assert check_capture(capture) == ["frames: expected 10 accounted for, found 8 + 1"]


def test_table_of_scans_by_hand() -> None:
    table = ScanTable(run_info())
    table.add(dense_scan(0, points=3, columns=4), 0xCBF43926)
    table.add(replace(dense_scan(-1, points=1, columns=1), complete=False))
    rows = list(csv.reader(io.StringIO(table.text())))
    assert ",".join(rows[0]) == (
        "index,slice,start_ns,end_ns,first_stamp_ns,last_stamp_ns,points,columns,"
        "columns_left,columns_right,complete,max_gap_ns_left,max_gap_ns_right,"
        "coverage_left,coverage_right,overlap_left,overlap_right,missing_left,missing_right,"
        "fill_left,fill_right,checksum,ready_host_ns"
    )
    start = START_NS
    end = START_NS + PERIOD_NS
    last = start + 75_000_000  # four columns, 25 ms apart
    times = [start, end, start, last]
    # Nothing is known of rotors here, nor of what the sensors should have sent; see `dense_scan`.
    rest = [*["0.000"] * 4, "NaN", "NaN", 1.0, 0.75]
    ends = [*rest, 3421780262, end + 7]
    assert rows[1] == list(map(str, [0, 0, *times, 3, 4, 2, 2, "true", 5, 6, *ends]))
    times = [start - PERIOD_NS, start, start - PERIOD_NS, start - PERIOD_NS]
    ends = [*rest, -1, start + 7]
    assert rows[2] == list(map(str, [-1, 0, *times, 1, 1, 1, 0, "false", 5, 6, *ends]))
    assert len(rows) == 3


def test_sensors_of_one_window_share_a_row() -> None:
    left = replace(dense_scan(points=2, columns=4), columns_per_sensor=(4, 0), max_gap_ns=(8, 0))
    left = replace(left, coverage=(0.75, 0.0), overlap=(0.25, 0.0))
    later = left.column_stamp_ns + 10_000_000
    right = replace(left, columns_per_sensor=(0, 4), max_gap_ns=(0, 9), column_stamp_ns=later)
    right = replace(right, coverage=(0.0, 1.0), overlap=(0.0, 0.5))
    # 70 and 40 columns a second are 7 and 4 in a window of 0.1 s.
    table = ScanTable(run_info(), (70.0, 40.0))
    table.add(left, 0xFFFFFFFF)
    table.add(replace(right, complete=False), 3)
    _, row = csv.reader(io.StringIO(table.text()))
    last = START_NS + 85_000_000
    turns = ["0.750", "1.000", "0.250", "0.500", 3, 0, 1.0, 0.75]
    assert row[4:] == list(
        map(str, [START_NS, last, 4, 8, 4, 4, "false", 8, 9, *turns, 2, START_NS + PERIOD_NS + 7])
    )
    assert table.statistics(0).written == 1


@pytest.mark.parametrize("scans", [1, 63, 64, 65, 128, 129, 1000])
def test_tables_have_a_row_for_every_window(scans: int) -> None:
    table = ScanTable(run_info())
    for index in range(scans):
        for points in (1, 2):
            table.add(dense_scan(index, points=points, columns=4))
            assert table.rows == index + 1
    rows = list(csv.reader(io.StringIO(table.text())))[1:]
    assert [int(row[0]) for row in rows] == list(range(scans))
    assert {row[6] for row in rows} == {"3"}
    found = table.statistics(0)
    assert (found.written, found.points) == (scans, 3 * scans)
    assert found.period_ms.max == (100.0 if scans > 1 else None)


def test_statistics_by_hand() -> None:
    table = ScanTable(run_info())
    # Columns 0 to 98 ms; window 3 is empty: the step from 2 to 4 still is 100 ms a window.
    for index in (0, 1, 2, 4):
        table.add(dense_scan(index, points=10, columns=50))
    found = table.statistics(empty=1)
    assert (found.written, found.empty, found.incomplete, found.points) == (4, 1, 1, 40)
    assert (found.span_ms.p50, found.span_ms.p99, found.span_ms.max) == (98.0, 98.0, 98.0)
    assert (found.period_ms.p50, found.period_ms.max) == (100.0, 100.0)


def test_report_has_the_contract_s_form() -> None:
    report = json.loads(report_text(run()))
    assert list(report) == [
        *("schema", "version", "inputs", "timescale", "grid", "capture", "unassigned"),
        *("sensors", "messages", "scans", "timing", "warnings"),
    ]
    assert report["schema"] == "mlbatch.report/1"
    assert report["inputs"] == [{"path": "/data/a.pcap", "bytes": 1000, "container": "pcap"}]
    assert report["grid"] == {
        "rate_hz": "10",
        "period_ns": "100000000",
        "t_init_ns": START_NS,
        "slices": 1,
        "sort": "columns",
    }
    assert list(report["capture"]["skipped"].items()) == [("not_ip", 7), ("fragment_lost", 3)]
    [sensor] = report["sensors"]
    assert sensor["packets"] == {
        "read": 110,
        "accepted": 100,
        "rejected": {"bad_size": 3, "duplicate": 7},
        "lost": 4,
        "reordered": 5,
    }
    assert list(sensor["packets"]["rejected"]) == ["bad_size", "duplicate"]
    assert sensor["columns"] == {"decoded": 1600, "written": 1500, "dropped": {"late": 100}}
    assert list(sensor["points"].values()) == [6000, 1000, 300, 200, 0, 4500, 0]
    assert sensor["clock"]["offset_to_host_ms"] == 12.5
    assert sensor["extrinsics"] == {"source": "rig", "body_from_sensor": np.eye(4).tolist()}
    assert report["scans"]["empty"] == 3
    assert list(report["timing"]) == [
        *("wall_s", "cpu_s", "read_s", "decode_s", "merge_s", "write_s", "recorded_s"),
        *("realtime_factor", "points_per_s", "peak_rss_mb", "engine"),
    ]
    assert report["timing"]["realtime_factor"] == 5.0
    assert report["warnings"][0]["code"] == "loss"


def test_a_period_that_is_no_whole_number_is_a_fraction() -> None:
    report = json.loads(report_text(run()._replace(rate_hz="15")))
    assert report["grid"]["period_ns"] == "200000000/3"


def test_without_machine_nothing_depends_on_timings_or_paths() -> None:
    text = report_text(run(), machine=False)
    moved = (InputReport("/elsewhere/b.pcap", 1000, "pcap"),)
    other = run()._replace(inputs=moved, timing=Timing(9, 8, 7, 6, 5, 4, 3, 2, 1, "native"))
    assert report_text(other, machine=False) == text
    assert "timing" not in text
    assert "path" not in text


def test_names_that_are_no_text_come_back() -> None:
    """A file name of two bytes that are not UTF-8."""
    name = os.fsdecode(b"/data/\xff\xfe.pcap")
    text = report_text(run()._replace(inputs=(InputReport(name, 1000, "pcap"),)))
    assert json.loads(text.encode("utf-8"))["inputs"][0]["path"] == name


# -- read back ------------------------------------------------------------------------------------


def test_a_report_is_read_into_what_it_was_written_from() -> None:
    text = report_text(run())
    found = report_of("report.json", text)
    assert report_text(found) == text
    assert found.sensors[0].ledger == ledger()
    assert found.sensors[0].clock == run().sensors[0].clock
    assert found.scans == run().scans


def test_what_a_report_lacks_is_empty() -> None:
    """As reports of earlier versions, and damaged ones."""
    sensor = {"name": "left", "packets": {"read": "many"}, "points": [], "clock": 5}
    found = RunReport.from_json({"sensors": [sensor, None], "scans": "x", "timing": {}})
    assert [one.name for one in found.sensors] == ["left", ""]
    assert found.sensors[0].ledger == SensorLedger()
    assert found.sensors[0].body_from_sensor.shape == (0,)
    assert (found.scans.written, found.timing, found.recorded_s) == (0, None, 0.0)
