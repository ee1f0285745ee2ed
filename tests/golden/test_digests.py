"""Outputs of the command line against digests: bytes stay what they were.

`digests.json` holds SHA-256 of every output file of small recordings. Only the command line runs
here, and only files are read, so that the test outlives every reorganisation of the package. One
digest serves any number of jobs and all containers. After a change of outputs that is meant,
`python -m tests.golden.test_digests` writes the file again, unless runs of one case differ.
"""

from __future__ import annotations

import contextlib
import json
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.builders.run import command
from tests.golden.digest_outputs import Digests
from tests.golden.digest_recordings import (
    RECORDINGS,
    rig_of,
    write_recordings,
)

_HERE = Path(__file__).resolve().parent
_REPOSITORY = _HERE.parents[1]
_DIGESTS = _HERE / "digests.json"
_SUFFIX = {"mcap": ".mcap", "rosbag1": ".bag"}


@dataclass(frozen=True, slots=True)
class Run:
    """What may vary without a change of the product.

    container "": that of the baseline; interrupt: what kills a first run, which is then resumed:
    `open:NAME` at the first file of this name, `size:BYTES` when a file is to grow beyond.
    """

    container: str = ""
    jobs: str = "1"
    interrupt: str = ""


@dataclass(frozen=True, slots=True)
class Case:
    """A conversion; runs: after the baseline, in which `Run` has no values of its own."""

    recording: str
    options: tuple[str, ...]
    format: str = "npz"
    runs: tuple[Run, ...] = ()

    @property
    def output(self) -> str:
        """Name of the output."""
        return "out" + _SUFFIX.get(self.format, "")


def _cases() -> Iterator[tuple[str, Case]]:
    """Lines of `cases.txt`."""
    for line in (_HERE / "cases.txt").read_text("utf-8").splitlines():
        if not line.startswith("#"):
            name, _, text = line.partition(": ")
            first, *runs = text.split("; ")
            recording, format_, *options = shlex.split(first)
            every = tuple(Run(**dict(word.split("=") for word in run.split())) for run in runs)
            yield name, Case(recording, tuple(options), format_, every)


CASES = dict(_cases())
# A query prints JSON; every recording, and those of several lidars.
QUERIES: Mapping[str, tuple[str, ...]] = {
    **{
        f"inspect {recording} {container}": ("inspect", f"in/{recording}/drive.{container}")
        for recording, containers in RECORDINGS.items()
        for container in containers
    },
    **{
        f"inspect {recording} whole": ("inspect", f"in/{recording}/drive.pcap", "--whole")
        for recording in ("two_lidars", "four_makers")
    },
    **{
        f"compare {recording} {container}": (
            *("compare", f"in/{recording}/drive.{container}"),
            *("--rig", f"in/{recording}/{rig_of(recording, container)}"),
        )
        for recording in ("two_lidars", "four_makers")
        for container in ("pcap", "mcap")
    },
    "sensors": ("sensors",),
}


@contextlib.contextmanager
def inside(folder: Path) -> Iterator[None]:
    """Work in a folder: paths in outputs are then relative."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def words_of(case: Case, run: Run) -> list[str]:
    """The conversion, less its output."""
    container = run.container or RECORDINGS[case.recording][0]
    rig = rig_of(case.recording, container)
    words = ["convert", f"in/{case.recording}/drive.{container}", *case.options]
    # What has no rig has one lidar, or its poses in the recording.
    words += ["--rig", f"in/{case.recording}/{rig}"] if rig else ["--rate", "20"]
    words += ["--format", case.format, "-o", f"made/{case.output}", "-q"]
    return [*words, "--jobs", run.jobs]


# Runs the command line until it is killed. Its clock is fast, so that it keeps its state after
# every scan.
_KILLED = """
import os, resource, sys
kind, _, what = sys.argv.pop(1).partition(":")
def watch(event, given):
    if event == "open" and str(given[0]).endswith(what):
        os.kill(os.getpid(), 9)
if kind == "open":
    sys.addaudithook(watch)
