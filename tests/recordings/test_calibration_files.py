"""Real calibration files of Velodyne and HESAI, by values read by eye."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mlbatch.sensors import read_calibration
from mlbatch.sensors.hesai.angles import read_angles, read_at128
from mlbatch.sensors.velodyne.calibration import VelodyneFile
from mlbatch.simulate.velodyne.models import MODELS
from tests.recordings import RECORDINGS
from tests.sensors.test_files import read

VELODYNE_FOLDER = RECORDINGS / "velodyne"
# Real files: the first lines, read by eye; angles of docs/sources/velodyne.md section 6.
ALONE = "calibration-without-recording"
VELODYNE = {
    "vlp16_ros2_dual/VLP16.yaml": ("VLP-16", 0.002, {0: -15.0, 1: 1.0, 14: -1.0, 15: 15.0}),
    "vlp32c_ros2/VLP32.yaml": ("VLP-32C", 0.004, {0: -25.0, 3: -15.639, 29: 15.0, 31: -1.333}),
    f"{ALONE}/HDL32.yaml": ("HDL-32E", 0.002, {0: -30.67, 1: -9.33, 31: 10.67}),
    f"{ALONE}/VLP16_hires.yaml": ("Puck Hi-Res", 0.002, {0: -10.0, 1: 0.667, 15: 10.0}),
    f"{ALONE}/HDL64e_s2.yaml": ("HDL-64E S3", 0.002, {}),
    f"{ALONE}/HDL64e_s3.yaml": ("HDL-64E S3", 0.002, {}),
}


def real(name: str) -> VelodyneFile:
    path = VELODYNE_FOLDER / name
    return read(path.read_bytes(), str(path))


@pytest.mark.parametrize("name", VELODYNE)
def test_real_files(name: str) -> None:
    model, unit_m, elevation_deg = VELODYNE[name]
    calibration = read_calibration(VELODYNE_FOLDER / name)
    assert calibration is not None
    assert calibration.model == model
    file = real(name)
    assert (file.lasers, file.unit_m, file.notes) == (len(MODELS[model].elevation_deg), unit_m, ())
    assert file.enabled.all()
    for laser, angle_deg in elevation_deg.items():
        assert math.degrees(file.elevation_rad[laser]) == pytest.approx(angle_deg, abs=4e-4)


HESAI_FOLDER = RECORDINGS / "hesai"

# First and last line of the files, as a text editor shows them: elevation, azimuth in deg.
FILES = {
    "pandar40p/Pandar40P.csv": (40, (14.794, -1.042), (-24.985, -1.042)),
    "pandar64/Pandar64.csv": (64, (14.9, -1.042), (-24.879, -1.042)),
    "pandarqt64/PandarQT64.csv": (64, (-52.121, 8.736), (52.133, -7.892)),
    "pandarxt16/PandarXT16.csv": (16, (15, 0), (-15, 0)),
    "pandarxt32/PandarXT32.csv": (32, (14.972363, 0.082385), (-16.023602, -0.129679)),
    "calibration-without-recording/Pandar128E4X.csv": (128, (15.139, 0.157), (-24.71, 0.302)),
    "calibration-without-recording/PandarAT128.csv": (128, (12.93, 2.4), (-12.47, 0.65)),
}


@pytest.mark.parametrize("name", FILES)
def test_real_csv_files(name: str) -> None:
    channels, first, last = FILES[name]
    found = read_angles(HESAI_FOLDER / name, (HESAI_FOLDER / name).read_bytes())
    assert found is not None
    assert found.path == HESAI_FOLDER / name
    assert found.azimuth_rad.shape == found.elevation_rad.shape == (channels,)
    for at, (elevation, azimuth) in ((0, first), (-1, last)):
        assert found.elevation_rad[at] == pytest.approx(math.radians(elevation), abs=1e-15)
        assert found.azimuth_rad[at] == pytest.approx(math.radians(azimuth), abs=1e-15)


def test_at128_real_dat_file() -> None:
    path = HESAI_FOLDER / "calibration-without-recording" / "PandarAT128.dat"
    found = read_at128(path, path.read_bytes())
    assert found is not None
    degrees = 180 / math.pi
    # From the sheet, rounded there to 0.01 deg.
    assert found.start_rad * degrees == pytest.approx([23.33, 143.21, 263.15], abs=0.005)
    assert np.abs(found.azimuth_rad).max() * degrees == pytest.approx(2.4, abs=0.005)
    assert found.elevation_rad.min() * degrees == pytest.approx(-12.46, abs=0.011)
    assert found.elevation_rad.max() * degrees == pytest.approx(12.92, abs=0.011)


def test_a_real_hdl_64e_has_all_corrections() -> None:
    file = real("calibration-without-recording/HDL64e_s2.yaml")
    assert file.azimuth_rad[0] == -0.1248942899601548
    assert file.elevation_rad[:2].tolist() == [-0.15304134919741974, -0.1458455539136526]
    assert file.dist_correction_m[:2].tolist() == [1.5195264000000002, 1.5145139]
    assert file.dist_correction_x_m[0] == 1.5500304
    assert file.dist_correction_y_m[1] == 1.5491043
    assert file.vert_offset_m[0] == 0.19548199
    assert file.horiz_offset_m[:2].tolist() == [0.025999999, -0.025999999]
