"""Outputs of the tool have no violation, and what a format shows is checked.

Both fixtures in every format, layout and preset; unusual lidars: ranges of an HDL-64E begin
elsewhere, a Ruby gives each return its own column, a PandarQT64 has the longest columns.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from mlbatch.outputs.stored_scan import COLUMN_NS
from mlbatch.verification import CHECKS, Verdict, verify
from tests.builders.captures import udp_frame, write_pcap
from tests.builders.points import STAMP_NS, VELODYNE, cloud_message, write_points
from tests.builders.rosbag2 import write_rosbag2
from tests.builders.run import ROOT, command
from tests.golden.test_bag_sessions import SESSIONS
from tests.golden.test_every_model import (
    HOST,
    RIG,
    RIG_METADATA,
    SOURCE,
    Sent,
    hesai_sent,
    robosense_sent,
    velodyne_sent,
)

FIXTURES = ("two_lidars", "four_makers")
ROUNDS: tuple[tuple[str, ...], ...] = (
    (),
    ("--slices", "3"),
    ("--split",),
    ("--keep-partial", "--rate", "20"),
    ("--split", "--slices", "2", "--keep-partial", "--rate", "30/7"),
)
FORMS: dict[str, tuple[str, ...]] = {
    "npz": (),
    "npz organized": ("--layout", "organized"),
    "ply": ("--format", "ply"),
    "mcap": ("--format", "mcap"),
    "mcap organized": ("--format", "mcap", "--layout", "organized"),
    "mcap zstd": ("--format", "mcap", "--compression", "zstd"),
    "rosbag2": ("--format", "rosbag2"),
    "rosbag2 lz4": ("--format", "rosbag2", "--compression", "lz4"),
    "rosbag1": ("--format", "rosbag1"),
}
PRESETS = ("velodyne", "ouster", "hesai", "autoware", "kiss-icp", "minimal")
SUFFIX = {"mcap": ".mcap", "rosbag1": ".bag"}
# Checks with values in each format, of merged scans at the standard layout.
MESSAGES = set(CHECKS) - {"names", "geometry", "duplicates", "messages"}
CHECKED = {
    "npz": set(CHECKS) - {"stamps", "tf_static", "frames", "imu", "messages"},
    "ply": set(CHECKS)
    - {"stamps", "tf_static", "frames", "imu", "messages", "geometry", "duplicates"},
    "mcap": MESSAGES,
    "rosbag2": MESSAGES | {"names"},
    "rosbag1": MESSAGES,
}


def converted(folder: Path, fixture: str, name: str, *words: str) -> Verdict:
    """The verdict on a conversion of a fixture."""
    source = ROOT / "fixtures" / fixture
    target = folder / f"out{SUFFIX.get(name, '')}"
    rig = ("--rig", source / "rig.yaml", "--quiet", "--overwrite")
    run = command("convert", source / f"{fixture}.pcap", "-o", target, *rig, *words)
    assert (run.code, run.err) == (0, "")
    return verify(target)


@pytest.mark.parametrize("fixture", FIXTURES)
@pytest.mark.parametrize("form", FORMS)
def test_fixtures_are_clean(form: str, fixture: str, tmp_path: Path) -> None:
    name = form.split()[0]
    for words in ROUNDS:
        verdict = converted(tmp_path, fixture, name, *FORMS[form], *words)
        assert verdict.ok, (words, verdict.violations)
        # The Velodyne, the HESAI and the ROBOSENSE of the other fixture have no IMU packets.
        if not words and fixture == "two_lidars":
            checked = {check.name for check in verdict.checks if check.checked}
            assert checked == CHECKED[name]


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_are_clean(preset: str, tmp_path: Path) -> None:
    for words in ((), ("--layout", "organized"), ("--split",)):
        layout = ("--point-layout", preset, *words)
        verdict = converted(tmp_path, "two_lidars", "mcap", *layout)
        assert verdict.ok, (words, verdict.violations)
        assert verdict.format == f"mcap, {preset}"


ODD: dict[str, Callable[[], Sent]] = {
    "HDL-64E": lambda: velodyne_sent("HDL-64E S3", "dual"),
    "Ruby": lambda: robosense_sent("Ruby 128", "dual"),
    "QT64": lambda: hesai_sent("PandarQT64", "39"),
    "JT128": lambda: hesai_sent("JT128", "37"),
    "Airy": lambda: robosense_sent("Airy 96", "strongest"),
}


@pytest.mark.parametrize("name", ODD)
def test_odd_lidars_are_clean(name: str, tmp_path: Path) -> None:
    sent = ODD[name]()
    longest_ns = int((sent.seen.firing_ns - sent.seen.stamp_ns[:, None]).max())
    assert 5 * longest_ns < COLUMN_NS
    path = recorded(sent, tmp_path)
    words: tuple[str | Path, ...] = ("--metadata", tmp_path / sent.file) if sent.file else ()
    if sent.is_named:
        words = ("--rig", tmp_path / "rig.yaml")
    for layout in ("dense", "organized"):
        target = tmp_path / layout
        more = ("--rate", "20", "--keep-partial", "--layout", layout)
        run = command("convert", path, "-o", target, *words, *more)
        assert run.code == 0, run.err
        verdict = verify(target)
        assert verdict.ok, verdict.violations
        assert verdict.points > 0


def test_recorded_messages_are_counted(tmp_path: Path) -> None:
    session = SESSIONS["MCAP"](tmp_path)
    for name in ("scans.mcap", "scans.bag"):
        words = ("--pass", "*metadata", "--quiet")
        run = command("convert", session, "-o", tmp_path / name, *words)
        assert run.code == 0, run.err
        verdict = verify(tmp_path / name)
        assert verdict.ok, verdict.violations
        checked = {check.name: check.checked for check in verdict.checks}
        assert checked["messages"] > 0
        assert checked["imu"] > 0


def test_clouds_are_clean(tmp_path: Path) -> None:
    """Points of a driver come twice where a shot had one return; both returns have one stamp."""
    firings = [
        (1 + column / 50, ring, 1, 9, ring, column * 5e-4)
        for column in range(180)
        for ring in range(16)
        for _ in range(2)
    ]
    messages = [
        cloud_message(VELODYNE, firings, STAMP_NS + number * 100_000_000) for number in range(4)
    ]
    bag = write_rosbag2(tmp_path / "clouds.db3", write_points("/points_raw", messages))
    for layout in ("dense", "organized"):
        target = tmp_path / layout
        run = command("convert", bag, "-o", target, "--keep-partial", "--layout", layout)
        assert run.code == 0, run.err
        verdict = verify(target)
        assert verdict.ok, verdict.violations
        assert verdict.points == 4 * len(firings)


def recorded(sent: Sent, folder: Path) -> Path:
    """A capture of what a lidar sent, and what is needed to read it."""
    if sent.file:
        (folder / sent.file).write_bytes(sent.content)
    more = RIG_METADATA.format(metadata=sent.file) if sent.file else ""
    rig = RIG.format(model=sent.model, ip=SOURCE) + more
    (folder / "rig.yaml").write_text(rig, encoding="utf-8")
    records = [
        (host_ns, udp_frame(payload, SOURCE, HOST, port, port)[0])
        for port, payloads in ((2368, sent.seen.payloads), (7788, sent.neighbours))
        for host_ns, payload in payloads
    ]
    return write_pcap(folder / "lidar.pcap", sorted(records))
