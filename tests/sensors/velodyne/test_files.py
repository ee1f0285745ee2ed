"""Calibration files of Velodyne sensors in place of the tables of their models."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mlbatch.errors import RigError
from mlbatch.lidar import READABLE
from mlbatch.sensors.velodyne import sensor as velodyne
from tests.builders.velodyne import VelodyneSpec
from tests.builders.velodyne_streams import PLAIN, evidence, made_of, pointing
from tests.builders.velodyne_tables import MODELS, calibration_yaml


def test_the_model_is_the_one_with_the_nearest_angles() -> None:
    for model in PLAIN:
        read = velodyne.read_calibration(Path("a.yaml"), calibration_yaml(model).encode())
        assert read is not None
        assert (read.model, read.is_shared, read.serial) == (model, True, "")
        assert read.path == Path("a.yaml")


def test_a_file_beats_the_table_of_its_model() -> None:
    seen = made_of(VelodyneSpec("VLP-16"))
    for model, fit in (("VLP-16", 200), ("Puck Hi-Res", READABLE), ("VLS-128", 0)):
        read = velodyne.read_calibration(Path("a.yaml"), calibration_yaml(model).encode())
        assert read is not None
        assert read.fit(evidence(seen.sent)) == fit


def test_its_angles_and_offsets_are_used() -> None:
    table = MODELS["VLP-16"]
    text = calibration_yaml("VLP-16").replace(
        "- laser_id: 3\n  rot_correction: -0.0\n", "- laser_id: 3\n  rot_correction: -0.01\n"
    )
    lines = text.splitlines()
    at = lines.index("- laser_id: 3")
    lines[at + 3] = "  dist_correction: 0.05"
    lines[at + 5] = "  horiz_offset_correction: 0.02"
    read = velodyne.read_calibration(Path("a.yaml"), "\n".join(lines).encode())
    assert read is not None
    lidar = read.lidar({}, evidence(made_of(VelodyneSpec("VLP-16")).sent))
    # Section 5: alpha = azimuth - rot, so rotor at zero looks 0.01 rad to the right (-y); the
    # side offset of section 10 shifts it by h (sin, cos) of alpha.
    assert lidar.beams.reach_m.tolist() == [0.05 if laser == 3 else 0.0 for laser in range(16)]
    direction, origin = pointing(lidar, np.zeros((1, 16)))
    flat = math.cos(math.radians(table.elevation_deg[3]))
    assert direction[0, 3, 0] == pytest.approx(flat * math.cos(0.01))
    assert direction[0, 3, 1] == pytest.approx(-flat * math.sin(0.01))
    assert origin[0, 3] == pytest.approx(
        [0.02 * math.sin(0.01), 0.02 * math.cos(0.01), table.vertical_m[3]]
    )


def test_another_unit_of_range_is_named_and_not_used() -> None:
    text = calibration_yaml("VLS-128").replace("resolution: 0.004", "resolution: 0.007")
    read = velodyne.read_calibration(Path("alpha.yaml"), text.encode())
    assert read is not None
    lidar = read.lidar({}, evidence(made_of(VelodyneSpec("VLS-128")).sent))
    assert lidar.notes == (
        "alpha.yaml: distance_resolution is 0.007 m, but a VLS-128 counts in 0.004 m, which is "
        "used",
    )


def test_a_file_of_no_model() -> None:
    spec = replace(MODELS["VLP-16"], elevation_deg=tuple(np.linspace(-60, 60, 16)))
    text = calibration_yaml("VLP-16")
    for old, new in zip(MODELS["VLP-16"].elevation_deg, spec.elevation_deg, strict=True):
        text = text.replace(
            f"vert_correction: {math.radians(old)!r}\n",
            f"vert_correction: {math.radians(new)!r} \n",
        )
    with pytest.raises(
        RigError, match=r"odd\.yaml: .*expected vertical angles of .*found a mean difference"
    ):
        velodyne.read_calibration(Path("odd.yaml"), text.encode())


def test_a_hdl_64e_is_an_s3_until_the_rig_says_s2() -> None:
    read = velodyne.read_calibration(Path("a.yaml"), calibration_yaml("HDL-64E S2").encode())
    assert read is not None
    sent = made_of(VelodyneSpec("HDL-64E S3")).sent
    assert read.model == "HDL-64E S3"
    assert read.fit(evidence(sent)) == 200
    (note,) = read.lidar({}, evidence(sent)).notes
    assert note == "assumed to be an HDL-64E S3; if it is an HDL-64E S2, name its model in the rig"
    other = read.for_model("HDL-64E S2")
    assert other is not None
    assert other.lidar({}, evidence(sent)).notes == ()
    assert read.for_model("VLP-16") is None


def test_a_hdl_64e_needs_one() -> None:
    sent = made_of(VelodyneSpec("HDL-64E S3")).sent
    fits = {one.model: one.fit(evidence(sent)) for one in velodyne.BUILT_IN}
    assert {model: fit for model, fit in fits.items() if fit} == {
        "HDL-64E S3": 100,
        "HDL-64E S2": READABLE,
    }
    expected = "HDL-64E: expected its calibration, found none; give the unit's YAML or db.xml with"
    for one in velodyne.BUILT_IN:
        if fits[one.model]:
            with pytest.raises(RigError, match=expected):
                one.lidar({}, evidence(sent))
