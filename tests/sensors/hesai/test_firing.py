"""Firing tables and optical centres of models are those of the document.

The encoder fires as the decoder does: `tests/sensors/test_round_trip.py`.
"""

from __future__ import annotations

import numpy as np
import pytest

from mlbatch.sensors.hesai import firing
from mlbatch.sensors.hesai.models import ALL, AZIMUTH_STATES, OPERATIONS
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


@pytest.mark.parametrize("name", [name for name in MODELS if name not in WITHOUT_CENTRE])
def test_optical_centres_are_those_of_the_document(name: str) -> None:
    wanted = reference.optical_centre_mm(name)
    # That of a JT16 is rotated: the page has it to a micrometre.
    assert MODELS[name].centre_mm == pytest.approx(wanted, abs=0.0006 if name == "JT16" else 0)


def test_models_without_a_known_optical_centre_have_none() -> None:
    assert {MODELS[name].centre_mm for name in WITHOUT_CENTRE} == {(0.0, 0.0, 0.0)}


def test_tables_cannot_be_changed() -> None:
    with pytest.raises(ValueError, match="read-only"):
        firing.QT128[0, 0] = 1
