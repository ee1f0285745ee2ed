"""The scene of the fixtures, by rays and points worked out by hand; and the files made from it."""

from __future__ import annotations

import hashlib
import json
import math
import struct
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import dpkt
import numpy as np
import pytest
import yaml
from matplotlib.image import imread

from tests.builders.make_fixtures import FOLDER, main
from tests.builders.scene import Pillar, Rectangle, Scene, Vector, box, hall
from tests.builders.two_lidars import LEFT, RIGHT, FixtureLidar, body_from_sensor, crc64

DOCS = Path(__file__).resolve().parents[2] / "docs"

# A square of 2 m at x = 4, centred on the x axis.
SHIELD = Scene((Rectangle((4.0, -1.0, -1.0), (0.0, 2.0, 0.0), (0.0, 0.0, 2.0), 10),))
PILLAR = Scene((Pillar(x=5.0, y=0.0, radius=1.0, height=2.0, reflectivity=10),))


def cast_one(scene: Scene, origin: Vector, direction: Vector) -> float:
    ray = np.array([direction]) / math.sqrt(sum(part**2 for part in direction))
    return float(scene.cast(np.array([origin]), ray)[0])


@pytest.mark.parametrize(
    ("scene", "origin", "direction", "expected"),
    [
        pytest.param(SHIELD, (0, 0, 0), (1, 0, 0), 4.0, id="square on"),
        pytest.param(SHIELD, (0, 0, 0), (4, 0.75, 0), math.hypot(4, 0.75), id="aslant"),
        pytest.param(SHIELD, (0, 0, 0), (4, 1.25, 0), math.inf, id="past its edge"),
        pytest.param(SHIELD, (0, 0, 0), (-1, 0, 0), math.inf, id="behind"),
        pytest.param(SHIELD, (0, 0, 0), (0, 1, 0), math.inf, id="along it"),
        pytest.param(SHIELD, (4, 0, 0), (0, 1, 0), math.inf, id="within its plane"),
        pytest.param(PILLAR, (0, 0, 1), (1, 0, 0), 4.0, id="pillar in the middle"),
        # 0.6 aside of the axis the mantle is sqrt(1 - 0.36) = 0.8 before it.
        pytest.param(PILLAR, (0, 0.6, 1), (1, 0, 0), 4.2, id="pillar off the middle"),
        pytest.param(PILLAR, (0, 1.1, 1), (1, 0, 0), math.inf, id="past the pillar"),
        pytest.param(PILLAR, (0, 0, 2.1), (1, 0, 0), math.inf, id="above the pillar"),
        # Down through the open top: 2 m forward and 1 m down meets the far side at x = 6.
        pytest.param(PILLAR, (4, 0, 2.5), (2, 0, -1), math.sqrt(5), id="pillar from inside"),
        pytest.param(PILLAR, (5, 0, 1), (0, 0, 1), math.inf, id="along the pillar's axis"),
        pytest.param(hall(), (0, 0, 2.5), (-1, 0, 0), 8.0, id="rear wall"),
        pytest.param(hall(), (0, 0, 2.5), (1, 0, 0), 12.0, id="front wall"),
        pytest.param(hall(), (0, 0, 2.5), (0, 0, 1), math.inf, id="open ceiling"),
        pytest.param(hall(), (-3, 0, 2), (0, 0, 1), 3.0, id="closed ceiling"),
        pytest.param(hall(), (0, 0, 2.5), (0, 0, -1), 0.7, id="roof of the machine"),
        pytest.param(hall(), (3, 0, 2.5), (0, 0, -1), 2.5, id="floor"),
        # The pillar at (6.5, 4.5) is 2 m before the wall at y = 7.
        pytest.param(hall(), (6.5, 0, 2), (0, 1, 0), 4.1, id="left front pillar"),
        # 2 m along the ramp's foot it is 2 * 1.5 / 4 = 0.75 m high.
        pytest.param(hall(), (9, 0, 3), (0, 0, -1), 2.25, id="ramp"),
        pytest.param(hall(), (3, -5, 3), (0, 0, -1), 2.0, id="top of the crate"),
        pytest.param(hall(), (0, -5, 0.5), (1, 0, 0), 2.5, id="side of the crate"),
    ],
)
def test_ray_meets_what_geometry_says(
    scene: Scene, origin: Vector, direction: Vector, expected: float
) -> None:
    assert cast_one(scene, origin, direction) == pytest.approx(expected, abs=1e-12)


def test_rays_are_cast_each_for_itself() -> None:
    origins = np.zeros((3, 3))
    directions = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.8, 0.0, 0.6]])
    # The third meets the plane x = 4 at z = 3, above the shield.
    assert SHIELD.cast(origins, directions).tolist() == [4.0, math.inf, math.inf]
    assert SHIELD.surface_hit(origins, directions).tolist() == [0, -1, -1]


