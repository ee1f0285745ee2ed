"""Measures mlbatch on this machine, next to other programs: `python -m tests.bench --help`.

Programs of a case run alternately, every other round in reverse order, and are compared run by run,
so that a slow minute of the machine slows both sides.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Final

from mlbatch.errors import one_line
from mlbatch.units import NS_PER_S
from tests.bench.cases import CASES, PEERS, RECORDINGS, RIG, Conversion
from tests.bench.measure import BenchError, Usage, measure

_OUTPUT_OPTIONS: Final[Mapping[str, tuple[str, ...]]] = {
    "": ("--dry-run",),
    "mcap": ("-o", "out.mcap"),
    "npz": ("-o", "out", "--format", "npz"),
    "ply": ("-o", "out", "--format", "ply"),
}
STAGES: Final = ("read", "decode", "merge", "write")
HEAD: Final = (
    *("case", "program", "CPU s", "own s", "time s", "ns/slot", "x real", "MB"),
    *STAGES,
    *("CPU/first", "first/CPU", "first/own", "first/time", "spread %"),
)
# Cells aligned to the left.
_LEFT_CELLS: Final = 2


@dataclass(frozen=True, slots=True)
class Run:
    """One run of a program.

    own_cpu_s: without start and imports; slots: (channel, return) positions; stages_s: time by
    stage (STAGES), from the report of a conversion.
    """

    usage: Usage
    own_cpu_s: float
    slots: int = 0
    written_bytes: int = 0
    stages_s: tuple[float, ...] = ()


# -- measurements ---------------------------------------------------------------------------------


class Bench:
    """A benchmark: the folder of its recordings, and the folder in which programs run."""

    def __init__(self, options: argparse.Namespace, folder: Path, scratch: Path) -> None:
        self.seconds: float = options.seconds
        self.repeat: int = options.repeat
        # Not resolved: the python of an environment is a link; its path names the environment.
        self.peer_python = options.peer_python and str(options.peer_python.absolute())
        self.folder = folder
        self.scratch = scratch

    def measure(self, name: str) -> dict[str, list[Run]]:
        """Runs of all programs of a case, by name."""
        conversions = CASES[name]
        first = conversions[0]
        programs: dict[str, Callable[[], Run]] = {
            one.name: partial(self.convert, one) for one in conversions
        }
        # Not measured: the first runs compile modules.
        warm = [run() for run in programs.values()]
        programs["python with numpy"] = partial(self.other, "start")
        if first.output:
            size = str(warm[0].written_bytes)
            programs["plain write"] = partial(self.other, "write", size)
        kind = RECORDINGS[first.recording].sensors[0].kind
        if self.peer_python and not first.output:
            for peer in PEERS.get(kind, ()):
                programs[peer] = partial(self.peer, peer, first.recording)
        runs: dict[str, list[Run]] = {program: [] for program in programs}
        for number in range(self.repeat):
            order = list(programs.items())
            for program, run in order if number % 2 == 0 else reversed(order):
                runs[program].append(run())
                if runs[program][0].slots != runs[program][-1].slots:
                    raise BenchError(f"{name}, {program}: expected the same counts in every run")
        return runs

    def recording(self, name: str) -> Path:
        """Folder of a recording, which is made unless it exists."""
        folder = self.folder / f"{name}-{self.seconds:g}s"
        if not (folder / RECORDINGS[name].file).exists():
            folder.mkdir(exist_ok=True)
            module = [sys.executable, "-m", "tests.bench.recordings"]
            measure(name, [*module, name, str(self.seconds), str(folder)], self.scratch)
        return folder

    def convert(self, conversion: Conversion) -> Run:
        """Run a conversion."""
        folder = self.recording(conversion.recording)
        recording = folder / RECORDINGS[conversion.recording].file
        report_path = self.scratch / "report.json"
        command = [sys.executable, "-m", "mlbatch", "convert", str(recording), "--quiet"]
        command += ["--rig", str(folder / RIG), "--report", str(report_path), *conversion.options]
        command += _OUTPUT_OPTIONS[conversion.output]
        usage = measure(conversion.name, command, self.scratch)
        report = json.loads(report_path.read_text(encoding="utf-8"))
        timing = report["timing"]
        return Run(
            usage,
            own_cpu_s=float(timing["cpu_s"]),
            slots=sum(sensor["points"]["slots"] for sensor in report["sensors"]),
            written_bytes=self._delete_outputs(),
            stages_s=tuple(timing[f"{stage}_s"] for stage in STAGES),
        )

    def other(self, program: str, *arguments: str, python: str = sys.executable) -> Run:
        """Run a program of programs.py."""
        # As text: Python puts the folder of a script first in its search path.
        script = Path(__file__).with_name("programs.py").read_text(encoding="utf-8")
        result = self.scratch / "result.json"
        usage = measure(
            program, [python, "-c", script, program, str(result), *arguments], self.scratch
        )
        found = json.loads(result.read_text(encoding="utf-8"))
        self._delete_outputs()
        return Run(usage, found["own_cpu_s"], found.get("slots", 0))

    def peer(self, peer: str, name: str) -> Run:
        """Run a peer: its arguments are `PATH,X,Y,Z,YAW_DEG` of sensors with a file, or models."""
        folder = self.recording(name)
        arguments = [
            ",".join(map(str, (folder / one.file, *one.translation_m, one.yaw_deg)))
            if one.file
            else one.kind
            for one in RECORDINGS[name].sensors
        ]
        capture = str(folder / RECORDINGS[name].file)
        return self.other(peer, capture, *arguments, python=str(self.peer_python))

    def _delete_outputs(self) -> int:
        """Empty the folder in which programs run; returns the bytes of all but JSON files."""
        size = sum(
            path.stat().st_size
            for path in self.scratch.rglob("*")
            if path.is_file() and path.suffix != ".json"
        )
        shutil.rmtree(self.scratch)
        self.scratch.mkdir()
        return size


# -- table ----------------------------------------------------------------------------------------


def rows(case: str, recorded_s: float, runs: Mapping[str, Sequence[Run]]) -> Iterator[list[str]]:
    """One row per program, cells as in HEAD: medians, except the largest memory.

    Ratios are medians of pairs of runs; spread: the largest distance of a pair from the median of
    `CPU/first`.
    """
    first = next(iter(runs.values()))
    for program, own in runs.items():
        cpu_s = median(one.usage.cpu_s for one in own)
        wall_s = median(one.usage.wall_s for one in own)
        slots = own[0].slots
        stages_s = [median(values) for values in zip(*(one.stages_s for one in own), strict=True)]
        per_slot = [f"{s * NS_PER_S / slots:.2f}" if slots else "" for s in (cpu_s, *stages_s)]
        cells = [
            case,
            program,
            f"{cpu_s:.3f}",
            f"{median(one.own_cpu_s for one in own):.3f}",
            f"{wall_s:.3f}",
            per_slot[0],
            f"{recorded_s / wall_s:.1f}",
            f"{max(one.usage.rss_mb for one in own):.0f}",
            *(per_slot[1:] or [""] * len(STAGES)),
        ]
        if own is not first:
            pairs = list(zip(first, own, strict=True))
            cpu = [two.usage.cpu_s / one.usage.cpu_s for one, two in pairs]
            inverse = [
                median(1 / value for value in cpu),
                median(one.own_cpu_s / max(two.own_cpu_s, 1e-9) for one, two in pairs),
                median(one.usage.wall_s / two.usage.wall_s for one, two in pairs),
            ]
            spread = max(abs(value / median(cpu) - 1) for value in cpu)
            cells += [f"{value:.2f}" for value in (median(cpu), *inverse)]
            cells.append(f"{100 * spread:.0f}")
        yield cells + [""] * (len(HEAD) - len(cells))


def aligned(table: Sequence[Sequence[str]]) -> list[str]:
    """Rows as lines."""
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    return [
        "  ".join(
            cell.ljust(width) if column < _LEFT_CELLS else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in table
    ]


# -- command line ---------------------------------------------------------------------------------


def parser() -> argparse.ArgumentParser:
    """The options."""
    options = argparse.ArgumentParser(
        "python -m tests.bench",
        description="Measure conversions of standard recordings: CPU, time and memory, "
        "next to other programs.",
    )
    options.add_argument("--seconds", type=float, default=12.0, help="length of a recording, s")
    options.add_argument("--repeat", type=int, default=5, help="runs of each program")
    options.add_argument(
        "--case", action="append", choices=CASES, help="measure this case only; repeatable"
    )
    options.add_argument(
        "--peer-python", type=Path, help="Python that has ouster-sdk and velodyne-decoder"
    )
    options.add_argument("--keep", type=Path, help="folder to keep and reuse the recordings in")
    return options


def main(arguments: list[str] | None = None) -> None:
    """Measure, print the table."""
    options = parser().parse_args(arguments)
    table: list[Sequence[str]] = [HEAD]
    print(f"{platform.platform()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    print(f"{options.seconds:g} s of recording, medians of {options.repeat} runs, MB: largest")
    try:
        with TemporaryDirectory(prefix="mlbatch-bench-", dir=options.keep) as scratch:
            folder = options.keep or Path(scratch)
            bench = Bench(options, folder.resolve(), Path(scratch).resolve() / "run")
            bench.scratch.mkdir()
            for case in options.case or CASES:
                table += rows(case, bench.seconds, bench.measure(case))
    except (BenchError, OSError) as err:
        sys.exit(one_line(f"bench: error: {err}"))
    print("\n".join(aligned(table)))


if __name__ == "__main__":
    main()
