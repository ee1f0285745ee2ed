"""Mistakes with lidars of all vendors."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from mlbatch.simulate.hesai.encode import HesaiSpec, angles_csv, fan
from mlbatch.simulate.robosense.encode import RobosenseSpec
from mlbatch.simulate.velodyne.encode import VelodyneSpec
from mlbatch.simulate.velodyne.models import calibration_yaml
from tests.builders.bags import Recorded
from tests.builders.lidar_packets import device_payloads
from tests.builders.livox import LivoxSpec
from tests.builders.others import EE, filled
from tests.builders.points import CLOUD, OUSTER, cloud_message
from tests.builders.rosbag2 import write_rosbag2
from tests.builders.sessions import NS_PER_S, Shell, write_metadata
from tests.builders.transcripts import transcripts
from tests.builders.vendor_sessions import (
    BEGIN_NS,
    BEGIN_US,
    framed,
    hesai_csv,
    lidar_payloads,
    livox_payloads,
    ouster,
    robosense_csv,
    rslidar_messages,
    write_capture,
    write_rig,
)

VLP16 = VelodyneSpec("VLP-16", start_us=BEGIN_US)
XT16 = HesaiSpec("PandarXT-16")
P40 = HesaiSpec("Pandar40P")
QT64 = HesaiSpec("PandarQT64")
BPEARL = RobosenseSpec("Bpearl v4")
HELIOS = RobosenseSpec("Helios 16")
# Packets that suffice to be recognised, and those of more than a few windows.
FEW = 20
MANY = 400
PORT = 2368
RS_PORT = 6699
DIFOP_PORT = 7788
IP = "10.0.0.8"
OTHER_IP = "10.0.0.9"
VENDOR_MISTAKES = transcripts("vendors")

_PLACED = "extrinsics: {matrix: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}"
_LEFT = f"name: left, metadata: silent/111.json, stream: {{source_ip: 10.0.0.1}}, {_PLACED}"
_TOP = f"name: top, stream: {{source_ip: 10.0.0.8}}, {_PLACED}"

# Sensors of the rigs, by the name of the file.
RIGS: dict[str, tuple[str, ...]] = {
    "any": ("name: top",),
    "cloud_csv": ("name: top, stream: {topic: /points}, metadata: files/xt16.csv",),
    "firing": ("name: top, decode: {firing_azimuth: maybe}",),
    "helios32": ("name: top, model: Helios 32",),
    "lite": ("name: top, model: Puck LITE",),
    "livox": ("name: top, model: Livox SDK2",),
    "os1": ("name: top, model: OS1-32",),
    "rs16_csv": ("name: top, metadata: files/rs16.csv",),
    "serial": ('name: top, stream: {serial: "77"}',),
    "silent": (_LEFT, _TOP),
    "silent_csv": (_LEFT, f"{_TOP}, metadata: files/xt16.csv"),
    "silent_helios": (_LEFT, f"{_TOP}, model: Helios 16"),
    "silent_livox": (_LEFT, f"{_TOP}, model: Livox SDK2"),
    "silent_vlp16": (_LEFT, f"{_TOP}, model: VLP-16"),
    "two": (f"name: front, {_PLACED}", f"name: rear, {_PLACED}"),
    "same": (
        f"name: front, model: VLP-16, {_PLACED}",
        f"name: rear, stream: {{port: 2368}}, {_PLACED}",
    ),
    "vlp16": ("name: top, model: VLP-16",),
    "vlp32c": ("name: top, model: VLP-32C",),
    "hdl32e_yml": ("name: top, model: VLP-32C, metadata: files/hdl32e.yml",),
    "vlp32c_yml": ("name: top, metadata: files/vlp32c.yml",),
    "vlp61": ("name: top, model: VLP-61",),
    "small": ("name: top, model: vls-128",),
    "xt16": ("name: top, model: PandarXT-16",),
    "xt16_csv": ("name: top, metadata: files/xt16.csv",),
    "folder": ("name: top, metadata: files",),
}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with everything that the mistakes are made with."""
    folder = tmp_path_factory.mktemp("vendors")
    _write_velodyne(folder)
    _write_velodyne_sessions(folder)
    _write_hesai(folder)
    _write_robosense(folder)
    _write_others(folder)
    for name, texts in RIGS.items():
        write_rig(folder / f"{name}.yaml", *texts)
    return folder


def _write_velodyne(folder: Path) -> None:
    few = lidar_payloads(VLP16, FEW)
    many = lidar_payloads(VLP16, MANY)
    write_capture(folder / "vlp16", framed(many, IP, PORT))
    for name, model in (("vlp32c", "VLP-32C"), ("hdl64", "HDL-64E S3")):
        payloads = lidar_payloads(replace(VLP16, model=model), FEW)
        write_capture(folder / name, framed(payloads, IP, PORT))
    positions = device_payloads(VLP16)
    write_capture(folder / "positions", framed(positions, IP, 8308))
    alike = [(host_ns, payload + bytes(6)) for host_ns, payload in few]
    write_capture(folder / "alike", framed(alike, IP, PORT))
    dual = replace(VLP16, mode="dual", start_us=BEGIN_US + 532_000)
    changed = many + lidar_payloads(dual, MANY)
    write_capture(folder / "changed", framed(changed, IP, PORT))
    (folder / "files").mkdir()
    for name, model in (("vlp16", "VLP-16"), ("vlp32c", "VLP-32C"), ("hdl32e", "HDL-32E")):
        (folder / "files" / f"{name}.yml").write_text(calibration_yaml(model), encoding="utf-8")
    cut = calibration_yaml("VLP-16")[:400]
    (folder / "files" / "cut.yml").write_text(cut, encoding="utf-8")


