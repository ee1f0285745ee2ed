"""Rows of models say what docs/sources say: layouts, beams, times, lenses, optical centres, units.

Decoders and encoders both take them from there: `test_round_trip.py` shows that they agree on all
else.
"""

from __future__ import annotations

import numpy as np
import pytest

from mlbatch.sensors.hesai import firing
from mlbatch.sensors.hesai.models import ALL, AZIMUTH_STATES, OPERATIONS
from mlbatch.sensors.robosense.models import ROWS
from mlbatch.sensors.robosense.models import Model as Robosense
from mlbatch.sensors.velodyne.models import ALL as VELODYNES
from mlbatch.sensors.velodyne.models import Model as Velodyne
from tests.reference import hesai, robosense, velodyne

FAMILIES = {"Pandar128E3X": "128E3X", "OT128": "OT128"}
HESAI = {model.name: model for model in ALL}
WITHOUT_CENTRE = ("Pandar20A", "Pandar20B", "AT128")


@pytest.mark.parametrize("row", VELODYNES, ids=lambda row: row.name)
def test_a_velodyne(row: Velodyne) -> None:
    sequence_us, times_us = velodyne.times_us(row.name)
    assert row.sequence_ns / 1000 == sequence_us
    assert row.firing_ns(row.sequence_ns)[0] / 1000 == pytest.approx(times_us, abs=0.0005)
    assert 1 / row.units_per_m == velodyne.unit_m(row.name)
    if not row.needs_file:
        elevation_deg, azimuth_deg, height_mm = velodyne.beams(row.name)
        assert list(row.elevation_deg) == elevation_deg
        assert list(row.clockwise_deg) == azimuth_deg
        assert row.height_mm == pytest.approx(height_mm)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_a_robosense(row: Robosense) -> None:
    wanted_us = robosense.firing_us(row.name)
    assert len(row.firing_ns) == len(wanted_us)
    for found_ns, times_us in zip(row.firing_ns, wanted_us, strict=True):
        assert [time_ns / 1000 for time_ns in found_ns] == pytest.approx(times_us)
    assert row.round_ns / 1000 == robosense.round_us(row.name)
    assert 1 / row.units_per_m == robosense.unit_m(row.name)
    assert row.lens_m == robosense.lens_m(row.name)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_layout_of_a_robosense(row: Robosense) -> None:
    layout, angles = row.layout, row.angles
    assert (layout.header, layout.block_id, layout.blocks, layout.per_block, layout.stride) == (
        robosense.blocks(row.name)
    )
    assert (layout.time_at, layout.mode_at) == robosense.fields(row.name)
    assert layout.magic == robosense.magic(row.name)
    assert (angles.elevation_at, angles.azimuth_at, angles.unit_deg) == robosense.angles(row.name)


@pytest.mark.parametrize("name", hesai.LAYOUTS)
def test_layout_of_a_hesai(name: str) -> None:
    row = HESAI[name]
    header, blocks, *rest = hesai.layout(name)
    assert header == row.header
    assert blocks in row.blocks
    assert rest == [row.channels, row.azimuth_at, row.lead, row.unit]
    tail = row.tail
    for at, field in (
        (tail.size, "tail length so far"),
        (tail.date_at, "date and time, 6 bytes"),
        (tail.us_at, "microseconds u32"),
        (tail.mode_at, "return mode u8"),
        (tail.rpm_at, "motor speed u16, rpm"),
    ):
        assert at == hesai.tail(name, field), field
    for used_at, field in (
        (tail.loop_at, "mode flag u8 (which firing loop)"),
        (tail.states_at, "azimuth state u16"),
        (tail.operation_at, "operational state u8"),
    ):
        assert used_at in (None, hesai.tail(name, field)), field
    base_ns, step_ns = hesai.cadence_ns(name)
    # That of an AT128 counts to a third block, which it does not have.
    base_ns += round(step_ns) if name == "AT128" else 0
    timing = row.timing
    sign = -1 if timing.counts_back else 1
    assert (timing.base_ns, sign * timing.step_ns / timing.divisor) == (base_ns, step_ns)


def test_layouts_without_a_row_in_the_tables_of_hesai() -> None:
    # Section 8: 6 date, 12 microseconds, 16 azimuth, 18 16 channels of 3 bytes; CRC to byte 80.
    jt16 = HESAI["JT16"]
    assert (jt16.tail.date_at, jt16.tail.us_at, jt16.header, jt16.lead) == (6, 12, 16, 2)
    assert (jt16.channels, jt16.unit, jt16.tail.size + jt16.tail.sequence_bytes + 4) == (16, 3, 80)
    # Section 1: 20 lasers and blocks, with the header of a Pandar64; section 5.
    old, row = HESAI["Pandar64"], HESAI["Pandar20A"]
    assert (row.channels, row.blocks, row.header, row.unit) == (20, (20,), old.header, old.unit)
    assert (row.tail, row.timing.base_ns, row.timing.step_ns) == (old.tail, -28580, 55560)


@pytest.mark.parametrize("name", [name for name in HESAI if name not in FAMILIES])
def test_firing_times_of_a_hesai(name: str) -> None:
    np.testing.assert_array_equal(HESAI[name].firing_ns, hesai.firing_ns(name))


@pytest.mark.parametrize("name", FAMILIES)
def test_modes_and_states_choose_the_table_of_the_document(name: str) -> None:
    wanted = hesai.by_state(FAMILIES[name])
    assert len(wanted) == OPERATIONS * AZIMUTH_STATES
    for key, times in wanted.items():
        table = HESAI[name].firing_ns[HESAI[name].tables[key]]
        np.testing.assert_array_equal(table, times, str(key))


@pytest.mark.parametrize("name", [name for name in HESAI if name not in WITHOUT_CENTRE])
def test_optical_centres_are_those_of_the_document(name: str) -> None:
    wanted = hesai.optical_centre_mm(name)
    # That of a JT16 is rotated: the page has it to a micrometre.
    assert HESAI[name].centre_mm == pytest.approx(wanted, abs=0.0006 if name == "JT16" else 0)


def test_models_without_a_known_optical_centre_have_none() -> None:
    assert {HESAI[name].centre_mm for name in WITHOUT_CENTRE} == {(0.0, 0.0, 0.0)}


def test_tables_cannot_be_changed() -> None:
    with pytest.raises(ValueError, match="read-only"):
        firing.QT128[0, 0] = 1
