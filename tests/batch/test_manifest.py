"""Sessions of manifests and patterns: names, inputs, options, parts, mistakes."""

from __future__ import annotations

from pathlib import Path

import pytest

from mlbatch.batch.identity import session_key
from mlbatch.batch.manifest import Common, chosen, parse_part, sessions_of
from mlbatch.batch.session import OWN, Option, Session
from mlbatch.errors import MlbatchError, RigError, UsageError

KINDS = {"rate": "value", "split": "flag", "metadata": "list", "on-jump": "value", "jobs": "value"}


def touch(folder: Path, *names: str) -> Path:
    """Empty files."""
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    return folder


def read(folder: Path, text: str, given: Common | None = None) -> dict[str, Session]:
    """The sessions of a manifest by name."""
    path = folder / "manifest.yaml"
    path.write_text("schema: mlbatch.batch/1\n" + text, encoding="utf-8")
    found = sessions_of([str(path)], given or Common(), KINDS)
    return {session.name: session for session in found}


def test_a_folder_is_a_session_of_all_its_recordings(tmp_path: Path) -> None:
    touch(tmp_path, "raw/d1/a.pcap", "raw/d1/b.pcap.zst", "raw/d1/tf.bag", "raw/d1/rig.yaml")
    touch(tmp_path, "raw/d1/bag/metadata.yaml", "raw/d1/bag/bag_0.db3", "raw/d1/deep/c.pcap")
    touch(tmp_path, "raw/d2/metadata.yaml", "raw/d2/d2_0.mcap", "raw/notes/readme.txt")
    found = read(tmp_path, 'sessions: [{glob: "raw/*/", name: "{folder}"}]\n')
    d1 = [str(tmp_path / "raw/d1" / name) for name in ("a.pcap", "b.pcap.zst", "bag", "tf.bag")]
    # d2 is a bag; notes has no recording.
    assert {name: list(one.inputs) for name, one in found.items()} == {
        "d1": d1,
        "d2": [str(tmp_path / "raw/d2")],
    }


def test_names_are_made_of_files_and_folders(tmp_path: Path) -> None:
    touch(tmp_path, "raw/d1/a.pcap.gz", "raw/d1/b.mcap", "raw/d2/a.pcapng")
    text = 'sessions: [{glob: "raw/*/*.*", name: "{folder}-{stem}"}]\n'
    assert list(read(tmp_path, text)) == ["d1-a", "d1-b", "d2-a"]
    found = sessions_of([f"{tmp_path}/raw/d1/*"], Common("r.yaml"), KINDS)
    assert [(one.name, one.rig) for one in found] == [("a", "r.yaml"), ("b", "r.yaml")]


def test_files_that_are_no_recordings_are_left_out_with_a_line(tmp_path: Path) -> None:
    touch(tmp_path, "raw/b.mcap", "raw/empty.txt")
    (tmp_path / "raw" / "left.json").write_text("{}")
    # Recordings are known by their content, too: the first bytes of a ROS 1 bag.
    (tmp_path / "raw" / "drive7").write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    lines: list[str] = []
    pattern = f"{tmp_path}/raw/*"
    found = sessions_of([pattern], Common(), KINDS, lines.append)
    assert [one.name for one in found] == ["b", "drive7"]
    expected = "left out 2 files that are no recordings: empty.txt, left.json"
    assert lines == [f"{pattern}: {expected}"]
    text = 'schema: mlbatch.batch/1\nsessions: [{glob: "raw/*"}]\n'
    (tmp_path / "manifest.yaml").write_text(text)
    found = sessions_of([str(tmp_path / "manifest.yaml")], Common(), KINDS, lines.append)
    assert [one.name for one in found] == ["b", "drive7"]
    assert lines[1].endswith(f"manifest.yaml:2: sessions[0].glob: {expected}")


def test_a_pattern_of_no_recording_is_an_error(tmp_path: Path) -> None:
    touch(tmp_path, "raw/left.json")
    with pytest.raises(UsageError, match="expected recordings or folders, found none for "):
        sessions_of([f"{tmp_path}/raw/*"], Common(), KINDS)


def test_a_file_that_is_named_is_a_session_whatever_it_is(tmp_path: Path) -> None:
    """`convert` then says what is wrong with it."""
    touch(tmp_path, "left.json")
    (one,) = sessions_of([f"{tmp_path}/left.json"], Common(), KINDS)
    assert one.inputs == (f"{tmp_path}/left.json",)


def test_a_session_may_name_its_inputs(tmp_path: Path) -> None:
    found = read(tmp_path, "sessions: [{name: b7, inputs: [s3://bucket/b7.pcap, tf.bag]}]\n")
    assert found["b7"].inputs == ("s3://bucket/b7.pcap", str(tmp_path / "tf.bag"))
    assert list(read(tmp_path, "sessions: [{inputs: [x/drive_7.pcap.zst]}]\n")) == ["drive_7"]


