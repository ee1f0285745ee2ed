"""Sessions of manifests and patterns: names, inputs, options, parts, mistakes."""

from __future__ import annotations

from pathlib import Path

import pytest

from mlbatch.batch.identity import session_key
from mlbatch.batch.manifest import Common, chosen, sessions_of
from mlbatch.batch.session import Option, Session
from mlbatch.errors import MlbatchError, UsageError
from mlbatch.pipeline.job import Shard
from mlbatch.rig.recipes import FOLDER
from tests.builders.sessions import Shell
from tests.builders.transcripts import transcripts

SENSOR = "sensors: [{name: a, stream: {port: 7502}}]\n"
SWEEPS = "sensors: [{name: a, points: {glob: top/*.bin, dtype: {x: f4, y: f4, z: f4, t: u4}}}]\n"
# Content of files; others are empty.
CONTENT = {
    "npz.yaml": f"{SENSOR}convert: {{format: npz}}\n",
    "sweeps.yaml": SWEEPS,
    # Recordings are known by their content, too: the first bytes of a ROS 1 bag.
    "raw/drive7": "#ROSBAG V2.0\n" + "\0" * 100,
    "raw/left.json": "{}",
}


def touch(folder: Path, names: str) -> None:
    """Files of these names."""
    for name in names.split():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(CONTENT.get(name, ""), encoding="utf-8")


def read(folder: Path, text: str, given: Common | None = None) -> dict[str, Session]:
    """The sessions of a manifest by name."""
    path = folder / "manifest.yaml"
    path.write_text(f"schema: mlbatch.batch/1\n{text}", encoding="utf-8")
    found = sessions_of([str(path)], given or Common())
    return {session.name: session for session in found}


def shown(session: Session, folder: Path) -> str:
    """A session as words: recordings, rig, options, name of the output."""
    rig = ["-r", session.rig] if session.rig else []
    words = [*session.inputs, *rig, *session.key_words, "->", session.output]
    return " ".join(words).replace(f"{folder}/", "")


