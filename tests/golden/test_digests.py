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
    jobs: int = 1
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


# A cover of all pairs of values, as far as they go together.
# recording, format, layout, compression, container, jobs
ROWS = """
two_lidars mcap organized zstd bag 3
two_lidars npz dense none pcapng 3
two_lidars ply dense none mcap 1
two_lidars rosbag1 dense none pcap 1
two_lidars rosbag2 organized zstd db3 1
four_makers mcap dense zstd mcap 1
four_makers npz dense none pcap 3
four_makers ply dense none db3 3
four_makers rosbag1 organized none bag 1
four_makers rosbag2 organized none pcapng 3
ouster mcap dense zstd pcapng 1
ouster npz dense none bag 1
ouster ply dense none pcap 3
ouster rosbag1 organized none db3 3
ouster rosbag2 organized zstd mcap 3
velodyne mcap organized zstd db3 1
velodyne npz organized none mcap 1
velodyne ply dense none bag 3
velodyne rosbag1 dense none pcapng 3
velodyne rosbag2 dense none pcap 3
hesai mcap organized none pcap 3
hesai npz organized none bag 3
hesai ply dense none pcapng 3
hesai rosbag1 organized none mcap 3
hesai rosbag2 dense zstd db3 1
robosense mcap organized zstd pcap 3
robosense npz dense none db3 3
robosense ply dense none bag 1
robosense rosbag1 dense none pcapng 1
robosense rosbag2 organized zstd mcap 1
livox mcap organized zstd pcapng 1
livox npz dense none pcapng 3
livox ply dense none pcapng 1
livox rosbag1 organized none pcap 3
livox rosbag2 organized zstd pcap 1
clouds mcap dense none db3 3
clouds npz organized none mcap 1
clouds ply dense none bag 1
clouds rosbag1 organized none db3 1
clouds rosbag2 dense zstd bag 3
"""
_PASSED = ("--pass", "/*/ouster/metadata")
_THREE = Run(jobs=3)


def _row_cases() -> dict[str, Case]:
    cases = {}
    for row in ROWS.split("\n")[1:-1]:
        recording, format_, layout, compression, container, jobs = row.split()
        options = ("--layout", layout, "--compression", compression)
        name = f"{recording} {format_} {layout} {compression}"
        cases[name] = Case(recording, options, format_, (Run(container, int(jobs)),))
    return cases


def _case(recording: str, *options: str, format: str = "npz", runs: tuple[Run, ...] = ()) -> Case:
    return Case(recording, options, format, runs)


def _option_cases() -> dict[str, Case]:
    two = "two_lidars"
    four = "four_makers"
    cases = {
        "split": _case(two, "--split", runs=(_THREE, Run("db3"))),
        "split mcap": _case(four, "--split", format="mcap", runs=(_THREE, Run("mcap"))),
        "slices": _case(two, "--slices", "4", format="mcap", runs=(_THREE, Run("bag"))),
        "slices npz": _case(four, "--slices", "4", runs=(_THREE,)),
        "split slices rosbag2": _case(two, "--split", "--slices", "4", format="rosbag2"),
        "keep partial": _case(two, "--keep-partial", runs=(_THREE, Run("mcap"))),
        "keep partial ply": _case(four, "--keep-partial", format="ply"),
        "drop incomplete": _case(
            two, "--keep-partial", "--drop-incomplete", "90", "--fault", "stall:left:0.3s-0.5s"
        ),
        "align clocks": _case(two, "--align-clocks", runs=(Run("pcapng"),)),
        "align clocks to first": _case(
            two, "--align-clocks", "--align-to", "first", "--fault", "drift:right:80ppm"
        ),
        "clock host": _case(four, "--clock", "host", format="mcap"),
        "rate": _case(two, "--rate", "30/7", "--keep-partial"),
        "wait for ever": _case(four, "--max-wait", "inf", "--rate", "29.97", format="mcap"),
        "start end": _case(two, "--start", "+0.2", "--end", "+0.5", format="mcap"),
        "limits": _case(
            *(four, "--min-range", "2", "--max-range", "9", "--keep-repeated"),
            *("--exclude-box", "-1,-9,-9,1,9,9", "--exclude-box", "2,-9,-9,3,9,9"),
        ),
        "limits organized": _case(
            *(four, "--min-range", "2", "--exclude-box", "-1,-9,-9,1,9,9"),
            *("--layout", "organized", "--keep-repeated"),
        ),
        "decode": _case(four, "--decode", "firing_azimuth=off", "--decode", "vertical_offset=off"),
        "decode crc": _case(two, "--decode", "crc=check", "--fault", "bitflip:left:5%"),
        "optical centre": _case(four, "--only", "right", "--decode", "optical_centre=on"),
        "ignore": _case(four, "--ignore", "roof", "--ignore", "rear", format="mcap"),
        "lz4": _case(two, "--compression", "lz4", format="mcap"),
        "jump split": _case(
            *(two, "--fault", "jump:left:37s@0.4s", "--fault", "jump:right:37s@0.4s"),
            *("--on-jump", "split", "--keep-partial"),
            runs=(Run(jobs=3),),
        ),
        "many faults": _case(
            *(
                four,
                "--fault",
                "drop:left:5%",
                "--fault",
                "dup:roof:2%",
                "--fault",
                "late:rear:0.1s",
            ),
            *("--fault", "reorder:right:3%", "--fault", "truncate:right:1%", "--fault-seed", "5"),
            *("--keep-partial", "--fault", "delay:roof:60ms"),
            runs=(_THREE,),
        ),
        "early": _case(four, "--fault", "early:left:0.1s", "--keep-partial"),
        "stall": _case(two, "--fault", "stall:right:0.2s-0.7s", "--max-wait", "0.1"),
        "resumed npz": _case(
            *(two, "--keep-partial", "--slices", "2"),
            runs=(Run(interrupt="open:000004-1.npz"), Run(jobs=3, interrupt="open:000004-0.npz")),
        ),
        "resumed mcap": _case(
            two, "--slices", "2", format="mcap", runs=(Run(interrupt="size:4700000"),)
        ),
        "resumed rosbag1": _case(two, format="rosbag1", runs=(Run(interrupt="size:2000000"),)),
        # Messages that pass through keep the QoS and the definitions of their recording.
        "bag mcap": _case("bag_mcap", *_PASSED, format="mcap", runs=(_THREE,)),
        "bag rosbag1": _case("bag_mcap", *_PASSED, format="rosbag1"),
        "bag rosbag2": _case("bag_mcap", *_PASSED, format="rosbag2", runs=(Run(jobs=3),)),
        "db3 bag rosbag2": _case("bag_db3", *_PASSED, format="rosbag2"),
        "bag of ROS 1 mcap": _case("bag_ros1", *_PASSED, format="mcap"),
        "bag of ROS 1 rosbag1": _case("bag_ros1", *_PASSED, format="rosbag1"),
        "bag of ROS 1 npz": _case("bag_ros1", "--split"),
    }
    for preset in ("velodyne", "ouster", "hesai", "autoware", "kiss-icp", "minimal"):
        options = ("--point-layout", preset)
        cases[f"points {preset}"] = _case(four, *options, format="mcap")
        cases[f"points {preset} organized"] = _case(
            four, *options, "--layout", "organized", format="rosbag1", runs=()
        )
    return cases


CASES = _row_cases() | _option_cases()
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
    return [*words, "--jobs", str(run.jobs)]


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
