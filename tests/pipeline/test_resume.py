"""`--resume`: messages, refused jobs, files left by runs that end early.

Signals at any moment: `tests/golden/test_resume.py`.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shutil
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import mlbatch
from mlbatch.errors import ExportError, RecordingError
from mlbatch.pipeline import files, job_identity, workers
from mlbatch.pipeline import output as pipeline_output
from mlbatch.readers import source
from mlbatch.types import Scan
from mlbatch.writers import atomic
from mlbatch.writers import npz_encoder as npz
from mlbatch.writers.formats import webdataset
from mlbatch.writers.output_file import Bytes
from tests.builders.run import command
from tests.builders.sessions import FIXTURE, SMALL, Shell, Unit, write_session
from tests.builders.transcripts import transcripts
from tests.resume_storm import contents, write_recordings

CAPTURE = f"{FIXTURE / 'two_lidars.pcap'} --rig {FIXTURE / 'rig.yaml'}"
FIX = "fix/two_lidars.pcap --rig fix/rig.yaml"
CASES = transcripts("resume", FIX=FIX)
# From fixtures/two_lidars/SOURCE.md: a window of 10 Hz each.
SCANS = 7
JOURNAL = Path("out.partial/files.jsonl")


def _fail_at(monkeypatch: pytest.MonkeyPatch, scan: int, error: BaseException) -> None:
    """Have the writing of a scan fail, once."""
    encode = npz.NpzEncoder.encode
    calls = 0

    def failing(encoder: npz.NpzEncoder, found: Scan) -> list[Bytes]:
        nonlocal calls
        calls += 1
        if calls == scan + 1:
            raise error
        return encode(encoder, found)

    monkeypatch.setattr(npz.NpzEncoder, "encode", failing)


def _interrupt(shell: Shell, words: str = f"{CAPTURE} -o out") -> None:
    """Leave a `.partial` with three scans that are whole."""
    with pytest.MonkeyPatch.context() as patch:
        _fail_at(patch, 3, KeyboardInterrupt())
        assert shell(f"convert {words}").code == 130
    assert len(JOURNAL.read_bytes().splitlines()) == 4


def _whole(shell: Shell, words: str = CAPTURE) -> dict[str, object]:
    Path("whole").mkdir()
    assert shell(f"convert {words} -o whole/out").code == 0
    return contents(Path("whole"))


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with out.partial, that of an interrupted run, and whole/out."""
    folder = tmp_path_factory.mktemp("interrupted")
    (folder / "fix").symlink_to(FIXTURE)
    (folder / "whole").mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert command("convert", *FIX.split(), "-o", "whole/out").code == 0
        _fail_at(patch, 3, KeyboardInterrupt())
        assert command("convert", *FIX.split(), "-o", "out").code == 130
    return folder


@pytest.mark.parametrize("name", CASES)
def test_transcript(shell: Shell, interrupted: Path, tmp_path: Path, name: str) -> None:
    shutil.copytree(interrupted, tmp_path, symlinks=True, dirs_exist_ok=True)
    CASES[name].check(shell, tmp_path)
    if not Path("out").exists():
        outcome = shell(f"convert {FIX} -o out --resume")
        assert outcome.err == "mlbatch: out: resumed after 3 scans\n"
    assert contents(Path()) == contents(Path("whole"))


