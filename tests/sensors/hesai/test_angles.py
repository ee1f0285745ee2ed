"""Angle files of HESAI lidars: what is read, what is left to others, what is refused."""

from __future__ import annotations

import hashlib
import math
import struct
from pathlib import Path

import numpy as np
import pytest

from mlbatch.errors import RigError
from mlbatch.sensors.hesai.angles import HesaiAngles, read_angles, read_at128

NAME = Path("unit.csv")


def rows(count: int = 16) -> list[str]:
    """Lines of a good file; channel c has elevation c / 2 and azimuth -c deg."""
    return ["Laser id,Elevation,Azimuth", *(f"{c},{c / 2},{-c}" for c in range(1, count + 1))]


def text(lines: list[str], end: str = "\n") -> bytes:
    return "".join(line + end for line in lines).encode()


def read(lines: list[str], end: str = "\n") -> HesaiAngles:
    found = read_angles(NAME, text(lines, end))
    assert found is not None
    return found


def refusal(lines: list[str]) -> str:
    with pytest.raises(RigError) as caught:
        read_angles(NAME, text(lines))
    message = str(caught.value)
    assert message.startswith("unit.csv: HESAI angles, line ")
    assert message.endswith("; read the correction file from the lidar again")
    assert "\n" not in message
    return message.removeprefix("unit.csv: HESAI angles, ").partition("; ")[0]


def test_angles_are_in_rad_by_channel() -> None:
    found = read(rows())
    assert found.elevation_rad[3] == pytest.approx(2 * math.pi / 180)
    assert found.azimuth_rad[15] == pytest.approx(-16 * math.pi / 180)
    np.testing.assert_allclose(found.azimuth_rad, -2 * found.elevation_rad)


@pytest.mark.parametrize(
    "title",
    ["Channel,Elevation,Azimuth", "LaserID,Elevation,Azimuth", "laser id, elevation, azimuth,,"],
)
def test_titles_that_are_in_use(title: str) -> None:
    np.testing.assert_array_equal(
        read([title, *rows()[1:]]).elevation_rad, read(rows()).elevation_rad
    )


def test_columns_are_found_by_their_titles() -> None:
    swapped = [
        "Channel,Azimuth,Elevation",
        *(f"{c},{-c},{c / 2}" for c in range(1, 17)),
    ]
    np.testing.assert_array_equal(read(swapped).azimuth_rad, read(rows()).azimuth_rad)


def test_lines_around_the_rows_does_not_matter() -> None:
    first, *others = rows()
    dressed = [
        "\ufeffEEFF,1,1",
        "# angles of a unit",
        first,
        "",
        others[1],
        "# 2 before 1",
        others[0],
        *(line + ",," for line in others[2:]),
        ",,",
    ]
    for end in ("\n", "\r\n"):
        found = read(dressed, end)
        np.testing.assert_array_equal(found.azimuth_rad, read(rows()).azimuth_rad)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{}",
        b"\xee\xff\x01\x05\x80" + bytes(300),
        b"elevation,azimuth\n1.0,2.0\n",
        b"15.0,2.0\n13.0,2.0\n",
        b"Channel,fire time(us)\n1,2.31\n",
        b"EEFF,1,1\nChannel,fire time(us),Channel,fire time(us)\n1,0,2,1\n",
        b"index,start_ns,end_ns\n0,1,2\n",
        b"Laser id\n1\n",
        b"Channel,Azimuth,Azimuth\n1,2,3\n",
        "körper: größe\n".encode("latin-1"),
        b"x,y,z\n" * 40 + text(rows()),
    ],
)
def test_other_files_are_left_to_others(content: bytes) -> None:
    assert read_angles(NAME, content) is None


