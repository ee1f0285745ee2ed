"""The db.xml of VeloView, as Boost writes it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence


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


def entries(count: int, **changes: object) -> list[dict[str, object]]:
    """Points of a db.xml; changes are to laser 3."""
    found: list[dict[str, object]] = [
        {"id_": laser, "rotCorrection_": -1.5, "vertCorrection_": laser / 4}
        for laser in range(count)
    ]
    found[3].update(changes)
    return found
