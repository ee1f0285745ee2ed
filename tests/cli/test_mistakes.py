"""Mistakes of users, each one line with its remedy, and what runs print."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import pytest

from tests.builders.captures import udp_frame
from tests.builders.others import EE, filled
from tests.builders.sessions import (
    EPOCH_NS,
    FIXTURE,
    NO_RECORDINGS,
    NS_PER_MS,
    NS_PER_S,
    RECORDINGS,
    SMALL,
    Records,
    Shell,
    Unit,
    twin,
    write_metadata,
    write_session,
)
from tests.builders.transcripts import transcripts

MISTAKES = transcripts("files")
REAL_MISTAKES = transcripts("recordings")
URLS = transcripts("urls")
SESSIONS = transcripts("sessions")
FIX = "fix/two_lidars.pcap --rig fix/rig.yaml"
OPTIONS = transcripts("options", FIX=FIX)
RUNS = transcripts("runs", FIX=FIX)
UPTIME = Unit(begin_ns=1000 * NS_PER_S, host_ns=EPOCH_NS - 1000 * NS_PER_S)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the inputs of all mistakes."""
    folder = tmp_path_factory.mktemp("mistakes")
    (folder / "fix").mkdir()
    for file in FIXTURE.iterdir():
        (folder / "fix" / file.name).write_bytes(file.read_bytes())
    rig = (FIXTURE / "rig.yaml").read_text()
    rear = "  - name: rear\n    stream: {source_ip: 10.5.5.99}\n    extrinsics: {matrix: M}\n"
    rear = rear.replace("M", "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]")
    cut = rig.index("# The machine's own body")
    (folder / "fix" / "astray.yaml").write_text(rig[:cut] + rear)
    silent = f"{rig[:cut]}{rear}    metadata: left.json\n"
    (folder / "fix" / "silent.yaml").write_text(silent)
    (folder / "fix" / "frame.yaml").write_text(
        "sensors:\n- {name: left, metadata: left.json, extrinsics: {frame: os_left}}\n"
    )
    (folder / "empty.yaml").write_text("sensors: []\n")
    (folder / "misspelt.yaml").write_text("sensors:\n- {name: left, extrinsic: {}}\n")
    (folder / "serial.yaml").write_text('sensors:\n- {name: left, stream: {serial: "5"}}\n')
    (folder / "text.txt").write_text("hello\n")
    (folder / "empty.pcap").touch()
    (folder / "folders").mkdir()
    (folder / "old").mkdir()
    (folder / "old" / "diary.txt").touch()
    for bag in ("bag1", "bag2"):
        (folder / "above" / bag).mkdir(parents=True)
        (folder / "above" / bag / f"{bag}_0.db3").touch()
        (folder / "above" / bag / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
    (folder / "above" / "map.pcd").write_text("# .PCD v0.7\n")
    (folder / "documents").mkdir()
    (folder / "documents" / "capture.pcap").write_bytes((FIXTURE / "two_lidars.pcap").read_bytes())
    for document, schema in (("x.mcap.report", "report"), ("golden", "digest")):
        text = f'{{\n "schema": "mlbatch.{schema}/1",\n "sensors": []\n}}\n'
        (folder / "documents" / f"{document}.json").write_text(text)
    if RECORDINGS.is_dir():
        (folder / "R").symlink_to(RECORDINGS.resolve())
    _write_sessions(folder)
    return folder


def _write_sessions(folder: Path) -> None:
    one = Unit()
    write_session(folder / "bare", one, metadata=False)
    _write_other_modes(folder)
    write_timed_sessions(folder)
    write_metadata_sessions(folder)
    write_session(folder / "uptime", UPTIME)
    write_session(folder / "pair", one, twin(one, 222))
    (folder / "other").mkdir()
    write_metadata(folder / "other" / "333.json", replace(SMALL, serial=333))
    (folder / "serials.yaml").write_text(
        "sensors:\n"
        "- {name: left, metadata: pair/111.json, extrinsics: {translation_m: [0, 1, 0]}}\n"
        "- {name: right, metadata: other/333.json, extrinsics: {translation_m: [0, 0, 0]}, "
        "stream: {port: 7502}}\n"
    )
    behind = replace(twin(one, 222), begin_ns=one.begin_ns - 3600 * NS_PER_S)
    late = replace(twin(one, 222), begin_ns=one.begin_ns + 9 * NS_PER_S)
    write_session(folder / "apart", one, replace(behind, host_ns=one.host_ns + 3600 * NS_PER_S))
    write_session(folder / "parted", one, late)
    write_session(folder / "short", replace(one, turns=1))
    write_session(folder / "twice", one, more=[one.records[7]])
    whole = write_session(folder / "cut", one)
    whole.write_bytes(whole.read_bytes()[:-338])


def m1() -> Records:
    """Packets of a lidar that has no decoder."""
    return [
        (EPOCH_NS + 1_327_000 * n, frame)
        for n in range(20)
        for frame in udp_frame(
            filled(1210, {0: bytes.fromhex("55aa5aa5"), 4: bytes((0, n))}),
            src="10.0.0.8",
            dport=6699,
        )
    ]


def write_timed_sessions(folder: Path) -> None:
    """A lidar without decoder, and clocks that are on another time, or step."""
    write_session(folder / "m1", more=m1())
    write_session(folder / "m1_bare", Unit(), more=m1(), metadata=False)
    write_session(folder / "m1_pair", Unit(), more=m1())
    gps = udp_frame(filled(512, {0: EE + b"712190403180"}), src="10.0.0.8", dport=10110)
    write_session(folder / "m1_gps", Unit(), more=[*m1(), *((EPOCH_NS, frame) for frame in gps)])
    power_on = Unit(begin_ns=50 * NS_PER_S, host_ns=EPOCH_NS)
    other = replace(power_on, begin_ns=7000 * NS_PER_S, host_ns=EPOCH_NS - 6950 * NS_PER_S)
    write_session(folder / "uptimes", power_on, twin(other, 222))
    write_session(folder / "one_window", Unit(turns=1, begin_ns=EPOCH_NS))
    write_session(folder / "two_turns", Unit(turns=2))
    write_session(folder / "brief", Unit(turns=1), twin(Unit(turns=1), 222))
    write_session(folder / "twelve_turns", Unit(turns=12))
    later = Unit(begin_ns=Unit().begin_ns + 5 * NS_PER_S, first_frame=55)
    write_session(folder / "gap", Unit(turns=6), later)
    second = Unit(turns=10)
    write_session(folder / "second", second)
    since_ns = 866 * NS_PER_S + 20 * NS_PER_MS
    ahead_ns = EPOCH_NS - 866 * NS_PER_S
    write_session(folder / "power_on", replace(second, begin_ns=since_ns, host_ns=ahead_ns))
    for name, step_s in (("forward", 37), ("back", -20)):
        before = Unit(turns=6)
        begin_ns = before.begin_ns + 600 * NS_PER_MS + step_s * NS_PER_S
        host_ns = before.host_ns - step_s * NS_PER_S
        after = replace(before, begin_ns=begin_ns, host_ns=host_ns, first_frame=11)
        write_session(folder / name, before, after)
    six = Unit(turns=6)
    write_session(folder / "tai", six.ahead(37 * NS_PER_S))
    # 540.793 s ahead of the capture host, and two lidars 5.25 s behind it.
    write_session(folder / "ahead", six.ahead(540_793 * NS_PER_MS))
    both = six.ahead(-5_250 * NS_PER_MS)
    write_session(folder / "behind", both, twin(both, 222))
    ptp = replace(SMALL, timestamp_mode="TIME_FROM_PTP_1588")
    for name, spec in (("counted", SMALL), ("ptp", ptp)):
        write_session(folder / name, Unit(spec).ahead(866 * NS_PER_S - EPOCH_NS))


def write_metadata_sessions(folder: Path) -> None:
    """Metadata that are not of the packets, or say little."""
    six = Unit(turns=6)
    fast = replace(SMALL, columns_per_frame=1024)
    files = {
        "two_modes": {"a": fast, "b": SMALL},
        "faster": {"111": replace(SMALL, rate_hz=20)},
        "restarted": {"111": replace(SMALL, init_id=SMALL.init_id + 1)},
    }
    for name, specs in files.items():
        write_session(folder / name, six, metadata=False)
        for stem, spec in specs.items():
            write_metadata(folder / name / f"{stem}.json", spec)
    # All revolutions have the numbers of the first one.
    still = [replace(six, turns=1, begin_ns=six.begin_ns + n * NS_PER_S // 10) for n in range(6)]
    write_session(folder / "still", *still)
    write_session(folder / "captured_twice", six, more=six.records)
    write_session(folder / "legacy_unit", replace(six, spec=replace(SMALL, profile="LEGACY")))
    pose = [1.0, 0.0, 0.0, 1.5, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 2.0, 0.0, 0.0, 0.0, 1.0]
    write_session(folder / "posed", replace(six, spec=replace(SMALL, extrinsic_m=pose)))
    for name, mode in (("unnamed", ""), ("internal", "TIME_FROM_INTERNAL_OSC")):
        spec = replace(SMALL, timestamp_mode=mode)
        since = replace(six, spec=spec).ahead(866 * NS_PER_S - EPOCH_NS)
        write_session(folder / name, since)


def _write_other_modes(folder: Path) -> None:
    """Metadata of 1024x10, of packets of 512x10; also named by a rig with their serial number."""
    write_session(folder / "mode", Unit(), metadata=False)
    write_metadata(folder / "mode" / "111.json", replace(SMALL, columns_per_frame=1024))
    (folder / "mode.yaml").write_text(
        'sensors: [{name: left, metadata: mode/111.json, stream: {serial: "111"}}]\n'
    )
    write_session(folder / "turned", Unit(), metadata=False)
    turned = tuple(sorted(SMALL.altitudes_deg()))
    write_metadata(folder / "turned" / "111.json", replace(SMALL, altitude_deg=turned))


@pytest.fixture
def shell(monkeypatch: pytest.MonkeyPatch, place: Path) -> Shell:
    return Shell(monkeypatch, place)


@pytest.mark.parametrize("name", MISTAKES)
def test_mistake(shell: Shell, place: Path, name: str) -> None:
    MISTAKES[name].check(shell, place)


@pytest.mark.parametrize("name", SESSIONS)
def test_session(monkeypatch: pytest.MonkeyPatch, place: Path, tmp_path: Path, name: str) -> None:
    SESSIONS[name].check_with(place, Shell(monkeypatch, tmp_path), tmp_path)


@pytest.mark.parametrize("name", OPTIONS)
def test_options(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str) -> None:
    (tmp_path / "fix").symlink_to(FIXTURE)
    OPTIONS[name].check(Shell(monkeypatch, tmp_path), tmp_path)


@pytest.mark.parametrize("name", RUNS)
def test_runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str) -> None:
    (tmp_path / "fix").symlink_to(FIXTURE)
    RUNS[name].check(Shell(monkeypatch, tmp_path), tmp_path)


@pytest.mark.skipif(not RECORDINGS.is_dir(), reason=NO_RECORDINGS)
@pytest.mark.parametrize("name", REAL_MISTAKES)
def test_mistake_with_a_real_recording(shell: Shell, place: Path, name: str) -> None:
    REAL_MISTAKES[name].check(shell, place)


@pytest.mark.parametrize("name", URLS)
def test_a_url_without_the_extra(
    shell: Shell, place: Path, name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    from mlbatch.batch.remote import _store

    _store.cache_clear()
    monkeypatch.setitem(sys.modules, "obstore", None)
    monkeypatch.setitem(sys.modules, "obstore.store", None)
    monkeypatch.setenv("MLBATCH_CACHE", str(tmp_path))
    URLS[name].check(shell, place)


def test_ambiguous_metadata_name_their_files(shell: Shell, place: Path) -> None:
    """LEGACY packets do not identify their sender, so two equal lidars need a rig."""
    old = replace(Unit(), spec=replace(SMALL, profile="LEGACY"))
    folder = place / "legacy"
    write_session(folder, old)
    write_metadata(folder / "222.json", replace(old.spec, serial=222))
    outcome = shell("convert legacy/drive.pcap -o out")
    assert outcome.code == 1
    assert outcome.err == (
        "mlbatch: error: packets of 10.0.0.1 > port 7502 (3392 bytes) carry no serial number and "
        "match 2 metadata files: legacy/111.json, legacy/222.json; expected one; name the sensor "
        "of each source with stream.source_ip in a rig file (--rig), or give only its --metadata\n"
    )


def test_wrong_usage_without_a_command_shows_the_help(shell: Shell) -> None:
    bare, unknown = shell(), shell("convrt x")
    assert (bare.code, bare.out) == (2, "")
    assert bare.err.startswith("Usage: ")
    assert "convert" in bare.err
    assert (unknown.code, unknown.out) == (2, "")
    assert len(unknown.err.splitlines()) == 1
    assert unknown.err.startswith("mlbatch: error: No such command 'convrt'")


@pytest.mark.parametrize(
    ("words", "code"),
    [
        ("inspect .", 0),
        ("convert . -o ../again.mcap", 0),
        ("convert .. -o ../../again.mcap", 0),
        ("report .", 0),
        ("verify .", 0),
        ("digest .", 0),
        ("diff . .", 0),
        ("batch . -o ../sessions", 0),
        ("compare .", 2),
        ("extract . -o ../raw.pcap", 2),
        ("merge . -o ../merged", 2),
    ],
)
def test_the_folder_that_one_is_in(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, words: str, code: int
) -> None:
    shell = Shell(monkeypatch, tmp_path)
    made = shell(f"convert {FIXTURE}/two_lidars.pcap --rig {FIXTURE}/rig.yaml -o bag -f rosbag2")
    assert made.code == 0
    Path("bag/inner").mkdir()
    monkeypatch.chdir("bag/inner" if ".." in words.split() else "bag")
    outcome = shell(words)
    assert (outcome.code, "internal error" in outcome.err) == (code, False), outcome.err
