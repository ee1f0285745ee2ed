"""Measure whole processes: CPU time, peak memory, what a writer costs a point, a reader a packet.

Candidates run in turn (A B A B ...) and are compared pair by pair, so that a slower minute of the
machine slows both. What is measured and how: measure.py.

    python -m tests.bench.run speed --folder /data/bench --peer-python /opt/peer/bin/python
    python -m tests.bench.run memory --folder /data/bench
    python -m tests.bench.run writers --folder /data/bench
    python -m tests.bench.run containers --folder /data/bench
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import sys
import tempfile
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final

from tests.bench.measure import (
    BenchError,
    Case,
    Found,
    Usage,
    measure,
    plain,
    ratios,
    repeat,
    show,
    spread,
)

CONTAINER_TOOL: Final = (sys.executable, "-m", "tests.bench.containers")
PEER: Final = Path(__file__).with_name("peer_ouster.py")
# The entry point of pyproject.toml, so that no installation is needed.
MLBATCH: Final = (
    sys.executable,
    "-c",
    "import sys; from mlbatch.cli import main; sys.exit(main())",
)
# As in rig.yaml: x, y, z in m, yaw in degrees.
PEER_EXTRINSICS: Final = ("--extrinsics=0,0.6,1.8,0", "--extrinsics=0,-0.6,1.8,90")
MIN_MEDIAN_MAX: Final = f"{'min':>8} {'median':>8} {'max':>8}"
WRITERS: Final = {"mcap": "out.mcap", "npz": "out_npz", "ply": "out_ply"}
MEMORY_SECONDS: Final = (12.0, 60.0, 300.0)
CONTAINERS: Final = (".pcap", ".mcap", ".db3")
CONTAINER_SECONDS: Final = (12.0, 60.0)


def recording(folder: Path, seconds: float, fragments: bool = False) -> Path:
    """The standard recording of this length, made where it does not exist."""
    path = folder / f"two_os1-128_{seconds:g}s{'_fragments' if fragments else ''}.pcap"
    if not path.exists():
        command = [sys.executable, "-m", "tests.bench.recordings", str(folder)]
        command += ["--seconds", f"{seconds:g}", *(["--fragments"] if fragments else [])]
        measure(command)
    return path


def convert(pcap: Path, output: Path | None = None) -> tuple[Usage, Found]:
    """Convert, or `--dry-run` without an output; the output is deleted again."""
    with tempfile.TemporaryDirectory(dir=pcap.parent) as scratch:
        report_path = Path(scratch) / "report.json"
        command = [
            *MLBATCH,
            "convert",
            str(pcap),
            "--rig",
            str(pcap.parent / "rig.yaml"),
            "--quiet",
        ]
        command += ["--report", str(report_path)]
        command += ["--dry-run"] if output is None else ["-o", str(output), "--overwrite"]
        usage = measure(command)
        report = json.loads(report_path.read_text(encoding="utf-8"))
    written = 0 if output is None else _take_away(output)
    slots = sum(sensor["points"]["slots"] for sensor in report["sensors"])
    scans = report["scans"]
    return usage, Found(slots, scans["points"], written, scans["written"])


def peer(python: str, pcap: Path) -> tuple[Usage, Found]:
    """The peer on the same recording."""
    metadata = [str(pcap.parent / f"sensor_{name}.json") for name in "ab"]
    usage = measure([python, str(PEER), str(pcap), *metadata, *PEER_EXTRINSICS])
    found = json.loads(usage.stdout)
    return usage, Found(found["slots"], found["points"], 0, found["frame_sets"])


def speed(options: argparse.Namespace) -> dict[str, object]:
    """CPU of the dry run, plain and fragmented, and of the peer."""
    cases = []
    for kind in ("plain", "fragments"):
        pcap = recording(options.folder, options.seconds, kind == "fragments")
        cases.append(Case(f"mlbatch {kind}", partial(convert, pcap)))
        if options.peer_python:
            cases.append(Case(f"peer {kind}", partial(peer, options.peer_python, pcap)))
    repeat(cases, options.repeat)
    show(cases)
    by_name = {case.name: case.cpu_s for case in cases}
    pairs = [("mlbatch fragments", "mlbatch plain")]
    if options.peer_python:
        pairs += [(f"mlbatch {kind}", f"peer {kind}") for kind in ("plain", "fragments")]
    compared = {f"{a} / {b}": ratios(by_name[a], by_name[b]) for a, b in pairs}
    print(f"\n{'CPU, pair by pair':36}{MIN_MEDIAN_MAX}")
    for name, values in compared.items():
        print(f"{name:36}{spread(values)}")
    return {"cases": [plain(case) for case in cases], "ratios": compared}


def memory(options: argparse.Namespace) -> dict[str, object]:
    """Peak memory of the dry run at three lengths; the longest recording is deleted again."""
    cases = []
    for seconds in MEMORY_SECONDS:
        pcap = recording(options.folder, seconds)
        case = Case(f"mlbatch {seconds:g} s", partial(convert, pcap))
        repeat([case], options.repeat)
        cases.append(case)
    if not options.keep:
        recording(options.folder, MEMORY_SECONDS[-1]).unlink()
    show(cases)
    growth = ratios(cases[-1].rss_mb, cases[0].rss_mb)
    print(f"\npeak memory, longest / shortest     {spread(growth)}")
    return {"cases": [plain(case) for case in cases], "growth": growth}


def writers(options: argparse.Namespace) -> dict[str, object]:
    """CPU of each writer: the conversion less the dry run, beside a copy of the same bytes."""
    pcap = recording(options.folder, options.seconds)
    base = Case("dry run", partial(convert, pcap))
    cases = [
        Case(name, partial(convert, pcap, pcap.parent / place)) for name, place in WRITERS.items()
    ]
    repeat([base, *cases], options.repeat)
    show([base, *cases])
    cost = {}
    print(f"\n{'ns a point above the dry run':36}{MIN_MEDIAN_MAX}     copy  bytes")
    for case in cases:
        found = case.found
        above = [(a - b) * 1e9 / found.points for a, b in zip(case.cpu_s, base.cpu_s, strict=True)]
        copy_ns = copy_s(found.written_bytes, found.scans) * 1e9 / found.points
        point_bytes = found.written_bytes / found.points
        print(f"{case.name:36}{spread(above)} {copy_ns:8.3f} {point_bytes:6.1f}")
        cost[case.name] = {"above_ns": above, "copy_ns": copy_ns, "point_bytes": point_bytes}
    return {"cases": [plain(case) for case in [base, *cases]], "writers": cost}


def containers(options: argparse.Namespace) -> dict[str, object]:
    """CPU a packet and memory of one pass of reading, by container and length; no decoding."""
    cases = []
    for seconds in CONTAINER_SECONDS:
        pcap = recording(options.folder, seconds)
        for suffix in CONTAINERS:
            path = pcap.with_suffix(suffix)
            if not path.exists():
                measure([*CONTAINER_TOOL, "write", str(pcap), str(path)])
            cases.append(Case(f"{suffix} {seconds:g} s", partial(read, path)))
    repeat(cases, options.repeat)
    cost_us = {}
    print(f"{'us a packet, and peak memory':30}{MIN_MEDIAN_MAX} us {'peak':>8} MB {'packets':>9}")
    for case in cases:
        each = [cpu_s * 1e6 / case.found.slots for cpu_s in case.cpu_s]
        cost_us[case.name] = each
        print(f"{case.name:30}{spread(each)} us {max(case.rss_mb):8.1f} MB {case.found.slots:9}")
    return {"cases": [plain(case) for case in cases], "us_a_packet": cost_us}


def read(path: Path) -> tuple[Usage, Found]:
    """One pass over a recording; slots are packets, and CPU is that of the pass alone."""
    usage = measure([*CONTAINER_TOOL, "read", str(path)])
    told = json.loads(usage.stdout)
    return replace(usage, cpu_s=told["cpu_s"]), Found(told["packets"], 0, told["bytes"])


def copy_s(size: int, blocks: int) -> float:
    """CPU time of numpy to copy `size` bytes, a block at a time between two warm buffers."""
    import numpy as np

    source = np.ones(max(1, size // max(1, blocks)), dtype=np.uint8)
    target = np.zeros_like(source)
    target[:] = source
    began = time.process_time()
    for _ in range(blocks):
        target[:] = source
    return time.process_time() - began


def _take_away(output: Path) -> int:
    """Delete an output and what lies beside it; returns its size in bytes."""
    if output.is_dir():
        size = sum(path.stat().st_size for path in output.rglob("*") if path.is_file())
        shutil.rmtree(output)
    else:
        size = output.stat().st_size
    for path in output.parent.glob(f"{output.name}*"):
        path.unlink()
    return size


MODES: Final = {"speed": speed, "memory": memory, "writers": writers, "containers": containers}


def main(arguments: list[str] | None = None) -> int:
    """Run one mode; prints a table and writes JSON where asked."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.bench.run",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("mode", choices=MODES)
    parser.add_argument("--folder", type=Path, required=True, help="where recordings are kept")
    parser.add_argument("--seconds", type=float, default=60.0, help="length; default 60")
    parser.add_argument("--repeat", type=int, default=5, help="runs of each case; default 5")
    parser.add_argument("--peer-python", help="interpreter of an environment with ouster-sdk")
    parser.add_argument("--keep", action="store_true", help="memory: keep the longest recording")
    parser.add_argument("--json", type=Path, help="file for all measurements")
    options = parser.parse_args(arguments)
    options.folder = options.folder.resolve()
    try:
        result = MODES[options.mode](options)
    except BenchError as err:
        print(err, file=sys.stderr)
        return 1
    machine = {"cpus": os.cpu_count(), "machine": platform.machine(), "load": os.getloadavg()}
    result |= {"mode": options.mode, "python": platform.python_version(), "host": machine}
    if options.json:
        options.json.write_text(json.dumps(result, indent=1), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