def _write_velodyne_sessions(folder: Path) -> None:
    few = lidar_payloads(VLP16, FEW)
    behind_us = 20 * 60_000_000
    late = lidar_payloads(replace(VLP16, start_us=BEGIN_US + behind_us), FEW)
    late = [(host_ns - behind_us * 1000, payload) for host_ns, payload in late]
    other = framed(late, OTHER_IP, PORT)
    write_capture(folder / "apart", framed(few, IP, PORT), other)
    write_capture(folder / "twins", framed(few, IP, PORT), framed(few, OTHER_IP, PORT))
    write_capture(folder / "pair", framed(few, IP, PORT), ouster().records)
    silent = lidar_payloads(replace(VLP16, start_us=BEGIN_US + 12e6), FEW)
    write_capture(folder / "silent", ouster(125).records, framed(silent, IP, PORT))
    for name in ("pair", "silent"):
        write_metadata(folder / name / "111.json", ouster().spec)


def _write_hesai(folder: Path) -> None:
    few = lidar_payloads(XT16, FEW)
    for name in ("bare", "other", "alike", "broken"):
        write_capture(folder / f"xt16_{name}", framed(few, IP, PORT))
    hesai_csv(folder / "xt16_other" / "32.csv", 32)
    hesai_csv(folder / "xt16_alike" / "a.csv", 16)
    hesai_csv(folder / "xt16_alike" / "b.csv", 16)
    broken = "Laser id,Elevation,Azimuth\n1,15,zero\n"
    (folder / "xt16_broken" / "16.csv").write_text(broken, encoding="utf-8")
    write_capture(folder / "xt16_twins", framed(few, IP, PORT), framed(few, OTHER_IP, PORT))
    hesai_csv(folder / "xt16_twins" / "16.csv", 16)
    hesai_csv(folder / "files" / "xt16.csv", 16)
    write_capture(folder / "qt64", framed(lidar_payloads(QT64, FEW), IP, PORT))
    (folder / "files" / "p64.csv").write_bytes(angles_csv(*fan("Pandar64", 64)))
    gps = filled(512, {0: EE + b"712190403180", 18: b"$GPRMC"})
    write_capture(folder / "gps", framed([(BEGIN_NS, gps)], IP, 10110))
    many = lidar_payloads(XT16, MANY)
    dual = lidar_payloads(replace(XT16, mode="dual", start_ns=BEGIN_NS + 160_000_000), MANY)
    write_capture(folder / "xt16_changed", framed(many + dual, IP, PORT))
    hesai_csv(folder / "xt16_changed" / "16.csv", 16)
    later = lidar_payloads(replace(P40, start_ns=BEGIN_NS + 240_000_000), MANY)
    counted = [
        (host_ns, payload + number.to_bytes(4, "little"))
        for number, (host_ns, payload) in enumerate(later)
    ]
    write_capture(folder / "p40", framed(lidar_payloads(P40, MANY) + counted, IP, PORT))
    hesai_csv(folder / "p40" / "40.csv", 40, lowest_deg=-25.0)


def _write_robosense(folder: Path) -> None:
    many = lidar_payloads(HELIOS, MANY)
    device = device_payloads(HELIOS)
    write_capture(folder / "helios_bare", framed(many[:FEW], IP, RS_PORT))
    write_capture(folder / "helios", framed(many, IP, RS_PORT), framed(device, IP, DIFOP_PORT))
    write_capture(folder / "difop", framed(device, IP, DIFOP_PORT))
    write_capture(folder / "bpearl", framed(lidar_payloads(BPEARL, FEW), IP, RS_PORT))
    other = "".join(f"{15 - n * 40 / 31:.3f},0\n" for n in range(32))
    (folder / "files" / "rs32_other.csv").write_text(other, encoding="utf-8")
    robosense_csv(folder / "files" / "rs15.csv", 15)
    robosense_csv(folder / "files" / "rs16.csv", 16)
    robosense_csv(folder / "files" / "rs32.csv", 32)
    write_rosbag2(folder / "helios.db3", rslidar_messages(many + device))


def _write_others(folder: Path) -> None:
    uptime = LivoxSpec(time_type=0, start_ns=1000 * NS_PER_S)
    since_ns = BEGIN_NS - uptime.start_ns
    livox = [(host_ns + since_ns, payload) for host_ns, payload in livox_payloads(uptime, MANY)]
    write_capture(folder / "livox", framed(livox, IP, 56301), ouster().records)
    write_metadata(folder / "livox" / "111.json", ouster().spec)
    points = [(1.0, 2.0, 3.0, 9.0, n * 32_000_000, 1) for n in range(4)]
    clouds = [
        Recorded(
            "/points",
            CLOUD,
            BEGIN_NS + (number + 1) * NS_PER_S // 10,
            cloud_message(OUSTER, points, BEGIN_NS + number * NS_PER_S // 10),
        )
        for number in range(5)
    ]
    write_rosbag2(folder / "clouds.db3", clouds)
    raw = rslidar_messages(lidar_payloads(HELIOS, MANY) + device_payloads(HELIOS))
    write_rosbag2(folder / "both.db3", raw + clouds)


@pytest.mark.parametrize("name", VENDOR_MISTAKES)
def test_mistake_with_a_vendor(shell: Shell, place: Path, tmp_path: Path, name: str) -> None:
    VENDOR_MISTAKES[name].check_with(place, shell, tmp_path)
