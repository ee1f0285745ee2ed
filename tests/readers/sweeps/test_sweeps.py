"""Folders with a file for each sweep: points at their own times, and mistakes in one line.

Stamps are known by construction: column n of a sweep is measured n ms after the time in its name.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mlbatch.readers.datasets import DATASET_FILES
from mlbatch.readers.sweeps.files import SweepError, read_sweep
from mlbatch.rig.rig import Sweeps, read_rig
from mlbatch.rig.write import write_rig
from tests.builders.run import scan_files
from tests.builders.sessions import Shell
from tests.builders.sweeps import dtype_text, pcd, raw, write_sweeps

MS = 1_000_000
START_NS = 1_700_000_000_000_000_000
SWEEPS = 4
COLUMNS = 98
RINGS = 4
FIELDS = {"x": "f4", "y": "f4", "z": "f4", "intensity": "f4", "t": "u4", "ring": "u2"}
POINTS = [
    (5.0, float(ring), 2.0, 9.0, column * MS, ring)
    for column in range(COLUMNS)
    for ring in range(RINGS)
]


def _starts() -> list[int]:
    return [START_NS + number * 100 * MS for number in range(SWEEPS)]


def _names(suffix: str = ".bin") -> dict[str, bytes]:
    return {f"{start}{suffix}": raw(FIELDS, POINTS) for start in _starts()}


def _rig(points: str) -> None:
    text = (
        f"sensors:\n- name: top\n  points: {points}\n  extrinsics: {{translation_m: [0, 0, 1]}}\n"
    )
    Path("rig.yaml").write_text(text)


GLOB = f"{{glob: top/*.bin, dtype: {dtype_text(FIELDS)}, from: start}}"


def _run(shell: Shell, points: str = GLOB) -> Any:
    _rig(points)
    return shell("convert drive --rig rig.yaml -o out --keep-partial --overwrite")


def _columns(folder: str = "out") -> list[int]:
    stamps: set[int] = set()
    for path in scan_files(Path(folder)):
        with np.load(path) as scan:
            stamps |= set((scan["column_stamp_ns"] - START_NS).tolist())
    return sorted(stamps)


def _xyz(folder: str = "out") -> Any:
    found = []
    for path in scan_files(Path(folder)):
        with np.load(path) as scan:
            found.append(scan["xyz"])
    return np.concatenate(found)


EXPECTED = [number * 100 * MS + n * MS for number in range(SWEEPS) for n in range(COLUMNS)]


def test_points_are_at_the_time_of_the_name_and_their_own(shell: Shell) -> None:
    write_sweeps(Path("drive/top"), _names())
    outcome = _run(shell)
    assert outcome.code == 0, outcome.err
    assert _columns() == EXPECTED
    xyz = _xyz()
    assert len(xyz) == SWEEPS * COLUMNS * RINGS
    # 1 m higher by the extrinsics.
    np.testing.assert_array_equal(np.unique(xyz[:, 2]), [3.0])
    np.testing.assert_array_equal(np.unique(xyz[:, 1]), [0.0, 1.0, 2.0, 3.0])
    report = json.loads(Path("out/report.json").read_text())
    assert report["sensors"][0]["points"]["written"] == SWEEPS * COLUMNS * RINGS
    assert [one["code"] for one in report["warnings"]] == ["clouds"]
    assert shell("verify out").code == 0


def test_a_lost_sweep_leaves_scans_that_lack_its_columns(shell: Shell) -> None:
    """The sweep of 537 to 635 ms is lost: window 5 keeps 37 of 98 columns, window 6 keeps 61."""
    rows = [f"- name: {name}\n  points: {GLOB.replace('top', name)}\n" for name in ("top", "rear")]
    poses = "  extrinsics: {{translation_m: [{}, 0, 1]}}\n"
    Path("rig.yaml").write_text(f"sensors:\n{rows[0]}{poses.format(0)}{rows[1]}{poses.format(1)}")
    for name, phase, lost in (("top", 0, ()), ("rear", 37 * MS, (5,))):
        starts = (
            START_NS + number * 100 * MS + phase for number in range(10) if number not in lost
        )
        write_sweeps(Path("drive") / name, {f"{at}.bin": raw(FIELDS, POINTS) for at in starts})
    outcome = shell("convert drive --rig rig.yaml -o out --fail-on underfilled>0")
    assert outcome.code == 3
    assert "rear: 1 of 9 scans have less than half of its usual columns, 0 have none" in outcome.err
    report = json.loads(Path("out/report.json").read_text())
    assert report["scans"]["underfilled_by_sensor"] == {"rear": 1}
    assert shell("verify out").code == 0
    report["scans"]["underfilled_by_sensor"] = {"rear": 2}
    Path("out/report.json").write_text(json.dumps(report))
    assert shell("verify out").code == 1


def _pcds(data: str) -> dict[str, bytes]:
    return {f"{start}.pcd": pcd(FIELDS, POINTS, data) for start in _starts()}


def _pcds_of_us(data: str) -> dict[str, bytes]:
    """Microseconds since 1970, as in the PCD files of TruckScenes: exact as float64."""
    fields = {"x": "f4", "y": "f4", "z": "f4", "intensity": "f4", "timestamp": "u8"}
    return {
        f"{start}.pcd": pcd(
            fields, [(*one[:4], start // 1000 + one[4] // 1000) for one in POINTS], data
        )
        for start in _starts()
    }


def _named(name: str, unit: int = 1) -> dict[str, bytes]:
    names = [name.format(start // unit, *divmod(start, 10**9)) for start in _starts()]
    return dict.fromkeys(names, raw(FIELDS, POINTS))


def _saved(array: Any = None, **arrays: Any) -> bytes:
    """A .npy or .npz file."""
    file = io.BytesIO()
    np.save(file, array) if array is not None else np.savez_compressed(file, **arrays)
    return file.getvalue()


# float64 holds ms after the start and the numbers of rings exactly.
TABLE = np.array(POINTS)
XYZ = {"points": TABLE[:, :3], "level": TABLE[:, 3].astype("u1"), "ring": TABLE[:, 5].astype("i8")}
WIDE = {"x": "f4", "y": "f4", "z": "f4", "intensity": "f4", "us": "u8"}
ARRAYS = "arrays: {x: points.0, y: points.1, z: points.2, intensity: level, ring: ring, t: us}"


PADDED = {"x": "f4", "pad": "u1", "y": "f4", "z": "f4", "intensity": "f4", "t": "u4"}
PADDED_POINTS = [(x, 255, y, z, i, t) for x, y, z, i, t, _ in POINTS]
# Files of the same sweeps, and how the rig describes them.
FORMS: Mapping[str, tuple[Mapping[str, bytes], str]] = {
    "pcd, binary": (_pcds("binary"), "{glob: top/*.pcd, from: start}"),
    "pcd, ascii": (_pcds("ascii"), "{glob: top/*.pcd, from: start}"),
    "64 bits, ascii": (_pcds_of_us("ascii"), "{glob: top/*.pcd, unit: us, from: absolute}"),
    # The unit of a name is that of its digits.
    "names in us": (_named("{0}.bin", 1000), GLOB),
    "names in ms": (_named("{0}.bin", MS), GLOB),
    "names in s and ns": (_named("{1}.{2:09d}.bin"), GLOB),
    "names of two numbers": (_named("{1}_{2:09d}.bin"), GLOB),
    "npy of one type": (
        {f"{start}.npy": _saved(TABLE) for start in _starts()},
        "{glob: top/*.npy, from: start, unit: ns, dtype: "
        "{x: f8, y: f8, z: f8, intensity: f8, t: f8, V8: V8}}",
    ),
    # The time is that of the points.
    "npz": (
        {
            f"view_{number}.npz": _saved(**XYZ, us=start // 1000 + TABLE[:, 4].astype("i8") // 1000)
            for number, start in enumerate(_starts())
        },
        f"{{glob: top/*.npz, {ARRAYS}, unit: us, from: absolute}}",
    ),
    "64 bits, raw": (
        {
            f"{number}.bin": raw(WIDE, [(*p[:4], start // 1000 + p[4] // 1000) for p in POINTS])
            for number, start in enumerate(_starts())
        },
        f"{{glob: top/*.bin, dtype: {dtype_text(WIDE)}, time: us, unit: us, from: absolute}}",
    ),
    "padding": (
        {f"{start}.bin": raw(PADDED, PADDED_POINTS) for start in _starts()},
        f"{{glob: top/*.bin, dtype: {dtype_text({**PADDED, 'pad': 'V1'})}, from: start}}",
    ),
}


@pytest.mark.parametrize("name", FORMS)
def test_every_form_gives_the_same_scans(shell: Shell, name: str) -> None:
    files, points = FORMS[name]
    write_sweeps(Path("drive/top"), files)
    outcome = _run(shell, points)
    assert outcome.code == 0, outcome.err
    assert _columns() == EXPECTED
    np.testing.assert_array_equal(_xyz(), [(x, y, z + 1) for x, y, z, *_ in POINTS * SWEEPS])


def test_a_file_cut_off_is_counted_and_named(shell: Shell) -> None:
    sweeps = _names()
    last = sorted(sweeps)[-1]
    sweeps[last] = sweeps[last][:-1]
    write_sweeps(Path("drive/top"), sweeps)
    outcome = _run(shell)
    assert outcome.code == 0, outcome.err
    assert _columns() == EXPECTED[:-COLUMNS]
    report = json.loads(Path("out/report.json").read_text())
    assert report["capture"]["skipped"] == {"truncated": 1}
    # A frame for each column of the other files, and one for the file itself.
    assert report["capture"]["frames"] == (SWEEPS - 1) * COLUMNS + 1
    size = len(sweeps[last])
    assert f"{last}: expected a multiple of 22 bytes" in outcome.err
    assert f"found {size}; correct `dtype`, or copy the file again" in outcome.err


def test_files_without_a_time_of_any_kind_are_counted(shell: Shell) -> None:
    """The first by name is damaged, the second has no points."""
    files, points = FORMS["npz"]
    none = {name: array[:0] for name, array in XYZ.items()}
    others = {"a.npz": files["view_0.npz"][:-40], "b.npz": _saved(**none, us=np.zeros(0, "i8"))}
    write_sweeps(Path("drive/top"), {**others, **files})
    outcome = _run(shell, points)
    assert outcome.code == 0, outcome.err
    assert _columns() == EXPECTED
    capture = json.loads(Path("out/report.json").read_text())["capture"]
    assert capture["skipped"] == {"truncated": 1}
    assert "a.npz: expected arrays of numbers" in outcome.err


@pytest.mark.parametrize("points", [GLOB, f"{{glob: 'a/{{stamp:us}}.npz', {ARRAYS}}}"])
def test_a_rig_with_sweeps_is_written_as_it_was_read(tmp_path: Path, points: str) -> None:
    file = tmp_path / "rig.yaml"
    file.write_text(f"sensors: [{{name: top, points: {points}}}]\n")
    rig = read_rig(file)
    assert rig.sensors[0].sweeps is not None
    file.write_text(write_rig(rig, tmp_path))
    again = read_rig(file).sensors[0]
    assert again.sweeps is not None
    assert again.sweeps._replace(place="") == rig.sensors[0].sweeps._replace(place="")
    assert (again.points, again.stream) == (rig.sensors[0].points, rig.sensors[0].stream)


# -- mistakes -------------------------------------------------------------------------------------

NAME = f"{START_NS}.bin"


@pytest.mark.parametrize(
    ("sweeps", "points", "expected"),
    [
        ({"000001.bin": raw(FIELDS, POINTS)}, GLOB,
         "000001.bin: expected the time of the sweep as its name (10 digits of s since 1970, 13 of "
         "ms, 16 of us, 19 of ns, or s with decimals), found '000001'; rename the files"),
        ({NAME: raw(FIELDS, POINTS), "1700000000.bin": raw(FIELDS, POINTS)}, GLOB,
         "expected a time with the digits of 1700000000.bin, found another unit; correct"),
        ({NAME: raw(FIELDS, POINTS)[:-3]}, GLOB,
         f"{NAME}: expected a multiple of 22 bytes, the size of a point of the dtype, found 8621; "
         "correct `dtype`, or copy the file again (1 of the first 1 files, rig.yaml:3: "
         "sensors[0].points.glob)"),
        ({NAME: b""}, GLOB, f"{NAME}: expected points, found 0 bytes; remove it or copy it again"),
        ({NAME: pcd(FIELDS, POINTS)}, GLOB,
         f"{NAME}: expected points of the dtype, found a PCD file; remove `dtype`"),
        ({NAME: raw(FIELDS, POINTS)}, "{glob: top/*.bin}",
         f"{NAME}: expected a PCD file, found one that begins with 00 00 a0 40 00 00 00 00; give"),
        ({NAME: pcd(FIELDS, POINTS).replace(b"DATA binary", b"DATA binary_compressed")},
         "{glob: top/*.bin}",
         "expected DATA binary or ascii, found 'binary_compressed'; convert it with PCL"),
        ({NAME: pcd(FIELDS, POINTS)[:-1]}, "{glob: top/*.bin}",
         f"{NAME}: expected 392 points of 22 bytes, found 8623 bytes of data; copy the file again"),
        ({NAME: pcd(FIELDS, POINTS).replace(b"SIZE 4 4", b"SIZE 4")}, "{glob: top/*.bin}",
         "expected a SIZE, TYPE and COUNT for each of 6 FIELDS, found 5, 6 and 6; the file is dam"),
        ({NAME: pcd(FIELDS, POINTS).replace(b"SIZE 4 4", b"SIZE 99999 4").replace(
            b"COUNT 1", b"COUNT 99999")}, "{glob: top/*.bin}",
         f"{NAME}: expected 392 points of 9999800019 bytes, found 8624 bytes of data; copy"),
        ({NAME: pcd(FIELDS, POINTS).replace(b"POINTS 392", b"POINTS 391")}, "{glob: top/*.bin}",
         "expected POINTS = WIDTH x HEIGHT, found 391 and 392 x 1; the file is damaged"),
        ({NAME: pcd(FIELDS, POINTS, "ascii")[:-12]}, "{glob: top/*.bin}", "; the file is damaged"),
        ({NAME: raw(FIELDS, POINTS)}, GLOB.replace("top/", "none/"),
         "rig.yaml:3: sensors[0].points.glob: expected files that match none/*.bin in drive, found "
         "none; give the folder that the pattern begins in, correct the pattern, or set"),
        ({NAME: raw(FIELDS, POINTS)}, GLOB.replace("top/*.bin", "'top/{stamp:us}.bin'"),
         f"{NAME}: expected the time of the sweep as its name"),
        ({"1.bin": raw(FIELDS, POINTS)}, GLOB.replace("start", "absolute"),
         "1.bin: expected the time of the sweep as its name (10 digits of s since 1970, 13"),
        ({NAME: _saved(**XYZ)}, "{glob: top/*.bin}",
         "expected one number for each point as array points, found points (392, 3) float64, "
         "level (392) uint8, ring (392) int64; give the arrays of the fields in the rig"),
        ({NAME: _saved(**XYZ, us=np.zeros(3))}, f"{{glob: top/*.bin, {ARRAYS}}}",
         "expected one number for each point in each field, found x (392) float64, "),
        ({NAME: _saved(TABLE)}, "{glob: top/*.bin, dtype: {x: f4, y: f4, z: f4, t: f4}}",
         "found (392, 6) float64 and 4 fields in the rig; correct `dtype`"),
        ({NAME: _saved(TABLE)[:-1]}, "{glob: top/*.bin}",
         f"{NAME}: expected arrays of numbers, found others ("),
        ({NAME: _saved(**XYZ)[:-30]}, "{glob: top/*.bin}",
         f"{NAME}: expected arrays of numbers, found others ("),
    ],
)  # fmt: skip
def test_mistakes_are_one_line(
    shell: Shell, sweeps: Mapping[str, bytes], points: str, expected: str
) -> None:
    write_sweeps(Path("drive/top"), sweeps)
    outcome = _run(shell, points)
    assert outcome.code != 0
    error = outcome.err.strip().splitlines()[-1]
    assert error.startswith("mlbatch: error: ")
    assert expected in error
    assert not Path("out").exists()


def test_fields_in_another_order_are_refused_by_their_times(shell: Shell) -> None:
    """The size of a point is the same; the times of points are then no sweep."""
    write_sweeps(Path("drive/top"), _names())
    text = dtype_text({"x": "f4", "y": "f4", "z": "f4", "intensity": "f4", "ring": "u2", "t": "u4"})
    outcome = _run(shell, f"{{glob: top/*.bin, dtype: {text}, from: start}}")
    assert outcome.code != 0
    assert not Path("out").exists()


def test_two_folders_of_one_pattern_are_refused(shell: Shell) -> None:
    write_sweeps(Path("drive/a"), _names())
    write_sweeps(Path("drive/b"), _names())
    outcome = _run(shell, GLOB.replace("top/*.bin", "'*/*.bin'"))
    assert outcome.code != 0
    assert "expected each time once, found that of drive/a/" in outcome.err
    assert "give each lidar a sensor with a pattern of its own" in outcome.err


@pytest.mark.parametrize(
    ("points", "expected"),
    [
        ("{glob: /data/*.bin}", "expected a pattern within the folder of the recording"),
        ("{glob: ../a/*.bin}", "expected a pattern within the folder of the recording"),
        ("{dtype: {x: f4}}", "expected dtype with glob, found no glob; add the glob"),
        ("{glob: a, dtype: {x: f2}}", "expected one of i1, u1, i2, u2, i4, u4, i8, u8, f4, f8, l"),
        (
            "{glob: '{time}.bin'}",
            "expected one of {stamp}, {stamp:s}, {stamp:ms}, {stamp:us}, "
            "{stamp:ns}, {stamp:iso}, and {sensor}, found {time}; write * for others",
        ),
        ("{glob: '{stamp}/{stamp}.bin'}", "found {stamp}, {stamp}; write * for others"),
        ("{glob: a, dtype: {x: f4}, arrays: {x: a}}", "expected arrays without dtype, found"),
        ("{glob: a, dtype: {x: '>f4'}}", "little endian, found the text '>f4'"),
        ("{glob: a, dtype: {x: fast}}", "little endian, found 'fast'"),
        ("{glob: a, dtype: {x: V0}}", "little endian, found 'V0'"),
        ("{glob: a, dtype: [x, y]}", "expected a mapping of fields to numpy types, found a list"),
        ("{glob: a, dtype: {}}", "expected a mapping of fields to numpy types, found a mapping"),
    ],
)
def test_mistakes_of_rigs(shell: Shell, points: str, expected: str) -> None:
    write_sweeps(Path("drive/top"), _names())
    outcome = _run(shell, points)
    assert outcome.code != 0
    assert outcome.err.startswith("mlbatch: error: rig.yaml:3: sensors[0].points")
    assert expected in outcome.err


def test_a_stream_and_a_glob_exclude_each_other(shell: Shell) -> None:
    write_sweeps(Path("drive/top"), _names())
    Path("rig.yaml").write_text(
        f"sensors:\n- name: top\n  stream: {{topic: /a}}\n  points: {GLOB}\n"
    )
    outcome = shell("convert drive --rig rig.yaml -o out")
    assert "stream: expected a stream without glob, found glob as well (line 4)" in outcome.err


@pytest.mark.parametrize("kind", DATASET_FILES, ids=lambda kind: str(kind.suffixes[0]))
def test_files_of_datasets_are_refused_with_the_reason(shell: Shell, kind: Any) -> None:
    name = f"drive/sensors/lidar/315967376959822000{kind.suffixes[0]}"
    Path(name).parent.mkdir(parents=True)
    Path(name).write_bytes(kind.magic + bytes(100))
    for path in (name, "drive"):
        outcome = shell(f"convert {path} -o out")
        assert outcome.code == 1
        assert f"{path}: expected a recording, found " in outcome.err
        assert kind.remedy in outcome.err
        assert outcome.err.count("\n") == 1
    assert not Path("out").exists()


# -- untrusted files ------------------------------------------------------------------------------

HEAD_LINES = pcd(FIELDS, POINTS[:2]).split(b"DATA")[0].splitlines()
PIECES = st.sampled_from(
    [b"0", b"-1", b"4", b"99999", b"999999999999", b"x", b"\xff", b" ", b"F U I", b"binary", b"\n"]
)


def _answer(file: Path) -> str:
    """Why a file cannot be read, or ""."""
    try:
        read_sweep(file, Sweeps("*.pcd", ()), START_NS)
    except SweepError as err:
        return str(err)
    return ""


@given(
    st.integers(0, len(HEAD_LINES) - 1),
    st.lists(PIECES, max_size=8),
    st.sampled_from([b"DATA binary\n", b"DATA ascii\n", b"DATA\n", b""]),
    st.binary(max_size=60),
)
def test_any_header_is_read_or_refused_in_one_line(
    tmp_path_factory: pytest.TempPathFactory,
    number: int,
    words: list[bytes],
    end: bytes,
    body: bytes,
) -> None:
    lines = list(HEAD_LINES)
    lines[number] = lines[number].split(b" ")[0] + b" " + b" ".join(words)
    file = tmp_path_factory.getbasetemp() / "noise.pcd"
    file.write_bytes(b"\n".join(lines) + b"\n" + end + body)
    answer = _answer(file)
    assert answer == "" or answer.startswith(f"{file}: ")
    assert "\n" not in answer


@given(st.sampled_from([_saved(TABLE), _saved(**XYZ)]), st.data())
def test_any_arrays_are_read_or_refused_in_one_line(
    tmp_path_factory: pytest.TempPathFactory, data: bytes, draw: st.DataObject
) -> None:
    damaged = bytearray(data)
    for _ in range(draw.draw(st.integers(1, 4))):
        damaged[draw.draw(st.integers(0, 300))] = draw.draw(st.integers(0, 255))
    file = tmp_path_factory.getbasetemp() / "noise.npz"
    file.write_bytes(damaged)
    answer = _answer(file)
    assert answer == "" or answer.startswith(f"{file}: ")
    assert "\n" not in answer


def test_a_rig_of_inspect_describes_the_same_folder(shell: Shell) -> None:
    write_sweeps(Path("drive/top"), _names())
    assert _run(shell).code == 0
    expected = _xyz()
    assert shell("inspect drive --rig rig.yaml --write-rig again.yaml").code == 0
    outcome = shell("convert drive --rig again.yaml -o again --keep-partial")
    assert outcome.code == 0, outcome.err
    np.testing.assert_array_equal(_xyz("again"), expected)