def test_a_rig_is_that_of_the_folder(tmp_path: Path) -> None:
    touch(tmp_path, "raw/d1/a.pcap", "raw/d1/rig.yaml", "raw/d2/b.pcap", "raw/d2/rig.yaml")
    text = 'rig: "raw/{folder}/rig.yaml"\nsessions: [{glob: "raw/*/", name: "{folder}"}]\n'
    found = read(tmp_path, text)
    assert {name: one.rig for name, one in found.items()} == {
        name: f"{tmp_path}/raw/{name}/rig.yaml" for name in ("d1", "d2")
    }
    text = 'sessions: [{name: b7, inputs: [raw/d2/b.pcap], rig: "raw/{folder}/rig.yaml"}]\n'
    assert read(tmp_path, text)["b7"].rig == f"{tmp_path}/raw/d2/rig.yaml"
    (tmp_path / "raw/d2/rig.yaml").unlink()
    expected = f"the rig of session b7, found no file {tmp_path}/raw/d2/rig.yaml; correct"
    with pytest.raises(UsageError, match=rf"sessions\[0\].rig: expected {expected}"):
        read(tmp_path, text)
    with pytest.raises(RigError, match=r"manifest.yaml:2: rig: expected .*, found \{dir\}"):
        read(tmp_path, 'rig: "{dir}/r.yaml"\nsessions: [{glob: "raw/*/"}]\n')


def test_nearer_options_replace_farther_ones(tmp_path: Path) -> None:
    touch(tmp_path, "truck.yaml", "may.yaml")
    text = (
        "rig: truck.yaml\noptions: {rate: 10, split: true, metadata: [a.json, b.json]}\n"
        "sessions:\n  - {inputs: [a.pcap]}\n"
        "  - {inputs: [b.pcap], rig: may.yaml, options: {on_jump: split, rate: 29.97}}\n"
        "  - {inputs: [c.pcap], options: {split: false, on-jump: error}}\n"
    )
    found = read(tmp_path, text)
    assert found["a"].rig == str(tmp_path / "truck.yaml")
    assert found["b"].rig == str(tmp_path / "may.yaml")
    lists = ["--metadata", "a.json", "--metadata", "b.json"]
    assert found["a"].key_words == [*lists, "--rate", "10", "--split"]
    # Numbers are the text of the file.
    words = ["--on-jump", "split", "--rate", "29.97", "--split"]
    assert found["b"].key_words == [*lists, *words]
    given = Common("mine.yaml", (Option("--rate", ("5",)),))
    over = read(tmp_path, text, given)
    assert {one.rig for one in over.values()} == {"mine.yaml"}
    assert all("5" in one.key_words and "29.97" not in one.key_words for one in over.values())


def test_a_flag_can_be_turned_off(tmp_path: Path) -> None:
    text = "options: {split: true}\nsessions: [{inputs: [c.pcap], options: {split: false}}]\n"
    assert read(tmp_path, text)["c"].key_words == []


def test_options_that_change_no_output_are_not_in_the_key() -> None:
    session = Session("a", ("a.pcap",), None, (Option("--jobs", ("4",)), Option("--no-fsync")))
    assert session.key_words == []


