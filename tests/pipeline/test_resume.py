"""`--resume`: messages, refused jobs, files left by runs that end early."""

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
from mlbatch.cli import run
from mlbatch.errors import ExportError, RecordingError
from mlbatch.pipeline import job_identity, resume, state_file, workers
from mlbatch.readers import source
from mlbatch.types import Scan
from mlbatch.writers.formats import npz
from mlbatch.writers.output_file import Bytes
from tests.builders.sessions import FIXTURE, SMALL, Shell, Unit, recording_shell, write_session
from tests.resume_storm import contents, write_recordings

CAPTURE = f"{FIXTURE / 'two_lidars.pcap'} --rig {FIXTURE / 'rig.yaml'}"
# From fixtures/two_lidars/SOURCE.md: a window of 10 Hz each.
SCANS = 7
STATE = Path("out.partial.state")


@pytest.fixture
def shell(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> Shell:
    """The command line, in an empty folder; every scan gets a line of the state file."""
    return recording_shell(monkeypatch, capsys, tmp_path)


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
    """Leave a `.partial` with three scans that are safe."""
    with pytest.MonkeyPatch.context() as patch:
        _fail_at(patch, 3, KeyboardInterrupt())
        assert shell(f"convert {words}").code == 130
    assert STATE.is_file()


def _records(state: Path) -> list[dict[str, Any]]:
    """Content of a state file, without checksums."""
    return [json.loads(line.partition(" ")[2]) for line in state.read_text().splitlines()]


def _whole(shell: Shell, words: str = CAPTURE) -> dict[str, object]:
    Path("whole").mkdir()
    assert shell(f"convert {words} -o whole/out").code == 0
    return contents(Path("whole"))


def test_it_continues_after_the_scans_that_are_safe(
    shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = _whole(shell)
    _interrupt(shell)
    first = Path("out.partial/000000.npz").stat().st_mtime_ns
    saved = []
    encode = npz.NpzEncoder.encode

    def counting(encoder: npz.NpzEncoder, scan: Scan) -> list[Bytes]:
        saved.append(scan.index)
        return encode(encoder, scan)

    monkeypatch.setattr(npz.NpzEncoder, "encode", counting)
    outcome = shell(f"convert {CAPTURE} -o out --resume")
    assert outcome.code == 0
    assert outcome.err == "mlbatch: out: resumed after 3 scans\n"
    assert saved == [3, 4, 5, 6]
    assert Path("out/000000.npz").stat().st_mtime_ns == first
    assert contents(Path()) == whole


def test_an_interrupt_names_resume(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    _fail_at(monkeypatch, 2, KeyboardInterrupt())
    outcome = shell(f"convert {CAPTURE} -o out")
    assert outcome.err == (
        "mlbatch: error: interrupted; finished scans are kept in .partial, from where "
        "--resume continues\n"
    )


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_request_to_end_is_an_interrupt(
    shell: Shell, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    before = signal.signal(number, signal.SIG_DFL)
    encode = npz.NpzEncoder.encode

    def ending(encoder: npz.NpzEncoder, scan: Scan) -> list[Bytes]:
        if scan.index == 1:
            signal.raise_signal(number)
        return encode(encoder, scan)

    monkeypatch.setattr(npz.NpzEncoder, "encode", ending)
    assert shell(f"convert {CAPTURE} -o out").code == 130
    assert signal.signal(number, before) is signal.SIG_DFL
    assert _records(STATE)[-1] == {"synced": True}


def test_nohup_outlives_its_terminal(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    encode = npz.NpzEncoder.encode

    def ending(encoder: npz.NpzEncoder, scan: Scan) -> list[Bytes]:
        signal.raise_signal(signal.SIGHUP)
        return encode(encoder, scan)

    monkeypatch.setattr(npz.NpzEncoder, "encode", ending)
    assert shell(f"convert {CAPTURE} -o out").code == 0
    assert signal.signal(signal.SIGHUP, before) is signal.SIG_IGN


def test_an_interrupt_after_the_last_rename_leaves_the_output_alone(
    shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    def ending(log: resume.ResumeLog) -> None:
        raise KeyboardInterrupt

    whole = _whole(shell)
    monkeypatch.setattr(resume.ResumeLog, "remove", ending)
    outcome = shell(f"convert {CAPTURE} -o out")
    assert (outcome.code, outcome.err) == (130, "mlbatch: error: interrupted\n")
    assert contents(Path()) == whole


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
    take = resume.ResumeLog.take
    calls = 0

    def ending(log: resume.ResumeLog, *given: Any) -> state_file.FinishedScan | None:
        nonlocal calls
        calls += 1
        if calls == 2:
            _Ending()
        if calls == 3:
            time.sleep(0.2)
        return take(log, *given)

    monkeypatch.setattr(resume.ResumeLog, "take", ending)
    outcome = shell(f"convert {CAPTURE} -o out")
    assert outcome.code == 130
    assert outcome.err.startswith("mlbatch: error: interrupted")
    assert calls <= 3


def test_nothing_to_resume_is_reported(shell: Shell) -> None:
    outcome = shell(f"convert {CAPTURE} -o out --resume")
    assert outcome.code == 0
    assert outcome.err == "mlbatch: out: nothing to resume; started over\n"
    assert contents(Path()) == _whole(shell)


def test_a_complete_output_is_left_alone(shell: Shell) -> None:
    shell(f"convert {CAPTURE} -o out")
    before = Path("out/report.json").read_bytes()
    outcome = shell(f"convert {CAPTURE} -o out --resume")
    assert (outcome.code, outcome.out) == (0, "")
    assert outcome.err == "mlbatch: out: is complete; there is nothing to resume\n"
    assert Path("out/report.json").read_bytes() == before
    again = shell(f"convert {CAPTURE} -o out --resume --overwrite")
    assert again.err == "mlbatch: out: nothing to resume; started over\n"
    assert Path("out/report.json").read_bytes() != before


def test_without_it_a_partial_is_replaced_and_the_option_named(shell: Shell) -> None:
    _interrupt(shell)
    outcome = shell(f"convert {CAPTURE} -o out")
    assert outcome.code == 0
    assert outcome.err == (
        "mlbatch: warning: interrupted: out.partial with 3 finished scans is discarded; "
        "--resume would continue after them\n"
    )
    assert contents(Path()) == _whole(shell)


@pytest.mark.parametrize(
    ("words", "difference"),
    [
        (f"{CAPTURE} --rate 20", "rate '20' instead of 'not given'"),
        (f"{CAPTURE} --format ply", "format 'ply' instead of 'npz'"),
        (f"{CAPTURE} --min-range 2", "min range m '2.0' instead of '0.0'"),
        (f"{CAPTURE} --decode crc=check", "decode 'crc=check' instead of 'not given'"),
        (f"{CAPTURE} --fault drop:left:1%", "faults"),
        (f"{CAPTURE} --keep-partial", "keep partial 'True' instead of 'False'"),
    ],
)
def test_another_job_is_refused(shell: Shell, words: str, difference: str) -> None:
    _interrupt(shell)
    outcome = shell(f"convert {words} -o out --resume")
    assert outcome.code == 2
    # Nothing is said to be resumed before that.
    [line] = outcome.err.splitlines()
    assert line.startswith(
        f"mlbatch: error: out.partial: expected the job of the interrupted run, found {difference}"
    )
    assert line.endswith("; give the same, or leave out --resume to start over")
    # The right job can still be resumed.
    assert shell(f"convert {CAPTURE} -o out --resume").err.count("resumed after 3 scans") == 1


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
    assert shell(f"convert {second} {output} --resume --overwrite").err == (
        f"mlbatch: {name}: nothing to resume; started over\n"
    )


def test_copies_and_other_versions_make_the_same_output(
    shell: Shell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture = write_session(tmp_path / "in", Unit(turns=8))
    assert shell(f"convert {capture} -o out").code == 0
    os.utime(capture, ns=(1, 1))
    monkeypatch.setattr(mlbatch, "__version__", "0.0.1")
    assert "is complete" in shell(f"convert {capture} -o out --resume").err


def test_another_recording_calibration_or_pose_is_refused(shell: Shell, tmp_path: Path) -> None:
    capture = write_session(tmp_path / "in", Unit(turns=8))
    words = f"{capture} -o out"
    _interrupt(shell, words)
    os.utime(capture, ns=(1, 1))
    assert "found recording 1 'drive.pcap (" in shell(f"convert {words} --resume").err
    _interrupt(shell, words)
    metadata = tmp_path / "in" / "111.json"
    found = json.loads(metadata.read_text())
    angles = found["beam_intrinsics"]["beam_altitude_angles"]
    angles[0] += 0.01
    metadata.write_text(json.dumps(found))
    assert "found calibration of ouster_111 '" in shell(f"convert {words} --resume").err


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


def test_a_recording_with_another_sample_is_refused(shell: Shell, tmp_path: Path) -> None:
    capture = write_session(tmp_path / "in", Unit(LARGE, turns=8))
    size = capture.stat().st_size
    words = f"{capture} -o out"
    middle = next(at for at, _ in job_identity._sampled(size, size) if at > size // 2)
    for at in (100, middle, size - 100):
        _interrupt(shell, words)
        _flip(capture, at)
        outcome = shell(f"convert {words} --resume")
        assert outcome.code == 2
        assert "expected the job of the interrupted run, found recording 1 'drive." in outcome.err
        _flip(capture, at)
    assert shell(f"convert {words} --resume").code == 0


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
        "for scan 2 of 3 that are finished: a recording was changed; restore it, or leave out "
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
    case = f"{recording} -o out.mcap --identity-extrinsics --keep-partial --pass /chatter"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(resume.ResumeLog, "complete", _refuse)
        assert shell(f"convert {case}").code == 1
    content = recording.read_bytes()
    at = len(content) // 10
    while not content[at : at + 100].isdigit():
        at = _unsampled(len(content), (at + 100) / len(content))
    _flip(recording, at)
    outcome = shell(f"convert {case} --resume")
    assert outcome.code == 2
    assert "expected the packets of the interrupted run" in outcome.err


def test_another_byte_of_a_calibration_is_refused(shell: Shell, tmp_path: Path) -> None:
    """Also one without influence: the file is not the same."""
    capture = write_session(tmp_path / "in", Unit(turns=8))
    _interrupt(shell, f"{capture} -o out")
    metadata = tmp_path / "in" / "111.json"
    _flip(metadata, metadata.read_bytes().index(b"calibration_status") + 3)
    assert "found calibration of ouster_111 '" in shell(f"convert {capture} -o out --resume").err


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("translation_m: [", "translation_m: [1"),
        ("exclude_boxes_m: [[-1.7", "exclude_boxes_m: [[-1.8"),
    ],
)
def test_another_rig_of_the_same_time_is_refused(
    shell: Shell, tmp_path: Path, before: str, after: str
) -> None:
    shutil.copytree(FIXTURE, tmp_path / "in")
    rig = tmp_path / "in" / "rig.yaml"
    words = f"{tmp_path / 'in' / 'two_lidars.pcap'} --rig {rig} -o out"
    _interrupt(shell, words)
    times = rig.stat()
    sound = rig.read_text()
    rig.write_text(sound.replace(before, after, 1))
    os.utime(rig, ns=(times.st_atime_ns, times.st_mtime_ns))
    assert rig.read_text() != sound
    outcome = shell(f"convert {words} --resume")
    assert outcome.code == 2
    assert "expected the job of the interrupted run, found " in outcome.err
    # Comments have no influence.
    rig.write_text(f"# The rig.\n{sound}")
    assert shell(f"convert {words} --resume").err == "mlbatch: out: resumed after 3 scans\n"


def test_a_lost_scan_is_refused(shell: Shell) -> None:
    _interrupt(shell)
    Path("out.partial/000001.npz").unlink()
    outcome = shell(f"convert {CAPTURE} -o out --resume")
    assert outcome.code == 1
    assert outcome.err.splitlines()[-1] == (
        "mlbatch: error: out.partial/000001.npz: expected a scan of the interrupted run, "
        "found no file; leave out --resume to start over"
    )


@pytest.mark.parametrize("words", ["", "--split", "--format ply", "--format nuscenes"])
def test_a_changed_byte_of_a_finished_scan_is_refused(shell: Shell, words: str) -> None:
    words = f"{CAPTURE} -o out {words} --jobs 1"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(resume.ResumeLog, "complete", _refuse)
        assert shell(f"convert {words}").code == 1
    files = [path for path in sorted(Path("out.partial").rglob("000001*")) if path.is_file()]
    for path in files:
        sound = path.read_bytes()
        path.write_bytes(sound[:-100] + bytes([sound[-100] ^ 1]) + sound[-99:])
        outcome = shell(f"convert {words} --resume")
        assert outcome.code == 1
        error = outcome.err.splitlines()[-1]
        assert error.startswith("mlbatch: error: out.partial/")
        assert path.name.partition(".")[0] in error
        assert "expected the bytes that the interrupted run has written, found others" in error
        path.write_bytes(sound)
    assert shell(f"convert {words} --resume").code == 0


@pytest.mark.parametrize("name", ["out.mcap", "out.mcap --compression zstd", "out.bag"])
def test_a_changed_byte_of_a_file_is_refused(shell: Shell, tmp_path: Path, name: str) -> None:
    spec = replace(SMALL, beams=128, columns_per_frame=512)
    capture = write_session(tmp_path / "in", Unit(spec, turns=30))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(resume.ResumeLog, "complete", _refuse)
        assert shell(f"convert {capture} -o {name}").code == 1
    partial = Path(f"{name.split()[0]}.partial")
    kept = _records(Path(f"{partial}.state"))[-2]["kept_bytes"]
    with partial.open("r+b") as file:
        file.seek(kept // 2)
        old = file.read(1)[0]
        file.seek(-1, os.SEEK_CUR)
        file.write(bytes([old ^ 1]))
    outcome = shell(f"convert {capture} -o {name} --resume")
    assert outcome.code == 1
    assert outcome.err.splitlines()[-1] == (
        f"mlbatch: error: {partial}: expected the bytes that the interrupted run has written, "
        "found others; leave out --resume to start over"
    )


def test_a_shorter_file_is_refused(shell: Shell, tmp_path: Path) -> None:
    spec = replace(SMALL, beams=128, columns_per_frame=512)
    capture = write_session(tmp_path / "in", Unit(spec, turns=30))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(resume.ResumeLog, "complete", _refuse)
        assert shell(f"convert {capture} -o out.mcap").code == 1
    partial = Path("out.mcap.partial")
    kept = _records(Path("out.mcap.partial.state"))[-2]["kept_bytes"]
    os.truncate(partial, kept - 1)
    outcome = shell(f"convert {capture} -o out.mcap --resume")
    assert outcome.code == 1
    assert outcome.err.splitlines()[-1] == (
        f"mlbatch: error: out.mcap.partial: expected {kept} bytes of the interrupted run, "
        f"found {kept - 1}; leave out --resume to start over"
    )


def _refuse(log: resume.ResumeLog) -> None:
    raise ExportError("stopped")


@pytest.mark.parametrize("option", ["", "--resume"])
def test_a_running_run_is_not_disturbed(shell: Shell, option: str) -> None:
    _interrupt(shell)
    with STATE.open("rb") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        outcome = shell(f"convert {CAPTURE} -o out {option}")
    assert outcome.code == 1
    assert outcome.err == (
        "mlbatch: error: out: expected no other run that writes it, found one; wait for its end "
        "or choose another output\n"
    )
    assert STATE.is_file()


@pytest.mark.parametrize("output", ["out", "out.mcap"])
def test_a_run_that_began_after_the_check_is_not_disturbed(
    shell: Shell, monkeypatch: pytest.MonkeyPatch, output: str
) -> None:
    """Two runs may both find nothing before one of them writes."""
    state, scan = Path(f"{output}.partial.state"), Path(f"{output}.partial")
    with contextlib.ExitStack() as files:

        def other_run(*_: object) -> None:
            file = files.enter_context(state.open("wb", buffering=0))
            fcntl.flock(file, fcntl.LOCK_EX)
            file.write(b"what it did")
            scan.write_bytes(b"what it wrote")

        monkeypatch.setattr(run, "check_target", other_run)
        outcome = shell(f"convert {CAPTURE} -o {output}")
    assert (outcome.code, "expected no other run that writes it, found one" in outcome.err) == (
        1,
        True,
    )
    assert state.read_bytes() == b"what it did"
    assert scan.read_bytes() == b"what it wrote"


def test_an_output_that_cannot_be_opened_leaves_no_state(
    shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        Path("out").mkdir()

    monkeypatch.setattr(run, "check_target", refuse)
    outcome = shell(f"convert {CAPTURE} -o out")
    assert (outcome.code, "found an existing one" in outcome.err) == (1, True)
    assert [path.name for path in Path().iterdir()] == ["out"]


@pytest.mark.parametrize(
    ("text", "records"),
    [
        ("", ""),
        ("{", ""),
        ("[]\n", "another checksum"),
        ("nonsense\n", "another checksum"),
        ('{"boot":"","schema":"mlbatch.state/1"}\n', "another checksum"),
    ],
)
def test_an_unreadable_state_is_ignored(shell: Shell, text: str, records: str) -> None:
    _interrupt(shell)
    STATE.write_text(text)
    outcome = shell(f"convert {CAPTURE} -o out --resume")
    *damage, last = outcome.err.splitlines()
    assert last == "mlbatch: out: nothing to resume; started over"
    assert damage == [_damage(1)] * bool(records)
    assert outcome.code == 0


def _damage(record: int) -> str:
    return (
        f"mlbatch: {STATE}: expected records as they were written, found record {record} with "
        "another checksum; scans from there on are converted again"
    )


def _swapped(lines: list[str]) -> list[str]:
    return [*lines[:2], lines[3], lines[2], *lines[4:]]


def _dropped(lines: list[str]) -> list[str]:
    return [*lines[:2], *lines[3:]]


def _repeated(lines: list[str]) -> list[str]:
    return [*lines[:2], lines[1], *lines[2:]]


def _changed(lines: list[str]) -> list[str]:
    checksum, _, record = lines[2].partition(" ")
    return [*lines[:2], f"{checksum} {record.replace('0', '1', 1)}", *lines[3:]]


@pytest.mark.parametrize("change", [_swapped, _dropped, _repeated, _changed])
def test_records_from_a_damaged_one_on_are_made_again(
    shell: Shell, change: Callable[[list[str]], list[str]]
) -> None:
    """Records: the job, a scan each of three, synced."""
    whole = _whole(shell)
    _interrupt(shell)
    lines = STATE.read_text().splitlines()
    assert len(lines) == 5
    STATE.write_text("".join(f"{line}\n" for line in change(lines)))
    outcome = shell(f"convert {CAPTURE} -o out --resume")
    assert outcome.err.splitlines() == [_damage(3), "mlbatch: out: resumed after 1 scans"]
    assert contents(Path()) == whole


def test_a_record_cut_off_by_a_kill_is_no_damage(shell: Shell) -> None:
    whole = _whole(shell)
    _interrupt(shell)
    lines = STATE.read_text().splitlines()
    STATE.write_text("\n".join(lines[:3])[:-7])
    outcome = shell(f"convert {CAPTURE} -o out --resume")
    assert outcome.err == "mlbatch: out: resumed after 1 scans\n"
    assert contents(Path()) == whole


def test_no_change_of_a_byte_gives_another_state(shell: Shell) -> None:
    """What a changed file says is what some of its first records say, or nothing."""
    _interrupt(shell)
    content = STATE.read_bytes()
    states = [state_file.read_state(STATE).state]
    lines = content.splitlines(keepends=True)
    for count in range(len(lines)):
        STATE.write_bytes(b"".join(lines[:count]))
        states.append(state_file.read_state(STATE).state)
    assert len(lines) == 5
    for at in range(len(content)):
        for flip in (0x01, 0x20, 0x80, content[at] ^ ord("\n"), content[at] ^ ord("0")):
            if not flip:
                continue
            STATE.write_bytes(content[:at] + bytes([content[at] ^ flip]) + content[at + 1 :])
            found = state_file.read_state(STATE)
            assert found.state in states
            assert found.state != states[0]


@pytest.mark.long
def test_no_change_of_a_byte_gives_another_output(shell: Shell) -> None:
    """The same to the end, for bytes of all records."""
    whole = _whole(shell)
    _interrupt(shell)
    Path("out.partial").rename("kept")
    content = STATE.read_bytes()
    after = set()
    for at in range(3, len(content), len(content) // 40):
        shutil.rmtree("out", ignore_errors=True)
        shutil.copytree("kept", "out.partial")
        STATE.write_bytes(content[:at] + bytes([content[at] ^ 4]) + content[at + 1 :])
        outcome = shell(f"convert {CAPTURE} -o out --resume")
        after.add(outcome.err.splitlines()[-1])
        assert outcome.code == 0
        assert contents(Path()) == whole
    assert after >= {
        "mlbatch: out: nothing to resume; started over",
        "mlbatch: out: resumed after 1 scans",
        "mlbatch: out: resumed after 2 scans",
        "mlbatch: out: resumed after 3 scans",
    }


def test_after_a_restart_only_what_reached_the_disk_counts(
    shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = _whole(shell)
    _interrupt(shell)
    lines = STATE.read_text().splitlines(keepends=True)
    monkeypatch.setattr(state_file, "_boot", lambda: "later")
    assert "synced" in lines[-1]
    STATE.write_text("".join(lines[:-1]))
    found = resume.find(Path("out"))
    assert (found.state, found.is_complete) == (None, False)
    STATE.write_text("".join(lines))
    assert "resumed after 3 scans" in shell(f"convert {CAPTURE} -o out --resume").err
    assert contents(Path()) == whole


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


@pytest.mark.parametrize("option", ["", "--overwrite"])
def test_a_kill_after_the_last_rename_leaves_nothing_to_do(
    shell: Shell, monkeypatch: pytest.MonkeyPatch, option: str
) -> None:
    monkeypatch.setattr(state_file.StateFile, "remove", lambda file: None)
    assert shell(f"convert {CAPTURE} -o out").code == 0
    Path("out.old.partial").mkdir()
    outcome = shell(f"convert {CAPTURE} -o out --resume {option}")
    assert (outcome.code, outcome.err) == (
        0,
        "mlbatch: out: is complete; there is nothing to resume\n",
    )
    assert sorted(path.name for path in Path().iterdir()) == ["out"]


def test_a_dry_run_leaves_nothing_to_resume(shell: Shell) -> None:
    outcome = shell(f"convert {CAPTURE} --dry-run --resume")
    assert outcome.code == 2
    assert "--resume: expected an output to continue, found --dry-run" in outcome.err