@pytest.mark.parametrize(
    ("scene", "point", "expected"),
    [
        pytest.param(SHIELD, (4.25, 0.5, 0.5), 0.25, id="before the square"),
        # 3 m beyond one edge and 4 m off the plane.
        pytest.param(SHIELD, (8, 4, 0), 5.0, id="beyond an edge"),
        pytest.param(SHIELD, (4, 4, -5), 5.0, id="beyond a corner"),
        pytest.param(PILLAR, (5, 1.5, 1), 0.5, id="outside the pillar"),
        pytest.param(PILLAR, (5, 0, 1), 1.0, id="on the pillar's axis"),
        # 3 m aside of the mantle and 4 m above the top.
        pytest.param(PILLAR, (9, 0, 6), 5.0, id="above the pillar"),
    ],
)
def test_distance_to_a_surface(scene: Scene, point: Vector, expected: float) -> None:
    assert scene.distance_to_surfaces(np.array([point])).tolist() == pytest.approx([expected])


def test_box_is_closed_but_for_its_bottom() -> None:
    crate = Scene(box((0.0, 0.0, 0.0), (2.0, 4.0, 6.0), 10))
    inside = np.tile([0.5, 1.5, 2.5], (6, 1))
    axes = np.vstack([np.eye(3), -np.eye(3)])
    assert crate.cast(inside, axes).tolist() == [1.5, 2.5, 3.5, 0.5, 1.5, math.inf]


def test_every_hit_is_on_a_surface() -> None:
    azimuth = np.linspace(0.0, 2.0 * math.pi, 500, endpoint=False)
    rise = np.linspace(-1.5, 1.5, 500)
    directions = np.stack(
        [np.cos(rise) * np.cos(azimuth), np.cos(rise) * np.sin(azimuth), np.sin(rise)], axis=1
    )
    origins = np.tile([0.2, 0.9, 2.4], (500, 1))
    distance = hall().cast(origins, directions)
    hit = np.isfinite(distance)
    points = origins[hit] + distance[hit, None] * directions[hit]
    assert hit.sum() > 300
    assert hall().distance_to_surfaces(points).max() < 1e-12


def test_fixture_is_made_again_to_the_byte(tmp_path: Path) -> None:
    main(tmp_path)
    made = sorted(path.name for path in tmp_path.iterdir())
    assert made == ["left.json", "rig.yaml", "right.json", "two_lidars.pcap"]
    for name in made:
        assert digest(tmp_path / name) == digest(FOLDER / name), name


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_crc_has_the_published_check_value() -> None:
    digits = np.frombuffer(b"123456789", np.uint8)[None, :]
    # CRC-64/XZ in the catalogue of parametrised CRC algorithms.
    assert crc64(digits).tolist() == [0x995DC9BBDF1939FA]


def datagrams() -> Iterator[tuple[int, int, bytes]]:
    """Last byte of the source address, destination port and payload, reassembled frame by frame."""
    parts: dict[tuple[bytes, int], bytes] = defaultdict(bytes)
    with (FOLDER / "two_lidars.pcap").open("rb") as file:
        for _, frame in dpkt.pcap.Reader(file):
            packet = dpkt.ethernet.Ethernet(frame).data
            if not isinstance(packet, dpkt.ip.IP) or packet.p != dpkt.ip.IP_PROTO_UDP:
                continue
            key = (packet.src, packet.id)
            # The low 13 bits of the flags word count units of 8 bytes.
            offset = (struct.unpack_from(">H", frame, 20)[0] & 0x1FFF) * 8
            assert offset == len(parts[key])
            parts[key] += frame[34:]
            if not packet.mf:
                datagram = parts.pop(key)
                yield packet.src[3], struct.unpack_from(">H", datagram, 2)[0], datagram[8:]
    assert not parts


def test_capture_contains_what_its_source_file_lists() -> None:
    seen: dict[tuple[int, int, int], int] = defaultdict(int)
    for host, port, payload in datagrams():
        seen[host, port, len(payload)] += 1
    # 0.85 s contain 272 packets of 3.125 ms; the one that both ends cut is not sent.
    # Sizes by docs/sources/ouster.md section 2: 32 beams x 12 or 4 bytes.
    assert dict(seen) == {
        (87, 7502, 32 + 16 * (12 + 32 * 12) + 32): 271,
        (88, 7502, 32 + 16 * (12 + 32 * 4) + 32): 271,
        (87, 7503, 48): 85,
        (88, 7503, 48): 85,
        (20, 5353, 12): 2,
    }


def test_rotors_pass_zero_37_ms_apart() -> None:
    zeros: dict[int, list[int]] = defaultdict(list)
    for host, _, payload in datagrams():
        if len(payload) > 1000 and struct.unpack_from("<H", payload, 32 + 8)[0] == 0:
            zeros[host].append(struct.unpack_from("<q", payload, 32)[0])
    # 2026-05-04T08:00:00 UTC and -87 ms + 2 revolutions of 99.99 ms; the zero before is missing.
    assert zeros[87][0] == 1_777_881_600_000_000_000 + 112_980_000
    # The first zero of `right` comes 63 ms before that one.
    apart = [right - left for left, right in zip(zeros[87], zeros[88][1:], strict=True)]
    assert apart == [pytest.approx(37e6, abs=0.2e6)] * 8


