"""Order of what reaches the disk: data, report, name; in every format, new and replaced."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from mlbatch.writers import atomic, durable
from tests.builders.run import command
from tests.builders.sessions import FIXTURE

FORMATS = ("mcap", "rosbag1", "rosbag2", "npz", "ply")
TARGETS = {"mcap": "out.mcap", "rosbag1": "out.bag"}


@dataclass
class Disk:
    """What is on the disk in the end of a power cut at any time, by the calls that a run made.

    A sync saves the content of a file or the names in a folder; a rename counts as saved only by a
    later sync of its folder. synced: content that was saved, by path at that time.
    """

    root: Path
    synced: dict[Path, bytes] = field(default_factory=dict)
    log: list[tuple[str, Path]] = field(default_factory=list)

    def sync(self, path: Path) -> None:
        """Called instead of fsync."""
        self.log.append(("entries" if path.is_dir() else "data", path))
        if path.is_file():
            self.synced[path] = path.read_bytes()

    def sync_all(self, path: Path) -> bool:
        """Called instead of syncfs."""
        for one in path.rglob("*"):
            if one.is_file():
                self.synced[one] = one.read_bytes()
        self.log.append(("all", path))
        return True

    def move(self, source: Path, target: Path) -> None:
        """Called before a rename: what gets a new name has to be saved under the old one."""
        self.log.append(("rename", target))
        if ".old." in target.name:
            return
        for one in [source, *source.rglob("*")] if source.is_dir() else [source]:
            if one.is_file():
                saved = self.synced.get(one)
                assert saved == one.read_bytes(), f"{one} is renamed before it is on the disk"
                self.synced[target / one.relative_to(source)] = saved


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Disk:
    monkeypatch.chdir(tmp_path)
    disk = Disk(tmp_path)
    rename = Path.rename
    replace: Callable[[Path, Path], None] = os.replace

    def renamed(source: Path, target: Path) -> Path:
        disk.move(Path(source), Path(target))
        return rename(source, target)

    def replaced(source: Path, target: Path) -> None:
        disk.move(Path(source), Path(target))
        replace(source, target)

    monkeypatch.setattr(Path, "rename", renamed)
    monkeypatch.setattr(os, "replace", replaced)
    monkeypatch.setattr(durable, "_sync", disk.sync)
    monkeypatch.setattr(durable, "_sync_file_system", disk.sync_all)
    return disk


def _convert(name: str, *options: str) -> str:
    target = TARGETS.get(name, "out")
    rig = ("--rig", FIXTURE / "rig.yaml")
    run = command(
        *("convert", FIXTURE / "two_lidars.pcap", *rig, "-o", target),
        *("--format", name, "--quiet", *options),
    )
    assert (run.code, run.err) == (0, "")
    return target


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("by_one_call", [True, False])
def test_data_are_on_the_disk_before_they_have_their_name(
    name: str, by_one_call: bool, disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not by_one_call:
        monkeypatch.setattr(durable, "_sync_file_system", lambda path: False)
    for option in ((), ("--overwrite",)):
        disk.log.clear()
        target = _convert(name, *option)
        renames = [at for at, (what, path) in enumerate(disk.log) if what == "rename"]
        last = [path.name for what, path in disk.log if what == "rename"][-1]
        assert last == target
        # Its name, too, by the next call.
        assert disk.log[renames[-1] + 1] == ("entries", Path())
        data = [path.name for _, path in disk.log].index(f"{target}.partial")
        reports = [at for at in renames if "report.json" in disk.log[at][1].name]
        assert len(reports) == 1
        assert data < reports[0] < renames[-1]


@pytest.mark.parametrize("name", ["mcap", "npz"])
def test_a_replaced_output_is_kept_until_the_new_one_has_its_name(
    name: str, disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The old folder is removed only after the new name is on the disk."""
    removed: list[int] = []
    remove = shutil.rmtree

    def removing(path: Path, *given: object) -> None:
        if ".old." in Path(path).name:
            removed.append(len(disk.log))
        remove(path)

    _convert(name)
    disk.log.clear()
    monkeypatch.setattr(shutil, "rmtree", removing)
    _convert(name, "--overwrite")
    names = [at for at, (what, path) in enumerate(disk.log) if path == Path() and what == "entries"]
    if name == "npz":
        assert len(removed) == 1
        assert names[0] < removed[0]


def test_a_report_elsewhere_is_on_the_disk_with_its_name(disk: Disk) -> None:
    Path("reports").mkdir()
    _convert("mcap", "--report", "reports/a.json")
    at = disk.log.index(("rename", Path("reports/a.json")))
    assert disk.log[at - 1] == ("data", Path("reports/a.json.partial"))
    assert disk.log[at + 1] == ("entries", Path("reports"))


@pytest.mark.parametrize("name", FORMATS)
def test_nothing_is_synced_without_it(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)

    def refuse(path: Path) -> None:
        raise AssertionError(path)

    for module in (atomic, durable):
        monkeypatch.setattr(module, "sync_to_disk", refuse)
        monkeypatch.setattr(module, "sync_entries", refuse)
    monkeypatch.setattr(os, "fsync", refuse)
    target = _convert(name, "--no-fsync")
    assert Path(target).exists()


def test_both_ways_sync_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Real calls: a folder of files and folders, with and without syncfs."""
    (tmp_path / "left").mkdir()
    for name in ("a", "left/b"):
        (tmp_path / name).write_bytes(b"scan")
    durable.sync_to_disk(tmp_path)
    synced = []
    fsync = os.fsync

    def noting(descriptor: int) -> None:
        synced.append(os.readlink(f"/proc/self/fd/{descriptor}"))
        fsync(descriptor)

    monkeypatch.setattr(durable, "_sync_file_system", lambda path: False)
    monkeypatch.setattr(os, "fsync", noting)
    durable.sync_to_disk(tmp_path)
    place = [synced.index(str(tmp_path / name)) for name in ("left/b", "left", "")[:2]]
    assert sorted(synced) == sorted(
        str(path) for path in (tmp_path, tmp_path / "a", tmp_path / "left", tmp_path / "left/b")
    )
    assert place == sorted(place)


@pytest.mark.parametrize(("code", "is_raised"), [(5, True), (28, True), (22, False), (13, False)])
def test_folders_that_cannot_be_synced(
    code: int, is_raised: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """EIO and ENOSPC are lost data; some file systems (EINVAL) and rights (EACCES) allow none."""

    def failing(descriptor: int) -> None:
        raise OSError(code, "refused")

    monkeypatch.setattr(os, "fsync", failing)
    if is_raised:
        with pytest.raises(OSError, match="refused"):
            durable.sync_entries(tmp_path)
    else:
        durable.sync_entries(tmp_path)


def test_data_that_do_not_reach_the_disk_are_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)

    def failing(descriptor: int) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(os, "fsync", failing)
    run = command(
        *("convert", FIXTURE / "two_lidars.pcap", "--rig", FIXTURE / "rig.yaml"),
        *("-o", "out.mcap", "--quiet"),
    )
    assert run.code == 1
    assert run.err.startswith(
        "mlbatch: error: out.mcap.partial: expected to write it, found 'Input/output error'; "
    )
    assert not Path("out.mcap").exists()
