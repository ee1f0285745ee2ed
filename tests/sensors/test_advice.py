"""Every lidar that needs a calibration file has advice on where it comes from."""

from __future__ import annotations

import re

import pytest

from mlbatch.lidar.interface import SensorModel
from mlbatch.sensors import models
from mlbatch.sensors.advice import calibration_advice

NEEDING = [model for model in models() if "required" in model.calibration]


@pytest.mark.parametrize("model", NEEDING, ids=lambda model: model.name)
def test_models_that_need_a_file_have_advice(model: SensorModel) -> None:
    advice = calibration_advice(f"{model.vendor} {model.name}")
    assert advice.startswith(f"{model.vendor} calls it ")
    # The kind of file that `mlbatch sensors` names.
    kinds = re.findall(r"\b(?:JSON|csv|dat|db\.xml)\b", model.calibration)
    assert kinds
    assert all(kind in advice for kind in kinds)
