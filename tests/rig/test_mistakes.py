"""The exact one-line error of each mistake in a rig file: `tests/cli/cases/rigs.txt`."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mlbatch.errors import RigError
from mlbatch.rig.rig import read_rig
from tests.builders.sessions import FIXTURE, Shell
from tests.builders.transcripts import transcripts
from tests.rig.test_extrinsics_files import FILES

CASES = transcripts("rigs")
VALID = """\
body_frame: base_link
rate_hz: 29.97
sensors:
  - name: left
    stream: {source_ip: 10.5.5.87, port: 7502}
    extrinsics: {translation_m: [0.1, 0.9, 2.8], rotation_rpy_deg: [0, 0, 90]}
    clock: {source: host, offset_s: -1.000000001}
  - name: rear
    extrinsics:
      matrix:
        - [0, -1, 0, -2]
        - [1, 0, 0, 0.5]
        - [0, 0, 1, 1e-1]
exclude_boxes_m: [[-3, -2, -1, 1, 2, 4]]
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with files that rigs name."""
    folder = tmp_path_factory.mktemp("rigs")
    (folder / "fix").symlink_to(FIXTURE)
    for name, text in FILES.items():
        (folder / name).write_text(text)
    return folder


@pytest.mark.parametrize("name", CASES)
def test_mistake(monkeypatch: pytest.MonkeyPatch, place: Path, name: str) -> None:
    CASES[name].check(Shell(monkeypatch, place), place)


def _answer(file: Path) -> str:
    """The error of the file; empty if it has none."""
    try:
        read_rig(file)
    except RigError as err:
        return str(err)
    return ""


@given(st.text(max_size=60), st.integers(min_value=0, max_value=len(VALID)))
def test_any_text_is_read_or_refused_in_one_line(
    tmp_path_factory: pytest.TempPathFactory, text: str, position: int
) -> None:
    file = tmp_path_factory.getbasetemp() / "noise.yaml"
    noisy = VALID[:position] + text + VALID[position:]
    for content in (text, noisy):
        file.write_bytes(content.encode("utf-8", "surrogatepass"))
        answer = _answer(file)
        assert "\n" not in answer
        assert answer == "" or answer.startswith(str(file))