BROKEN = {
    "twice": (2, ["1,0,0"], "line 3: expected every channel once, found channel 1 again"),
    "missing": (9, [], "line 16: expected channels 1 to 16, found no channel 9"),
    "nan": (4, ["4,nan,0"], "line 5: expected elevation from -90 to 90 deg, found nan"),
    "high": (4, ["4,90.5,0"], "line 5: expected elevation from -90 to 90 deg, found 90.5"),
    "far": (4, ["4,0,-361"], "line 5: expected azimuth from -360 to 360 deg, found -361"),
    "infinite": (4, ["4,0,inf"], "line 5: expected azimuth from -360 to 360 deg, found inf"),
    "word": (4, ["4,abc,0"], "line 5: expected elevation from -90 to 90 deg, found abc"),
    "zero": (1, ["0,0,0"], "line 2: expected a channel from 1 to 128, found 0"),
    "many": (1, ["129,0,0"], "line 2: expected a channel from 1 to 128, found 129"),
    "name": (1, ["one,0,0"], "line 2: expected a channel from 1 to 128, found one"),
    "two cells": (16, ["16,8.0"], "line 17: expected channel, elevation, azimuth, found 16, 8.0"),
    "empty cell": (16, ["16,,3"], "line 17: expected elevation from -90 to 90 deg, found nothing"),
    "long": (
        1,
        ["1" + "x" * 99],
        "line 2: expected channel, elevation, azimuth, found 1" + "x" * 56,
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_rows_are_refused(name: str) -> None:
    at, instead, message = BROKEN[name]
    lines = rows()
    lines[at : at + 1] = instead
    assert refusal(lines).startswith(message)


def test_files_that_end_early_are_refused() -> None:
    expected = "16, 20, 32, 40, 64, 90 or 128 channels in all"
    assert refusal(rows()[:12]) == f"line 12: expected {expected}, found 11"
    assert refusal(rows()[:1]) == f"line 1: expected {expected}, found 0"


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
def test_digest_counts_lines_with_crlf_ends(end: str, mark: bytes) -> None:
    digest = hashlib.sha256(text(rows(), "\r\n")).hexdigest()
    content = mark + text([*rows(), f"{digest},,"], end)
    assert read_angles(NAME, content) is not None


def test_digest_finds_a_changed_angle() -> None:
    digest = hashlib.sha256(text(rows(), "\r\n")).hexdigest()
    lines = [*rows(), f"{digest},,"]
    lines[3] = "3,1.6,-3"
    expected = "expected lines that match this SHA-256, found changed lines"
    assert refusal(lines) == f"line 18: {expected}"


def at128_content(resolution: int = 2) -> bytes:
    """Frames at 20, 140, 260 deg, 120 deg wide; azimuth 1 deg, elevation channel / 10 deg, from 0.

    Adjust of channel 1 at 4 deg: azimuth 0.06, elevation -0.02 deg; elsewhere 0.
    """
    per_deg = 25600 // resolution
    adjust = bytearray(2 * 128 * 180)
    adjust[180 + 2], adjust[128 * 180 + 180 + 2] = 6 // resolution, 256 - 2 // resolution
    body = b"\xee\xff\x01\x05\x80\x03\x03" + bytes(8) + bytes([resolution])
    body += struct.pack("<3I", *(deg * per_deg for deg in (20, 140, 260)))
    body += struct.pack("<3I", *(deg * per_deg for deg in (140, 260, 20)))
    body += struct.pack("<128i", *([per_deg] * 128))
    body += struct.pack("<128i", *(per_deg * channel // 10 for channel in range(128)))
    body += bytes(adjust)
    return body + hashlib.sha256(body).digest()


@pytest.mark.parametrize("resolution", [1, 2])
def test_at128_units(resolution: int) -> None:
    content = at128_content(resolution)
    assert len(content) == 47176
    found = read_at128(Path("at.dat"), content)
    assert found is not None
    degrees = 180 / math.pi
    assert found.start_rad * degrees == pytest.approx([20, 140, 260])
    assert found.azimuth_rad * degrees == pytest.approx(np.ones(128))
    assert found.elevation_rad[120] * degrees == pytest.approx(12)
    assert found.azimuth_adjust_rad[1, 2] * degrees == pytest.approx(0.06)
    assert found.elevation_adjust_rad[1, 2] * degrees == pytest.approx(-0.02)
    assert np.count_nonzero(found.azimuth_adjust_rad) == 1


@pytest.mark.parametrize("content", [b"", b"\xee\xff", bytes(47176), text(rows())])
def test_files_that_are_no_at128_files(content: bytes) -> None:
    assert read_at128(Path("at.dat"), content) is None


@pytest.mark.parametrize(
    ("at", "value", "message"),
    [
        (3, 3, "expected version 1.5, found 1.3"),
        (4, 64, "expected channels 128, found 64"),
        (5, 4, "expected mirrors 3, found 4"),
        (6, 1, "expected frames 3, found 1"),
        (15, 0, "expected a resolution from 1 to 8, found 0"),
        (9000, 1, "expected content that matches its SHA-256, found changed content"),
    ],
)
def test_damaged_at128_files_are_refused(at: int, value: int, message: str) -> None:
    content = bytearray(at128_content())
    content[at] = value
    with pytest.raises(RigError) as caught:
        read_at128(Path("at.dat"), bytes(content))
    assert str(caught.value) == (
        f"at.dat: HESAI AT128 angles: {message}; read the correction file from the lidar again"
    )


def test_at128_file_that_ends_early_is_refused() -> None:
    with pytest.raises(RigError, match="expected 47176 bytes, found 400 bytes"):
        read_at128(Path("at.dat"), at128_content()[:400])
