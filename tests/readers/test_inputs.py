"""Recordings as users name them: files, folders, patterns."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.builders.mcaps import write_mcap
from tests.builders.sessions import Shell, Unit, twin, write_session
from tests.builders.sessions_of_bags import unit_messages
from tests.builders.transcripts import transcripts

CASES = transcripts("inputs")


@pytest.mark.parametrize("name", CASES)
def test_transcript(shell: Shell, tmp_path: Path, name: str) -> None:
    """In a folder with two captures of one session and their metadata, and a bag."""
    parts = tmp_path / "parts"
    write_session(parts, Unit()).rename(parts / "left.pcap")
    write_session(parts, twin(Unit(), 222)).rename(parts / "right.pcap")
    write_mcap(tmp_path / "parts.mcap", unit_messages(Unit(turns=1), "top"))
    CASES[name].check(shell, tmp_path)
