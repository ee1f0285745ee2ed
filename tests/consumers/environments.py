"""Environments of the consumers: `.venv-consumers/NAME`, made once, and how programs run there."""

from __future__ import annotations

import ctypes
import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
PLACE = ROOT / ".venv-consumers"
PROGRAMS = Path(__file__).resolve().parent / "programs"
_STAMP = "installed.txt"
_INSTALL_S = 1800
_RUN_S = 600


@dataclass(frozen=True, slots=True)
class Environment:
    """Packages of PyPI or npm; versions: those that docs/formats.md names."""

    name: str
    packages: tuple[str, ...]

    @property
    def folder(self) -> Path:
        """Where it is."""
        return PLACE / self.name

    @property
    def is_node(self) -> bool:
        """Packages of npm."""
        return self.name == "node"


ENVIRONMENTS = {
    one.name: one
    for one in (
        # Its folder reader opens PLY files by Open3D, its MCAP reader needs mcap-ros2-support.
        Environment(
            "kiss-icp",
            ("kiss-icp==1.3.0", "rosbags==0.11.9", "open3d==0.20.0", "mcap-ros2-support==0.6.0"),
        ),
        Environment("genz-icp", ("genz-icp==0.3.2", "rosbags==0.11.9")),
        Environment("rko-lio", ("rko_lio==0.4.0", "rosbags==0.11.9")),
        Environment("small-gicp", ("small_gicp==1.0.1", "numpy")),
        Environment("open3d", ("open3d==0.20.0",)),
        Environment("pypcd4", ("pypcd4==1.5.1",)),
        Environment("laspy", ("laspy==2.7.0", "lazrs==0.8.2")),
        Environment("rerun", ("rerun-sdk==0.41.0",)),
        Environment("rosbags", ("rosbags==0.11.9",)),
        Environment("mcap-ros2", ("mcap-ros2-support==0.6.0", "numpy")),
        Environment("ouster-sdk", ("ouster-sdk==1.0.1",)),
        Environment("velodyne-decoder", ("velodyne-decoder==3.1.0",)),
        Environment("polars", ("polars==2.1.0",)),
        Environment("pandas", ("pandas==3.1.1",)),
        Environment(
            "node",
            (
                *("@mcap/core@2.2.2", "@mcap/nodejs@1.0.2"),
                *("@foxglove/rosmsg@5.0.5", "@foxglove/rosmsg2-serialization@3.1.0"),
            ),
        ),
    )
}


@cache
def made(name: str) -> Path:
    """The folder of an environment, made if its packages changed."""
    environment = ENVIRONMENTS[name]
    stamp = environment.folder / _STAMP
    wanted = "\n".join((sys.version if not environment.is_node else "", *environment.packages))
    if stamp.is_file() and stamp.read_text(encoding="utf-8") == wanted:
        return environment.folder
    shutil.rmtree(environment.folder, ignore_errors=True)
    environment.folder.mkdir(parents=True)
    if environment.is_node:
        npm = _program("npm")
        (environment.folder / "package.json").write_text("{}", encoding="utf-8")
        command = [npm, "install", "--no-audit", "--no-fund", *environment.packages]
        _run(command, environment.folder, _INSTALL_S)
    else:
        _run([sys.executable, "-m", "venv", str(environment.folder)], ROOT, _INSTALL_S)
        pip = ["-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        python = str(environment.folder / "bin" / "python")
        _run([python, *pip, *environment.packages], ROOT, _INSTALL_S)
    stamp.write_text(wanted, encoding="utf-8")
    return environment.folder


def read_by(name: str, *arguments: str | Path, program: str = "") -> Any:
    """What the program of a consumer prints, a JSON document; program: with another name."""
    folder = made(name)
    stem = program or "read_" + name.replace("-", "_")
    if ENVIRONMENTS[name].is_node:
        source = PROGRAMS / f"{stem}.mjs"
        # Modules are looked up from the folder of the program.
        copy = folder / source.name
        shutil.copy(source, copy)
        command = [_program("node"), str(copy)]
    else:
        command = [str(folder / "bin" / "python"), str(PROGRAMS / f"{stem}.py")]
    printed = _run([*command, *map(str, arguments)], folder)
    # Consumers print lines of their own before the document.
    return json.loads(printed.strip().splitlines()[-1])


def run_in(name: str, *command: str | Path) -> str:
    """What a command of a consumer prints."""
    folder = made(name)
    program, *arguments = map(str, command)
    return _run([str(folder / "bin" / program), *arguments], folder)


def run_of_system(*command: str | Path, cwd: Path) -> str:
    """What a program of the system prints; skips the test without it."""
    program, *arguments = map(str, command)
    return _run([_program(program), *arguments], cwd)


def need_library(name: str) -> None:
    """Skip the test without a library of the system that packages expect."""
    try:
        ctypes.CDLL(name)
    except OSError:
        pytest.skip(f"{name} is not installed (docs/formats.md says which package has it)")


def _program(name: str) -> str:
    found = shutil.which(name)
    if found is None:
        pytest.skip(f"{name} is not installed (docs/formats.md says which package has it)")
    return found


def _run(command: list[str], cwd: Path, seconds: float = _RUN_S) -> str:
    # Without mlbatch on the path, without a display.
    clean = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        cwd=cwd,
        env=clean | {"QT_QPA_PLATFORM": "offscreen", "NO_COLOR": "1"},
        timeout=seconds,
        check=False,
    )
    assert done.returncode == 0, f"{' '.join(command)}\n{done.stdout[-4000:]}{done.stderr[-4000:]}"
    return done.stdout
