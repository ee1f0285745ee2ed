"""The door to all makers: models and files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from mlbatch import sensors
from mlbatch.errors import RigError
from tests.builders.ouster import OusterSpec, metadata_json


def test_every_model_has_its_own_name_and_a_vendor() -> None:
    names = [model.name for model in sensors.models()]
    assert len(set(names)) == len(names)
    assert {model.vendor for model in sensors.models()} == {
        plugin.VENDOR for plugin in sensors.plugins() if plugin.MODELS
    }


def test_every_model_states_how_it_was_verified() -> None:
    verified = {model.verified for model in sensors.models()}
    assert verified == {"real recording", "two sources", "one source"}


def test_the_models_of_ouster() -> None:
    rows = {model.name: model for model in sensors.models() if model.vendor == "Ouster"}
    real = {name for name, model in rows.items() if model.verified == "real recording"}
    assert real == {"OS0-32", "OS0-128", "OS1-32", "OS1-64", "OS1-128", "OS2-128"}
    assert rows["OS1-16"].channels == 16
    assert rows["OSDome-128"].returns == (1, 2)


def test_a_metadata_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "front.json"
    path.write_text(json.dumps(metadata_json(OusterSpec(serial=77))))
    found = sensors.read_calibration(path)
    assert found is not None
    assert (found.path, found.model, found.serial) == (path, "OS-1-128", "77")


def test_files_that_cannot_be_read_are_reported(tmp_path: Path) -> None:
    with pytest.raises(
        RigError, match=r"none\.json: expected a calibration file, found no such file"
    ):
        sensors.read_calibration(tmp_path / "none.json")
    with pytest.raises(RigError, match="expected a calibration file, found a directory"):
        sensors.read_calibration(tmp_path)


def test_a_file_too_large_for_a_calibration_is_none(tmp_path: Path) -> None:
    path = tmp_path / "large.json"
    content = json.dumps(metadata_json(OusterSpec())).encode()
    path.write_bytes(content + b" " * (sensors.MAX_CALIBRATION_BYTES - len(content)))
    assert sensors.read_calibration(path) is not None
    with path.open("ab") as file:
        file.write(b" ")
    assert sensors.read_calibration(path) is None


def test_no_vendor_knows_an_odd_packet() -> None:
    assert sensors.describe(3, np.zeros((2, 3), np.uint8)) is None
