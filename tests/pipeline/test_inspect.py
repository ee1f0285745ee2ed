"""`mlbatch inspect`: table, JSON, notes, and the rig file it writes."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mlbatch
from mlbatch.errors import RigError
from mlbatch.rig.rig import read_rig
from mlbatch.simulate.velodyne.encode import VelodyneSpec
from tests.builders.captures import udp_frame
from tests.builders.sessions import (
    CAPTURE,
    NS_PER_MS,
    NS_PER_S,
    SMALL,
    Shell,
    Unit,
    arrays,
    twin,
    write_metadata,
    write_session,
)
from tests.builders.vendor_sessions import framed, lidar_payloads, write_capture

LEFT = "ouster_122647000123"
RIGHT = "ouster_122648000456"


def _streams(shell: Shell, arguments: str) -> list[dict[str, Any]]:
    outcome = shell(f"inspect {arguments} --json")
    assert (outcome.code, outcome.err) == (0, "")
    document = json.loads(outcome.out)
    assert document["schema"] == "mlbatch.inspect/1"
    streams: list[dict[str, Any]] = document["streams"]
    return streams


def test_the_table_of_the_fixture(shell: Shell) -> None:
    outcome = shell(f"inspect {CAPTURE}")
    assert (outcome.code, outcome.err) == (0, "")
    table_text, recordings, clocks, poses = outcome.out.split("\n\n")
    assert poses == f"poses: not checked (the pose of {LEFT}, {RIGHT} is not known)\n"
    head, *rows = table_text.splitlines()
    starts = [head.index(word) for word in head.split()]
    ends = [*starts[1:], None]
    cells = [[row[a:b].strip() for a, b in zip(starts, ends, strict=True)] for row in [head, *rows]]
    assert " ".join(cells[0]) == (
        "stream what sensor packets Hz lost seconds clock calibration extrinsics missing"
    )
    table = {row[0]: row[1:] for row in cells[1:]}
    # Packets, rates and spans by fixtures/two_lidars/SOURCE.md.
    model = "OS-0-32-U1 512x10 RNG19_RFL8_SIG16_NIR16"
    lidar = table["10.5.5.87 > port 7502"]
    assert lidar[:6] == [model, LEFT, "271", "320.0", "0", "0.844"]
    assert lidar[6].startswith("utc -")
    assert lidar[7:] == ["left.json", "", ""]
    imu = table["10.5.5.87 > port 7503"]
    assert imu == ["Ouster IMU", LEFT, "85", "100.0", "", "0.840", "", "", "", ""]
    assert table["10.5.5.88 > port 7503"][1] == RIGHT
    assert table["10.5.5.20 > port 5353"][:3] == ["unknown", "", "2"]
    assert len(table) == 5
    assert re.match(r"clocks: synchronised within \d\.\d+ ms\n", clocks)
    assert clocks.count("clock: UTC, -") == 2
    # Size of the file; times of its first and last frame, 20.150 ms and 869.839 ms.
    lines = [re.split(r" {2,}", line) for line in recordings.splitlines()]
    assert lines[0] == ["recording", "container", "MB", "start", "seconds"]
    assert lines[1:] == [[str(CAPTURE), "pcap", "2.5", "2026-05-04T08:00:00.020Z", "0.850"]]


def test_loss_and_clock_of_an_unsynchronised_lidar(shell: Shell, tmp_path: Path) -> None:
    unit = Unit(begin_ns=1000 * NS_PER_S, host_ns=1_700_000_000 * NS_PER_S)
    capture = write_session(tmp_path, unit)
    raw = capture.read_bytes()
    gone = slice(24 + 10 * 1338, 24 + 13 * 1338)
    capture.write_bytes(raw[: gone.start] + raw[gone.stop :])
    outcome = shell(f"inspect {capture}")
    # The newest of 512 columns a revolution of 0.1 s, at its end.
    assert "uptime -1700000000.000 s" in outcome.out
    assert "since power-on, -1700000000.000195 s to the capture host" in outcome.out
    (stream,) = _streams(shell, str(capture))
    assert (stream["packets"], stream["lost"], stream["timescale"]) == (93, 3, "uptime")


def test_a_stream_without_metadata(shell: Shell, tmp_path: Path) -> None:
    capture = write_session(tmp_path, Unit(), metadata=False)
    (stream,) = _streams(shell, str(capture))
    assert (stream["sensor"], stream["missing"]) == ("", "metadata")
    assert stream["what"] == "Ouster lidar, serial 111, 1280 bytes: needs its metadata"
    outcome = shell(f"inspect {capture}")
    assert outcome.out.splitlines()[-1] == (
        "note: no lidar with its metadata; files examined: none"
    )


@pytest.mark.parametrize(
    ("name", "head"), [("a.mcap", b"\x89MCAP0\r\n"), ("a.bag", b"#ROSBAG V2.0\n")]
)
def test_a_recording_of_nothing_but_damage_is_an_error(
    shell: Shell, tmp_path: Path, name: str, head: bytes
) -> None:
    (tmp_path / name).write_bytes(head + bytes(1 << 20))
    outcome = shell("inspect", tmp_path / name)
    assert (outcome.code, outcome.out) == (1, "")
    begin = f"mlbatch: error: {tmp_path / name}: expected packets or messages, found none ("
    assert outcome.err.startswith(begin)
    assert f"byte {len(head)}: " in outcome.err


def test_only_the_first_ten_seconds_are_read(shell: Shell, tmp_path: Path) -> None:
    capture = write_session(tmp_path, Unit(turns=110))
    (stream,) = _streams(shell, str(capture))
    # Packets come every 3.125 ms; one of them just 10 s after the first.
    assert stream["packets"] == 10_000 * 1000 // 3125 + 1


def test_extrinsics_of_the_metadata_are_shown_and_written(shell: Shell, tmp_path: Path) -> None:
    pose = [0.0, -1.0, 0.0, 1.5, 1.0, 0.0, 0.0, -0.25, 0.0, 0.0, 1.0, 2.0, 0.0, 0.0, 0.0, 1.0]
    capture = write_session(tmp_path, Unit(spec=replace(SMALL, extrinsic_m=pose)))
    (stream,) = _streams(shell, str(capture))
    assert stream["extrinsics"] == "metadata"
    assert shell(f"inspect {capture} --write-rig rig.yaml").code == 0
    (sensor,) = read_rig(Path("rig.yaml")).sensors
    np.testing.assert_array_equal(sensor.extrinsics, np.reshape(pose, (4, 4)))


def test_extrinsics_nobody_gave_are_written_as_unknown_and_refused(shell: Shell) -> None:
    written = shell(f"inspect {CAPTURE} --write-rig rig.yaml")
    assert (written.code, written.err) == (0, "")
    assert written.out.splitlines()[-1] == "wrote rig.yaml"
    lines = Path("rig.yaml").read_text().splitlines()
    places = [number for number, line in enumerate(lines, 1) if line == "    extrinsics: unknown"]
    assert len(places) == 2
    comment = (
        "  # extrinsics not known: replace `unknown` by {translation_m: [x, y, z], "
        "rotation_rpy_deg: [r, p, y]}; a guess within 1 m and 20 degrees is refined by mlbatch "
        "calibrate"
    )
    assert lines.count(comment) == 2
    refused = shell(f"convert {CAPTURE} --rig rig.yaml -o out")
    assert (refused.code, refused.out) == (1, "")
    assert refused.err == (
        f"mlbatch: error: rig.yaml:{places[0]}: sensors[0].extrinsics: expected the pose of "
        f"{LEFT}, required for every sensor when there are two or more, found unknown (also of "
        f"{RIGHT}); give translation_m and a rotation (a guess is enough for `mlbatch calibrate`, "
        "which refines it), or accept the body origin "
        "with --identity-extrinsics\n"
    )
    assert not Path("out").exists()
    with pytest.raises(RigError, match=rf"rig.yaml:{places[0]}: sensors\[0\].extrinsics: "):
        next(mlbatch.scans(CAPTURE, rig="rig.yaml"))
    # Poses play no part in a comparison.
    assert shell(f"compare {CAPTURE} --rig rig.yaml").code == 0


def test_the_rig_gives_the_same_scans(shell: Shell) -> None:
    assert shell(f"inspect {CAPTURE} --write-rig rig.yaml").code == 0
    with_rig = shell(f"convert {CAPTURE} --rig rig.yaml --identity-extrinsics -o with-rig")
    assert (with_rig.code, with_rig.warnings) == (0, ["identity_extrinsics"])
    found = shell(f"convert {CAPTURE} --identity-extrinsics -o found")
    assert (found.code, found.warnings) == (0, ["identity_extrinsics"])
    names = sorted(path.name for path in Path("found").iterdir())
    for name in names:
        if name != "report.json":
            assert Path("with-rig", name).read_bytes() == Path("found", name).read_bytes()
    assert names.count("000006.npz") == 1


def test_a_single_lidar_of_unknown_extrinsics_stays_in_its_own_frame(
    shell: Shell, tmp_path: Path
) -> None:
    capture = write_session(tmp_path, Unit())
    assert shell(f"inspect {capture} --write-rig rig.yaml").code == 0
    assert "    extrinsics: unknown\n" in Path("rig.yaml").read_text()
    assert shell(f"convert {capture} -o found").code == 0
    done = shell(f"convert {capture} --rig rig.yaml -o with-rig")
    assert (done.code, done.err) == (0, "")
    found = arrays("found/000000.npz")
    with_rig = arrays("with-rig/000000.npz")
    assert str(with_rig["frame_id"]) == "ouster_111"
    assert found.keys() == with_rig.keys()
    for key in found:
        np.testing.assert_array_equal(found[key], with_rig[key])
    # One of two, too.
    capture = write_session(tmp_path / "two", Unit(), twin(Unit(), 222))
    assert shell(f"inspect {capture} --write-rig two.yaml").code == 0
    assert shell(f"convert {capture} --rig two.yaml -o out").code == 1
    assert shell(f"convert {capture} --rig two.yaml --only ouster_222 -o out").code == 0
    assert str(arrays("out/000000.npz")["frame_id"]) == "ouster_222"


def test_no_rig_is_written_of_nothing(shell: Shell, tmp_path: Path) -> None:
    capture = write_session(tmp_path, Unit(), metadata=False)
    outcome = shell(f"inspect {capture} --write-rig rig.yaml")
    assert outcome.code == 1
    assert outcome.err == (
        "mlbatch: error: --write-rig: expected at least one lidar with its metadata, found none; "
        "give --metadata FILE\n"
    )
    assert not Path("rig.yaml").exists()


def test_a_rig_of_legacy_lidars_names_their_addresses(shell: Shell, tmp_path: Path) -> None:
    old = Unit(spec=replace(SMALL, profile="LEGACY"))
    other = replace(old, ip="10.0.0.2", spec=replace(old.spec, serial=222, beams=32))
    capture = write_session(tmp_path, old, other)
    assert shell(f"inspect {capture} --write-rig rig.yaml").code == 0
    first, second = read_rig(Path("rig.yaml")).sensors
    assert (first.name, str(first.stream)) == ("ouster_111", "source_ip 10.0.0.1, port 7502")
    assert (second.name, str(second.stream)) == ("ouster_222", "source_ip 10.0.0.2, port 7502")
    assert shell(f"convert {capture} --rig rig.yaml --identity-extrinsics -o out").code == 0


def test_the_order_of_sensors_is_that_of_serial_numbers(shell: Shell, tmp_path: Path) -> None:
    first = Unit(spec=replace(SMALL, serial=1000), ip="10.0.0.9")
    early = twin(replace(first, begin_ns=first.begin_ns - NS_PER_MS), 999, "10.0.0.8")
    capture = write_session(tmp_path, first, early)
    shell(f"inspect {capture} --write-rig rig.yaml")
    names = [sensor.name for sensor in read_rig(Path("rig.yaml")).sensors]
    assert names == ["ouster_999", "ouster_1000"]


# -- the whole recording ------------------------------------------------------------------------


def _long_session(folder: Path) -> Path:
    """12.8 s of a lidar that loses 5 packets after 11 s; others that begin after 10.5 s."""
    unit = Unit(turns=128)
    records = unit.records
    begin_ns = unit.begin_ns
    late_ns = begin_ns + 10_500 * NS_PER_MS
    # 320 packets a second.
    kept = [one for number, one in enumerate(records) if not 3600 <= number < 3605]
    foreign = [
        (late_ns + number * 100 * NS_PER_MS, udp_frame(b"x" * 100, "10.0.0.9", dport=9000)[0])
        for number in range(11)
    ]
    other = twin(replace(unit, begin_ns=late_ns, turns=10), 222)
    return write_session(folder, more=[*kept, *foreign, *other.records])


@pytest.fixture(scope="module")
def long_session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("long")
    write_metadata(folder / "111.json", SMALL)
    return _long_session(folder)


def test_all_figures_are_of_the_whole_recording(shell: Shell, long_session: Path) -> None:
    outcome = shell(f"inspect {long_session} --whole --json")
    document = json.loads(outcome.out)
    assert document["whole"] is True
    streams = {one["stream"]: one for one in document["streams"]}
    lidar = streams["10.0.0.1 > port 7502"]
    assert (lidar["packets"], lidar["lost"]) == (128 * 32 - 5, 5)
    span_s = (lidar["last_host_ns"] - lidar["first_host_ns"]) / NS_PER_S
    # From the first packet to the last of 4096, 3.125 ms apart.
    assert span_s == pytest.approx(4095 * 0.003125, abs=1e-6)
    assert lidar["rate_hz"] == pytest.approx((128 * 32 - 6) / span_s)
    foreign = streams["10.0.0.9 > port 9000"]
    assert (foreign["packets"], foreign["what"], foreign["sensor"]) == (11, "unknown", "")
    assert foreign["rate_hz"] == pytest.approx(10)
    other = streams["10.0.0.2 > port 7502"]
    assert (other["packets"], other["sensor"]) == (320, "")
    (note,) = document["notes"]
    assert note.startswith("10.0.0.2 > port 7502: Ouster")
    assert "it started after the first 10 s" in note


def test_without_the_option_all_figures_are_of_ten_seconds(
    shell: Shell, long_session: Path
) -> None:
    document = json.loads(shell(f"inspect {long_session} --json").out)
    assert (document["whole"], document["notes"]) == (False, [])
    (lidar,) = document["streams"]
    assert lidar["lost"] == 0
    assert 3150 < lidar["packets"] < 3250
    assert lidar["last_host_ns"] - lidar["first_host_ns"] < 10.1 * NS_PER_S


def test_the_whole_of_a_short_recording_is_its_first_seconds(shell: Shell) -> None:
    ten = json.loads(shell(f"inspect {CAPTURE} --json").out)
    whole = json.loads(shell(f"inspect {CAPTURE} --whole --json").out)
    assert {**ten, "whole": True} == whole


@pytest.mark.parametrize("whole", ["", "--whole"])
def test_loss_is_that_of_a_conversion(shell: Shell, tmp_path: Path, whole: str) -> None:
    """Also of a sensor whose packets carry no number, among duplicates and damaged timestamps."""
    spec = VelodyneSpec("VLP-16", "strongest")
    sent = lidar_payloads(spec, 800)
    lost = {200, 201, 500}
    kept = [one for number, one in enumerate(sent) if number not in lost]
    at_ns, payload = kept[300]
    # The last six bytes are the timestamp, us of the hour, and two factory bytes.
    kept[300] = at_ns, payload[:-6] + (3_000_000_000).to_bytes(4, "little") + payload[-2:]
    kept.insert(100, kept[99])
    capture = write_capture(tmp_path, framed(kept, "10.0.0.9", 2368))
    (stream,) = json.loads(shell(f"inspect {capture} --json {whole}").out)["streams"]
    outcome = shell(f"convert {capture} --identity-extrinsics --dry-run --quiet --keep-partial")
    (sensor,) = json.loads(outcome.out)["sensors"]
    assert sensor["packets"]["rejected"] == {"bad_stamp": 1, "duplicate": 1}
    # The damaged packet is missing, too, where packets are counted by their timestamps.
    assert stream["lost"] == sensor["packets"]["lost"] == len(lost) + 1