def test_nohup_outlives_its_terminal(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    encode = npz.NpzEncoder.encode

    def ending(encoder: npz.NpzEncoder, scan: Scan) -> list[Bytes]:
        signal.raise_signal(signal.SIGHUP)
        return encode(encoder, scan)

    monkeypatch.setattr(npz.NpzEncoder, "encode", ending)
    assert shell(f"convert {CAPTURE} -o out").code == 0
    assert signal.signal(signal.SIGHUP, before) is signal.SIG_IGN


class _Interrupted(threading.Condition):
    """Receives a signal in the first thread right after it took the lock for the third time."""

    calls = 0

    def __enter__(self) -> bool:
        taken = super().__enter__()
        if threading.current_thread() is threading.main_thread():
            _Interrupted.calls += 1
            if _Interrupted.calls == 3:
                signal.raise_signal(signal.SIGTERM)
        return taken


@pytest.mark.parametrize("jobs", [1, 3])
def test_an_interrupt_leaves_no_thread_behind(
    shell: Shell, monkeypatch: pytest.MonkeyPatch, jobs: int
) -> None:
    """Without care the lock remains taken, and the first thread waits for those that need it."""
    make = workers.OrderedWorkers.__init__

    def making(made: workers.OrderedWorkers[Any], threads: int, ahead: int) -> None:
        make(made, threads, ahead)
        made._changed = _Interrupted()

    monkeypatch.setattr(workers.OrderedWorkers, "__init__", making)
    monkeypatch.setattr(_Interrupted, "calls", 0)
    outcome = shell(f"convert {CAPTURE} -o out --jobs {jobs}")
    assert outcome.code == 130
    assert _Interrupted.calls > 3
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("mlbatch")]


class _Ending:
    """Receives a signal in its finalizer, where Python prints and ignores exceptions."""

    def __del__(self) -> None:
        signal.raise_signal(signal.SIGTERM)


