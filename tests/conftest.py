"""What all tests share: one profile of hypothesis, and the command line in an empty folder."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from tests.builders.sessions import Shell

# No deadline: how long an example takes depends on how loaded the machine is.
settings.register_profile("mlbatch", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("mlbatch")


@pytest.fixture
def shell(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> Shell:
    """The command line, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return Shell(monkeypatch, capsys)
