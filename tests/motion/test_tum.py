"""TUM files: exact times, and mistakes in one line with file and line."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from mlbatch.errors import RigError
from mlbatch.motion.tum import read_tum

GOOD = """\
# timestamp tx ty tz qx qy qz qw
1777881600.000000001 1 2 3 0 0 0 1
1777881600.1 1.5 2 3 0 0 0.70710678 0.70710678

1777881601 2 2 3 0 0 1 0
"""


def test_times_are_exact_to_the_ns(tmp_path: Path) -> None:
    path = tmp_path / "drive.tum"
    path.write_text(GOOD)
    track = read_tum(path)
    start = 1_777_881_600 * 10**9
    assert track.stamp_ns.tolist() == [start + 1, start + 10**8, start + 10**9]
    assert track.position_m.tolist() == [[1, 2, 3], [1.5, 2, 3], [2, 2, 3]]
    np.testing.assert_allclose(track.rotation[1] @ [1, 0, 0], [0, 1, 0], atol=1e-8)
    assert track.source == "drive.tum"


def test_exponents_are_read_as_numpy_writes_them(tmp_path: Path) -> None:
    path = tmp_path / "drive.tum"
    path.write_text("1.5e+00 0 0 0 0 0 0 1\n2.5e+00 0 0 0 0 0 0 1\n")
    assert read_tum(path).stamp_ns.tolist() == [1_500_000_000, 2_500_000_000]


def test_a_byte_order_mark_is_no_content(tmp_path: Path) -> None:
    path = tmp_path / "drive.tum"
    path.write_bytes(b"\xef\xbb\xbf" + GOOD.encode())
    assert len(read_tum(path).stamp_ns) == 3


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", r":2: expected a time after that of the line b"),
        ("1 0 0 0 0 0 1\n", r":1: expected 8 numbers \(time x y z qx qy qz qw\), found 7"),
        ("1 0 0 0 0 0 0 one\n", r":1: expected 8 finite numbers"),
        ("-1 0 0 0 0 0 0 1\n", r":1: expected 8 finite numbers, the first a time in s since 1970"),
        ("1 0 0 nan 0 0 0 1\n", r":1: expected 8 finite numbers"),
        ("177788160000 0 0 0 0 0 0 1\n", r":1: expected 8 finite numbers, the first a time in s"),
        (
            "1.777881600e+18 0 0 0 0 0 0 1\n",
            r":1: expected 8 finite numbers, the first a time in s",
        ),
        ("1 0 0 0 0 0 1 1\n", r":1: expected a unit quaternion x, y, z, w, found norm 1.414"),
        ("1 0 0 0 0 0 0 1\n", r": expected at least 2 poses, found 1"),
        ("", r": expected at least 2 poses, found 0"),
    ],
)
def test_a_mistake_is_one_line(text: str, expected: str, tmp_path: Path) -> None:
    path = tmp_path / "drive.tum"
    path.write_text(text)
    with pytest.raises(RigError) as caught:
        read_tum(path)
    assert re.search(r"drive\.tum" + expected, str(caught.value)), caught.value
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(RigError, match="expected a trajectory"):
        read_tum(tmp_path / "none.tum")