def test_frame_ids_of_right_wrap() -> None:
    frames = [
        struct.unpack_from("<H", p, 2)[0] for host, _, p in datagrams() if host == 88 and p[0]
    ]
    assert 65535 in frames
    assert 0 in frames


@pytest.mark.parametrize(
    ("lidar", "range_of", "half_step_m"),
    [
        pytest.param(LEFT, ("<I", 12, 0x7FFFF, 1), 0.0005, id="left"),
        pytest.param(RIGHT, ("<H", 4, 0x7FFF, 8), 0.004, id="right"),
    ],
)
def test_points_lie_on_the_scene(
    lidar: FixtureLidar, range_of: tuple[str, int, int, int], half_step_m: float
) -> None:
    layout, pixel_size, mask, step_mm = range_of
    document = json.loads((FOLDER / f"{lidar.name}.json").read_text())
    host = int(lidar.ip.rsplit(".", 1)[1])
    packets = [payload for source, port, payload in datagrams() if (source, port) == (host, 7502)]
    points = []
    for packet in packets[::9]:
        column = 32 + 7 * (12 + 32 * pixel_size)
        mid = struct.unpack_from("<H", packet, column + 8)[0]
        for beam in range(32):
            (word,) = struct.unpack_from(layout, packet, column + 12 + beam * pixel_size)
            if word & mask:
                points.append(sensor_point(document, (word & mask) * step_mm, mid, beam))
    pose = body_from_sensor(lidar)
    body = np.array(points) @ pose[:3, :3].T + pose[:3, 3]
    assert len(body) > 600
    assert hall().distance_to_surfaces(body).max() <= half_step_m + 1e-9


def sensor_point(
    document: dict[str, dict[str, list[float]]], r: int, mid: int, beam: int
) -> Vector:
    """One point by the formula of docs/sources/ouster.md section 6, number by number; metres."""
    beams = document["beam_intrinsics"]
    n = beams["beam_to_lidar_transform"][3]
    theta = 2 * math.pi * (1 - mid / 512)
    a = theta - math.radians(beams["beam_azimuth_angles"][beam])
    p = math.radians(beams["beam_altitude_angles"][beam])
    x = (r - n) * math.cos(a) * math.cos(p) + n * math.cos(theta)
    y = (r - n) * math.sin(a) * math.cos(p) + n * math.sin(theta)
    z = (r - n) * math.sin(p)
    lift = document["lidar_intrinsics"]["lidar_to_sensor_transform"][11]
    return (-x / 1000, -y / 1000, (z + lift) / 1000)


def test_rig_names_both_lidars_by_serial() -> None:
    rig = yaml.safe_load((FOLDER / "rig.yaml").read_text())
    assert [sensor["stream"]["serial"] for sensor in rig["sensors"]] == [LEFT.serial, RIGHT.serial]
    assert rig["sensors"][0]["extrinsics"]["rotation_rpy_deg"] == list(LEFT.rpy_deg)


def test_extrinsics_rotate_about_fixed_axes() -> None:
    # Pitch 22 degrees lowers the x axis, then yaw 80 degrees rotates it to the left.
    forward = body_from_sensor(LEFT)[:3, 0]
    down = math.radians(22.0)
    left = math.radians(80.0)
    expected = (math.cos(left) * math.cos(down), math.sin(left) * math.cos(down), -math.sin(down))
    assert forward.tolist() == pytest.approx(expected)


def run(script: str, *arguments: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(DOCS / script), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_time_span_picture_is_what_its_script_draws() -> None:
    assert run("time_span.py").stdout == (DOCS / "time_span.svg").read_text()


def test_picture_shows_each_lidar_in_its_colour(tmp_path: Path) -> None:
    side = np.linspace(0.0, 3.0, 50)
    xyz = np.stack([side, side % 0.7, side], axis=1)
    np.savez(
        tmp_path / "000000.npz",
        xyz=np.concatenate([xyz, xyz + 1.0]).astype(np.float32),
        lidar_id=np.repeat([0, 1], 50).astype(np.uint8),
        sensors=np.array(["left", "right"]),
        index=0,
        start_ns=0,
        end_ns=100_000_000,
    )
    assert run("picture.py", tmp_path, tmp_path / "out.png").returncode == 0
    assert (tmp_path / "out.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    # Red, green, blue and opacity from 0 to 1.
    pixels = imread(tmp_path / "out.png").reshape(-1, 4)
    # Orange has more red than blue, cyan more blue than red.
    assert (pixels[:, 0] > pixels[:, 2] + 80 / 255).any()
    assert (pixels[:, 2] > pixels[:, 0] + 80 / 255).any()


def test_picture_of_nothing_is_refused_in_one_line(tmp_path: Path) -> None:
    done = run("picture.py", tmp_path, tmp_path / "out.png")
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "expected a folder of npz scans, found none; convert" in done.stderr
