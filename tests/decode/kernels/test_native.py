"""Kernels are compiled once and cached, and compiled again if the cache entry is not usable."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from mlbatch.decode import kernels
from mlbatch.decode.kernels import _probe_source as probe
from mlbatch.decode.kernels import native
from mlbatch.errors import UsageError
from tests.contract.tree import ROOT
from tests.decode.kernels.sources import SUMS, needs_numba, total

pytestmark = needs_numba


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache folder, in a process that has loaded nothing."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(native, "_loaded", {})
    return tmp_path / "mlbatch"


def forget(monkeypatch: pytest.MonkeyPatch) -> None:
    """As a new process does."""
    monkeypatch.setattr(native, "_loaded", {})


def refuse(monkeypatch: pytest.MonkeyPatch) -> None:
    """From here on, compiling fails."""
    monkeypatch.setattr("mlbatch.decode.kernels._compile.compiled", None)


def test_a_kernel_computes(folder: Path) -> None:
    assert total([1, 2, 4], 3) == 21
    assert total([], 3) == 0


def test_it_is_compiled_once(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert not native.is_kept(SUMS, 3)
    assert total([1, 2], 3) == 9
    assert native.is_kept(SUMS, 3)
    forget(monkeypatch)
    refuse(monkeypatch)
    assert total([1, 2], 3) == 9
    with pytest.raises(TypeError):
        total([1, 2], 4)


def test_constants_make_other_kernels(folder: Path) -> None:
    assert [total([5], times) for times in (1, 2, 1)] == [5, 10, 5]
    assert len(list(folder.glob("*.kernel"))) == 2


@pytest.mark.parametrize("damage", ["", "short", "bit", "text"])
def test_a_damaged_entry_is_compiled_anew(
    damage: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    total([1], 3)
    (entry,) = folder.glob("*.kernel")
    whole = entry.read_bytes()
    turned = bytearray(whole)
    turned[len(whole) // 2] ^= 1
    entry.write_bytes({"": b"", "short": whole[:-1], "bit": bytes(turned)}.get(damage, b"text"))
    forget(monkeypatch)
    assert total([1], 3) == 3
    assert native.is_kept(SUMS, 3)


def test_other_versions_and_processors_have_entries_of_their_own(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    total([1], 3)
    for number, identity in enumerate((b"other numba", b"other CPU")):
        forget(monkeypatch)
        monkeypatch.setattr(native, "_machine_identity", lambda identity=identity: identity)
        assert total([1], 3) == 3
        assert len(list(folder.glob("*.kernel"))) == number + 2


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="a system without users")
def test_a_folder_of_others_is_not_used(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder.mkdir()
    folder.chmod(0o777)
    assert native.cache_folder() is None
    assert total([1], 3) == 3
    assert not list(folder.iterdir())
    folder.chmod(0o700)
    monkeypatch.setattr(os, "geteuid", lambda: folder.stat().st_uid + 1)
    assert native.cache_folder() is None


def test_without_a_folder_it_is_compiled_in_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    forget(monkeypatch)
    assert native.cache_folder() is None
    assert total([2], 3) == 6


def test_a_folder_that_cannot_be_written_to_is_no_error(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: object, **__: object) -> None:
        raise PermissionError

    monkeypatch.setattr("tempfile.mkstemp", refused)
    assert total([2], 3) == 6
    assert not list(folder.iterdir())


def test_old_entries_go(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(native, "_MOST_ENTRIES", 2)
    folder.mkdir()
    stale = folder / "old.kernel"
    stale.write_text("")
    os.utime(stale, (1, 1))
    for times in (1, 2):
        total([1], times)
    assert len(list(folder.glob("*.kernel"))) == 2
    assert not stale.exists()


def test_the_folder_follows_the_user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert native.cache_folder() == tmp_path / ".cache" / "mlbatch"


def test_threads_share_a_kernel(folder: Path) -> None:
    found: list[int] = []
    threads = [threading.Thread(target=lambda: found.append(total([1, 2], 5))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [15] * 4


def test_processes_that_compile_at_once_do_not_disturb_each_other(tmp_path: Path) -> None:
    code = "from tests.decode.kernels.sources import total; print(total([1, 2], 5))"
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path), "PYTHONPATH": str(ROOT)}
    running = [
        subprocess.Popen(
            [sys.executable, "-c", code], env=environment, cwd=ROOT, stdout=subprocess.PIPE
        )
        for _ in range(2)
    ]
    assert [process.communicate()[0].strip() for process in running] == [b"15"] * 2
    assert len(list((tmp_path / "mlbatch").iterdir())) == 1


def test_what_is_kept_is_loaded_without_numba(folder: Path) -> None:
    total([1, 2], 5)
    code = (
        "import sys; from tests.decode.kernels.sources import total\n"
        "print(total([1, 2], 5), 'numba' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["15", "False"]


def test_auto_waits_for_long_recordings(folder: Path) -> None:
    assert kernels.choose_engine("auto", kernels.AUTO_BYTES - 1) == "numpy"
    assert kernels.choose_engine("auto", kernels.AUTO_BYTES) == "numba"
    assert kernels.choose_engine("numba", 0) == "numba"
    assert kernels.choose_engine("numpy", 1 << 40) == "numpy"


def test_without_numba_auto_is_numpy_and_numba_an_error(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    assert kernels.choose_engine("auto", 1 << 40) == "numpy"
    with pytest.raises(UsageError, match=r"not installed here; `pip install mlbatch\[fast\]`"):
        kernels.choose_engine("numba", 0)


def test_a_numba_that_does_not_load_is_as_good_as_none(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(source: str, constants: tuple[native.Constant, ...]) -> None:
        raise ImportError(f"numba needs\nanother numpy for {probe.__name__ in source}")

    monkeypatch.setattr("mlbatch.decode.kernels._compile.compiled", broken)
    assert kernels.choose_engine("auto", 1 << 40) == "numpy"
    with pytest.raises(UsageError, match="got numba needs another numpy"):
        kernels.choose_engine("numba", 0)
