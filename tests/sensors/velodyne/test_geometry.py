"""Points of the HDL-64E by hand, in a scalar loop, and as rays met something; heights of others.

Source: docs/sources/velodyne.md sections 5, 6 and 10.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from mlbatch.arrays import F32Array, F64Array, I64Array
from mlbatch.lidar.interface import Calibration
from mlbatch.sensors.velodyne.calibration import VelodyneFile
from mlbatch.sensors.velodyne.packets import hdl64_projection
from mlbatch.sensors.velodyne.sensor import VelodyneCalibration
from mlbatch.simulate.velodyne.encode import VelodyneSpec
from mlbatch.simulate.velodyne.models import MODELS, calibration_yaml
from tests.builders.decoded import Rotor, projected, rotor_words
from tests.builders.spinning import PLAIN, from_file, pointing, stream_of

LASERS = 64
AT_ONCE = np.zeros((1, LASERS), np.int64)


@dataclass(frozen=True)
class Laser:
    """Corrections of a laser, rad and m: rot, vertical, c, cx, cy, h and o of section 10."""

    rot: float = 0.0
    w: float = 0.0
    c: float = 0.0
    cx: float = 0.0
    cy: float = 0.0
    h: float = 0.0
    o: float = 0.0


def unit(laser: Laser) -> VelodyneFile:
    """A sensor whose lasers are all alike."""
    values = (laser.rot, laser.w, laser.c, laser.cx, laser.cy, laser.o, laser.h)
    rot, w, c, cx, cy, o, h = (np.full(LASERS, value) for value in values)
    enabled = np.ones(LASERS, np.bool_)
    return VelodyneFile(Path("db.xml"), LASERS, 0.002, rot, w, c, cx, cy, o, h, enabled)


def project(
    file: VelodyneFile,
    azimuth_deg: F64Array,
    range_m: F64Array,
    firing_ns: I64Array = AT_ONCE,
    hz: float = 0.0,
    table: int = 0,
) -> F32Array:
    """Points (n, 64, 3) of columns at these rotor azimuths (n,)."""
    words = rotor_words(azimuth_deg / 360, hz, table)
    rotor = Rotor(firing_ns, project=lambda pose: hdl64_projection(file, pose))
    return projected(rotor, words, range_m.astype(np.float32))


NEAR = Laser(c=1.0, cx=1.2, cy=1.4)
UP_30 = math.pi / 6


@pytest.mark.parametrize(
    ("laser", "azimuth_deg", "range_m", "xyz"),
    [
        (Laser(), 0.0, 10.0, (10, 0, 0)),
        # 90 degrees clockwise is to the right, where y is negative.
        (Laser(), 90.0, 10.0, (0, -10, 0)),
        # alpha = azimuth - rot.
        (Laser(rot=math.pi / 6), 30.0, 10.0, (10, 0, 0)),
        # 10 m 30 degrees up: 8.660254 to the right, h forward, 5 + o up.
        (Laser(w=UP_30, c=1.0, h=0.5, o=0.2), 90.0, 9.0, (0.5, -8.660254, 5.2)),
        # Ahead, h moves to the left.
        # Y = 11: ky = 1.4 - 0.4 x 9.07 / 23.11 = 1.2430117.
        (NEAR, 0.0, 10.0, (11.2430117, 0, 0)),
        # X = 11: kx = 1.2 - 0.2 x 8.6 / 22.64 = 1.1240283, on either side.
        (NEAR, 90.0, 10.0, (0, -11.1240283, 0)),
        # q = 8.660254: kx = 1.2 + 0.2 x 2.4 / 22.64 = 1.2212014,
        # ky = 1.4 - 0.4 x 6.730254 / 23.11 = 1.2835092, kz = 1.2523553.
        (replace(NEAR, w=UP_30), 0.0, 9.0, (8.9057802, 0, 5.1261777)),
        # From 25.04 m on there is one correction only.
        (NEAR, 0.0, 25.04, (26.04, 0, 0)),
        # Without both values near by, too.
        (replace(NEAR, cx=0.0), 0.0, 10.0, (11, 0, 0)),
    ],
)
def test_points_by_hand(
    laser: Laser, azimuth_deg: float, range_m: float, xyz: tuple[float, float, float]
) -> None:
    points = project(unit(laser), np.array([azimuth_deg]), np.full((1, LASERS), range_m))
    assert (points == points[:, :1]).all()
    assert points[0, 0].tolist() == pytest.approx(xyz, abs=3e-6)


def test_beams_fire_while_the_rotor_rotates() -> None:
    # 50 us at 10 Hz: 0.00314159 rad. Beams that do not fire (-1) are not rotated.
    firing_ns = np.array([[0] * 64, [-1, 50_000] * 32])
    ranges = np.full((2, LASERS), 10.0)
    points = project(unit(Laser()), np.zeros(2), ranges, firing_ns, hz=10.0, table=1)
    assert points[1, 0] == pytest.approx([10, 0, 0], abs=1e-6)
    assert points[1, 1] == pytest.approx([9.9999507, -0.0314154, 0], abs=1e-6)
    still = project(unit(Laser()), np.zeros(2), ranges, firing_ns, hz=10.0, table=0)
    assert still[1, 1] == pytest.approx([10, 0, 0], abs=1e-6)


@pytest.mark.parametrize(
    ("model", "lowest_m"),
    [
        *(("VLP-16", 0.01123), ("HDL-32E", 0.01717), ("VLS-128", 0.0273)),
        *(("HDL-64E S2", 0.2), ("HDL-64E S3", 0.2)),
    ],
)
def test_without_vertical_offsets_all_beams_leave_one_point(model: str, lowest_m: float) -> None:
    stream = stream_of(VelodyneSpec(model))
    on, off = stream.lidar(), stream.lidar(vertical_offset="off")
    high, low = stream.read(on).xyz, stream.read(off).xyz
    heights_m = np.array(MODELS[model].vertical_m)
    assert np.abs(heights_m).max() == pytest.approx(lowest_m, abs=5e-5)
    raised_m = np.broadcast_to([0, 0, 1] * heights_m[:, None, None], high[0].shape)
    is_met = stream.truth.counts > 0
    # Float32 at 260 m.
    assert np.abs(high - low - raised_m)[is_met].max() < 5e-5
    if model in PLAIN:
        assert on.beams.origin[2, :, 2] == pytest.approx(heights_m, abs=1e-5)
        assert not off.beams.origin.any()


# -- what a file of a unit says -------------------------------------------------------------------


def file_lines(model: str) -> list[str]:
    return calibration_yaml(model).splitlines()


def unit_of(lines: list[str]) -> Calibration:
    return from_file("\n".join(lines), "unit.yaml")


def test_a_laser_that_a_file_disables_sees_nothing() -> None:
    stream = stream_of(VelodyneSpec("VLP-16"))
    whole = unit_of(file_lines("VLP-16"))
    assert isinstance(whole, VelodyneCalibration)
    assert whole.file is not None
    enabled = np.arange(16) != 5
    dark = VelodyneCalibration(whole.row, replace(whole.file, enabled=enabled))
    lidar = dark.lidar({}, stream.evidence)
    range_m = stream.read(lidar).range_m
    assert not range_m[:, 5].any()
    np.testing.assert_array_equal(
        range_m[:, enabled], stream.read(stream.lidar()).range_m[:, enabled]
    )
    assert lidar.firing_ns[0, 5] == -1


def test_its_angles_and_offsets_are_used() -> None:
    table = MODELS["VLP-16"]
    lines = file_lines("VLP-16")
    at = lines.index("- laser_id: 3")
    lines[at + 1] = "  rot_correction: -0.01"
    lines[at + 3] = "  dist_correction: 0.05"
    lines[at + 5] = "  horiz_offset_correction: 0.02"
    lidar = unit_of(lines).lidar({}, stream_of(VelodyneSpec("VLP-16")).evidence)
    # Section 5: alpha = azimuth - rot, so rotor at zero looks 0.01 rad to the right (-y); the
    # side offset of section 10 shifts it by h (sin, cos) of alpha.
    assert lidar.beams.reach_m.tolist() == [0.05 if laser == 3 else 0.0 for laser in range(16)]
    direction, origin = pointing(lidar, np.zeros((1, 16)))
    flat = math.cos(math.radians(table.elevation_deg[3]))
    ahead, aside = math.cos(0.01), math.sin(0.01)
    assert direction[0, 3, :2] == pytest.approx([flat * ahead, -flat * aside])
    assert origin[0, 3] == pytest.approx([0.02 * aside, 0.02 * ahead, table.vertical_m[3]])


@pytest.mark.parametrize("model", PLAIN)
def test_a_file_without_heights_keeps_the_built_in_ones(model: str) -> None:
    """ROS drivers write 0 for all lasers, or nothing."""
    heights_m = np.array(MODELS[model].vertical_m)
    seen = stream_of(VelodyneSpec(model)).evidence
    missing = [line for line in file_lines(model) if "vert_offset" not in line]
    zeros = "\n".join(missing).replace("  dist_c", "  vert_offset_correction: 0.0\n  dist_c")
    for lines in (missing, zeros.splitlines()):
        lidar = unit_of(lines).lidar({}, seen)
        assert np.abs(lidar.beams.origin[2, :, 2] - heights_m).max() < 1e-5
        assert lidar.notes == (
            f"unit.yaml: the vertical offsets of all lasers are 0; those of a "
            f"{MODELS[model].row.reported_as} are used, "
            f"up to {np.abs(heights_m).max() * 1000:.1f} mm (vertical_offset=off: none)",
        )
        lowered = unit_of(lines).lidar({"vertical_offset": "off"}, seen)
        assert lowered.notes == ()
        assert not lowered.beams.origin.any()
    # A single value is the unit's own.
    lidar = unit_of(zeros.replace("correction: 0.0", "correction: 0.003", 1).splitlines()).lidar(
        {}, seen
    )
    assert lidar.notes == ()
    assert lidar.beams.origin[2, :, 2].tolist() == [0.003] + [0.0] * (len(heights_m) - 1)


def test_another_unit_of_range_is_named_and_not_used() -> None:
    text = calibration_yaml("VLS-128").replace("resolution: 0.004", "resolution: 0.007")
    lidar = from_file(text, "alpha.yaml").lidar({}, stream_of(VelodyneSpec("VLS-128")).evidence)
    assert lidar.notes == (
        "alpha.yaml: distance_resolution is 0.007 m, but a VLS-128 counts in 0.004 m, which is "
        "used",
    )
