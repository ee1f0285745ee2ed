"""TUM files: exact times, and mistakes in one line with file and line."""

from __future__ import annotations

import math
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


def quaternion(yaw_deg: float, roll_deg: float = 0.0) -> list[float]:
    """x, y, z, w of a body with a heading that leans to its side."""
    yaw, roll = math.radians(yaw_deg) / 2, math.radians(roll_deg) / 2
    return [
        math.cos(yaw) * math.sin(roll),
        math.sin(yaw) * math.sin(roll),
        math.sin(yaw) * math.cos(roll),
        math.cos(yaw) * math.cos(roll),
    ]


def turning(path: Path, first_deg: float, last_deg: float, roll_deg: float, shift: int) -> None:
    """Poses of a body that turns; shift: 1 for w first."""
    lines = []
    for number in range(50):
        yaw_deg = first_deg + (last_deg - first_deg) * number / 49
        numbers = quaternion(yaw_deg, roll_deg)
        numbers = numbers[-shift:] + numbers[:-shift] if shift else numbers
        lines.append(f"{number}.5 {number} 0 0 " + " ".join(f"{one:.9f}" for one in numbers))
    path.write_text("\n".join(lines) + "\n")


# Headings of half a circle around that of the start: what is read is tilted by 180 less them.
HEADINGS = [(0, 0), (0, 90), (-60, 60), (0, 360)]


@pytest.mark.parametrize(("first", "last"), HEADINGS)
@pytest.mark.parametrize("roll", [0.0, 4.0, -4.0])
def test_w_first_is_refused(first: float, last: float, roll: float, tmp_path: Path) -> None:
    path = tmp_path / "drive.tum"
    turning(path, first, last, roll, 1)
    message = r"drive\.tum: expected quaternions as qx qy qz qw, found \d+ % .*; write w last"
    with pytest.raises(RigError, match=message):
        read_tum(path)


@pytest.mark.parametrize(("first", "last"), [*HEADINGS, (0, 180), (90, 270)])
@pytest.mark.parametrize("roll", [0.0, 10.0, 40.0, 90.0])
def test_w_last_is_read(first: float, last: float, roll: float, tmp_path: Path) -> None:
    """On a slope as well; on its side, where the body does turn."""
    if roll == 90.0 and (first, last) == (0, 0):
        pytest.skip("lying on its side and level with w first are the same numbers")
    path = tmp_path / "drive.tum"
    turning(path, first, last, roll, 0)
    assert len(read_tum(path).stamp_ns) == 50