FOLDERS = 'sessions: [{glob: "raw/*/", name: "{folder}"}]\n'
RIGS = """rig: "raw/{folder}/rig.yaml"
sessions:
- {glob: "raw/*/", name: "{folder}"}
- {name: b7, inputs: [raw/d2/b.pcap]}
"""
LAYERS = """rig: npz.yaml
options: {rate: 10, split: true, metadata: [a.json, b.json], jobs: 4, no_fsync: true}
sessions:
- {inputs: [a.pcap]}
- {inputs: [b.pcap], rig: sweeps.yaml, options: {on_jump: split, rate: 29.97}}
- {inputs: [c.pcap], options: {split: false, on-jump: error, format: mcap}}
"""
DATED = """rig: old.yaml
rigs:
- {sessions: "*-wet", rig: wet.yaml}
- {from: 2024-05-01, until: 2024-06-30, rig: may.yaml}
- {from: 2024-07-01, rig: new.yaml}
sessions:
- {glob: "raw/*/", name: "{folder}"}
- {name: own, inputs: [raw/20240501/a.pcap], rig: own.yaml}
- {name: by-path, inputs: [raw/20240501/a.pcap]}
"""
# Files, a manifest, and its sessions.
CASES = {
    # d2 is a bag; notes has no recording.
    "all recordings of a folder": (
        "raw/d1/a.pcap raw/d1/b.pcap.zst raw/d1/tf.bag raw/d1/rig.yaml raw/d1/bag/metadata.yaml "
        "raw/d1/bag/bag_0.db3 raw/d1/deep/c.pcap raw/d2/metadata.yaml raw/notes/readme.txt",
        FOLDERS,
        {
            "d1": "raw/d1/a.pcap raw/d1/b.pcap.zst raw/d1/bag raw/d1/tf.bag -> scans.mcap",
            "d2": "raw/d2 -> scans.mcap",
        },
    ),
    "names of folders and files": (
        "raw/d1/a.pcap.gz raw/d1/b.mcap raw/d2/a.pcapng",
        'sessions: [{glob: "raw/*/*.*", name: "{folder}-{stem}-{name}"}]\n',
        {
            "d1-a-a.pcap.gz": "raw/d1/a.pcap.gz -> scans.mcap",
            "d1-b-b.mcap": "raw/d1/b.mcap -> scans.mcap",
            "d2-a-a.pcapng": "raw/d2/a.pcapng -> scans.mcap",
        },
    ),
    "a file that is named, whatever it is": (
        "raw/left.json",
        "sessions: [{glob: raw/left.json}]\n",
        {"left.json": "raw/left.json -> scans.mcap"},
    ),
    "named inputs": (
        "",
        "sessions: [{name: b7, inputs: [s3://b/b7.pcap, t.bag]}, {inputs: [x/d_7.pcap.zst]}]\n",
        {"b7": "s3://b/b7.pcap t.bag -> scans.mcap", "d_7": "x/d_7.pcap.zst -> scans.mcap"},
    ),
    "the rig of each folder": (
        "raw/d1/a.pcap raw/d1/rig.yaml raw/d2/b.pcap raw/d2/rig.yaml",
        RIGS,
        {
            "d1": "raw/d1/a.pcap -r raw/d1/rig.yaml -> scans.mcap",
            "d2": "raw/d2/b.pcap -r raw/d2/rig.yaml -> scans.mcap",
            "b7": "raw/d2/b.pcap -r raw/d2/rig.yaml -> scans.mcap",
        },
    ),
    # The rig of all is for dates before the first rule; a pattern precedes dates.
    "rigs by name and date": (
        "old.yaml wet.yaml may.yaml new.yaml own.yaml raw/2024-04-30/a.pcap raw/20240501/a.pcap "
        "raw/2024_06_30_x/a.pcap raw/20240701-dry/a.pcap raw/20240701-wet/a.pcap",
        DATED,
        {
            "2024-04-30": "raw/2024-04-30/a.pcap -r old.yaml -> scans.mcap",
            "20240501": "raw/20240501/a.pcap -r may.yaml -> scans.mcap",
            "2024_06_30_x": "raw/2024_06_30_x/a.pcap -r may.yaml -> scans.mcap",
            "20240701-dry": "raw/20240701-dry/a.pcap -r new.yaml -> scans.mcap",
            "20240701-wet": "raw/20240701-wet/a.pcap -r wet.yaml -> scans.mcap",
            "own": "raw/20240501/a.pcap -r own.yaml -> scans.mcap",
            "by-path": "raw/20240501/a.pcap -r may.yaml -> scans.mcap",
        },
    ),
    "folders of sweeps, by the rig": (
        "raw/one/top/17.bin raw/two/top/17.bin raw/other/notes.txt sweeps.yaml",
        f"rig: sweeps.yaml\n{FOLDERS}",
        {
            "one": "raw/one -r sweeps.yaml -> scans.mcap",
            "two": "raw/two -r sweeps.yaml -> scans.mcap",
        },
    ),
    # Options of a session precede those of all, and these the rig's; numbers are the text of the
    # file; those that change no output are not shown.
    "nearer options": (
        "npz.yaml sweeps.yaml",
        LAYERS,
        {
            "a": "a.pcap -r npz.yaml --metadata a.json --metadata b.json --rate 10 --split "
            "-> scans",
            "b": "b.pcap -r sweeps.yaml --metadata a.json --metadata b.json --on-jump split "
            "--rate 29.97 --split -> scans.mcap",
            "c": "c.pcap -r npz.yaml --format mcap --metadata a.json --metadata b.json "
            "--on-jump error --rate 10 -> scans.mcap",
        },
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_sessions_of_a_manifest(name: str, tmp_path: Path) -> None:
    files, text, expected = CASES[name]
    touch(tmp_path, files)
    found = read(tmp_path, text)
    assert {key: shown(one, tmp_path) for key, one in found.items()} == expected


def test_a_dataset_is_a_rig_of_the_package(tmp_path: Path) -> None:
    """Of all sessions, or of one; that of a session precedes a rig and the rules of all."""
    touch(tmp_path, "a.yaml b.yaml")
    sessions = "sessions: [{inputs: [a.bag]}, {inputs: [b.bag], %s}]\n"
    texts = {
        "dataset: mcd\n" + sessions % "rig: b.yaml": [FOLDER / "mcd.yaml", tmp_path / "b.yaml"],
        "rigs: [{sessions: '*', rig: a.yaml}]\n" + sessions % "dataset: mcd": [
            tmp_path / "a.yaml",
            FOLDER / "mcd.yaml",
        ],
        "rig: a.yaml\n" + sessions % "dataset: mcd": [tmp_path / "a.yaml", FOLDER / "mcd.yaml"],
    }
    for text, rigs in texts.items():
        assert [one.rig for one in read(tmp_path, text).values()] == list(map(str, rigs))
        assert {one.rig for one in read(tmp_path, text, Common("r.yaml")).values()} == {"r.yaml"}


def test_the_command_line_precedes_the_manifest(tmp_path: Path) -> None:
    given = Common("mine.yaml", (Option("--rate", ("5",)),))
    for session in read(tmp_path, LAYERS, given).values():
        assert session.rig == "mine.yaml"
        assert session.values("rate") == ("5",)


def test_files_that_are_no_recordings_are_left_out_with_a_line(tmp_path: Path) -> None:
    touch(tmp_path, "raw/b.mcap raw/empty.txt raw/left.json raw/drive7 manifest.yaml")
    (tmp_path / "manifest.yaml").write_text(
        'schema: mlbatch.batch/1\nsessions: [{glob: "raw/*"}]\n'
    )
    lines: list[str] = []
    for source in (f"{tmp_path}/raw/*", f"{tmp_path}/manifest.yaml"):
        found = sessions_of([source], Common("r.yaml"), lines.append)
        assert [(one.name, one.rig) for one in found] == [("b", "r.yaml"), ("drive7", "r.yaml")]
    expected = "left out 2 files that are no recordings: empty.txt, left.json"
    assert lines[0] == f"{tmp_path}/raw/*: {expected}"
    assert lines[1].endswith(f"manifest.yaml:2: sessions[0].glob: {expected}")


MISTAKES = transcripts("manifests")


@pytest.mark.parametrize("name", MISTAKES)
def test_mistake(shell: Shell, tmp_path: Path, name: str) -> None:
    touch(tmp_path, "raw/left.json raw/one/top/17.bin")
    MISTAKES[name].check(shell, tmp_path)


def test_a_manifest_needs_its_schema(tmp_path: Path) -> None:
    (tmp_path / "manifest.yaml").write_text("sessions: []\n")
    with pytest.raises(MlbatchError, match="expected the key schema"):
        sessions_of([str(tmp_path / "manifest.yaml")], Common())


def sessions(names: str) -> list[Session]:
    """Sessions of these names, a letter each."""
    return [Session(name, (f"{name}.pcap",)) for name in names]


@pytest.mark.parametrize("count", [1, 2, 3, 5, 9])
def test_parts_are_disjoint_and_whole(count: int) -> None:
    parts = [
        chosen(sessions("gfedcba"), (), Shard(number, count)) for number in range(1, count + 1)
    ]
    assert sorted(one.name for part in parts for one in part) == list("abcdefg")
    sizes = [len(part) for part in parts]
    assert max(sizes) - min(sizes) <= 1
    # Not by the order in which patterns or the manifest have them.
    again = chosen(sessions("abcdefg"), (), Shard(1, count))
    assert {one.name for one in again} == {one.name for one in parts[0]}


def test_only_names_sessions() -> None:
    assert [one.name for one in chosen(sessions("ab"), ("b",), Shard(1, 1))] == ["b"]
    with pytest.raises(UsageError, match="nearest is drive"):
        chosen([Session("drive", ())], ("driev",), Shard(1, 1))


KIT = "base_link: {{lidar: {{x: {}, y: 0, z: 0, roll: 0, pitch: 0, yaw: 0}}}}\n"
POSES = "0 {} 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n"
# End of the rig, options, the file that changes, and what changes in the key.
KEYS = {
    "extrinsics": ("sensors: [{name: a, extrinsics: {file: f.yaml}}]\n", (), "f.yaml", KIT, "rig"),
    "poses by the rig": (
        f"{SENSOR}convert: {{deskew: f.tum}}\n",
        *((), "f.tum", POSES, "trajectory"),
    ),
    "poses by an option": (
        *(SENSOR, (Option("--deskew", ("f.tum",)),), "f.tum"),
        *(POSES, "trajectory"),
    ),
}


@pytest.mark.parametrize("name", KEYS)
def test_a_session_changes_with_the_files_it_names(name: str, tmp_path: Path) -> None:
    """The same name, other content: a finished session is converted again."""
    rig_text, options, file, content, expected = KEYS[name]
    rig = tmp_path / "rig.yaml"
    rig.write_text(rig_text, encoding="utf-8")
    touch(tmp_path, "data/a.pcap")
    session = Session("a", (str(tmp_path / "data/a.pcap"),), str(rig), options)
    keys = []
    for x in (1, 2, 1):
        (tmp_path / file).write_text(content.format(x), encoding="utf-8")
        keys.append(session_key(session, tmp_path))
    assert keys[0] == keys[2]
    assert {key for key in keys[0] if keys[0][key] != keys[1][key]} == {expected}
