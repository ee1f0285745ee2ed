"""Velodyne calibration in the db.xml that boost writes, facts/velodyne.md section 9."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest

from mlbatch.sensors.velodyne.calibration import MAX_BYTES
from tests.sensors.velodyne.test_calibration import fault, read

XML = Path("drive/db.xml")


def xml_of(
    points: Sequence[Mapping[str, object]],
    enabled: Sequence[int] = (),
    lsb_cm: object = 0.2,
    kind: str = "<!DOCTYPE boost_serialization>",
) -> str:
    """A db.xml as boost writes it."""
    items = "".join(
        '<item class_id="13"><px class_id="14" class_name="calib">'
        + "".join(f"<{key}>{value}</{key}>" for key, value in point.items())
        + "</px></item>\n"
        for point in points
    )
    flags = "".join(f"<item>{flag}</item>" for flag in enabled)
    return (
        '<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>\n'
        f'{kind}\n<boost_serialization signature="serialization::archive" version="4">\n'
        f'<DB class_id="0" version="0"><distLSB_>{lsb_cm}</distLSB_>'
        "<position_><xyz><count>3</count><item>0</item></xyz></position_>"
        f"<enabled_><count>{len(enabled)}</count>{flags}</enabled_>"
        f"<points_ class_id='12'><count>{len(points)}</count><item_version>1</item_version>"
        f"\n{items}</points_></DB>\n</boost_serialization>\n"
    )


def points(count: int, **changes: object) -> list[dict[str, object]]:
    """Points of a db.xml; changes are to laser 3."""
    found: list[dict[str, object]] = [
        {"id_": laser, "rotCorrection_": -1.5, "vertCorrection_": laser / 4}
        for laser in range(count)
    ]
    found[3].update(changes)
    return found


def test_xml_gives_degrees_and_centimetres() -> None:
    changed = points(
        64,
        vertCorrection_=-7.5,
        distCorrection_=151.95264,
        distCorrectionX_="1.55e+02",
        distCorrectionY_=152.5,
        vertOffsetCorrection_=19.5,
        horizOffsetCorrection_=-2.6,
        focalSlope_=1.4,
    )
    file = read(xml_of(changed[::-1], [1] * 64), XML)
    assert (file.lasers, file.notes) == (64, ())
    assert file.unit_m == pytest.approx(0.002)
    assert math.degrees(file.elevation_rad[3]) == pytest.approx(-7.5)
    assert math.degrees(file.azimuth_rad[63]) == pytest.approx(-1.5)
    assert math.degrees(file.elevation_rad[63]) == pytest.approx(15.75)
    assert file.dist_correction_m[3] == pytest.approx(1.5195264)
    assert file.dist_correction_x_m[3] == pytest.approx(1.55)
    assert file.dist_correction_y_m[3] == pytest.approx(1.525)
    assert file.vert_offset_m[3] == pytest.approx(0.195)
    assert file.horiz_offset_m[3] == pytest.approx(-0.026)
    assert file.dist_correction_m[4] == 0


def test_xml_of_32_lasers_lists_64() -> None:
    file = read(xml_of(points(64), [1] * 32 + [0] * 32), XML)
    assert file.lasers == 32
    assert len(file.elevation_rad) == 32
    assert file.enabled.all()
    assert file.notes == ("32 of 64 lasers are enabled",)


def test_xml_with_a_laser_switched_off() -> None:
    file = read(xml_of(points(64), [1] * 9 + [0] + [1] * 54), XML)
    assert file.lasers == 64
    assert (~file.enabled).nonzero()[0].tolist() == [9]
    assert file.notes == ("63 of 64 lasers are enabled",)


def test_xml_without_flags_has_all_lasers() -> None:
    file = read(xml_of(points(16)).replace("<?xml", "\ufeff<?xml", 1), XML)
    assert file.lasers == 16
    assert file.enabled.all()


ENTITIES = '<!DOCTYPE boost_serialization [<!ENTITY a "1111111111"><!ENTITY b "&a;&a;&a;">]>'


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (
            xml_of(points(64, id_=64)),
            "DB.points_.item[3].id_: expected a laser id from 0 to 63, found 64",
        ),
        (xml_of(points(64, id_=2)), "DB.points_.item[3].id_: expected each id once, found 2 again"),
        (xml_of(points(63)), "lasers: expected ids 0 to 63, found no laser 63"),
        (
            xml_of([]).replace("0.2<", "0.2<!-- rotCorrection_ --><"),
            "DB.points_: expected 1 to 128",
        ),
        (xml_of(points(129)), "DB.points_: expected 1 to 128 lasers, found 129"),
        (xml_of(points(64, vertCorrection_=91)), "vertCorrection_: expected at most 90 degrees"),
        (
            xml_of(points(64, rotCorrection_="nan")),
            "rotCorrection_: expected a finite number, found nan",
        ),
        (xml_of(points(64, distCorrection_=1500)), "distCorrection_: expected at most 500 cm"),
        (xml_of(points(64), [0] * 64), "DB.enabled_: expected enabled lasers, found none"),
        (xml_of(points(64), [2] * 64), "DB.enabled_: expected at most 128 items of 0 or 1"),
        (xml_of(points(64), [1] * 200), "DB.enabled_: expected at most 128 items of 0 or 1"),
        (xml_of(points(64), lsb_cm=20), "DB.distLSB_: expected 0.05 to 2 cm, found 20"),
        (xml_of(points(64))[:-200], "expected XML, found"),
        (
            xml_of(points(64), kind=ENTITIES),
            "expected XML without entities and definitions, found some",
        ),
        (
            xml_of(points(64), kind='<!DOCTYPE boost_serialization SYSTEM "a.dtd">'),
            "expected XML without entities and definitions, found some",
        ),
        (xml_of(points(64)) + " " * MAX_BYTES, "expected at most 1000000 bytes"),
    ],
)
def test_broken_xml(text: str, told: str) -> None:
    assert told in fault(text, XML)
