"""The compiled library: its declarations, and what happens without it."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

import mlbatch
from mlbatch import native
from mlbatch.errors import UsageError
from mlbatch.native import library, require_library
from tests.builders.run import TWO_LIDARS, command
from tests.contract.tree import PACKAGE

SOURCES = PACKAGE / "native"
HEADER = (SOURCES / "native.h").read_text(encoding="utf-8")


@pytest.fixture
def _fresh() -> Iterator[None]:
    """The library is looked up anew, before and after."""
    library.library.cache_clear()
    library.trouble.cache_clear()
    yield
    library.library.cache_clear()
    library.trouble.cache_clear()


@pytest.mark.usefixtures("_fresh")
def test_without_the_library_nothing_is_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(library, "library_path", lambda: None)
    capture, rig = TWO_LIDARS / "two_lidars.pcap", TWO_LIDARS / "rig.yaml"
    out = tmp_path / "out.mcap"
    done = command("convert", capture, "--rig", rig, "-o", out)
    assert done.code == 2
    assert done.err == (
        "mlbatch: error: expected the compiled library of mlbatch, found none, since it was not "
        "compiled when mlbatch was installed; reinstall mlbatch, which compiles it\n"
    )
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("_fresh")
def test_a_damaged_library_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "broken.so"
    path.write_bytes(b"\x7fELF" + bytes(100))
    monkeypatch.setenv("MLBATCH_NATIVE", str(path))
    assert native.library_path() == path
    with pytest.raises(UsageError, match=r"broken\.so"):
        require_library()


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
@pytest.mark.usefixtures("_fresh")
def test_a_library_of_another_version_is_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "other.so"
    flags = ["-std=c11", "-shared", "-fPIC"]
    text = HEADER.replace(f"MLBATCH_ABI {library._ABI}", f"MLBATCH_ABI {library._ABI + 1}")
    for source in SOURCES.glob("*.c"):
        (tmp_path / source.name).write_text(source.read_text(encoding="utf-8"), encoding="utf-8")
    (tmp_path / "native.h").write_text(text, encoding="utf-8")
    files = [str(one) for one in tmp_path.glob("*.c")]
    subprocess.run(["cc", *flags, "-o", str(path), *files], check=True)
    monkeypatch.setenv("MLBATCH_NATIVE", str(path))
    with pytest.raises(UsageError, match=r"other\.so of another version"):
        require_library()


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_the_engine_is_built_where_a_compiler_is() -> None:
    """Otherwise all tests of it would be skipped."""
    assert library.trouble() == ""


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_the_sources_have_no_warnings(tmp_path: Path) -> None:
    flags = ["-std=c11", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-fsyntax-only"]
    sources = [str(one) for one in sorted(SOURCES.glob("*.c"))]
    done = subprocess.run(["cc", *flags, *sources], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("name", ["auto", "numpy", "native"])
def test_the_engine_is_ignored_with_a_note(name: str) -> None:
    capture = TWO_LIDARS / "two_lidars.pcap"
    rig = TWO_LIDARS / "rig.yaml"
    done = command("convert", capture, "--rig", rig, "--dry-run", "--engine", name)
    assert done.code == 0
    assert "mlbatch: --engine is ignored, since everything is compiled" in done.err


def test_the_version_says_whether_the_library_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    assert command("--version").out == f"mlbatch {mlbatch.__version__}\n"
    monkeypatch.setattr(library, "trouble", lambda: "")
    assert command("--version", "-v").out.splitlines()[1] == "compiled library: found"
    monkeypatch.setattr(library, "trouble", lambda: "none")
    line = command("--version", "--verbose").out.splitlines()[1]
    assert line == "no compiled library: none; reinstall mlbatch, which compiles it"
