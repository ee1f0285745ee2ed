"""Compile the C sources of `mlbatch/native` while a wheel or an editable installation is built.

The library is loaded by ctypes, not imported, so one wheel serves every Python of its platform.
Where no compiler is found, the build asks for one that is a Python package (Zig's).
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

# No contraction of products and sums: every compiler and processor gives the same bytes. Square
# roots without errno, so that compilers make vectors of them.
FLAGS = (
    *("-std=c11", "-O3", "-ffp-contract=off", "-fno-math-errno"),
    *("-fvisibility=hidden", "-fPIC", "-shared"),
)
ZIG = "ziglang>=0.13"
LIBRARY = "mlbatch/native/_native.so"


def compiler() -> list[str]:
    """Command of the compiler: CC, that of Python, cc, gcc or clang; empty where there is none."""
    chosen = os.environ.get("CC")
    if chosen:
        return shlex.split(chosen)
    for name in (sysconfig.get_config_var("CC") or "", "cc", "gcc", "clang"):
        words = shlex.split(name)
        if words and shutil.which(words[0]):
            return words
    return []


class LibraryHook(BuildHookInterface):  # type: ignore[type-arg]
    """Build hook of hatchling, named in pyproject.toml."""

    def dependencies(self) -> list[str]:
        """Return what the build needs besides hatchling."""
        return [] if compiler() else [ZIG]

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile beside the sources, which Python finds in a clone, and into a wheel."""
        root = Path(self.root)
        self.work = tempfile.TemporaryDirectory()
        library = Path(self.work.name) / "_native.so"
        # Zig compiles for the very processor of this machine unless told.
        command = compiler() or [sys.executable, "-m", "ziglang", "cc", "-mcpu=baseline"]
        more = [
            *shlex.split(os.environ.get("CFLAGS", "")),
            *shlex.split(os.environ.get("ARCHFLAGS", "")),
        ]
        sources = sorted(str(path) for path in (root / "mlbatch" / "native").glob("*.c"))
        words = [*command, *FLAGS, *more, "-o", str(library), *sources]
        try:
            subprocess.run(words, check=True)
        except (OSError, subprocess.CalledProcessError) as err:
            raise SystemExit(
                f"mlbatch: expected a working C compiler, found: {err}; mend it, choose another "
                "by CC, or unset CC and install without any"
            ) from err
        try:
            # Whole or absent, also for a process that loads it now or another installation.
            partial = root / f"{LIBRARY}.{os.getpid()}.partial"
            shutil.copy(library, partial)
            os.replace(partial, root / LIBRARY)
        except OSError:
            # A wheel can be built from sources that cannot be written to.
            if version == "editable":
                raise
        if version != "editable":
            build_data["force_include"][str(library)] = LIBRARY
        build_data["pure_python"] = False
        platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["tag"] = f"py3-none-{platform}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove the work folder."""
        self.work.cleanup()
