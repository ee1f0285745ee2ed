"""Which packets are whose: by what they carry, whatever port and address they come from."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.builders.captures import udp_frame
from tests.builders.sessions import (
    EPOCH_NS,
    NO_RECORDINGS,
    NS_PER_MS,
    NS_PER_S,
    RECORDINGS,
    SMALL,
    Records,
    Shell,
    Unit,
    twin,
    write_metadata,
    write_session,
)

Report = dict[str, Any]
Convert = Callable[[str], Report]
OUSTER = RECORDINGS / "ouster"
needs_recordings = pytest.mark.skipif(not RECORDINGS.is_dir(), reason=NO_RECORDINGS)
LEGACY = replace(SMALL, profile="LEGACY")
PACKETS = 96  # 3 turns


@pytest.fixture
def convert(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> Convert:
    """The report of a dry run."""
    monkeypatch.chdir(tmp_path)
    shell = Shell(monkeypatch, capsys)

    def run(arguments: str) -> Report:
        outcome = shell(f"convert {arguments} --dry-run --keep-partial")
        assert outcome.code == 0, outcome.err
        report: Report = json.loads(outcome.out)
        return report

    return run


def _read(report: Report) -> dict[str, int]:
    return {sensor["name"]: sensor["packets"]["read"] for sensor in report["sensors"]}


def _unassigned(report: Report) -> list[tuple[str, int, str]]:
    return [(row["stream"], row["packets"], row["what"]) for row in report["unassigned"]]


def _codes(report: Report) -> list[str]:
    return [warning["code"] for warning in report["warnings"]]


def _rig(folder: Path, *sensors: str) -> Path:
    rig = folder / "rig.yaml"
    here = "extrinsics: {translation_m: [0, 0, 0]}"
    lines = [f"- {{{sensor}, {here}}}\n" for sensor in sensors]
    rig.write_text("sensors:\n" + "".join(lines))
    return rig


# -- without a rig --------------------------------------------------------------------------------


def test_two_lidars_on_one_port(convert: Convert, tmp_path: Path) -> None:
    one = Unit()
    capture = write_session(tmp_path, one, twin(one, 222))
    report = convert(f"{capture} --identity-extrinsics")
    assert _read(report) == {"ouster_111": PACKETS, "ouster_222": PACKETS}
    assert [sensor["stream"] for sensor in report["sensors"]] == [
        "10.0.0.1 > port 7502",
        "10.0.0.2 > port 7502",
    ]


def test_two_lidars_from_one_address_and_port(convert: Convert, tmp_path: Path) -> None:
    """A switch that hides addresses: the serial number in every packet is enough."""
    one = Unit()
    capture = write_session(tmp_path, one, twin(one, 222, one.ip))
    assert _read(convert(f"{capture} --identity-extrinsics")) == {
        "ouster_111": PACKETS,
        "ouster_222": PACKETS,
    }


def test_a_lidar_that_moves_to_another_address(convert: Convert, tmp_path: Path) -> None:
    """Within the first 10 s and after them, since its serial number proves it."""
    one = Unit()
    soon = replace(one, ip="10.0.0.7", begin_ns=one.begin_ns + 300 * NS_PER_MS, first_frame=8)
    late = replace(one, ip="10.0.0.8", begin_ns=one.begin_ns + 20 * NS_PER_S, first_frame=205)
    capture = write_session(tmp_path, one, soon, late)
    report = convert(str(capture))
    assert _read(report) == {"ouster_111": 3 * PACKETS}
    assert _unassigned(report) == []


def test_a_lidar_without_metadata_is_told_and_counted(convert: Convert, tmp_path: Path) -> None:
    one = Unit()
    capture = write_session(tmp_path, one, twin(one, 333))
    (tmp_path / "333.json").unlink()
    report = convert(str(capture))
    assert _read(report) == {"ouster_111": PACKETS}
    what = "Ouster lidar, serial 333, 1280 bytes: needs its metadata (1280 bytes)"
    assert _unassigned(report) == [("10.0.0.2 > port 7502", PACKETS, what)]
    assert _codes(report) == ["no_metadata"]


def test_an_unknown_serial_number_among_the_packets_of_a_lidar(
    convert: Convert, tmp_path: Path
) -> None:
    one = Unit()
    capture = write_session(tmp_path, one, twin(one, 333, one.ip))
    (tmp_path / "333.json").unlink()
    report = convert(str(capture))
    assert _read(report) == {"ouster_111": PACKETS}
    assert [row[:2] for row in _unassigned(report)] == [("10.0.0.1 > port 7502", PACKETS)]


def test_a_lidar_that_begins_late_is_told_and_counted(convert: Convert, tmp_path: Path) -> None:
    one = Unit(turns=3)
    late = replace(twin(one, 222), begin_ns=one.begin_ns + 12 * NS_PER_S)
    capture = write_session(tmp_path, one, late)
    report = convert(str(capture))
    assert _read(report) == {"ouster_111": PACKETS}
    what = "Ouster lidar, serial 222, 1280 bytes: needs its metadata"
    assert _unassigned(report) == [
        ("10.0.0.2 > port 7502", PACKETS, f"not seen in the first 10 s: {what} (1280 bytes)")
    ]
    assert report["warnings"] == [
        {
            "code": "late_stream",
            "sensor": "",
            "message": f"10.0.0.2 > port 7502: {what}; it began after the first 10 s, where "
            "sensors are looked for, so that its packets are counted as unassigned; name the "
            "sensor in a rig file (--rig)",
        }
    ]


def test_other_late_traffic_is_counted_without_a_warning(convert: Convert, tmp_path: Path) -> None:
    frame = udp_frame(b"hello", "10.0.0.9", dport=9000)[0]
    capture = write_session(tmp_path, Unit(), more=[(EPOCH_NS + 15 * NS_PER_S, frame)])
    report = convert(str(capture))
    assert _unassigned(report) == [
        ("10.0.0.9 > port 9000", 1, "not seen in the first 10 s: unknown (5 bytes)")
    ]
    assert report["warnings"] == []


@pytest.mark.parametrize("profile", ["RNG15_RFL8_NIR8", "LEGACY"])
def test_the_extra_byte_of_old_drivers_is_accepted(
    convert: Convert, tmp_path: Path, profile: str
) -> None:
    plain = Unit(spec=replace(SMALL, profile=profile))
    one = write_session(tmp_path / "plain", plain)
    two = write_session(tmp_path / "longer", replace(plain, tail=b"\xa5"))
    first, second = convert(str(one)), convert(str(two))
    assert _read(second) == {"ouster_111": PACKETS}
    assert second["sensors"] == first["sensors"]
    assert second["scans"] == first["scans"]


def test_packets_of_a_wrong_size_are_rejected(convert: Convert, tmp_path: Path) -> None:
    one = Unit()
    cut: Records = [
        (host_ns, udp_frame(payload[:1000], one.ip, dport=one.port)[0])
        for host_ns, payload in one.payloads[5:8]
    ]
    capture = write_session(tmp_path, one, more=cut)
    report = convert(str(capture))
    assert _read(report) == {"ouster_111": PACKETS + 3}
    assert report["sensors"][0]["packets"]["rejected"] == {"bad_size": 3}


def test_given_metadata_replace_the_search(convert: Convert, tmp_path: Path) -> None:
    one = Unit()
    capture = write_session(tmp_path, one, twin(one, 222))
    other = write_metadata(tmp_path / "elsewhere.json", replace(SMALL, serial=222))
    report = convert(f"{capture} --metadata {other}")
    assert _read(report) == {"ouster_222": PACKETS}
    assert report["sensors"][0]["calibration"].endswith("elsewhere.json")
    assert _codes(report) == ["no_metadata"]


def test_foreign_files_beside_the_recording_do_no_harm(convert: Convert, tmp_path: Path) -> None:
    capture = write_session(tmp_path, Unit())
    for name, text in (("a.json", "{}"), ("b.json", "no json"), ("c.json", '{"sensor_info": 1}')):
        (tmp_path / name).write_text(text)
    report = convert(str(capture))
    assert (_read(report), _codes(report)) == ({"ouster_111": PACKETS}, [])


# -- IMU packets ----------------------------------------------------------------------------------


def _imu(report: Report) -> dict[str, int]:
    return {sensor["name"]: sensor["imu_packets"] for sensor in report["sensors"]}


def test_imu_packets_belong_to_the_lidar_at_their_address(convert: Convert, tmp_path: Path) -> None:
    one = Unit()
    two = twin(one, 222)
    more = one.imu_records(5) + two.imu_records(3)
    report = convert(f"{write_session(tmp_path, one, two, more=more)} --identity-extrinsics")
    assert _imu(report) == {"ouster_111": 5, "ouster_222": 3}


def test_imu_packets_on_the_port_of_the_lidar(convert: Convert, tmp_path: Path) -> None:
    one = Unit()
    report = convert(str(write_session(tmp_path, one, more=one.imu_records(4, port=one.port))))
    assert (_read(report), _imu(report)) == ({"ouster_111": PACKETS}, {"ouster_111": 4})


def test_imu_packets_of_twins_at_one_address_are_told_by_port(
    convert: Convert, tmp_path: Path
) -> None:
    one = Unit()
    other = Unit(spec=replace(SMALL, serial=222, imu_port=7603), port=7602)
    more = one.imu_records(5, 7503) + other.imu_records(3, 7603) + one.imu_records(2, 9999)
    report = convert(f"{write_session(tmp_path, one, other, more=more)} --identity-extrinsics")
    assert _imu(report) == {"ouster_111": 5, "ouster_222": 3}
    assert _unassigned(report) == [("10.0.0.1 > port 9999", 2, "Ouster IMU (48 bytes)")]


# -- with a rig -----------------------------------------------------------------------------------


def _twins(folder: Path) -> Path:
    """Two equal lidars whose packets name nobody."""
    one = Unit(spec=LEGACY, range_mm=4000)
    return write_session(folder, one, replace(twin(one, 222), range_mm=7000))


def test_a_rig_tells_legacy_twins_by_address(convert: Convert, tmp_path: Path) -> None:
    capture = _twins(tmp_path)
    rig = _rig(
        tmp_path,
        "name: far, stream: {source_ip: 10.0.0.2}, metadata: 222.json",
        "name: near, stream: {source_ip: 10.0.0.1, port: 7502}, metadata: 111.json",
    )
    report = convert(f"{capture} --rig {rig}")
    assert _read(report) == {"far": PACKETS, "near": PACKETS}
    assert [sensor["stream"][:8] for sensor in report["sensors"]] == ["10.0.0.2", "10.0.0.1"]
    # Points nearer than 5 m are those of the first lidar.
    cut = convert(f"{capture} --rig {rig} --min-range 5")
    assert [sensor["points"]["written"] > 0 for sensor in cut["sensors"]] == [True, False]


def test_a_lidar_that_is_not_in_the_rig_is_counted_in_silence(
    convert: Convert, tmp_path: Path
) -> None:
    one = Unit()
    late = replace(twin(one, 444, "10.0.0.4"), begin_ns=one.begin_ns + 12 * NS_PER_S)
    capture = write_session(tmp_path, one, twin(one, 222), late)
    rig = _rig(tmp_path, 'name: front, stream: {serial: "111"}')
    report = convert(f"{capture} --rig {rig}")
    assert (_read(report), _codes(report)) == ({"front": PACKETS}, [])
    assert [row[:2] for row in _unassigned(report)] == [
        ("10.0.0.2 > port 7502", PACKETS),
        ("10.0.0.4 > port 7502", PACKETS),
    ]
    assert _unassigned(report)[0][2].startswith("not_in_rig: Ouster lidar, serial 222")


@pytest.mark.parametrize("stream", ['serial: "222"', "source_ip: 10.0.0.2"])
def test_a_lidar_of_the_rig_that_begins_late_joins(
    convert: Convert, tmp_path: Path, stream: str
) -> None:
    one = Unit(turns=130)
    late = replace(twin(one, 222), begin_ns=one.begin_ns + 12 * NS_PER_S, turns=10)
    capture = write_session(tmp_path, one, late)
    rig = _rig(
        tmp_path,
        'name: front, stream: {serial: "111"}, metadata: 111.json',
        f"name: rear, stream: {{{stream}}}, metadata: 222.json",
    )
    report = convert(f"{capture} --rig {rig}")
    assert _read(report) == {"front": 130 * 32, "rear": 10 * 32}
    assert report["warnings"] == [
        {
            "code": "not_seen_yet",
            "sensor": "rear",
            "message": "no packet of it in the first 10 seconds",
        }
    ]
    assert all(sensor["columns"]["written"] > 0 for sensor in report["sensors"])


def test_an_optional_lidar_may_be_missing(convert: Convert, tmp_path: Path) -> None:
    capture = write_session(tmp_path, Unit(turns=20))
    rig = _rig(
        tmp_path,
        'name: front, stream: {serial: "111"}',
        "name: rear, stream: {source_ip: 10.0.0.2}, metadata: 111.json, optional: true",
    )
    report = convert(f"{capture} --rig {rig}")
    assert _read(report) == {"front": 20 * 32, "rear": 0}
    assert _codes(report) == ["not_seen_yet"]
    # Without it no window is complete, but all are written.
    assert report["scans"]["incomplete"] == report["scans"]["written"] == 21


# -- real recordings ------------------------------------------------------------------------------


@needs_recordings
@pytest.mark.parametrize("kind", ["legacy", "nonlegacy"])
def test_two_real_lidars_on_one_port(convert: Convert, kind: str) -> None:
    case = OUSTER / f"two-sensors_same-ports_{kind}" / f"same_ports_{kind}.pcap"
    report = convert(f"{case} --identity-extrinsics --clock host")
    found = {
        sensor["name"]: (sensor["stream"], sensor["packets"]["accepted"], sensor["imu_packets"])
        for sensor in report["sensors"]
    }
    imu = 1 if kind == "nonlegacy" else 0
    assert found == {
        "ouster_122239000672": ("169.254.238.111 > port 7502", 1, imu),
        "ouster_122247000785": ("169.254.92.158 > port 7502", 1, imu),
    }
    assert report["unassigned"] == []


@needs_recordings
def test_extrinsics_files_of_the_maker_do_not_pass_for_metadata(convert: Convert) -> None:
    folder = OUSTER / "os0-128_v2.3.0_rng15"
    report = convert(str(folder / "OS-0-128-U1_v2.3.0_1024x10.pcap"))
    assert _read(report) == {"ouster_122150000150": 64}
