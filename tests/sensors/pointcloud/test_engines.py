"""Clouds of a spinning lidar by both engines: the same bytes, whatever is filtered or moved."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest

from mlbatch.arrays import U8Array
from mlbatch.pipeline.sensor import header_loops
from mlbatch.ros.point_packets import Layout, Points, pack
from mlbatch.sensors.pointcloud.sensor import CloudLidar
from tests.builders.engines import needs_native
from tests.builders.points import OUSTER, STAMP_NS, cloud_message, write_points
from tests.builders.run import command
from tests.builders.sessions_of_bags import write_mcap

pytestmark = needs_native

# A turn of 0.2 rad between two poses, 50 ms each.
TRAJECTORY = "".join(
    f"{STAMP_NS / 1e9 - 1 + number * 0.05:.6f} {number * 0.3:.3f} 0.5 0 "
    f"0 0 {np.sin(0.1 * number):.9f} {np.cos(0.1 * number):.9f}\n"
    for number in range(60)
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four revolutions of 64 columns on 16 rings, and one of two lidars in one cloud."""
    place = tmp_path_factory.mktemp("clouds")
    random = np.random.default_rng(11)
    messages = []
    for number in range(5):
        xyz = random.integers(-400, 400, (64, 16, 3)) / 16
        xyz[random.random((64, 16)) < 0.2] = 0
        points = [
            (*xyz[column, ring].tolist(), ring + column, column * 1_562_500, ring)
            for ring in range(16)
            for column in range(64)
        ]
        if number == 2:
            # Twice the points of each ring: no cloud that is packed at once.
            points += [(1.0, 2.0, 3.0, 4, column * 1_562_500, 3) for column in range(64)]
        messages.append(cloud_message(OUSTER, points, STAMP_NS + number * 100_000_000))
    write_mcap(place / "drive.mcap", write_points("/top/points", messages))
    (place / "track.tum").write_text(TRAJECTORY, encoding="utf-8")
    (place / "rig.yaml").write_text(
        "sensors:\n  - name: top\n    stream: {topic: /top/points}\n"
        "    extrinsics: {translation_m: [1, 2, 3], rotation_rpy_deg: [1, 2, 30]}\n",
        encoding="utf-8",
    )
    return place


def _digests(folder: Path, form: str) -> list[str]:
    """Of all scans."""
    paths = sorted(folder.rglob(f"*.{form}"))
    return [hashlib.sha256(path.read_bytes()).hexdigest() for path in paths]


@pytest.mark.parametrize(
    "options",
    [
        "",
        "--min-range 8 --max-range 30",
        "--deskew track.tum",
        "--min-range 8 --deskew track.tum --deskew-to middle",
        "--exclude-box 0,0,-40,40,40,40",
        "--layout organized",
    ],
)
def test_engines_give_the_same_bytes(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: str
) -> None:
    monkeypatch.chdir(folder)
    found = {}
    for engine in ("numpy", "native"):
        for form in ("npz", "pcd"):
            output = tmp_path / f"{engine}-{form}"
            words = [*options.split(), "--engine", engine, "--format", form, "--quiet"]
            done = command("convert", "drive.mcap", "--rig", "rig.yaml", "-o", output, *words)
            assert done.code == 0, done.err
            found[engine, form] = _digests(output, form)
            assert found[engine, form]
    assert found["numpy", "npz"] == found["native", "npz"]
    assert found["numpy", "pcd"] == found["native", "pcd"]


def _lidar_and_packets() -> tuple[CloudLidar, U8Array]:
    """Forty columns of eight rings."""
    random = np.random.default_rng(3)
    ring = np.tile(np.arange(8, dtype=np.uint16), 40)
    nothing = np.zeros(320, np.uint8)
    stamp_ns = STAMP_NS + np.repeat(np.arange(40), 8) * 55_296
    reals = random.random((4, 320)).astype(np.float32)
    layout = Layout(0, 16, by_ring=True)
    return CloudLidar(layout, "/top"), pack(
        Points(stamp_ns, reals, ring, nothing, nothing), layout, 0
    )


@pytest.mark.parametrize("knows_keys", [False, True])
def test_compiled_headers_are_those_of_numpy(knows_keys: bool) -> None:
    lidar, packets = _lidar_and_packets()
    host_ns = np.full(40, STAMP_NS)
    expected = lidar.column_headers(packets, host_ns)
    key = lidar.sequence(packets)
    loops = header_loops(lidar, "native")
    assert loops is not None
    start = np.arange(40) * lidar.packet_size
    known = key if knows_keys else None
    found = loops.read(packets.reshape(-1), start, lidar.packet_size, host_ns, known)
    assert found is not None
    headers, found_key = found
    assert found_key.tolist() == key.tolist()
    for name in ("stamp_ns", "encoder", "valid"):
        assert np.array_equal(
            getattr(headers, name).reshape(-1), getattr(expected, name).reshape(-1)
        )


def test_unusual_headers_are_left_to_numpy() -> None:
    """Another layout, or times that fall."""
    lidar, packets = _lidar_and_packets()
    loops = header_loops(lidar, "native")
    assert loops is not None
    start = np.arange(40) * lidar.packet_size
    host_ns = np.full(40, STAMP_NS)
    assert loops.read(packets.reshape(-1), start[::-1], lidar.packet_size, host_ns) is None
    packets[7, 5] = 1
    assert loops.read(packets.reshape(-1), start, lidar.packet_size, host_ns) is None