else:
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(what), int(what)))
from mlbatch.cli import main
main()
"""


def convert(case: Case, run: Run, made: Path) -> None:
    """Convert into the folder `made` of the working folder."""
    words = words_of(case, run)
    kept: set[int] = set()
    if run.interrupt:
        killed = subprocess.run(
            [sys.executable, "-c", _KILLED, run.interrupt, *words],
            env=os.environ | {"PYTHONPATH": str(_REPOSITORY)},
            capture_output=True,
            check=False,
        )
        assert killed.returncode != 0, "was to be interrupted"
        assert list(made.glob("*.partial")), killed.stderr.decode()
        kept = _numbers(made)
        words.append("--resume")
    said = command(*words)
    assert said.code == 0, said.err
    if run.interrupt.startswith("open:"):
        assert kept & _numbers(made), "nothing of the first run was kept"


def _numbers(folder: Path) -> set[int]:
    """Numbers that the file system gives to files; one that is made again has another."""
    return {path.stat().st_ino for path in folder.rglob("*.npz")}


def digests_of(case: Case, run: Run) -> Digests:
    """Convert in the working folder, which holds the recordings, and verify the output."""
    found = Digests()
    made = Path("made")
    shutil.rmtree(made, ignore_errors=True)
    made.mkdir()
    convert(case, run, made)
    found.add_folder(made)
    if run == Run():
        for path in sorted(made.glob("out*")):
            if path.is_dir() or path.suffix in _SUFFIX.values():
                verdict = json.loads(command("verify", str(path), "--json").out)
                assert verdict["ok"], verdict["violations"]
                found.add_json(verdict, f"verify {path.name}")
    return found


def digests_of_query(words: Sequence[str]) -> Digests:
    """What a command prints as JSON, and the rig that `inspect` writes."""
    found = Digests()
    said = command(*words, "--json")
    assert said.code == 0, said.err
    found.add_json(json.loads(said.out), "")
    if words[0] == "inspect":
        rig = Path(words[1]).parent / "rig_written.yaml"
        rig.unlink(missing_ok=True)
        said = command(*words, "--write-rig", str(rig))
        assert said.code == 0, said.err
        found.add_file(rig, rig.name)
        rig.unlink()
    return found


def _context_key(case: Case, run: Run) -> str:
    return f"context {run.container or RECORDINGS[case.recording][0]}"


def differences(expected: Mapping[str, str], found: Mapping[str, str]) -> list[str]:
    """Names of files whose digests differ, are missing or not expected."""
    return sorted({name for name, _ in expected.items() ^ found.items()})


def run_differences(
    case: Case, run: Run, found: Digests, expected: Mapping[str, Mapping[str, str]]
) -> list[str]:
    """Differences of a run from the entry of its case."""
    lines = differences(expected["product"], found.product)
    context = expected.get(_context_key(case, run), {})
    if run != Run():
        # Only the output of the baseline is verified.
        context = {k: v for k, v in context.items() if not k.startswith("verify ")}
    return lines + differences(context, found.context)


@pytest.fixture(scope="module")
def workplace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all recordings in its folder `in`."""
    folder = tmp_path_factory.mktemp("digests")
    write_recordings(folder / "in")
    return folder


@pytest.fixture(scope="module")
def kept() -> dict[str, dict[str, dict[str, str]]]:
    """The digests that are kept."""
    found: dict[str, dict[str, dict[str, str]]] = json.loads(_DIGESTS.read_text("utf-8"))
    return found


@pytest.mark.parametrize("name", CASES)
def test_outputs_are_what_they_were(
    name: str, workplace: Path, kept: dict[str, dict[str, dict[str, str]]]
) -> None:
    case = CASES[name]
    with inside(workplace):
        for run in (Run(), *case.runs):
            lines = run_differences(case, run, digests_of(case, run), kept[name])
            shown = f"{name}: {words_of(case, run)}"
            assert not lines, f"{shown} (was: {kept[name]['about']['baseline']})"


@pytest.mark.parametrize("name", QUERIES)
def test_queries_answer_what_they_did(
    name: str, workplace: Path, kept: dict[str, dict[str, dict[str, str]]]
) -> None:
    with inside(workplace):
        found = digests_of_query(QUERIES[name])
    assert not differences(kept[name]["context"], found.context), name


def test_all_that_is_kept_is_tested(kept: dict[str, dict[str, dict[str, str]]]) -> None:
    assert kept.keys() == CASES.keys() | QUERIES.keys()


def _main() -> None:
    """Write `digests.json`, unless runs of one case differ."""
    entries: dict[str, dict[str, dict[str, str]]] = {}
    for name, case in CASES.items():
        found = digests_of(case, Run())
        entry = {"product": found.product, _context_key(case, Run()): found.context}
        entry["about"] = {"baseline": found.about}
        for run in case.runs:
            other = digests_of(case, run)
            entry.setdefault(_context_key(case, run), other.context)
            if lines := run_differences(case, run, other, entry):
                raise SystemExit(f"{name}: {run}: {lines}; digests.json is as it was")
        entries[name] = entry
    for name, words in QUERIES.items():
        entries[name] = {"context": digests_of_query(words).context}
    text = json.dumps(entries, indent=1, ensure_ascii=False) + "\n"
    _DIGESTS.write_text(text, "utf-8")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place, inside(Path(place)):
        write_recordings(Path("in"))
        _main()