MISTAKES = {
    "no schema": ("sessions: []\n", "schema"),
    "unknown key": ("session: []\nsessions: []\n", "nearest known key is sessions"),
    "unknown option": ("options: {rat: 1}\nsessions: []\n", "nearest known key is rate"),
    "glob and inputs": ("sessions: [{glob: x, inputs: [y]}]\n", "glob and inputs"),
    "neither": ("sessions: [{name: x}]\n", "glob and inputs"),
    "no inputs": ("sessions: [{inputs: []}]\n", "list of recordings"),
    "nothing matches": ('sessions: [{glob: "nothing/*"}]\n', "found none"),
    "unknown field": ('sessions: [{glob: "*.yaml", name: "{date}"}]\n', "{folder}"),
    "slash in a name": ("sessions: [{name: a/b, inputs: [x]}]\n", "folder name"),
    "dots": ('sessions: [{name: "..", inputs: [x]}]\n', "folder name"),
    "the same name": ("sessions: [{inputs: [a/x.pcap]}, {inputs: [b/X.pcap]}]\n", "different"),
    "no flag": ("options: {split: maybe}\nsessions: []\n", "true or false"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_are_one_line(name: str, tmp_path: Path) -> None:
    text, expected = MISTAKES[name]
    schema = "" if name == "no schema" else "schema: mlbatch.batch/1\n"
    path = tmp_path / "manifest.yaml"
    path.write_text(schema + text, encoding="utf-8")
    with pytest.raises(MlbatchError) as caught:
        sessions_of([str(path)], Common(), KINDS)
    assert isinstance(caught.value, (RigError, UsageError))
    assert expected in str(caught.value)
    assert "expected" in str(caught.value)


def sessions(*names: str) -> list[Session]:
    """Sessions of these names."""
    return [Session(name, (f"{name}.pcap",)) for name in names]


@pytest.mark.parametrize("count", [1, 2, 3, 5, 9])
def test_parts_are_disjoint_and_whole(count: int) -> None:
    all_of_them = sessions(*"gfedcba")
    parts = [chosen(all_of_them, (), (number, count)) for number in range(1, count + 1)]
    names = [one.name for part in parts for one in part]
    assert sorted(names) == list("abcdefg")
    sizes = [len(part) for part in parts]
    assert max(sizes) - min(sizes) <= 1
    # Not by the order in which patterns or the manifest have them.
    again = chosen(sessions(*"abcdefg"), (), (1, count))
    assert {one.name for one in again} == {one.name for one in parts[0]}


def test_only_names_sessions() -> None:
    assert [one.name for one in chosen(sessions("a", "b"), ("b",), (1, 1))] == ["b"]
    with pytest.raises(UsageError, match="nearest is drive"):
        chosen(sessions("drive"), ("driev",), (1, 1))


@pytest.mark.parametrize("text", ["0/2", "3/2", "1", "a/b", "1/0", "-1/2", "1/2/3", ""])
def test_wrong_parts_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match="--part 1/16"):
        parse_part(text)


OWN_FILES = (
    *("scans.mcap", "scans", "scans.bag", "scans.mcap.partial", "scans.mcap.partial.state"),
    *("scans.seg2.mcap", "scans.mcap.scans.csv", "report.json", "report.seg2.json"),
    *("page.html", "log.txt", "session.json", "started.json", "session.json.partial"),
)
OTHER_FILES = ("scans.txt", "my scans.mcap", "scans.mcap.bak", "report.pdf", "rig.yaml")


def test_only_files_of_runs_are_removed() -> None:
    assert all(OWN.fullmatch(name) for name in OWN_FILES)
    assert not any(OWN.fullmatch(name) for name in OTHER_FILES)


def test_a_session_changes_with_the_extrinsics_files_of_its_rig(tmp_path: Path) -> None:
    recording = tmp_path / "data" / "a.pcap"
    recording.parent.mkdir()
    recording.write_bytes(b"x")
    file = tmp_path / "kit.yaml"
    text = "base_link: {lidar: {x: 1, y: 0, z: 0, roll: 0, pitch: 0, yaw: 0}}\n"
    file.write_text(text)
    rig = tmp_path / "rig.yaml"
    rig.write_text("sensors: [{name: a, extrinsics: {file: kit.yaml}}]\n")
    session = Session("a", (str(recording),), str(rig))
    before = session_key(session, tmp_path)
    assert session_key(session, tmp_path) == before
    file.write_text(text.replace("x: 1", "x: 2"))
    after = session_key(session, tmp_path)
    assert {key for key in before if before[key] != after[key]} == {"rig"}


def test_folders_of_sweeps_are_sessions_by_the_rig(tmp_path: Path) -> None:
    touch(tmp_path / "raw", "one/top/1700000000.bin", "two/top/1700000000.bin", "other/notes.txt")
    (tmp_path / "rig.yaml").write_text(
        "sensors: [{name: a, points: {glob: top/*.bin, dtype: {x: f4, y: f4, z: f4, t: u4}}}]\n"
    )
    head = "sessions: [{glob: raw/*/, name: '{folder}'}]\n"
    found = read(tmp_path, f"rig: rig.yaml\n{head}")
    inputs = {name: session.inputs for name, session in found.items()}
    assert inputs == {name: (str(tmp_path / "raw" / name),) for name in ("one", "two")}
    with pytest.raises(UsageError, match="found none; check the pattern, or give the rig that"):
        read(tmp_path, head)


@pytest.mark.parametrize("place", ["option", "rig"])
def test_the_key_changes_with_the_trajectory(tmp_path: Path, place: str) -> None:
    """The same name, other poses: a finished session is converted again."""
    touch(tmp_path, "a.pcap")
    rig = tmp_path / "rig.yaml"
    section = "convert: {deskew: drive.tum}\n" if place == "rig" else ""
    rig.write_text("sensors: [{name: left, stream: {port: 7502}}]\n" + section, encoding="utf-8")
    options = () if place == "rig" else (Option("--deskew", ("drive.tum",)),)
    session = Session("a", (str(tmp_path / "a.pcap"),), str(rig), options)
    keys = []
    for x in (1, 2, 1):
        text = f"0 {x} 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n"
        (tmp_path / "drive.tum").write_text(text, encoding="utf-8")
        keys.append(session_key(session, tmp_path))
    assert keys[0] == keys[2]
    assert {name for name in keys[0] if keys[0][name] != keys[1][name]} == {"trajectory"}


def test_the_format_of_the_rig_names_the_output(tmp_path: Path) -> None:
    """As the options of a manifest, which take precedence."""
    touch(tmp_path, "a.pcap")
    (tmp_path / "rig.yaml").write_text(
        "sensors: [{name: left, stream: {port: 7502}}]\nconvert: {format: npz}\n", encoding="utf-8"
    )
    head = "rig: rig.yaml\nsessions: [{name: a, inputs: [a.pcap]}]\n"
    assert read(tmp_path, head)["a"].output == "scans"
    given = Common(options=(Option("--format", ("mcap",)),))
    assert read(tmp_path, head, given)["a"].output == "scans.mcap"


def test_a_manifest_without_sessions_is_a_mistake(tmp_path: Path) -> None:
    with pytest.raises(RigError, match="expected a list of sessions, found an empty one; add one"):
        read(tmp_path, "sessions: []\n")
