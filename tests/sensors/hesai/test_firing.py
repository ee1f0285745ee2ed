"""Firing tables and optical centres of models and of the encoder: the document, and laws."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from mlbatch.arrays import I64Array
from mlbatch.sensors.hesai import firing
from mlbatch.sensors.hesai.firing import HIGH, NEVER, OT128, SAVING, STANDARD
from mlbatch.sensors.hesai.models import ALL, AZIMUTH_STATES, OPERATIONS
from mlbatch.simulate.hesai import models as encoder
from tests.reference import hesai as reference

FAMILIES = {"Pandar128E3X": "128E3X", "OT128": "OT128"}
MODELS = {model.name: model for model in ALL}
WITHOUT_CENTRE = ("Pandar20A", "Pandar20B", "AT128")


@pytest.mark.parametrize("name", [name for name in MODELS if name not in FAMILIES])
def test_a_model_fires_as_the_document_says(name: str) -> None:
    np.testing.assert_array_equal(MODELS[name].firing_ns, reference.firing_ns(name))


@pytest.mark.parametrize("name", FAMILIES)
def test_modes_and_states_choose_the_table_of_the_document(name: str) -> None:
    wanted = reference.by_state(FAMILIES[name])
    assert len(wanted) == OPERATIONS * AZIMUTH_STATES
    for key, times in wanted.items():
        table = MODELS[name].firing_ns[MODELS[name].tables[key]]
        np.testing.assert_array_equal(table, times, str(key))


@pytest.mark.parametrize("name", encoder.TABLES)
def test_the_encoder_fires_as_the_document_says(name: str) -> None:
    wanted = reference.firing_ns(name.removesuffix("-7"))
    np.testing.assert_array_equal(np.atleast_2d(encoder.TABLES[name]), wanted)


@pytest.mark.parametrize("name", FAMILIES)
def test_the_encoder_has_the_states_of_the_document(name: str) -> None:
    wanted = reference.by_state(FAMILIES[name])
    for (mode, state), times in encoder.STATES[name].items():
        operation = encoder.OPERATIONS[mode]
        np.testing.assert_array_equal(times, wanted[operation, state], f"{mode} {state}")


@pytest.mark.parametrize("name", [name for name in MODELS if name not in WITHOUT_CENTRE])
def test_optical_centres_are_those_of_the_document(name: str) -> None:
    wanted = reference.optical_centre_mm(name)
    # That of a JT16 is rotated: the page has it to a micrometre.
    assert MODELS[name].centre_mm == pytest.approx(wanted, abs=0.0006 if name == "JT16" else 0)


def test_models_without_a_known_optical_centre_have_none() -> None:
    assert {MODELS[name].centre_mm for name in WITHOUT_CENTRE} == {(0.0, 0.0, 0.0)}


def test_tables_are_on_the_side_of_the_block_time_that_the_manual_states() -> None:
    assert firing.P40.max() == firing.P64.max() == -3620
    assert min(firing.QT64.min(), firing.XT16.min(), firing.XT32.min()) > 0


def test_beams_of_pandar20_fire_as_those_of_pandar40p_that_look_alike() -> None:
    """Channels of a Pandar40P at elevations of 8, 5, 3, 2, 1.67, 1 deg; and from 3 deg on."""
    same = [2, 3, 4, 5, 6, 8]
    assert np.abs(firing.P20A[:6] - firing.P40[same]).max() < 10
    assert np.abs(firing.P20B[:4] - firing.P40[same[2:]]).max() < 10


def test_loops_of_qt128_leave_a_quarter_silent() -> None:
    first, second = firing.QT128
    np.testing.assert_array_equal(np.flatnonzero(first == NEVER), np.arange(32))
    np.testing.assert_array_equal(np.flatnonzero(second == NEVER), np.arange(32, 64))


@pytest.mark.parametrize("tables", [firing.E128, OT128])
def test_a_quarter_of_the_channels_is_silent_in_high_resolution(
    tables: Mapping[tuple[str, int], I64Array],
) -> None:
    for (mode, _), times in tables.items():
        assert np.count_nonzero(times == NEVER) == (32 if mode == HIGH else 0)


def test_what_fires_in_both_states_of_ot128_fires_at_once_in_standard_mode() -> None:
    high, standard = OT128[HIGH, 0], OT128[STANDARD, 0]
    fires = high != NEVER
    np.testing.assert_array_equal(high[fires], standard[fires])


def test_energy_saving_fires_as_standard() -> None:
    np.testing.assert_array_equal(firing.E128[SAVING, 1], firing.E128[STANDARD, 1])


def test_tables_cannot_be_changed() -> None:
    with pytest.raises(ValueError, match="read-only"):
        firing.QT128[0, 0] = 1
