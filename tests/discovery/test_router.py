"""Assignment of packets to sensors by their content, whatever port and address they come from."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest

from tests.builders.captures import udp_frame
from tests.builders.sessions import (
    EPOCH_NS,
    NS_PER_MS,
    NS_PER_S,
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
PACKETS = 96  # 3 revolutions
IDENTITY = "--identity-extrinsics"


@pytest.fixture
def convert(shell: Shell) -> Convert:
    """The report of a dry run."""

    def run(arguments: str) -> Report:
        outcome = shell(f"convert {arguments} --dry-run --keep-partial")
        assert outcome.code == 0, outcome.err
        report: Report = json.loads(outcome.out)
        return report

    return run


def _read(report: Report) -> dict[str, int]:
    return {sensor["name"]: sensor["packets"]["read"] for sensor in report["sensors"]}


def _rig(folder: Path, sensors: Sequence[str]) -> Path:
    rig = folder / "rig.yaml"
    lines = [
        f"- {{{sensor}, extrinsics: {{translation_m: [{x_m}, 0, 0]}}}}\n"
        for x_m, sensor in enumerate(sensors)
    ]
    rig.write_text("sensors:\n" + "".join(lines))
    return rig


# Warnings of other tests.
OTHERS = ("rejected", "loss", "identity_extrinsics")


@dataclass(frozen=True)
class Case:
    """A session and its report.

    without: serial numbers without a metadata file; rig: its sensors; read, imu: packets by
    sensor; unassigned: stream, packets and the beginning of the description; warnings: code,
    sensor and message.
    """

    units: Sequence[Unit]
    read: Mapping[str, int]
    more: Records = field(default_factory=list)
    without: Sequence[int] = ()
    rig: Sequence[str] = ()
    options: str = ""
    streams: Sequence[str] = ()
    imu: Mapping[str, int] = field(default_factory=dict)
    rejected: Mapping[str, int] = field(default_factory=dict)
    unassigned: Sequence[tuple[str, int, str]] = ()
    warnings: Sequence[tuple[str, str, str]] = ()


ONE = Unit()
LONG = Unit(turns=130)
LEGACY = Unit(spec=replace(SMALL, profile="LEGACY"))
AFTER_12_S = ONE.begin_ns + 12 * NS_PER_S
# Another port for its packets and those of its IMU.
MOVED_PORTS = Unit(spec=replace(SMALL, serial=222, imu_port=7603), port=7602)
NEEDS_METADATA = "Ouster lidar, serial {}, 1280 bytes: needs its metadata"
NOT_SEEN = ("not_seen_yet", "rear", "no packet of it in the first 10 seconds")
UNASSIGNED = (
    "unassigned",
    "",
    "10.0.0.1 > port 7502: expected packets of ouster_111, found "
    f"{NEEDS_METADATA.format(333)} as well; {PACKETS} packets are counted as unassigned; give the "
    "--metadata of that lidar, or leave it out with --ignore SERIAL",
)
HELLO = udp_frame(b"hello", "10.0.0.9", dport=9000)[0]
CUT = [
    (host_ns, udp_frame(payload[:1000], ONE.ip, dport=ONE.port)[0])
    for host_ns, payload in ONE.payloads[5:8]
]


def _not_in_rig(ip: str, serial: int) -> tuple[str, str, str]:
    return (
        "not_in_rig",
        "",
        f"{ip} > port 7502: {NEEDS_METADATA.format(serial)}; expected a sensor of the rig, found "
        "none for it; its packets are counted as unassigned; add it to the rig, or leave it out "
        f"with --ignore {ip}",
    )


CASES = {
    "two on one port": Case(
        (ONE, twin(ONE, 222)),
        {"ouster_111": PACKETS, "ouster_222": PACKETS},
        options=IDENTITY,
        streams=("10.0.0.1 > port 7502", "10.0.0.2 > port 7502"),
    ),
    # A switch that hides addresses: the serial number in every packet is enough.
    "two from one address and port": Case(
        (ONE, twin(ONE, 222, ONE.ip)),
        {"ouster_111": PACKETS, "ouster_222": PACKETS},
        options=IDENTITY,
    ),
    # Within the first 10 s and after them, by its serial number.
    "one that moves to other addresses": Case(
        (
            ONE,
            replace(ONE, ip="10.0.0.7", begin_ns=ONE.begin_ns + 300 * NS_PER_MS, first_frame=8),
            replace(ONE, ip="10.0.0.8", begin_ns=ONE.begin_ns + 20 * NS_PER_S, first_frame=205),
        ),
        {"ouster_111": 3 * PACKETS},
    ),
    **{
        f"one without metadata, {option}": Case(
            (ONE, twin(ONE, 333)),
            {"ouster_111": PACKETS},
            without=(333,),
            options=option,
            unassigned=(
                (
                    "10.0.0.2 > port 7502",
                    PACKETS,
                    f"ignored: {NEEDS_METADATA.format(333)} (1280 bytes)",
                ),
            ),
        )
        for option in ("--ignore 10.0.0.2:7502", "--ignore 333", "--only ouster_111")
    },
    "an unknown serial number on the stream of a lidar": Case(
        (ONE, twin(ONE, 333, ONE.ip)),
        {"ouster_111": PACKETS},
        without=(333,),
        unassigned=(("10.0.0.1 > port 7502", PACKETS, "Ouster lidar, serial 333"),),
        warnings=(UNASSIGNED,),
    ),
    **{
        f"a lidar that the user leaves out, as {word}": Case(
            (ONE, twin(ONE, 333, ip)),
            {"ouster_111": PACKETS},
            without=(333,),
            options=f"--strict --ignore {word}",
            unassigned=((f"{ip} > port 7502", PACKETS, "ignored: Ouster lidar, serial 333"),),
        )
        for ip, word in (
            (ONE.ip, "333"),
            ("10.0.0.2", "333"),
            ("10.0.0.2", "10.0.0.2"),
            ("10.0.0.2", "10.0.0.2:7502"),
        )
    },
    "one of two from one address is left out": Case(
        (ONE, twin(ONE, 222, ONE.ip)),
        {"ouster_111": PACKETS},
        options="--strict --ignore ouster_222",
        unassigned=(("10.0.0.1 > port 7502", PACKETS, "ignored: Ouster lidar, serial 222"),),
    ),
    "a sensor that is left out by its address": Case(
        (ONE, twin(ONE, 222)),
        {"ouster_111": PACKETS},
        options="--strict --ignore 10.0.0.2",
        unassigned=(("10.0.0.2 > port 7502", PACKETS, "ignored: Ouster lidar, serial 222"),),
    ),
    "three from one address, one is left out, one has no metadata": Case(
        (ONE, twin(ONE, 222, ONE.ip), twin(ONE, 333, ONE.ip)),
        {"ouster_111": PACKETS},
        without=(333,),
        options="--ignore 222",
        unassigned=(
            ("10.0.0.1 > port 7502", PACKETS, "Ouster lidar, serial 333"),
            ("10.0.0.1 > port 7502", PACKETS, "ignored: Ouster lidar, serial 222"),
        ),
        warnings=(UNASSIGNED,),
    ),
    "one that begins late": Case(
        (ONE, replace(twin(ONE, 222), begin_ns=AFTER_12_S)),
        {"ouster_111": PACKETS},
        unassigned=(
            (
                "10.0.0.2 > port 7502",
                PACKETS,
                f"not seen in the first 10 s: {NEEDS_METADATA.format(222)} (1280 bytes)",
            ),
        ),
        warnings=(
            (
                "late_stream",
                "",
                f"10.0.0.2 > port 7502: {NEEDS_METADATA.format(222)}; it started after the "
                "first 10 s, in which sensors are detected; its packets are counted as "
                "unassigned; name the sensor in a rig file (--rig)",
            ),
        ),
    ),
    "other late packets": Case(
        (ONE,),
        {"ouster_111": PACKETS},
        more=[(EPOCH_NS + 15 * NS_PER_S, HELLO)],
        unassigned=(("10.0.0.9 > port 9000", 1, "not seen in the first 10 s: unknown (5 bytes)"),),
    ),
    "packets of a wrong size": Case(
        (ONE,), {"ouster_111": PACKETS + 3}, more=CUT, rejected={"bad_size": 3}
    ),
    "IMU packets by address": Case(
        (ONE, twin(ONE, 222)),
        {"ouster_111": PACKETS, "ouster_222": PACKETS},
        more=ONE.imu_records(5) + twin(ONE, 222).imu_records(3),
        options=IDENTITY,
        imu={"ouster_111": 5, "ouster_222": 3},
    ),
    "IMU packets on the port of the lidar": Case(
        (ONE,),
        {"ouster_111": PACKETS},
        more=ONE.imu_records(4, port=ONE.port),
        imu={"ouster_111": 4},
    ),
    "IMU packets at one address by port": Case(
        (ONE, MOVED_PORTS),
        {"ouster_111": PACKETS, "ouster_222": PACKETS},
        more=ONE.imu_records(5, 7503) + MOVED_PORTS.imu_records(3, 7603) + ONE.imu_records(2, 9999),
        options=IDENTITY,
        imu={"ouster_111": 5, "ouster_222": 3},
        unassigned=(("10.0.0.1 > port 9999", 2, "Ouster IMU (48 bytes)"),),
    ),
    "a lidar without metadata that is not in the rig": Case(
        (ONE, twin(ONE, 333)),
        {"front": PACKETS},
        without=(333,),
        rig=('name: front, stream: {serial: "111"}',),
        unassigned=(("10.0.0.2 > port 7502", PACKETS, "not_in_rig: Ouster lidar, serial 333"),),
        warnings=(_not_in_rig("10.0.0.2", 333),),
    ),
    "lidars that are not in the rig": Case(
        (ONE, twin(ONE, 222), replace(twin(ONE, 444, "10.0.0.4"), begin_ns=AFTER_12_S)),
        {"front": PACKETS},
        rig=('name: front, stream: {serial: "111"}',),
        unassigned=(
            ("10.0.0.2 > port 7502", PACKETS, "not_in_rig: Ouster lidar, serial 222"),
            ("10.0.0.4 > port 7502", PACKETS, "not seen in the first 10 s: Ouster lidar"),
        ),
        warnings=(_not_in_rig("10.0.0.2", 222), _not_in_rig("10.0.0.4", 444)),
    ),
    "lidars that are not in the rig and left out": Case(
        (ONE, twin(ONE, 222), replace(twin(ONE, 444, "10.0.0.4"), begin_ns=AFTER_12_S)),
        {"front": PACKETS},
        rig=('name: front, stream: {serial: "111"}',),
        options="--strict --ignore 222 --ignore 10.0.0.4",
        unassigned=(
            ("10.0.0.2 > port 7502", PACKETS, "ignored: Ouster lidar, serial 222"),
            ("10.0.0.4 > port 7502", PACKETS, "ignored: not seen in the first 10 s: Ouster lidar"),
        ),
    ),
    **{
        f"one of the rig that begins late, by {stream}": Case(
            (LONG, replace(twin(LONG, 222), begin_ns=AFTER_12_S, turns=10)),
            {"front": 130 * 32, "rear": 10 * 32},
            rig=(
                'name: front, stream: {serial: "111"}, metadata: 111.json',
                f"name: rear, stream: {{{stream}}}, metadata: 222.json",
            ),
            warnings=(NOT_SEEN,),
        )
        for stream in ('serial: "222"', "source_ip: 10.0.0.2")
    },
    "an optional one that is missing": Case(
        (Unit(turns=20),),
        {"front": 20 * 32, "rear": 0},
        rig=(
            'name: front, stream: {serial: "111"}',
            "name: rear, stream: {source_ip: 10.0.0.2}, metadata: 111.json, optional: true",
        ),
        warnings=(NOT_SEEN,),
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_packets_are_assigned(convert: Convert, tmp_path: Path, name: str) -> None:
    case = CASES[name]
    capture = write_session(tmp_path, *case.units, more=case.more)
    for serial in case.without:
        (tmp_path / f"{serial}.json").unlink()
    rig = f"--rig {_rig(tmp_path, case.rig)}" if case.rig else ""
    report = convert(f"{capture} {case.options} {rig}")
    assert _read(report) == case.read
    sensors = report["sensors"]
    if case.streams:
        assert [sensor["stream"] for sensor in sensors] == list(case.streams)
    assert {one["name"]: one["imu_packets"] for one in sensors if one["imu_packets"]} == case.imu
    assert sensors[0]["packets"]["rejected"] == case.rejected
    unassigned = report["unassigned"]
    assert [(one["stream"], one["packets"]) for one in unassigned] == [
        one[:2] for one in case.unassigned
    ]
    for found, (_, _, start) in zip(unassigned, case.unassigned, strict=True):
        assert found["what"].startswith(start)
    noted = [(one["code"], one["sensor"], one["message"]) for one in report["warnings"]]
    # Rejected packets are asserted by their counts.
    # Lidars of which packets are missing have a warning of their own.
    assert [one for one in noted if one[0] not in OTHERS] == list(case.warnings)
    for sensor in sensors:
        assert (sensor["columns"]["written"] > 0) == (sensor["packets"]["read"] > 0)


def test_without_an_optional_sensor_no_scan_is_complete(convert: Convert, tmp_path: Path) -> None:
    """All are written nevertheless."""
    case = CASES["an optional one that is missing"]
    capture = write_session(tmp_path, *case.units)
    scans = convert(f"{capture} --rig {_rig(tmp_path, case.rig)}")["scans"]
    assert scans["incomplete"] == scans["written"] == 21


@pytest.mark.parametrize("profile", ["RNG15_RFL8_NIR8", "LEGACY"])
def test_the_extra_byte_of_old_drivers_is_accepted(
    convert: Convert, tmp_path: Path, profile: str
) -> None:
    plain = Unit(spec=replace(SMALL, profile=profile))
    first = convert(str(write_session(tmp_path / "plain", plain)))
    second = convert(str(write_session(tmp_path / "longer", replace(plain, tail=b"\xa5"))))
    assert _read(second) == {"ouster_111": PACKETS}
    assert second["sensors"] == first["sensors"]
    assert second["scans"] == first["scans"]


def test_given_metadata_replace_the_search(convert: Convert, tmp_path: Path) -> None:
    capture = write_session(tmp_path, ONE, twin(ONE, 222))
    other = write_metadata(tmp_path / "elsewhere.json", replace(SMALL, serial=222))
    report = convert(f"{capture} --metadata {other} --ignore 111")
    assert _read(report) == {"ouster_222": PACKETS}
    assert report["sensors"][0]["calibration"].endswith("elsewhere.json")
    assert report["warnings"] == []


def test_a_rig_separates_equal_lidars_without_serial_numbers_by_address(
    convert: Convert, tmp_path: Path
) -> None:
    near = replace(LEGACY, range_mm=4000)
    capture = write_session(tmp_path, near, replace(twin(near, 222), range_mm=7000))
    rig = _rig(
        tmp_path,
        (
            "name: far, stream: {source_ip: 10.0.0.2}, metadata: 222.json",
            "name: near, stream: {source_ip: 10.0.0.1, port: 7502}, metadata: 111.json",
        ),
    )
    report = convert(f"{capture} --rig {rig}")
    assert _read(report) == {"far": PACKETS, "near": PACKETS}
    assert [sensor["stream"][:8] for sensor in report["sensors"]] == ["10.0.0.2", "10.0.0.1"]
    # Points nearer than 5 m are those of the first lidar.
    cut = convert(f"{capture} --rig {rig} --min-range 5")
    assert [sensor["points"]["written"] > 0 for sensor in cut["sensors"]] == [True, False]