def test_an_interrupt_in_a_finalizer_is_not_lost(
    shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    take = files.Files.take
    calls = 0

    def ending(own: files.Files, *given: Any) -> files.FinishedScan | None:
        nonlocal calls
        calls += 1
        if calls == 2:
            _Ending()
        if calls == 3:
            time.sleep(0.2)
        return take(own, *given)

    monkeypatch.setattr(files.Files, "take", ending)
    outcome = shell(f"convert {CAPTURE} -o out")
    assert outcome.code == 130
    assert outcome.err.startswith("mlbatch: error: interrupted")
    assert calls <= 3


@pytest.mark.parametrize(
    ("words", "name", "fault"),
    [
        ("", "000003.npz", "table"),
        ("--format ply --split", "right/000003.ply", "table"),
        ("--slices 2", "000003-1.npz", "table"),
        ("--keep-partial", "head.npz", "table"),
        ("--format nuscenes", "000003.time.bin", "container"),
        ("--format webdataset --split", "left/000002.tar", "table"),
        ("--format rosbag2", "out_0.mcap", ""),
        ("--format rosbag2 --max-bag-duration 0.2", "out_1.mcap", "names"),
        ("", "scans.csv", "table"),
    ],
)
def test_a_file_missing_in_a_complete_output_is_named(
    shell: Shell, words: str, name: str, fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(webdataset, "WINDOWS_PER_FILE", 2)
    shell(f"convert {CAPTURE} {words} -o out")
    assert "is complete" in shell(f"convert {CAPTURE} {words} -o out --resume").err
    Path("out", name).unlink()
    refused = shell(f"convert {CAPTURE} {words} -o out --resume")
    assert (refused.code, refused.err) == (
        1,
        "mlbatch: error: out: expected all files of the complete output for --resume, found 1 "
        f"missing, first {name}; restore it, or make all again with --overwrite\n",
    )
    verdict = shell("verify out --json")
    assert verdict.code != 0
    if fault:
        assert fault in {one["check"] for one in json.loads(verdict.out)["violations"]}
    assert shell(f"convert {CAPTURE} {words} -o out --resume --overwrite").code == 0
    assert Path("out", name).is_file()


@pytest.mark.parametrize(
    ("first", "second", "difference"),
    [
        (CAPTURE, f"{CAPTURE} --rate 20", "rate '20' instead of 'not given'"),
        (CAPTURE, f"{CAPTURE} --rig moved.yaml", "rig '"),
        ("in/drive.pcap", "other/drive.pcap", "recording 1 'drive.pcap ("),
    ],
)
@pytest.mark.parametrize("output", ["-o out", "-o out.mcap", "-o out --report elsewhere.json"])
def test_a_complete_output_of_another_job_is_refused(
    shell: Shell, first: str, second: str, difference: str, output: str
) -> None:
    rig = (FIXTURE / "rig.yaml").read_text().replace(": left.json", f": {FIXTURE}/left.json")
    rig = rig.replace(": right.json", f": {FIXTURE}/right.json")
    Path("moved.yaml").write_text(rig.replace("translation_m: [0.3,", "translation_m: [0.4,"))
    write_session(Path("in"), Unit(turns=8))
    write_session(Path("other"), Unit(turns=8, range_mm=5000))
    assert shell(f"convert {first} {output}").code == 0
    before = contents(Path())
    name = output.split()[1]
    refused = shell(f"convert {second} {output} --resume")
    assert refused.code == 2
    assert refused.err.startswith(
        f"mlbatch: error: {name}: expected the complete output of this job for --resume, found "
        f"{difference}"
    )
    assert refused.err.endswith("; choose another output, or replace this one with --overwrite\n")
    assert contents(Path()) == before
    assert "is complete" in shell(f"convert {first} {output} --resume").err
    again = shell(f"convert {second} {output} --resume --overwrite").err
    assert again.startswith(f"mlbatch: {name}: nothing to resume; started over\n")
    # A pose that was moved is wrong.
    assert ("pose: left and right" in again) == ("moved" in second)


def test_copies_and_other_versions_make_the_same_output(
    shell: Shell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture = write_session(tmp_path / "in", Unit(turns=8))
    assert shell(f"convert {capture} -o out").code == 0
    os.utime(capture, ns=(1, 1))
    monkeypatch.setattr(mlbatch, "__version__", "0.0.1")
    assert "is complete" in shell(f"convert {capture} -o out --resume").err


# Revolutions of 0.8 MB: samples are 0.1 MB apart.
LARGE = replace(SMALL, beams=128)


def _flip(path: Path, at: int) -> None:
    """Change a byte of a file, but neither its size nor its times."""
    times = path.stat()
    content = bytearray(path.read_bytes())
    content[at] ^= 4
    path.write_bytes(content)
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))


def _unsampled(size: int, near: float) -> int:
    """A byte of a recording that is in no sample."""
    sampled = [range(at, at + count) for at, count in job_identity._sampled(size, size)]
    at = int(near * size)
    return next(one for one in range(at, size) if not any(one in part for part in sampled))


def _flipped(at: Callable[[bytes], int]) -> Callable[[bytes], bytes]:
    """Change of a bit; at: which byte."""

    def change(content: bytes) -> bytes:
        place = at(content)
        return content[:place] + bytes([content[place] ^ 4]) + content[place + 1 :]

    return change


def _replaced(before: bytes, after: bytes) -> Callable[[bytes], bytes]:
    return lambda content: content.replace(before, after, 1)


def _middle_sample(content: bytes) -> int:
    size = len(content)
    return next(at for at, _ in job_identity._sampled(size, size) if at > size // 2)


def _angle_moved(content: bytes) -> bytes:
    metadata = json.loads(content)
    metadata["beam_intrinsics"]["beam_altitude_angles"][0] += 0.01
    return json.dumps(metadata).encode()


# What is converted, a file of it that changes, but not its time; None: the time alone.
CHANGES: list[tuple[str, str, Callable[[bytes], bytes] | None, str]] = [
    ("small", "drive.pcap", None, "recording 1 'drive.pcap ("),
    ("large", "drive.pcap", _flipped(lambda _: 100), "recording 1 'drive."),
    ("large", "drive.pcap", _flipped(_middle_sample), "recording 1 'drive."),
    ("large", "drive.pcap", _flipped(lambda content: len(content) - 100), "recording 1 'drive."),
    ("small", "111.json", _angle_moved, "calibration of ouster_111 '"),
    # Also a byte without influence: the file is not the same.
    (
        *("small", "111.json"),
        _flipped(lambda content: content.index(b"calibration_status") + 3),
        "calibration of ouster_111 '",
    ),
    ("rig", "rig.yaml", _replaced(b"translation_m: [", b"translation_m: [1"), ""),
    ("rig", "rig.yaml", _replaced(b"exclude_boxes_m: [[-1.7", b"exclude_boxes_m: [[-1.8"), ""),
]


@pytest.mark.parametrize(("kind", "name", "change", "found"), CHANGES)
def test_another_input_is_refused(
    shell: Shell, kind: str, name: str, change: Callable[[bytes], bytes] | None, found: str
) -> None:
    if kind == "rig":
        shutil.copytree(FIXTURE, "in")
        words = "in/two_lidars.pcap --rig in/rig.yaml -o out"
    else:
        unit = Unit(LARGE if kind == "large" else SMALL, turns=8)
        words = f"{write_session(Path('in'), unit)} -o out"
    _interrupt(shell, words)
    path = Path("in", name)
    sound = path.read_bytes()
    times = path.stat().st_atime_ns, path.stat().st_mtime_ns
    path.write_bytes(sound if change is None else change(sound))
    assert (path.read_bytes() == sound) == (change is None)
    os.utime(path, ns=(1, 1) if change is None else times)
    refused = shell(f"convert {words} --resume")
    assert refused.code == 2
    assert f"expected the job of the interrupted run, found {found}" in refused.err
    # Comments of a rig have no influence.
    path.write_bytes(b"# The rig.\n" * (kind == "rig") + sound)
    os.utime(path, ns=times)
    assert shell(f"convert {words} --resume").err == "mlbatch: out: resumed after 3 scans\n"


def test_other_packets_in_finished_scans_are_refused(shell: Shell, tmp_path: Path) -> None:
    """No sample has them, and neither size nor time of the recording changed."""
    capture = write_session(tmp_path / "in", Unit(LARGE, turns=8))
    words = f"{capture} -o out"
    whole = _whole(shell, str(capture))
    _interrupt(shell, words)
    # Scan 1 of 7 begins about 1.8 revolutions after the start, as that has 20 ms of a window.
    at = _unsampled(capture.stat().st_size, 0.3)
    _flip(capture, at)
    outcome = shell(f"convert {words} --resume")
    assert outcome.code == 2
    assert outcome.err.splitlines()[-1] == (
        "mlbatch: error: out.partial: expected the packets of the interrupted run, found others "
        "for a finished scan, that of window 1: a recording was changed; restore it, or leave out "
        "--resume to start over"
    )
    _flip(capture, at)
    outcome = shell(f"convert {words} --resume")
    assert outcome.err == "mlbatch: out: resumed after 3 scans\n"
    assert contents(Path()) == whole


def test_other_packets_behind_finished_scans_are_converted(shell: Shell, tmp_path: Path) -> None:
    capture = write_session(tmp_path / "in", Unit(LARGE, turns=8))
    words = f"{capture} -o out"
    before = _whole(shell, str(capture))
    shutil.rmtree("whole")
    _interrupt(shell, words)
    _flip(capture, _unsampled(capture.stat().st_size, 0.8))
    assert shell(f"convert {words} --resume").err == "mlbatch: out: resumed after 3 scans\n"
    found = contents(Path())
    assert found == _whole(shell, str(capture))
    assert found != before


def test_another_forwarded_message_is_refused(shell: Shell, tmp_path: Path) -> None:
    write_recordings(tmp_path / "in", 12)
    recording = tmp_path / "in" / "bag" / "drive.mcap"
    case = f"{recording} -o out --identity-extrinsics --keep-partial --pass /chatter"
    case += " --format rosbag2 --max-bag-duration 0.2"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(files.Files, "complete", _refuse)
        assert shell(f"convert {case}").code == 1
    content = recording.read_bytes()
    at = len(content) // 10
    while not content[at : at + 100].isdigit():
        at = _unsampled(len(content), (at + 100) / len(content))
    _flip(recording, at)
    outcome = shell(f"convert {case} --resume")
    assert outcome.code == 2
    assert "expected the packets of the interrupted run" in outcome.err


CHANGED = "expected the bytes that the interrupted run has written, found"


@pytest.mark.parametrize("jobs", ["", "--jobs 3"])
@pytest.mark.parametrize(
    "words",
    ["", "--split", "--format ply", "--format nuscenes", "--format rosbag2 --max-bag-duration 0.2"],
)
def test_a_changed_byte_of_a_finished_file_is_found(shell: Shell, words: str, jobs: str) -> None:
    """Of each file of a scan, and of a file of a bag: it is made again, and no other."""
    words = f"{CAPTURE} {words} {jobs}"
    whole = _whole(shell, words)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(files.Files, "complete", _refuse)
        assert shell(f"convert {words} -o out").code == 1
    changed = [path for path in sorted(Path("out.partial").rglob("*1.*")) if path.suffix != ".csv"]
    assert changed
    times = {path: path.stat().st_mtime_ns for path in Path("out.partial").rglob("*[02].*")}
    for path in changed:
        sound = path.read_bytes()
        path.write_bytes(sound[:-100] + bytes([sound[-100] ^ 1]) + sound[-99:])
    outcome = shell(f"convert {words} -o out --resume")
    assert outcome.code == 0
    lines = outcome.err.splitlines()[1:]
    # Of two files of a scan, the first says it.
    assert lines == [
        f"mlbatch: {path}: {CHANGED} others; made again"
        for path in changed
        if not path.name.endswith(".time.bin")
    ]
    assert contents(Path()) == whole
    assert times
    for path, time_ns in times.items():
        name = path.relative_to("out.partial")
        assert Path("out", name).stat().st_mtime_ns == time_ns


def _refuse(own: files.Files) -> None:
    raise ExportError("stopped")


@pytest.mark.parametrize("option", ["", "--resume"])
def test_a_running_run_is_not_disturbed(shell: Shell, option: str) -> None:
    _interrupt(shell)
    with JOURNAL.open("rb") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        outcome = shell(f"convert {CAPTURE} -o out {option}")
    assert outcome.code == 1
    assert outcome.err == (
        "mlbatch: error: out: expected no other run that writes it, found one; wait for its end "
        "or choose another output\n"
    )
    assert "resumed after 3 scans" in shell(f"convert {CAPTURE} -o out --resume").err


@pytest.mark.parametrize("output", ["out", "out.mcap"])
def test_a_run_that_began_after_the_check_is_not_disturbed(
    shell: Shell, monkeypatch: pytest.MonkeyPatch, output: str
) -> None:
    """Two runs may both find nothing before one of them writes."""
    partial = Path(f"{output}.partial")
    lock = partial if partial.suffixes == [".mcap", ".partial"] else partial / "files.jsonl"
    with contextlib.ExitStack() as held:

        def other_run(*_: object) -> None:
            lock.parent.mkdir(exist_ok=True)
            file = held.enter_context(lock.open("wb", buffering=0))
            fcntl.flock(file, fcntl.LOCK_EX)
            file.write(b"what it did")

        monkeypatch.setattr(pipeline_output, "check_target", other_run)
        outcome = shell(f"convert {CAPTURE} -o {output}")
    assert (outcome.code, "expected no other run that writes it, found one" in outcome.err) == (
        1,
        True,
    )
    assert lock.read_bytes() == b"what it did"


def test_an_output_that_cannot_be_opened_leaves_nothing(
    shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        Path("out").mkdir()

    monkeypatch.setattr(pipeline_output, "check_target", refuse)
    outcome = shell(f"convert {CAPTURE} -o out")
    assert (outcome.code, "found an existing one" in outcome.err) == (1, True)
    assert [path.name for path in Path().iterdir()] == ["out"]


def test_no_change_of_a_byte_gives_another_scan(shell: Shell) -> None:
    """What a changed list says is some of what it said."""
    _interrupt(shell)
    content = JOURNAL.read_bytes()
    said = {position: one for position, one in files.records(JOURNAL)}
    assert len(said) == 3
    for at in range(len(content)):
        for flip in (0x01, 0x20, 0x80, content[at] ^ ord("\n"), content[at] ^ ord("0")):
            if not flip:
                continue
            JOURNAL.write_bytes(content[:at] + bytes([content[at] ^ flip]) + content[at + 1 :])
            found = [one for _, one in files.records(JOURNAL)]
            assert all(one in said.values() for one in found)
            assert 1 <= len(found) <= 3


def test_a_full_disk_names_the_remedy(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = _whole(shell)
    _fail_at(monkeypatch, 4, OSError(28, "No space left on device"))
    outcome = shell(f"convert {CAPTURE} -o out")
    assert outcome.code == 1
    assert outcome.err == (
        "mlbatch: error: out.partial/000004.npz: expected to write it, found 'No space left on "
        "device'; free space on this disk or choose another output; then --resume continues after "
        "the 4 scans that are safe\n"
    )
    assert shell(f"convert {CAPTURE} -o out --resume").code == 0
    assert contents(Path()) == whole


def test_an_unreadable_disk_names_the_remedy(
    shell: Shell, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The reader's buffer has 4 MB: the recording is longer, and breaks in its second half."""
    spec = replace(SMALL, beams=128, columns_per_frame=512)
    capture = write_session(tmp_path / "in", Unit(spec, turns=60))
    whole = _whole(shell, str(capture))
    fill = source.Source.fill

    def failing(opened: source.Source, target: memoryview) -> int:
        if opened.position_bytes > 0.5 * opened.size_bytes and Path("out.partial").exists():
            broken = OSError(5, "Input/output error")
            text = f"{opened.path}: could not read it (Input/output error); check the disk"
            raise RecordingError(text) from broken
        return fill(opened, target)

    with monkeypatch.context() as patch:
        patch.setattr(source.Source, "fill", failing)
        outcome = shell(f"convert {capture} -o out")
    assert outcome.code == 1
    assert (
        "could not read it (Input/output error); check the disk; then --resume continues after"
        in (outcome.err)
    )
    assert shell(f"convert {capture} -o out --resume").code == 0
    assert contents(Path()) == whole


def test_bad_input_says_nothing_of_it(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    _fail_at(monkeypatch, 4, ExportError("what cannot be mended"))
    assert shell(f"convert {CAPTURE} -o out").err == "mlbatch: error: what cannot be mended\n"


def test_an_output_to_be_replaced_can_be_resumed(shell: Shell) -> None:
    whole = _whole(shell)
    shell(f"convert {CAPTURE} -o out --rate 5")
    _interrupt(shell, f"{CAPTURE} -o out --overwrite")
    refused = shell(f"convert {CAPTURE} -o out --resume")
    assert refused.code == 1
    assert "expected a new output, found an existing one" in refused.err
    assert shell(f"convert {CAPTURE} -o out --resume --overwrite").code == 0
    assert contents(Path()) == whole


def test_a_kill_after_the_last_rename_leaves_nothing_to_do(
    shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(atomic, "tidy", lambda target, fsync: None)
        assert shell(f"convert {CAPTURE} -o out").code == 0
    assert Path("out/files.jsonl").exists()
    Path("out.old.partial").mkdir()
    outcome = shell(f"convert {CAPTURE} -o out --resume")
    assert (outcome.code, outcome.err) == (
        0,
        "mlbatch: out: is complete; there is nothing to resume\n",
    )
    assert sorted(path.name for path in Path().iterdir()) == ["out"]
    assert not Path("out/files.jsonl").exists()


def test_a_kill_between_the_renames_of_a_replaced_folder_is_resumed(
    shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The older output has another name then, and the new one none yet."""
    whole = _whole(shell)
    assert shell(f"convert {CAPTURE} -o out --rate 5").code == 0

    def ending(output: atomic.Output) -> None:
        output.target.rename(atomic.old_path(output.target))
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(atomic.Output, "_replace_folder", ending)
        assert shell(f"convert {CAPTURE} -o out --overwrite").code == 130
    assert sorted(path.name for path in Path().glob("out*")) == ["out.old.partial", "out.partial"]
    outcome = shell(f"convert {CAPTURE} -o out --overwrite --resume")
    assert outcome.err == f"mlbatch: out: resumed after {SCANS} scans\n"
    assert contents(Path()) == whole
